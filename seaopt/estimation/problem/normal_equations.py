r"""Normal equations: Gram matrices of passes added up over unknowns, solved over what the data show.

A matrix is scaled to a unit diagonal before it is inverted. Its eigenvalues below a cut, a part of the largest, are
directions that the data do not show: they are left out, as in a pseudo-inverse.

A log of many segments has as many initial states, which meet the parameters but not one another: the matrix is an
arrow, of blocks D and a shaft (A, B) of what they share. Each block is then eliminated alone,

.. math:: S = A - \sum_i B_i^T D_i^+ B_i, \qquad
          x_0 = S^+ \Big(b_0 - \sum_i B_i^T D_i^+ b_i\Big), \qquad x_i = D_i^+ (b_i - B_i x_0),

which costs in proportion to the number of blocks; an eigendecomposition of all costs its cube.
"""

from __future__ import annotations

from typing import TypeVar

import numpy as np
from jaxtyping import Bool, Float, Int

from seaopt.estimation.problem.shapes import Matrix, ParameterMatrix, Parts, Vector
from seaopt.records import record

FEWEST = 100  # unknowns from which the blocks of an arrow are eliminated one by one
LARGEST_BLOCK = 50  # unknowns
RANK = 1e-10  # eigenvalues of the normalised Hessian below this part of the largest are zero


@record(eq=False)
class QuadraticModel:
    """A sum of squares near `z`: half of it (the cost), its gradient and its Gauss-Newton Hessian.

    `linear` marks the unknowns in which residuals are affine: a step may change those at will.
    """

    z: Vector
    cost: float
    gradient: Vector
    hessian: Matrix
    linear: Bool[np.ndarray, " n"]

    def distance_squared(self, free: Bool[np.ndarray, " n"]) -> float:
        """Return the squared distance to the minimum over the free unknowns, in standard deviations."""
        return measure_decrement(self.hessian[free][:, free], self.gradient[free], 1e-12)


M = TypeVar("M", bound=QuadraticModel, covariant=True)


def add_gram(
    normal: Float[np.ndarray, "... m m"], gram: Float[np.ndarray, "... nc nc"], places: Int[np.ndarray, " nd"]
) -> None:
    """Add a Gram matrix of [residual, derivatives] to the normal matrix of [residual, unknowns], in place. `normal`:
    shape (..., 1 + n, 1 + n), row 0 the gradient behind the residual's square; `gram`: shape (..., 1 + nd, 1 + nd), of
    one output of a pass, in sigma; `places`: the unknown of each derivative, -1 where that is known.
    """
    used = np.flatnonzero(places >= 0)
    to, of = np.concatenate([[0], 1 + places[used]]), np.concatenate([[0], 1 + used])
    normal[..., to[:, None], to] += gram[..., of[:, None], of]


def invert(matrix: Matrix, cut: float = RANK) -> tuple[Matrix, Vector]:
    """Return the inverse over what is seen, and how much of each unknown is not (0 to 1, squared)."""
    scale, factors = _factor(matrix, cut)
    return factors.invert() / np.outer(scale, scale), factors.unseen()


def solve_seen(matrix: Matrix, right: Float[np.ndarray, "n ..."], cut: float) -> Float[np.ndarray, "n ..."]:
    """Return matrix^-1 right over what is seen; the rest stays where it is."""
    scale, factors = _factor(matrix, cut)
    if not right.size:
        return right.copy()
    columns = right.reshape(len(scale), -1) / scale[:, None]
    return (factors.solve(columns) / scale[:, None]).reshape(right.shape)


def measure_decrement(matrix: Matrix, gradient: Vector, cut: float) -> float:
    """Return the Newton decrement gradient' matrix^-1 gradient over what is seen."""
    return float(gradient @ solve_seen(matrix, gradient, cut))


def eliminate(matrix: Matrix, p: int, cut: float = 1e-12) -> ParameterMatrix:
    """Return the Schur complement of all but the first p unknowns."""
    if len(matrix) == p:
        return matrix.copy()
    return matrix[:p, :p] - matrix[:p, p:] @ solve_seen(matrix[p:, p:], matrix[p:, :p], cut)


def _factor(matrix: Matrix, cut: float) -> tuple[Vector, _Eigenspace | _Arrow]:
    """Return the scale of the unknowns, and the factors of the matrix scaled to a unit diagonal."""
    scale = np.sqrt(np.maximum(matrix.diagonal(), 1e-300))
    shape, scaled = find_arrow(matrix), matrix / (scale[:, None] * scale)
    return scale, _Eigenspace.of(scaled, cut) if shape is None else _Arrow.of(scaled, shape, cut)


@record(eq=False)
class _Eigenspace:
    """The eigenvalues and eigenvectors that are seen, of matrices in a stack, and the eigenvectors that are not."""

    values: Float[np.ndarray, "... n"]
    vectors: Float[np.ndarray, "... n n"]
    seen: Bool[np.ndarray, "... n"]

    @classmethod
    def of(cls, matrix: Float[np.ndarray, "... n n"], cut: float, largest: float = 1e-300) -> _Eigenspace:
        values, vectors = np.linalg.eigh(matrix)
        return cls(values=values, vectors=vectors, seen=values > cut * np.max(values, initial=largest))

    def solve(self, right: Float[np.ndarray, "... n m"]) -> Float[np.ndarray, "... n m"]:
        return self.vectors @ (self._invert_values()[..., None] * (self.vectors.swapaxes(-1, -2) @ right))

    def invert(self) -> Float[np.ndarray, "... n n"]:
        return (self.vectors * self._invert_values()[..., None, :]) @ self.vectors.swapaxes(-1, -2)

    def _invert_values(self) -> Float[np.ndarray, "... n"]:
        if self.seen.all():
            return 1.0 / self.values
        return np.where(self.seen, 1.0 / np.where(self.seen, self.values, 1.0), 0.0)

    def unseen(self) -> Float[np.ndarray, "... n"]:
        return np.sum(np.where(self.seen[..., None, :], 0.0, self.vectors) ** 2, axis=-1)


@record(eq=False)
class ArrowShape:
    """Which unknowns are the shaft of an arrow, and which are its blocks: those of one size are rows of one array."""

    shaft: Int[np.ndarray, " q"]
    blocks: tuple[Int[np.ndarray, "..."], ...]


def find_arrow(matrix: Matrix) -> ArrowShape | None:
    """Return the shape of a matrix that is an arrow of many small blocks; None where that would save nothing. Unknowns
    that meet far more others than the usual one does are the shaft; what is left falls apart into blocks.
    """
    if len(matrix) < FEWEST:
        return None
    from scipy.sparse import csr_array  # deferred: scipy is slow to load
    from scipy.sparse.csgraph import connected_components

    meet = matrix != 0.0
    counts = np.count_nonzero(meet, axis=1)
    shaft = counts > 2.0 * np.median(counts)
    outside = np.flatnonzero(~shaft)
    _, labels = connected_components(csr_array(meet[outside][:, outside]), directed=False)
    sizes = np.bincount(labels)
    if np.max(sizes) > LARGEST_BLOCK or np.count_nonzero(shaft) > len(matrix) // 2:
        return None
    rows = outside[np.argsort(labels, kind="stable")]
    ends = np.cumsum(sizes)
    blocks = tuple(
        np.array([rows[end - size : end] for end in ends[sizes == size]]) for size in np.unique(sizes).tolist()
    )
    return ArrowShape(shaft=np.flatnonzero(shaft), blocks=blocks)


@record(eq=False)
class _Arrow:
    """The factors of an arrow: of each block, what takes the shaft's unknowns to the block's, and of the rest."""

    shape: ArrowShape
    blocks: tuple[_Eigenspace, ...]
    across: tuple[Float[np.ndarray, "..."], ...]
    remainder: _Eigenspace

    @classmethod
    def of(cls, matrix: Matrix, shape: ArrowShape, cut: float) -> _Arrow:
        shaft = matrix[shape.shaft][:, shape.shaft]
        reduced = shaft.copy()
        blocks: list[_Eigenspace] = []
        across: Parts = []
        for rows in shape.blocks:
            beside = matrix[rows[:, :, None], shape.shaft]
            blocks.append(_Eigenspace.of(matrix[rows[:, :, None], rows[:, None, :]], cut))
            across.append(blocks[-1].solve(beside))
            reduced -= np.einsum("bkp,bkq->pq", beside, across[-1])
        largest = float(np.max(np.linalg.eigvalsh(shaft), initial=1e-300))
        return cls(
            shape=shape, blocks=tuple(blocks), across=tuple(across), remainder=_Eigenspace.of(reduced, cut, largest)
        )

    def solve(self, right: Float[np.ndarray, "n m"]) -> Float[np.ndarray, "n m"]:
        solution = np.empty_like(right)
        shaft = right[self.shape.shaft].copy()
        for rows, across in zip(self.shape.blocks, self.across, strict=True):
            shaft -= np.einsum("bkq,bkm->qm", across, right[rows])
        solution[self.shape.shaft] = shaft = self.remainder.solve(shaft)
        for rows, block, across in zip(self.shape.blocks, self.blocks, self.across, strict=True):
            solution[rows] = block.solve(right[rows]) - across @ shaft
        return solution

    def invert(self) -> Matrix:
        every = self._extend(np.eye(self.shape.shaft.size))
        inverse = every @ self.remainder.solve(every.T)
        for rows, block in zip(self.shape.blocks, self.blocks, strict=True):
            inverse[rows[:, :, None], rows[:, None, :]] += block.invert()
        return inverse

    def unseen(self) -> Vector:
        null = self._extend(self.remainder.vectors[:, ~self.remainder.seen])
        unseen = np.sum(null**2 / np.maximum(np.sum(null**2, axis=0), 1e-300), axis=1)
        for rows, block in zip(self.shape.blocks, self.blocks, strict=True):
            unseen[rows] += block.unseen()
        return np.minimum(unseen, 1.0)

    def _extend(self, shaft: Float[np.ndarray, "q m"]) -> Float[np.ndarray, "n m"]:
        """Return vectors of the shaft's unknowns with those of the blocks that follow them."""
        count = self.shape.shaft.size + sum(rows.size for rows in self.shape.blocks)
        every = np.empty((count, shaft.shape[1]))
        every[self.shape.shaft] = shaft
        for rows, across in zip(self.shape.blocks, self.across, strict=True):
            every[rows] = -across @ shaft
        return every
