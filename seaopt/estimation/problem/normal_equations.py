"""Normal equations: Gram matrices of passes added up over unknowns, and what is seen of them inverted.

A matrix is scaled to a unit diagonal before it is inverted. Its eigenvalues below a cut, a part of the largest, are
directions that are not seen: they are left out, as in a pseudo-inverse.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int

RANK = 1e-10  # eigenvalues of the normalised Hessian below this part of the largest are zero


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


def spectrum(
    matrix: Float[np.ndarray, "n n"],
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"], Float[np.ndarray, "n n"]]:
    """Return the scale of the unknowns, and eigenvalues and eigenvectors of the matrix scaled to a unit diagonal."""
    scale = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    values, vectors = np.linalg.eigh(matrix / np.outer(scale, scale))
    return scale, values, vectors


def inverse(
    matrix: Float[np.ndarray, "n n"], cut: float = RANK
) -> tuple[Float[np.ndarray, "n n"], Float[np.ndarray, " n"]]:
    """Return the inverse over what is seen, and how much of each unknown is not (0 to 1, squared)."""
    scale, values, vectors = spectrum(matrix)
    seen = _seen(values, cut)
    found = (vectors[:, seen] / values[seen]) @ vectors[:, seen].T / np.outer(scale, scale)
    return found, np.sum(vectors[:, ~seen] ** 2, axis=1)


def solved(
    matrix: Float[np.ndarray, "n n"], right: Float[np.ndarray, "n ..."], cut: float
) -> Float[np.ndarray, "n ..."]:
    """Return matrix^-1 right over what is seen; the rest stays where it is."""
    scale, values, vectors = spectrum(matrix)
    seen = _seen(values, cut)
    along = (vectors[:, seen] / scale[:, None]).T @ right
    return (vectors[:, seen] / scale[:, None]) @ (along.T / values[seen]).T


def newton_decrement(matrix: Float[np.ndarray, "n n"], gradient: Float[np.ndarray, " n"], cut: float) -> float:
    """Return gradient' matrix^-1 gradient over what is seen."""
    scale, values, vectors = spectrum(matrix)
    seen = _seen(values, cut)
    return float(np.sum((vectors.T @ (gradient / scale))[seen] ** 2 / values[seen]))


def eliminated(matrix: Float[np.ndarray, "n n"], p: int, cut: float = 1e-12) -> Float[np.ndarray, "p p"]:
    """Return the Schur complement of all but the first p unknowns."""
    if len(matrix) == p:
        return matrix.copy()
    return matrix[:p, :p] - matrix[:p, p:] @ solved(matrix[p:, p:], matrix[p:, :p], cut)


def _seen(values: Float[np.ndarray, " n"], cut: float) -> Bool[np.ndarray, " n"]:
    return values > cut * np.max(values, initial=1e-300)
