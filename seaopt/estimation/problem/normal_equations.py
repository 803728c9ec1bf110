"""Normal equations: Gram matrices of passes added up over unknowns, solved over what the data show.

A matrix is scaled to a unit diagonal before it is inverted. Its eigenvalues below a cut, a part of the largest, are
directions that the data do not show: they are left out, as in a pseudo-inverse.
"""

from __future__ import annotations

from typing import Generic, TypeVar

import numpy as np
from jaxtyping import Bool, Float, Int

from seaopt.records import record

RANK = 1e-10  # eigenvalues of the normalised Hessian below this part of the largest are zero


@record(eq=False)
class QuadraticModel:
    """A sum of squares near `z`: half of it (the cost), its gradient and its Gauss-Newton Hessian.

    `linear` marks the unknowns in which residuals are affine: a step may change those at will.
    """

    z: Float[np.ndarray, " n"]
    cost: float
    gradient: Float[np.ndarray, " n"]
    hessian: Float[np.ndarray, "n n"]
    linear: Bool[np.ndarray, " n"]

    def distance_squared(self, free: Bool[np.ndarray, " n"]) -> float:
        """Return the squared distance to the minimum over the free unknowns, in standard deviations."""
        return measure_decrement(self.hessian[np.ix_(free, free)], self.gradient[free], 1e-12)

    def predict_fall(self, step: Float[np.ndarray, " n"]) -> float:
        """Return by how much a step lowers the cost."""
        return -float(self.gradient @ step + 0.5 * step @ self.hessian @ step)


M = TypeVar("M", bound=QuadraticModel)


@record(eq=False)
class TrustRegionStep(Generic[M]):
    """A step from the minimum's model at `start` to `end`; `damping` is its lambda, 0 where the region is no limit."""

    start: M
    end: Float[np.ndarray, " n"]
    damping: float

    @property
    def moved(self) -> Float[np.ndarray, " n"]:
        """How far the unknowns move."""
        return self.end - self.start.z


def add_gram(
    normal: Float[np.ndarray, "... m m"], gram: Float[np.ndarray, "... nc nc"], places: Int[np.ndarray, " nd"]
) -> None:
    """Add a Gram matrix of [residual, derivatives] to the normal matrix of [residual, unknowns], in place.

    Parameters
    ----------
    normal : array, shape (..., 1 + n, 1 + n)
        Row 0 is the gradient, behind the residual's own square.
    gram : array, shape (..., 1 + nd, 1 + nd)
        Of one output of a pass, in sigma.
    places : array of int, shape (nd,)
        The unknown of each derivative, -1 where that is known.

    """
    used = np.flatnonzero(places >= 0)
    to, of = np.concatenate([[0], 1 + places[used]]), np.concatenate([[0], 1 + used])
    normal[..., to[:, None], to] += gram[..., of[:, None], of]


def invert(
    matrix: Float[np.ndarray, "n n"], cut: float = RANK
) -> tuple[Float[np.ndarray, "n n"], Float[np.ndarray, " n"]]:
    """Return the inverse over what is seen, and how much of each unknown is not (0 to 1, squared)."""
    scale, values, vectors = _decompose(matrix)
    seen = _seen(values, cut)
    inverse = (vectors[:, seen] / values[seen]) @ vectors[:, seen].T / np.outer(scale, scale)
    return inverse, np.sum(vectors[:, ~seen] ** 2, axis=1)


def solve_seen(
    matrix: Float[np.ndarray, "n n"], right: Float[np.ndarray, "n ..."], cut: float
) -> Float[np.ndarray, "n ..."]:
    """Return matrix^-1 right over what is seen; the rest stays where it is."""
    scale, values, vectors = _decompose(matrix)
    seen = _seen(values, cut)
    along = (vectors[:, seen] / scale[:, None]).T @ right
    return (vectors[:, seen] / scale[:, None]) @ (along.T / values[seen]).T


def measure_decrement(matrix: Float[np.ndarray, "n n"], gradient: Float[np.ndarray, " n"], cut: float) -> float:
    """Return the Newton decrement gradient' matrix^-1 gradient over what is seen."""
    scale, values, vectors = _decompose(matrix)
    seen = _seen(values, cut)
    return float(np.sum((vectors.T @ (gradient / scale))[seen] ** 2 / values[seen]))


def eliminate(matrix: Float[np.ndarray, "n n"], p: int, cut: float = 1e-12) -> Float[np.ndarray, "p p"]:
    """Return the Schur complement of all but the first p unknowns."""
    if len(matrix) == p:
        return matrix.copy()
    return matrix[:p, :p] - matrix[:p, p:] @ solve_seen(matrix[p:, p:], matrix[p:, :p], cut)


def _decompose(
    matrix: Float[np.ndarray, "n n"],
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"], Float[np.ndarray, "n n"]]:
    """Return the scale of the unknowns, and eigenvalues and eigenvectors of the matrix scaled to a unit diagonal."""
    scale = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    values, vectors = np.linalg.eigh(matrix / np.outer(scale, scale))
    return scale, values, vectors


def _seen(values: Float[np.ndarray, " n"], cut: float) -> Bool[np.ndarray, " n"]:
    return values > cut * np.max(values, initial=1e-300)
