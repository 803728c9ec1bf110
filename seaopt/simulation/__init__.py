"""Discretisation, integrators and compiled kernels: a plant and a log in, outputs and sensitivities out."""

from seaopt.simulation.discretisation import Clock, Hold, transition
from seaopt.simulation.integrator import count_stable_steps, find_stable_steps
from seaopt.simulation.model import Model, depends_on_time, linearise, make_model
from seaopt.simulation.native import threads
from seaopt.simulation.passes import Layout, Pass, Point, RobustLoss, Segment, Weights, layout_of
from seaopt.simulation.run import double_sum, keep_part, keep_passes, measure_room, run_passes, stream
from seaopt.simulation.simulate import simulate

__all__ = [
    "Clock", "Hold", "Layout", "Model", "Pass", "Point", "RobustLoss", "Segment", "Weights", "count_stable_steps",
    "depends_on_time", "double_sum", "find_stable_steps", "keep_part", "keep_passes", "layout_of", "linearise",
    "make_model", "measure_room", "run_passes", "simulate", "stream", "threads", "transition",
]  # fmt: skip
