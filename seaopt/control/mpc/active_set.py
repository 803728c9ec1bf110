r"""The point nearest to another within bounds, by the dual active-set method.

For :math:`y_0` and rows :math:`n_i` of length 1,

.. math:: \text{minimise } \tfrac12 |y - y_0|^2 \quad\text{with}\quad l_i \le n_i y \le h_i.

Rows are held at one of their ends, those of the last program to begin with. On them y is the nearest point, with
multipliers :math:`\lambda`; with N the held rows, signed to point inwards, and b their ends,

.. math:: y = y_0 + N^T \lambda, \qquad N N^T \lambda = b - N y_0, \qquad N^T = Q R.

Rows with negative multipliers are let go, so that the distance to :math:`y_0` is the least that the held rows allow.
Then the row that is broken most is taken in. On the way there the multipliers change by :math:`-t r`, with r the row's
share in the held ones; one that would become negative is let go first. Each full step increases the distance, so that
no set comes back, and the method ends: at the solution, or with a row that no step brings closer, which proves that the
bounds contradict each other. A row counts as such where 1e-6 of its length or less is left besides the held ones: rows
that nearly depend on each other can be said to contradict although a point keeps them. In most samples of a controller
nothing changes, and the answer is one product.

`c/active_set.c` takes the same steps, and updates Q and R where this module makes them anew.

Source: D. Goldfarb and A. Idnani, Math. Programming 27, 1983.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from jaxtyping import Float, Int

from seaopt.records import record
from seaopt.signals import MatrixMN, MatrixNN, VectorK

Vector = Float[np.ndarray, " n"]
PerRow = Float[np.ndarray, " m"]
TOLERANCE, TOLERANCE_SINGLE = 1e-10, 1e-5  # by how much a bound may be broken, per 1 + the largest value of a row
DEPENDENT, DEPENDENT_SINGLE = 1e-12, 1e-6  # square of what is left of a row besides the held ones: it depends on them
SOLVED, UNFINISHED, INFEASIBLE = "solved", "maximum iterations reached", "the bounds contradict each other"
Ending = Literal["solved", "maximum iterations reached", "the bounds contradict each other"]


@record(eq=False)
class QPSolution:
    """A point, where its rows are held, how the search ended, and the rows taken in or let go after the start."""

    x: Vector
    sides: Int[np.ndarray, " m"]  # 1: held at the high end, -1: at the low one, 0: not held; the next start
    status: Ending
    iterations: int


@record(eq=False)
class _Held:
    """The nearest point on held rows, its multipliers, and Q with the upper triangle R of the rows' normals."""

    sides: dict[int, int]  # by row
    point: Vector
    dual: VectorK
    Q: MatrixNN
    R: Float[np.ndarray, "k k"]


@record(eq=False)
class _Bounds:
    start: Vector
    normals: MatrixMN
    low: PerRow
    high: PerRow

    def hold(self, sides: dict[int, int]) -> _Held:
        """Return the point nearest to the start on which each row has its end: the high one where its side is 1."""
        if not sides:  # in most samples: nothing to factor
            return _Held(sides=sides, point=self.start, dual=np.zeros(0), Q=np.eye(self.start.size), R=np.zeros((0, 0)))
        rows, inward = list(sides), -np.array(list(sides.values()), dtype=float)
        normals = inward[:, None] * self.normals[rows]
        ends = inward * np.where(inward < 0.0, self.high[rows], self.low[rows])
        Q, tall = np.linalg.qr(normals.T, mode="complete")
        R = tall[: len(rows)]
        w = np.linalg.solve(R.T, ends - normals @ self.start)
        return _Held(sides=sides, point=self.start + Q[:, : len(rows)] @ w, dual=np.linalg.solve(R, w), Q=Q, R=R)

    def let_go(self, state: _Held, j: int) -> _Held:
        """Return what holds without the j-th of the held rows."""
        row = list(state.sides)[j]
        return self.hold({each: side for each, side in state.sides.items() if each != row})

    def find_broken(self, state: _Held) -> tuple[int, int, float]:
        """Return the row that is broken most, its side, and by how much."""
        values = self.normals @ state.point
        broken = np.maximum(values - self.high, self.low - values)
        broken[list(state.sides)] = 0.0
        row = int(np.argmax(broken))
        return row, 1 if values[row] > self.high[row] else -1, float(broken[row])

    def take_in(self, state: _Held, row: int, side: int, broken: float, most: int) -> tuple[_Held, Ending, int]:
        """Return what holds with a broken row, once the rows that are in its way are let go; in `most` changes."""
        dual = state.dual
        for used in range(1, most + 1):
            k = len(state.sides)
            d = state.Q.T @ (-side * self.normals[row])
            share, remaining = np.linalg.solve(state.R, d[:k]), float(d[k:] @ d[k:])
            ratios = np.where(share > 0.0, dual / np.where(share > 0.0, share, 1.0), np.inf)
            partial = float(np.min(ratios, initial=np.inf))
            full = broken / remaining if remaining > DEPENDENT else np.inf
            step = min(partial, full)
            if step == np.inf:
                return state, INFEASIBLE, used
            if full <= partial:
                return self.hold({**state.sides, row: side}), SOLVED, used
            j = int(np.argmin(ratios))
            dual, broken = np.delete(dual - step * share, j), broken - (step * remaining if full < np.inf else 0.0)
            state = self.let_go(state, j)
        return state, UNFINISHED, most


def find_nearest(
    start: Vector, normals: MatrixMN, low: PerRow, high: PerRow, sides: Int[np.ndarray, " m"], max_iterations: int
) -> QPSolution:
    """Return the point nearest to `start` within low <= normals x <= high; of a row held at one end the other is not
    looked at. `sides`: where rows are held to begin with, linearly independent, as in a QPSolution. `max_iterations`:
    changes of these at most, besides the rows that are let go at the start.
    """
    bounds = _Bounds(start=start, normals=normals, low=low, high=high)
    state = bounds.hold({row: side for row, side in enumerate(sides.tolist()) if side})
    while np.min(state.dual, initial=0.0) < 0.0:
        state = bounds.let_go(state, int(np.argmin(state.dual)))
    status: Ending = SOLVED
    iterations, tolerance = 0, TOLERANCE * (1.0 + float(np.max(np.abs(normals @ start))))
    while status == SOLVED:
        row, side, broken = bounds.find_broken(state)
        if not broken > tolerance:
            break
        state, status, used = bounds.take_in(state, row, side, broken, max_iterations - iterations)
        iterations += used
    ended = np.zeros_like(sides)
    ended[list(state.sides)] = list(state.sides.values())
    return QPSolution(x=state.point, sides=ended, status=status, iterations=iterations)
