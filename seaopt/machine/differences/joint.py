r"""Whether one machine that was certified explains all measured lines together.

Each line within reach of some draw is not yet a machine: another draw may be needed at each. For one response G

.. math:: p_k = \Big(1 + \frac{d_k^2}{(P-1)\,s_k^2}\Big)^{-(P-1)}, \qquad d_k = \max(|\hat G_k - G_k| - \tau |G_k|, 0),

is the probability of a difference that is larger, but for the share :math:`\tau` by which a machine may be off, and of
m lines :math:`-2 \sum_k \ln p_k` is above the chi-square of 2m degrees of freedom as often as stated, or less often
(Fisher, Statistical Methods for Research Workers, 1932). The certified machine that goes best with the lines is sought
from the nearest draw on, along the principal axes of the draws and no further than they go.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from seaopt.machine.differences.comparison import TOLERATED, Comparison, Lines
from seaopt.machine.differences.leeway import Spread
from seaopt.robustness.uncertainty.worst import place_values

ROUNDS = 6  # of Gauss and Newton
STEP = 0.02  # of the draws' width along an axis, for slopes


def is_one_of(comparison: Comparison, spread: Spread, drawn: Sequence[Lines], alpha: float) -> bool:
    """Tell whether a machine within the spread of the draws explains all lines, which a right one does not with the
    probability `alpha` at most. `drawn`: the responses of the nominal machine and of the draws.
    """
    misfits = [float(np.sum(_weigh(comparison, row) ** 2)) for row in drawn]
    best = int(np.argmin(misfits))
    model, misfit = drawn[best], misfits[best]
    if explains(comparison, model, alpha) or not spread.names:
        return explains(comparison, model, alpha)
    axes, along = spread.find_axes(range(len(spread.names)))
    along = np.vstack([np.zeros(len(axes)), along])
    low, high, at = np.min(along, axis=0), np.max(along, axis=0), along[best]
    for _ in range(ROUNDS):
        ahead = _go_on(comparison, spread, axes, (low, high), at, model)
        moved = _respond(comparison, spread, axes, [ahead, 0.5 * (at + ahead)])
        left = [float(np.sum(_weigh(comparison, row) ** 2)) for row in moved]
        k = int(np.argmin(left))
        if left[k] >= misfit:
            return False
        at, model, misfit = (ahead, 0.5 * (at + ahead))[k], moved[k], left[k]
        if explains(comparison, model, alpha):
            return True
    return False


def explains(comparison: Comparison, model: Lines, alpha: float) -> bool:
    """Tell whether a response explains all lines of each output and amplitude."""
    from scipy.special import chdtri  # deferred: 0.1 s

    left = np.maximum(np.abs(comparison.response - model) - TOLERATED * np.abs(model), 0.0) / comparison.std
    ratios, first = comparison.ratios, 0
    for ratio in ratios:
        share, m, p = left[first : first + ratio.value.size], ratio.value.size, ratio.blocks
        unlikely = 2.0 * (p - 1) * float(np.sum(np.log1p(share**2 / (p - 1)), where=ratio.sure))
        if unlikely > chdtri(2 * m, alpha / len(ratios)):
            return False
        first += m
    return True


def _weigh(comparison: Comparison, model: Lines) -> Float[np.ndarray, " r"]:
    """Return what a response is off by, over what it may be."""
    off = (comparison.response - model) / np.hypot(comparison.std, TOLERATED * np.abs(comparison.response))
    return np.concatenate([off.real, off.imag])


def _respond(
    comparison: Comparison,
    spread: Spread,
    axes: Float[np.ndarray, "d n"],
    places: Sequence[Float[np.ndarray, " d"]],
) -> list[Lines]:
    """Return the responses at places along the axes."""
    assert comparison.controller.design is not None
    plant, values = comparison.controller.design
    return comparison.predict([place_values(plant, values, spread.move(place @ axes)) for place in places])


def _go_on(
    comparison: Comparison,
    spread: Spread,
    axes: Float[np.ndarray, "d n"],
    edges: tuple[Float[np.ndarray, " d"], Float[np.ndarray, " d"]],
    at: Float[np.ndarray, " d"],
    model: Lines,
) -> Float[np.ndarray, " d"]:
    """Return where along the axes, within their edges, the lines are nearest, to first order of log G."""
    from scipy.optimize import least_squares  # deferred: 0.2 s

    low, high = edges
    steps = STEP * (high - low) * np.where(at > 0.5 * (low + high), -1.0, 1.0)
    beside = _respond(comparison, spread, axes, [*(at + np.diag(steps))])
    slopes = np.log(np.array(beside) / model) / steps[:, None]

    def errors(place: Float[np.ndarray, " d"]) -> Float[np.ndarray, " r"]:
        return _weigh(comparison, model * np.exp((place - at) @ slopes))

    inner = np.clip(at, low + 1e-6 * (high - low), high - 1e-6 * (high - low))
    return least_squares(errors, inner, x_scale=high - low, bounds=edges, max_nfev=50).x
