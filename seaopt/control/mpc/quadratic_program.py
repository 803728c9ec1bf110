r"""The quadratic program of a `HorizonProgram`, of which only vectors change from sample to sample.

.. math:: \text{minimise } \tfrac12 x^T H x + q^T x \quad\text{with}\quad l \le A x \le h, \qquad H = L L^T.

In :math:`y = L^T x` it asks for the point nearest to :math:`-L^{-1} q` within bounds of the rows :math:`A L^{-T}`,
which `active_set` finds. Those rows are divided by their lengths, so that the row that is broken most is the one
furthest away.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float, Int

from seaopt.control.mpc.active_set import QPSolution, find_nearest
from seaopt.control.mpc.prediction import HorizonProgram
from seaopt.records import record
from seaopt.signals import MatrixMN, MatrixNN, VectorM, VectorN

PENALTY = 3.0  # of a unit of slack, a tenth of half the width of its bounds; the Hessian's diagonal is 1 on the mean
CURVATURE = 1.0  # of half its square
WIDE = 1e6  # stands for no limit: of a row in units of its limit


def stack_hessian(prediction: HorizonProgram) -> Float[np.ndarray, "nv nv"]:
    """Return the Hessian over knots and slacks."""
    n, k = prediction.knots.size, len(prediction.outputs.names)
    return np.block([[prediction.H, np.zeros((n, k))], [np.zeros((k, n)), CURVATURE * np.eye(k)]])


@record(eq=False)
class QuadraticProgram:
    """A program's matrices; `factor_program` makes one."""

    inverse: MatrixNN
    normals: MatrixMN  # the rows of y, of length 1
    scale: VectorM  # one over the lengths that they had: of their bounds too

    def solve(
        self, q: VectorN, low: VectorM, high: VectorM, sides: Int[np.ndarray, " m"], max_iterations: int
    ) -> QPSolution:
        """Return the solution for a gradient and bounds, from rows that are held to begin with."""
        nearest = find_nearest(
            -self.inverse @ q, self.normals, low * self.scale, high * self.scale, sides, max_iterations
        )
        return replace(nearest, x=self.inverse.T @ nearest.x)


def factor_program(hessian: MatrixNN, rows: MatrixMN) -> QuadraticProgram:
    """Return a program by its Hessian and its rows, none of which is zero."""
    inverse = np.linalg.inv(np.linalg.cholesky(hessian))
    normals = rows @ inverse.T
    scale = 1.0 / np.linalg.norm(normals, axis=1)
    return QuadraticProgram(inverse=inverse, normals=normals * scale[:, None], scale=scale)
