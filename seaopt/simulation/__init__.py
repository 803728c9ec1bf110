"""Discretisation, integrators and compiled kernels: a plant and a log in, outputs and sensitivities out."""

from seaopt.simulation.discretisation import Clock, Hold, transition
from seaopt.simulation.model import Model, linearised, make_model
from seaopt.simulation.passes import Pass, Point, Segment, Weights
from seaopt.simulation.run import run_pass
from seaopt.simulation.simulate import simulate

__all__ = [
    "Clock", "Hold", "Model", "Pass", "Point", "Segment", "Weights", "linearised", "make_model", "run_pass",
    "simulate", "transition",
]  # fmt: skip
