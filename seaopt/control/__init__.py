"""Loop algebra, controller structures, the tuner, the state estimator and predictive control within limits."""

from seaopt.control.controller import Controller
from seaopt.control.digital import DigitalPlant, sample
from seaopt.control.estimator import Estimator, EstimatorRun, EstimatorState, estimator
from seaopt.control.force_run import ForceRun, close_loop
from seaopt.control.innovations import estimate_noise
from seaopt.control.law import Gains, TransferFunction
from seaopt.control.loop import Loop, LoopFigures
from seaopt.control.mpc import ForceMPC, MPCState, MPCStep, force_mpc
from seaopt.control.mpc_code import export_mpc
from seaopt.control.mpc_spec import MPCSpec
from seaopt.control.noise import NoiseModel
from seaopt.control.spec import ControllerSpec
from seaopt.control.tuner import current_per_force, tune

__all__ = [
    "Controller", "ControllerSpec", "DigitalPlant", "Estimator", "EstimatorRun", "EstimatorState", "ForceMPC",
    "ForceRun", "Gains", "Loop", "LoopFigures", "MPCSpec", "MPCState", "MPCStep", "NoiseModel",
    "TransferFunction", "close_loop", "current_per_force", "estimate_noise", "estimator", "export_mpc", "force_mpc",
    "sample", "tune",
]  # fmt: skip
