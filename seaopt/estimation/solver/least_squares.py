r"""Nonlinear least squares from normal equations: Levenberg-Marquardt as a trust region, with bounds.

At each iterate the step is the one with the least

.. math:: g^T d + \tfrac12 d^T H d \quad\text{subject to}\quad |D d| \le \Delta,
          \qquad\text{which solves}\qquad (H + \lambda D^2)\, d = -g

over the unknowns that no bound blocks, with :math:`H = J^T J` and D the largest norms yet of J's columns (Moré,
Lecture Notes in Mathematics 630, 1978): a parameter that the data hardly show at a far point is not thrown out of the
world. The step is clipped to the bounds and is taken if the cost falls; :math:`\Delta` follows from how well the fall
was predicted. Costs are in units of sigma, so that the Newton decrement :math:`g^T H^{-1} g` is the squared distance
to the minimum in standard deviations: the search ends when that distance is negligible. An evaluation may move the
point (to the best linear unknowns, see `fit_problem`); the region does not bound those.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Generic, Literal, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool

from seaopt.estimation.problem.fit_problem import BudgetError
from seaopt.estimation.problem.normal_equations import M, QuadraticModel, find_arrow, solve_seen
from seaopt.estimation.problem.shapes import Matrix, Vector
from seaopt.records import record

Status = Literal["converged", "max_iterations", "stalled"]
STILL_MOVING = (
    "still moving when its iterations were used up; start closer, fix a parameter, or give the method a larger "
    "max_iterations (in Python)"
)
Callback = Callable[[str, float], None]  # (phase and round, cost) of each iteration of a search
DampedSolver = Callable[[float, Vector], Vector]  # (lambda, b) -> (H + lambda)^-1 b

DECREMENT = 1e-10  # squared standard deviations still to go
RELATIVE_DECREMENT = 1e-12  # of the cost
FIRST_RADIUS = 0.3  # over the size of the first point
ROUNDING_DECREMENT = 1e-4  # squared standard deviations that rounding may leave of residuals that are rounding
UNSEEN = 1e-14  # of the largest eigenvalue; directions below it are left where they are
ROUNDING_RADIUS = 1e-15  # of the size of the point
FLAT_STEPS = 6  # in a row that leave the cost as it is, or jump where they are to
LOST_STEPS, GAIN = 8, 1e-2  # to where the cost is not finite, since it last fell by such a share of what is left
NEAR_ENOUGH = 0.25  # squared standard deviations that the slope leaves where the cost is flat
STRAIGHT_RATIO = 2e-5  # distance over the one before, squared: H changes by a few times that over the step to come


@runtime_checkable
class Objective(Protocol[M]):
    """A sum of squares that can be minimised."""

    def evaluate(self, z: Vector) -> M:
        """Return its quadratic model at z."""
        ...


@record(eq=False)
class Solution(Generic[M]):
    """Where the search ended, and the distance, squared, from which its last step was made if that was a whole one."""

    z: Vector
    evaluation: M
    status: Status
    message: str
    iterations: int
    before: float = 0.0
    lost: bool = False  # where steps beyond, to the end, could not be simulated


def minimise(
    objective: Objective[M],
    start: Vector | M,
    low: Vector,
    high: Vector,
    *,
    first_radius: float = FIRST_RADIUS,
    decrement: float = DECREMENT,
    max_iterations: int = 50,
    callback: Callable[[M], None] | None = None,
    follow: Callable[[M, Vector], M] | None = None,
    before: float = 0.0,
    flat: float = 0.0,
    ends: Callable[[M], bool] | None = None,
) -> Solution[M]:
    """Minimise a sum of squares from `start`, inside the bounds.

    `objective`: gives cost, gradient and Gauss-Newton Hessian at any point; `start`: first point, or the model there;
    `low`, `high`: bounds; `first_radius`: of the region, over the size of the first point; `decrement`: squared
    standard deviations to the minimum at which to stop; `max_iterations`: evaluations after the first; `callback`:
    called with the model after each iteration; `follow`: (model, z) -> what it says of a z nearby if residuals are
    straight from there: then a last step needs no evaluation of its own once the whole steps before it have shown how
    straight they are; `before`: of the search that this one goes on from; `flat`: share of the cost that is no change:
    a few steps in a row that make none, or that should make none and go up, end a search among kinks and jumps, whose
    gradient does not die out; `ends`: tells of each point whether it is all that is asked for.
    """
    current = objective.evaluate(np.clip(start, low, high)) if isinstance(start, np.ndarray) else start
    if not np.isfinite(current.cost):
        message = "the simulation overflows at the first guess; start closer or check units"
        return Solution(z=current.z, evaluation=current, status="stalled", message=message, iterations=0)
    scale = _column_norms(current)
    radius = first_radius * max(float(np.linalg.norm(scale * current.z)), 1.0)
    unchanged, lost, best, iteration = 0, 0, current.cost, 1
    for iteration in range(1, max_iterations + 2):  # after the last step convergence is tested once more
        blocked = find_blocked(current, low, high)
        distance = current.distance_squared(~blocked)
        allowed = decrement + RELATIVE_DECREMENT * current.cost
        if distance <= allowed:
            return Solution(
                z=current.z,
                evaluation=current,
                status="converged",
                iterations=iteration - 1,
                before=before,
                message=f"the minimum is {np.sqrt(distance):.1g} standard deviations away",
            )
        if iteration > max_iterations:
            break
        if unchanged >= FLAT_STEPS:
            return Solution(
                z=current.z,
                evaluation=current,
                status="converged" if distance <= NEAR_ENOUGH else "stalled",
                iterations=iteration - 1,
                message=f"the cost is flat or jumps, and {np.sqrt(distance):.1g} standard deviations are left by its "
                "slope",
            )
        if lost >= LOST_STEPS:
            message = "the search goes where the plant cannot be simulated; start closer, or give bounds"
            return Solution(
                z=current.z, evaluation=current, status="stalled", message=message, iterations=iteration - 1, lost=True
            )
        change, damping = _step(current, blocked, scale, radius)
        end = np.clip(current.z + change, low, high)
        moved = end - current.z
        length = float(np.linalg.norm(np.where(current.linear, 0.0, scale * moved)))
        if radius < ROUNDING_RADIUS * max(float(np.linalg.norm(scale * current.z)), 1e-300):
            near = distance < ROUNDING_DECREMENT
            left = f"{np.sqrt(distance):.1g} standard deviations are left" if near else "the gradient is not zero"
            return Solution(
                z=current.z,
                evaluation=current,
                status="converged" if near else "stalled",
                iterations=iteration,
                message=f"a smaller step would be lost in rounding, and {left}",
            )
        whole = damping == 0.0 and bool(np.all(end == current.z + change))
        if follow is not None and whole and _is_straight(distance, before, allowed):
            trial = follow(current, end)
            # A bound that held so far need not hold there.
            remaining = trial.distance_squared(~find_blocked(trial, low, high))
            if remaining <= decrement + RELATIVE_DECREMENT * trial.cost:
                if callback is not None:
                    callback(trial)
                return Solution(
                    z=trial.z,
                    evaluation=trial,
                    status="converged",
                    iterations=iteration,
                    message=f"the minimum is within {distance / np.sqrt(before):.1g} standard deviations",
                )
        predicted = -float(current.gradient @ moved + 0.5 * moved @ current.hessian @ moved)
        try:
            trial = objective.evaluate(end)
        except BudgetError:
            break
        ratio = (current.cost - trial.cost) / predicted if predicted > 0.0 and np.isfinite(trial.cost) else -1.0
        lost += not np.isfinite(trial.cost)
        if trial.cost < best - max(GAIN * 0.5 * distance, NEAR_ENOUGH):
            lost, best = 0, trial.cost
        # So short a step rises only where the cost jumps, and the next one does not get over that either.
        change_of_cost = min(abs(trial.cost - current.cost), predicted if ratio < 0.0 else np.inf)
        unchanged = unchanged + 1 if flat > 0.0 and change_of_cost <= flat * current.cost else 0
        if ratio < 0.25:
            radius = 0.25 * min(radius, length) if length > 0.0 else 0.25 * radius
        elif ratio > 0.75 or damping == 0.0:
            radius = max(radius, 2.0 * length)
        if ratio > 1e-4:
            current, before = trial, distance if whole else 0.0
            scale = np.maximum(scale, _column_norms(current))
        if callback is not None:
            callback(current)
        if ends is not None and ends(current):
            message = "what was asked for is found"
            return Solution(z=current.z, evaluation=current, status="converged", message=message, iterations=iteration)
    return Solution(
        z=current.z, evaluation=current, status="max_iterations", iterations=iteration - 1, message=STILL_MOVING
    )


def name_phase(callback: Callback | None, phase: str) -> Callback | None:
    """Return what tells a callback of the phase, too."""
    if callback is None:
        return None
    return lambda where, cost: callback(f"{phase}, {where}", cost)


def _is_straight(distance: float, before: float, allowed: float) -> bool:
    """Tell from two distances to the minimum, squared, whether the next step may be followed without an evaluation.
    Whole steps square what is left of the distance: it falls by r = distance / before to the power of two, and then of
    four; all are squares. A tenth of the distance allowed is asked of that, for it is not quite so in many dimensions.
    If steps only shortened the distance by one factor, what is left would still be small.
    """
    if not 0.0 < distance <= STRAIGHT_RATIO * before:
        return False
    ratio = distance / before
    return distance * ratio <= ROUNDING_DECREMENT and distance * ratio**2 <= 0.01 * allowed


def _column_norms(model: QuadraticModel) -> Vector:
    """Return the norms of the Jacobian's columns."""
    return np.sqrt(np.maximum(np.diag(model.hessian), 1e-300))


def find_blocked(model: QuadraticModel, low: Vector, high: Vector) -> Bool[np.ndarray, " n"]:
    """Return which unknowns lie on a bound, to a ten-thousandth of a standard deviation, that descent would cross."""
    near = 1e-4 / _column_norms(model)
    return ((model.z - low <= near) & (model.gradient > 0.0)) | ((high - model.z <= near) & (model.gradient < 0.0))


def _step(model: QuadraticModel, blocked: Bool[np.ndarray, " n"], scale: Vector, radius: float) -> tuple[Vector, float]:
    """Return the step within the radius and its lambda; the linear unknowns follow the others."""
    h, g = model.hessian, model.gradient
    free = ~blocked & (np.diag(h) > 0.0)  # what is not seen at all would go as far as rounding takes it
    bound, follow = free & ~model.linear, free & model.linear
    matrix, gradient, response = h[bound][:, bound], g[bound], np.zeros((0, 0))
    if np.any(follow):
        right = np.column_stack([g[follow], h[follow][:, bound]])
        response = solve_seen(h[follow][:, follow], right, 1e-13)
        matrix = matrix - h[bound][:, follow] @ response[:, 1:]
        gradient = gradient - h[bound][:, follow] @ response[:, 0]
    step = np.zeros(blocked.size)
    d = scale[bound]
    solve, largest = _make_damped_solver(matrix / np.outer(d, d))
    along, multiplier = _shorten(solve, largest, gradient / d, radius)
    step[bound] = along / d
    if np.any(follow):
        step[follow] = -response[:, 0] - response[:, 1:] @ step[bound]
    return step, multiplier


def _make_damped_solver(matrix: Matrix) -> tuple[DampedSolver, float]:
    """Return (lambda, b) -> (matrix + lambda)^-1 b over what is seen, and a bound on the largest eigenvalue."""
    if find_arrow(matrix) is not None:
        identity = np.eye(len(matrix))
        largest = float(np.max(np.sum(np.abs(matrix), axis=1)))
        return lambda damping, right: solve_seen(matrix + damping * identity, right, UNSEEN), largest
    values, vectors = np.linalg.eigh(matrix)
    values = np.maximum(values, 0.0)
    largest = float(np.max(values, initial=0.0))

    def solve(damping: float, right: Vector) -> Vector:
        seen = values + damping > UNSEEN * max(largest, 1e-300)
        return vectors @ np.where(seen, (vectors.T @ right) / np.where(seen, values + damping, 1.0), 0.0)

    return solve, largest


def _shorten(solve: DampedSolver, largest: float, g: Vector, radius: float) -> tuple[Vector, float]:
    """Return the step -(H + lambda)^-1 g, no longer than the radius, with the smallest such lambda >= 0."""
    newton = -solve(0.0, g)
    if float(np.linalg.norm(newton)) <= radius:
        return newton, 0.0
    multiplier = max(float(np.linalg.norm(g)) / radius - largest, UNSEEN * max(largest, 1e-300))
    for _ in range(50):  # Newton's method on 1 / |step|, which is nearly straight in lambda
        step = -solve(multiplier, g)
        size = float(np.linalg.norm(step))
        if abs(size - radius) <= 1e-3 * radius:
            break
        slope = float(step @ solve(multiplier, step)) / size
        multiplier = max(multiplier + (size / slope) * (size - radius) / radius, 1e-3 * multiplier)
    return -solve(multiplier, g), multiplier
