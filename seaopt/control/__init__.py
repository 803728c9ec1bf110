"""Loop algebra, controller structures, the tuner, laws that run, the state estimator and predictive control."""

from seaopt.control.compensation.compensate import add_compensation
from seaopt.control.compensation.ripple_fit import RippleFit, identify_ripple
from seaopt.control.deploy.export import export
from seaopt.control.frontier.free_law import FreeLaw, bound_free_law
from seaopt.control.frontier.frontier import sweep
from seaopt.control.frontier.rows import Frontier
from seaopt.control.given.assessment import assess
from seaopt.control.given.law_file import GivenLaw, read_law
from seaopt.control.given.pid_forms import cascade_pid, drive_pid, ideal_pid, parallel_pid
from seaopt.control.impedance.critical_damping import critical_impedance
from seaopt.control.impedance.region import ImpedanceRegion, passive_region
from seaopt.control.impedance.rendering import Rendering, add_impedance, render
from seaopt.control.impedance.scorecard import Score, Scorecard, scorecard
from seaopt.control.laws.command import Command, command_of
from seaopt.control.laws.controller import Controller
from seaopt.control.laws.passivity import Passivity, passivity, passivity_rows
from seaopt.control.laws.plausibility import GateState, PlausibilityGate
from seaopt.control.laws.realisation import LawState, RunnableLaw, realise, runnable
from seaopt.control.laws.spec import ControllerSpec
from seaopt.control.laws.structures import DisturbanceObserver, Gains, Notch, Prefilter
from seaopt.control.loops.compensation.link_feedforward import LinkFeedforward, LinkPath
from seaopt.control.loops.compensation.ripple_term import CompensateRipple
from seaopt.control.loops.compensation.terms import CompensateFriction, CompensateGravity, Compensation
from seaopt.control.loops.law import Law
from seaopt.control.loops.loop import Loop, LoopFigures
from seaopt.control.loops.margins import DiskMargin, Margins, margins, nu_gap
from seaopt.control.loops.outer_loop import Impedance, OuterLoop
from seaopt.control.loops.sampled_plant import DigitalPlant, sample
from seaopt.control.loops.transfer_function import TransferFunction
from seaopt.control.mpc.estimator import Estimator, EstimatorRun, EstimatorState, estimator
from seaopt.control.mpc.export import export_mpc
from seaopt.control.mpc.innovations import estimate_noise
from seaopt.control.mpc.mpc import ForceMPC, force_mpc
from seaopt.control.mpc.noise import NoiseModel
from seaopt.control.mpc.spec import MPCSpec
from seaopt.control.mpc.step import MPCState, MPCStep
from seaopt.control.running.closed_loop import run_loop
from seaopt.control.running.force_run import ForceRun, close_loop
from seaopt.control.running.sampled_loop import SampledLoop
from seaopt.control.scheduling.compensation import compensate_schedule
from seaopt.control.scheduling.gain_table import GainTable
from seaopt.control.scheduling.runnable_schedule import RunnableSchedule, ScheduleState
from seaopt.control.scheduling.scheduled_controller import ScheduledController
from seaopt.control.scheduling.tuning import tune_schedule
from seaopt.control.tuning.corners import corners, draw
from seaopt.control.tuning.tuner import tune

__all__ = [
    "Command", "CompensateFriction", "CompensateGravity", "CompensateRipple", "Compensation", "Controller",
    "ControllerSpec", "DigitalPlant", "DiskMargin", "DisturbanceObserver", "Estimator", "EstimatorRun",
    "EstimatorState", "ForceMPC", "ForceRun", "FreeLaw", "Frontier", "GainTable", "Gains", "GateState", "GivenLaw",
    "Impedance", "ImpedanceRegion", "Law", "LawState", "LinkFeedforward", "LinkPath", "Loop", "LoopFigures",
    "MPCSpec", "MPCState", "MPCStep", "Margins", "NoiseModel", "Notch", "OuterLoop", "Passivity",
    "PlausibilityGate", "Prefilter", "Rendering", "RippleFit", "RunnableLaw", "RunnableSchedule", "SampledLoop",
    "ScheduleState", "ScheduledController", "Score", "Scorecard", "TransferFunction", "add_compensation",
    "add_impedance", "assess", "bound_free_law", "cascade_pid", "close_loop", "command_of", "compensate_schedule",
    "corners", "critical_impedance", "draw", "drive_pid", "estimate_noise", "estimator", "export", "export_mpc",
    "force_mpc", "ideal_pid", "identify_ripple", "margins", "nu_gap", "parallel_pid", "passive_region", "passivity",
    "passivity_rows", "read_law", "realise", "render", "run_loop", "runnable", "sample", "scorecard", "sweep",
    "tune", "tune_schedule",
]  # fmt: skip
