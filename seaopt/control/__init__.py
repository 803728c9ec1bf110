"""Loop algebra, controller structures, the tuner, laws that run, the state estimator and predictive control."""

from seaopt.control.closed_loop import run_loop
from seaopt.control.controller import Controller
from seaopt.control.digital import DigitalPlant, sample
from seaopt.control.estimator import Estimator, EstimatorRun, EstimatorState, estimator
from seaopt.control.export import export
from seaopt.control.force_run import ForceRun, close_loop
from seaopt.control.frontier import Frontier, sweep
from seaopt.control.innovations import estimate_noise
from seaopt.control.law import Gains, Notch, Observer, TransferFunction
from seaopt.control.loop import Loop, LoopFigures
from seaopt.control.margins import DiskMargin, Margins, margins, nu_gap
from seaopt.control.mpc import ForceMPC, MPCState, MPCStep, force_mpc
from seaopt.control.mpc_code import export_mpc
from seaopt.control.mpc_spec import MPCSpec
from seaopt.control.noise import NoiseModel
from seaopt.control.passivity import Passivity, passivity, passivity_rows
from seaopt.control.realisation import LawState, RunnableLaw, realise, runnable
from seaopt.control.sampled_loop import SampledLoop
from seaopt.control.scenarios import corners, draw
from seaopt.control.spec import ControllerSpec
from seaopt.control.tuner import current_per_force, tune

__all__ = [
    "Controller", "ControllerSpec", "DigitalPlant", "DiskMargin", "Estimator", "EstimatorRun", "EstimatorState",
    "ForceMPC", "ForceRun", "Frontier", "Gains", "LawState", "Loop", "LoopFigures", "MPCSpec", "MPCState", "MPCStep",
    "Margins", "NoiseModel", "Notch", "Observer", "Passivity", "RunnableLaw", "SampledLoop", "TransferFunction",
    "close_loop", "corners", "current_per_force", "draw", "estimate_noise", "estimator", "export", "export_mpc",
    "force_mpc", "margins", "nu_gap", "passivity", "passivity_rows", "realise", "run_loop", "runnable", "sample",
    "sweep", "tune",
]  # fmt: skip
