"""The pass, compiled where there is a compiler and interpreted where there is none."""

from __future__ import annotations

from seaopt.simulation.compiled import compiled_pass
from seaopt.simulation.interpreted import interpreted_pass
from seaopt.simulation.model import Model
from seaopt.simulation.passes import Pass, Point, Segment, Weights


def run_pass(
    model: Model,
    segment: Segment,
    point: Point,
    weights: Weights | None = None,
    *,
    outputs: bool = False,
    columns: bool = False,
    states: bool = False,
) -> Pass:
    """Run one pass over a segment.

    Parameters
    ----------
    model, segment, point, weights
        What is simulated, on which data, with which unknowns, and how residuals are weighted (not at all if None).
    outputs, columns, states : bool
        Keep the model outputs, the residuals with their derivatives, the state trajectory.

    Returns
    -------
    Pass
        Numbers that are not finite where the simulation left what floats can hold.

    """
    chosen = weights if weights is not None else Weights.plain(model.ny)
    keep = {"outputs": outputs, "columns": columns, "states": states}
    result = compiled_pass(model, segment, point, chosen, **keep)
    return result if result is not None else interpreted_pass(model, segment, point, chosen, **keep)
