"""The resolvent of a state space at many points at once: every frequency response is computed here."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Complex, Float

from seaopt.records import record

WIDE = 500  # columns from which on BLAS starts threads for products, which cost more than they save


@record(eq=False)
class Resolvent:
    """C (sI - A)^-1 B in the basis of a complex Schur form of A, by back substitution. No pole has to be avoided but by
    s itself, and repeated ones do no harm.
    """

    triangle: Complex[np.ndarray, "n n"]
    right: Complex[np.ndarray, "n u"]
    left: Complex[np.ndarray, "y n"]

    @classmethod
    def of(cls, a: Float[np.ndarray, "n n"], b: Float[np.ndarray, "n u"], c: Float[np.ndarray, "y n"]) -> Resolvent:
        """Return the resolvent of a state space, whose states are scaled first."""
        from scipy.linalg import matrix_balance, schur  # deferred: scipy is slow to load

        if not a.size:
            return cls(triangle=a + 0j, right=b + 0j, left=c + 0j)
        balanced, (scale, _) = matrix_balance(a, permute=False, separate=True)
        triangle, basis = (np.asarray(part) for part in schur(balanced, output="complex")[:2])
        return cls(triangle=triangle, right=basis.conj().T @ (b / scale[:, None]), left=(c * scale) @ basis)

    @property
    def poles(self) -> Complex[np.ndarray, " n"]:
        """The eigenvalues of A."""
        return self.triangle.diagonal()

    def respond(self, s: Complex[np.ndarray, " m"]) -> Complex[np.ndarray, "y u m"]:
        """Return the response at points of the plane."""
        return self.read(self.solve(s - self.poles[:, None], self.right[:, :, None]))

    def solve(
        self, distance: Complex[np.ndarray, "n m"], rhs: Complex[np.ndarray, "n u k"]
    ) -> Complex[np.ndarray, "n u m"]:
        """Return (sI - A)^-1 rhs, of the distances of s from the poles."""
        n, count = distance.shape
        x = np.zeros((n, rhs.shape[1], count), dtype=complex)
        flat = x.reshape(n, rhs.shape[1] * count)
        for i in range(n - 1, -1, -1):
            x[i] = rhs[i]
            flat[i] += _weigh(self.triangle[i, i + 1 :], flat[i + 1 :])
            x[i] /= distance[i]
        return x

    def read(self, x: Complex[np.ndarray, "n u m"]) -> Complex[np.ndarray, "y u m"]:
        """Return C of states."""
        n, *shape = x.shape
        flat = x.reshape(n, math.prod(shape))
        return np.array([_weigh(row, flat) for row in self.left]).reshape(len(self.left), *shape)


def _weigh(row: Complex[np.ndarray, " n"], columns: Complex[np.ndarray, "n m"]) -> Complex[np.ndarray, " m"]:
    if columns.shape[1] < WIDE:
        return row @ columns
    out = np.zeros(columns.shape[1], dtype=complex)
    for weight, column in zip(row, columns, strict=True):
        out += weight * column
    return out
