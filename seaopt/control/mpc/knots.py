"""Where the command of a plan is free, and the straight lines between."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int


def spread_knots(samples: int, moves: int) -> Int[np.ndarray, " n"]:
    """Return `moves` samples from 0 to samples - 1, each step longer than the last by about a constant factor."""
    low, high = 1.0, 10.0
    for _ in range(80):  # the factor for which `moves` - 1 steps reach the end
        factor = 0.5 * (low + high)
        if _space_knots(factor, moves)[-1] < samples - 1:
            low = factor
        else:
            high = factor
    knots = np.round(_space_knots(high, moves)).astype(int)
    knots[-1] = samples - 1
    return np.maximum(knots, np.arange(moves))


def _space_knots(factor: float, moves: int) -> Float[np.ndarray, " n"]:
    return np.concatenate([[0.0], np.cumsum(factor ** np.arange(moves - 1))])


def interpolate_knots(knots: Int[np.ndarray, " n"]) -> Float[np.ndarray, "samples n"]:
    """Return W, which draws straight lines between the knots."""
    samples = np.arange(knots[-1] + 1)
    return np.column_stack([np.interp(samples, knots, row) for row in np.eye(knots.size)])
