r"""Nonlinear least squares from normal equations: Levenberg-Marquardt with bounds.

At each iterate the step solves

.. math:: (H + \lambda\,\mathrm{diag}(H))\, d = -g

over the unknowns that are not held by a bound, with :math:`H = J^T J` and Marquardt's scaling (SIAM J. 11(2), 1963),
is clipped to the bounds, and is taken if the cost falls; :math:`\lambda` follows Nielsen's rule (IMM-REP-1999-05).
Costs are in units of sigma, so that the Newton decrement :math:`g^T H^{-1} g` is the squared distance to the minimum
in standard deviations: the search ends when that distance is negligible. An evaluation may move the point (to the best
linear unknowns, see `residuals`); those unknowns are not damped.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Float

from seaopt.estimation.residuals import Evaluation

Status = Literal["converged", "max_iterations", "stalled"]
Callback = Callable[[int, float], None]
Evaluate = Callable[[Any, "Evaluation | None", float], Evaluation]

DECREMENT = 1e-10  # squared standard deviations still to go
RELATIVE = 1e-12  # of the cost


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Solution:
    """Where the search ended."""

    z: Float[np.ndarray, " n"]
    evaluation: Evaluation
    status: Status
    message: str
    iterations: int


def minimise(
    evaluate: Evaluate,
    start: Float[np.ndarray, " n"] | Evaluation,
    low: Float[np.ndarray, " n"],
    high: Float[np.ndarray, " n"],
    *,
    reach: Float[np.ndarray, " n"] | None = None,
    max_iterations: int = 50,
    callback: Callback | None = None,
) -> Solution:
    """Minimise a sum of squares from `start`, inside the bounds.

    Parameters
    ----------
    evaluate : callable
        (z, where the step came from, damping) -> cost, gradient and Gauss-Newton Hessian at z.
    start : array, shape (n,), or Evaluation
        First point, or what was found there.
    low, high : array, shape (n,)
        Bounds.
    reach : array, shape (n,), optional
        No step is longer than twice the larger of this and the present value, unknown by unknown: a far start must not
        be thrown out of the world. Infinite entries are free.
    max_iterations : int
        Evaluations after the first.
    callback : callable, optional
        Called with the iteration and the cost.

    """
    here = start if isinstance(start, Evaluation) else evaluate(np.clip(start, low, high), None, 0.0)
    z = here.z
    if not np.isfinite(here.cost):
        message = "the simulation overflows at the first guess; start closer or check units"
        return Solution(z=z, evaluation=here, status="stalled", message=message, iterations=0)
    damping, growth = 1e-4, 2.0
    for iteration in range(1, max_iterations + 1):
        held = _held(z, here, low, high)
        distance = _decrement(here, held) + 2.0 * here.pending
        if distance <= DECREMENT + RELATIVE * here.cost:
            return Solution(
                z=z, evaluation=here, status="converged", iterations=iteration - 1,
                message=f"the minimum is {np.sqrt(distance):.1g} standard deviations away",
            )  # fmt: skip
        step = _step(here, held, damping)
        if reach is not None:
            size = np.abs(step) / (2.0 * np.maximum(reach, np.abs(z)))
            step = step / max(1.0, float(np.max(size)))
        trial = np.clip(z + step, low, high)
        moved = trial - z
        if not np.any(np.abs(moved) > 1e-15 * np.abs(z)) and damping > 1.0:
            return Solution(
                z=z, evaluation=here, status="stalled", iterations=iteration,
                message="no smaller step can be told from rounding, and the gradient is not zero",
            )  # fmt: skip
        predicted = -float(here.gradient @ moved + 0.5 * moved @ here.hessian @ moved) + here.pending
        there = evaluate(trial, here, damping)
        ratio = (here.cost - there.cost) / predicted if predicted > 0.0 else -1.0
        if np.isfinite(there.cost) and ratio > 1e-4:
            z, here = there.z, there
            damping = max(damping * max(1.0 / 9.0, 1.0 - (2.0 * ratio - 1.0) ** 3), 1e-12)
            growth = 2.0
        else:
            damping, growth = damping * growth * 2.0, growth * 2.0
        if callback is not None:
            callback(iteration, here.cost)
    return Solution(
        z=z, evaluation=here, status="max_iterations", iterations=max_iterations,
        message=f"still moving after {max_iterations} iterations; raise max_iterations or start closer",
    )  # fmt: skip


def _held(
    z: Float[np.ndarray, " n"], here: Evaluation, low: Float[np.ndarray, " n"], high: Float[np.ndarray, " n"]
) -> Bool[np.ndarray, " n"]:
    """Tell which unknowns lie on a bound, to a ten-thousandth of a standard deviation, that descent would cross."""
    near = 1e-4 / np.sqrt(np.maximum(np.diag(here.hessian), 1e-300))
    return ((z - low <= near) & (here.gradient > 0.0)) | ((high - z <= near) & (here.gradient < 0.0))


def _scaled(here: Evaluation, held: Bool[np.ndarray, " n"]) -> tuple[Float[np.ndarray, "m m"], Float[np.ndarray, " m"]]:
    free = ~held
    scale = np.sqrt(np.maximum(np.diag(here.hessian)[free], 1e-300))
    return here.hessian[np.ix_(free, free)] / np.outer(scale, scale), scale


def _decrement(here: Evaluation, held: Bool[np.ndarray, " n"]) -> float:
    matrix, scale = _scaled(here, held)
    g = here.gradient[~held] / scale
    values, vectors = np.linalg.eigh(matrix)
    seen = values > 1e-12 * max(values[-1], 1e-300) if values.size else np.zeros(0, dtype=bool)
    return float(np.sum((vectors.T @ g)[seen] ** 2 / values[seen]))


def _step(here: Evaluation, held: Bool[np.ndarray, " n"], damping: float) -> Float[np.ndarray, " n"]:
    matrix, scale = _scaled(here, held)
    damped = matrix + np.diag(np.where(here.undamped[~held], 1e-12, damping))
    step = np.zeros(held.size)
    step[~held] = -np.linalg.solve(damped, here.gradient[~held] / scale) / scale
    return step
