r"""Taylor models: polynomials in the coordinates of a box, and a bound on all that is left out.

With :math:`e_i \in [-1, 1]` the coordinates of a box, a Taylor model encloses a function of them,

.. math:: f(e) \in \sum_\alpha a_\alpha e^\alpha + [-r, r] \quad \text{for all } e, \quad |\alpha| \le q .

Sums and products of models enclose sums and products of what they enclose: what a product has beyond degree q goes
into r. A function of one model is expanded about its centre, with Lagrange's bound on the rest (Makino, Berz,
International Journal of Pure and Applied Mathematics 4, 2003). Terms that cancel, cancel in the polynomial: what
interval arithmetic (Moore, Interval Analysis, 1966) loses where a parameter occurs twice is lost in order q + 1 only.
Rounding is estimated, not
enclosed by directed rounding: every product adds some units in the last place of its size to the rest.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from itertools import combinations_with_replacement
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

Array = Float[np.ndarray, "..."]
ROUNDING = 2e-15  # of the size of a product, its rounding and that of the sums it is in
SPARSE = 8  # monomials up to which a product goes through them one by one


@dataclass(frozen=True, slots=True, eq=False)
class Basis:
    """The monomials of so many coordinates up to a degree, by ascending degree.

    Parameters
    ----------
    size, degree : int
        Coordinates and highest degree.
    powers : array, shape (m, size)
        Exponents of every monomial.
    target : array, shape (m, m)
        Which monomial a product is; -1 beyond the degree.
    until : array, shape (degree + 1,)
        How many monomials are of at most a degree.
    degrees : array, shape (m,)
        Of every monomial.
    pairs : three arrays
        Monomials whose products are within the degree, by ascending product, and where each product starts.

    """

    size: int
    degree: int
    powers: Int[np.ndarray, "m k"]
    target: Int[np.ndarray, "m m"]
    until: Int[np.ndarray, " d"]
    degrees: Int[np.ndarray, " m"]
    pairs: tuple[Int[np.ndarray, " n"], Int[np.ndarray, " n"], Int[np.ndarray, " m"]]

    def place(self, *coordinates: int) -> int:
        """Return where the product of coordinates is."""
        at = 0
        for k in coordinates:
            at = int(self.target[at, 1 + k])
        return at


@cache
def basis(size: int, degree: int) -> Basis:
    """Return the monomials of `size` coordinates up to a degree; 0 if there are none."""
    degree = degree if size else 0
    rows = [each for d in range(degree + 1) for each in combinations_with_replacement(range(size), d)]
    powers = np.array([[row.count(k) for k in range(size)] for row in rows], dtype=int).reshape(len(rows), size)
    where = {tuple(row): k for k, row in enumerate(powers)}
    target = np.array([[where.get(tuple(a + b), -1) for b in powers] for a in powers], dtype=int)
    degrees = np.sum(powers, axis=1)
    until = np.searchsorted(degrees, np.arange(degree + 1), side="right")
    first, second = np.nonzero(target >= 0)
    order = np.argsort(target[first, second], kind="stable")
    first, second = first[order], second[order]
    starts = np.searchsorted(target[first, second], np.arange(degrees.size))
    return Basis(size, degree, powers, target, until, degrees, (first, second, starts))


@dataclass(frozen=True, slots=True, eq=False)
class Taylor:
    """Taylor models over many boxes, or of the entries of matrices.

    Parameters
    ----------
    basis : Basis
    a, r : arrays
        Coefficients, shape (m, *s), and the rest, s. A rest that is infinite encloses everything.

    """

    basis: Basis
    a: Array
    r: Array

    @property
    def c(self) -> Array:
        """The centre: its value in the middle of the box."""
        return self.a[0]

    @property
    def reach(self) -> Array:
        """Largest distance from the centre."""
        return np.sum(np.abs(self.a[1:]), axis=0) + self.r

    @property
    def size(self) -> Array:
        """Largest size."""
        return np.sum(np.abs(self.a), axis=0) + self.r

    def truncated(self, degree: int) -> Taylor:
        """Return a model of a lower degree, what it leaves out in its rest."""
        over, count = basis(self.basis.size, degree), int(self.basis.until[min(degree, self.basis.degree)])
        return Taylor(over, self.a[:count], self.r + np.sum(np.abs(self.a[count:]), axis=0))

    def sizes(self) -> Array:
        """Return the largest size of the parts of each degree, shape (degree + 1, *s)."""
        return np.add.reduceat(np.abs(self.a), np.concatenate([[0], self.basis.until[:-1]]), axis=0)

    def __neg__(self) -> Taylor:
        return Taylor(self.basis, -self.a, self.r)

    def __add__(self, other: Taylor | float) -> Taylor:
        if isinstance(other, Taylor):
            return Taylor(self.basis, self.a + other.a, self.r + other.r)
        a = self.a.copy()
        a[0] += other
        return Taylor(self.basis, a, self.r)

    def __sub__(self, other: Taylor | float) -> Taylor:
        return self + (-other)

    def __mul__(self, other: Taylor | float | Array) -> Taylor:
        """Return the product with a model of the same shape, or with numbers."""
        if isinstance(other, Taylor):
            return _product(self, other, np.multiply)
        return Taylor(self.basis, self.a * other, self.r * np.abs(other))

    __radd__, __rmul__ = __add__, __mul__

    def __rsub__(self, other: float) -> Taylor:
        return (-self) + other

    def __matmul__(self, other: Taylor) -> Taylor:
        return _product(self, other, np.matmul)

    def between(self, left: Array, right: Array) -> Taylor:
        """Return left @ self @ right, of matrices without uncertainty."""
        return Taylor(self.basis, left @ self.a @ right, np.abs(left) @ self.r @ np.abs(right))

    def __getitem__(self, key: Any) -> Taylor:
        """Return entries; the key is of the shape s."""
        key = key if isinstance(key, tuple) else (key,)
        return Taylor(self.basis, self.a[(slice(None), *key)], self.r[key])

    def with_rest(self, rest: Array) -> Taylor:
        """Return the same polynomial with another rest."""
        return Taylor(self.basis, self.a, rest)

    def applied(self, series: list[Array], last: Array) -> Taylor:
        """Return a function of this.

        Parameters
        ----------
        series : list of arrays
            Its Taylor coefficients about the centre, up to the degree.
        last : array
            Largest size of the next one over all values; not finite where the function is not smooth.

        """
        moved = Taylor(self.basis, np.concatenate([np.zeros_like(self.a[:1]), self.a[1:]]), self.r)
        out = constant(series[-1], self.basis)
        for item in reversed(series[:-1]):
            out = out * moved
            out = Taylor(out.basis, np.concatenate([out.a[:1] + item, out.a[1:]]), out.r)
        return _finite(out.with_rest(out.r + last * self.reach ** (self.basis.degree + 1)))

    def reciprocal(self) -> Taylor:
        """Return 1/self; infinitely uncertain where that may be zero."""
        inverse = 1.0 / self.c
        least = np.abs(self.c) - self.reach
        degree = self.basis.degree
        last = np.where(least > 0.0, np.abs(inverse) ** (degree + 1) / np.where(least > 0.0, least, 1.0), np.inf)
        return self.applied([inverse * (-inverse) ** k for k in range(degree + 1)], last)


def constant(value: Array, over: Basis) -> Taylor:
    """Return what does not depend on the coordinates."""
    a = np.zeros((over.powers.shape[0], *value.shape))
    a[0] = value
    return Taylor(over, a, np.zeros(value.shape))


def linear(centre: Array, slopes: Array, over: Basis) -> Taylor:
    """Return centre + sum of slopes[i] e_i; shapes s and (k, *s)."""
    out = constant(centre, over)
    out.a[1 : 1 + over.size] = slopes
    return out


def stacked(items: list[Taylor]) -> Taylor:
    """Return models as the entries along a new last axis."""
    return Taylor(
        items[0].basis, np.stack([item.a for item in items], axis=-1), np.stack([item.r for item in items], axis=-1)
    )


def kept(item: Taylor, mask: Bool[np.ndarray, "..."]) -> Taylor:
    """Return the models where a mask holds, zero elsewhere."""
    return Taylor(item.basis, np.where(mask, item.a, 0.0), np.where(mask, item.r, 0.0))


@np.errstate(over="ignore", invalid="ignore")  # not finite becomes an infinite rest
def _product(a: Taylor, b: Taylor, times: Callable[[Array, Array], Array]) -> Taylor:
    over = a.basis
    mine, others = _present(a), _present(b)
    if mine.size > SPARSE and times is np.multiply:
        first, second, starts = over.pairs
        whole = np.add.reduceat(a.a[first] * b.a[second], starts, axis=0)
    else:
        whole = np.zeros((over.until[-1], *times(a.r, b.r).shape))
        for i in mine:
            own = others[: np.searchsorted(others, over.until[over.degree - over.degrees[i]])]
            whole[over.target[i, own]] += times(a.a[i], b.a[own])
    parts, every = a.sizes(), np.cumsum(b.sizes()[::-1], axis=0)  # entry k: the parts of the k + 1 highest degrees
    own = b.r + ROUNDING * (every[-1] + b.r)
    rest = times(np.sum(parts, axis=0) + a.r, own) + times(a.r, every[-1])
    if over.degree:
        rest = rest + np.sum(times(parts[1:], every[:-1]), axis=0)
    return _finite(Taylor(over, whole, rest))


def _present(item: Taylor) -> Int[np.ndarray, " m"]:
    """Return the monomials that some entry has."""
    return np.flatnonzero(np.any(item.a.reshape(item.a.shape[0], -1), axis=1))


def _finite(item: Taylor) -> Taylor:
    """Return the models, those that overflowed with an infinite rest."""
    good = np.isfinite(np.sum(item.a, axis=0)) & np.isfinite(item.r)
    if np.all(good):
        return item
    return Taylor(item.basis, np.where(good, item.a, 0.0), np.where(good, item.r, np.inf))
