"""Loop algebra, controller structures and the tuner."""

from seaopt.control.controller import Controller
from seaopt.control.digital import DigitalPlant, sample
from seaopt.control.law import Gains, TransferFunction
from seaopt.control.loop import Loop, LoopFigures
from seaopt.control.spec import ControllerSpec
from seaopt.control.tuner import current_per_force, tune

__all__ = [
    "Controller", "ControllerSpec", "DigitalPlant", "Gains", "Loop", "LoopFigures", "TransferFunction",
    "current_per_force", "sample", "tune",
]  # fmt: skip
