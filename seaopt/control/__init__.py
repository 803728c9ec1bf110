"""Loop algebra, controller structures and the tuner."""

from seaopt.control.controller import Controller
from seaopt.control.digital import DigitalPlant, sample
from seaopt.control.frontier import Frontier, sweep
from seaopt.control.law import Gains, Notch, Observer, TransferFunction
from seaopt.control.loop import Loop, LoopFigures
from seaopt.control.scenarios import corners, draw
from seaopt.control.spec import ControllerSpec
from seaopt.control.tuner import current_per_force, tune

__all__ = [
    "Controller", "ControllerSpec", "DigitalPlant", "Frontier", "Gains", "Loop", "LoopFigures", "Notch", "Observer",
    "TransferFunction", "corners", "current_per_force", "draw", "sample", "sweep", "tune",
]  # fmt: skip
