r"""Taylor models, the arithmetic of the bounds: polynomials over a box, each with a bound on all that it leaves out.

With :math:`e_i \in [-1, 1]` the coordinates of a box, a Taylor model encloses a function of them,

.. math:: f(e) \in \sum_\alpha a_\alpha e^\alpha + [-r, r] \quad \text{for all } e, \quad |\alpha| \le q .

Sums and products of models enclose sums and products of what they enclose: what a product has beyond degree q goes
into r. A function of one model is expanded about its centre, with Lagrange's bound on the remainder (Makino, Berz,
International Journal of Pure and Applied Mathematics 4, 2003). Terms that cancel, cancel in the polynomial: what
interval arithmetic (Moore, Interval Analysis, 1966) loses where a parameter occurs twice is lost in order q + 1 only.
Rounding is estimated, not enclosed by directed rounding: every product adds some units in the last place of its size to
the remainder.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from itertools import combinations_with_replacement
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from seaopt.records import record

Array = Float[np.ndarray, "..."]
PRODUCT_ROUNDING = 2e-15  # of a product's size: rounding of the product and of the sums it enters
SPARSE = 8  # monomials up to which a product goes through them one by one


@record(eq=False)
class Basis:
    """The monomials of some coordinates up to a degree, by ascending degree."""

    size: int  # coordinates
    degree: int
    powers: Int[np.ndarray, "m k"]  # exponents of every monomial
    target: Int[np.ndarray, "m m"]  # the monomial that a product of two is; -1 beyond the degree
    until: Int[np.ndarray, " d"]  # how many monomials have at most that degree
    degrees: Int[np.ndarray, " m"]  # of every monomial
    # Monomials whose products are within the degree, by ascending product, and where each product starts.
    pairs: tuple[Int[np.ndarray, " n"], Int[np.ndarray, " n"], Int[np.ndarray, " m"]]

    def index_of(self, *coordinates: int) -> int:
        """Return the index of a product of coordinates."""
        index = 0
        for k in coordinates:
            index = int(self.target[index, 1 + k])
        return index


@cache
def build_basis(size: int, degree: int) -> Basis:
    """Return the monomials of `size` coordinates up to a degree; 0 if there are none."""
    degree = degree if size else 0
    factors = [chosen for d in range(degree + 1) for chosen in combinations_with_replacement(range(size), d)]
    powers = np.array([[chosen.count(k) for k in range(size)] for chosen in factors], dtype=int)
    powers = powers.reshape(len(factors), size)
    index = {tuple(row): k for k, row in enumerate(powers)}
    target = np.array([[index.get(tuple(a + b), -1) for b in powers] for a in powers], dtype=int)
    degrees = np.sum(powers, axis=1)
    until = np.searchsorted(degrees, np.arange(degree + 1), side="right")
    first, second = np.nonzero(target >= 0)
    order = np.argsort(target[first, second], kind="stable")
    first, second = first[order], second[order]
    starts = np.searchsorted(target[first, second], np.arange(degrees.size))
    return Basis(
        size=size,
        degree=degree,
        powers=powers,
        target=target,
        until=until,
        degrees=degrees,
        pairs=(first, second, starts),
    )


@dataclass(frozen=True, slots=True, eq=False)  # not a record: the algebra below makes them by position
class Taylor:
    """Taylor models of several quantities: of many boxes, or of the entries of matrices.

    The coefficients a have the shape (m, *s), the remainder r has s; one that is infinite encloses everything.
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

    def truncate(self, degree: int) -> Taylor:
        """Return a model of a lower degree, with what it leaves out in its remainder."""
        over, count = build_basis(self.basis.size, degree), int(self.basis.until[min(degree, self.basis.degree)])
        return Taylor(over, self.a[:count], self.r + np.sum(np.abs(self.a[count:]), axis=0))

    def sizes_by_degree(self) -> Array:
        """Return the largest size of the parts of each degree, shape (degree + 1, *s)."""
        return np.add.reduceat(np.abs(self.a), np.concatenate([[0], self.basis.until[:-1]]), axis=0)

    def __neg__(self) -> Taylor:
        return Taylor(self.basis, -self.a, self.r)

    def __add__(self, other: Taylor | float | Array) -> Taylor:
        if isinstance(other, Taylor):
            return Taylor(self.basis, self.a + other.a, self.r + other.r)
        a = self.a.copy()
        a[0] += other
        return Taylor(self.basis, a, self.r)

    def __sub__(self, other: Taylor | float | Array) -> Taylor:
        return self + (-other)

    def __mul__(self, other: Taylor | float | Array) -> Taylor:
        """Return the product with a model of the same shape, or with numbers."""
        if isinstance(other, Taylor):
            return _multiply(self, other, np.multiply)
        return Taylor(self.basis, self.a * other, self.r * np.abs(other))

    __radd__, __rmul__ = __add__, __mul__

    def __rsub__(self, other: float) -> Taylor:
        return (-self) + other

    def __matmul__(self, other: Taylor) -> Taylor:
        return _multiply(self, other, np.matmul)

    def transform(self, left: Array, right: Array) -> Taylor:
        """Return left @ self @ right, of matrices without uncertainty."""
        return Taylor(self.basis, left @ self.a @ right, np.abs(left) @ self.r @ np.abs(right))

    def __getitem__(self, key: Any) -> Taylor:
        """Return entries; the key is of the shape s."""
        key = key if isinstance(key, tuple) else (key,)
        return Taylor(self.basis, self.a[(slice(None), *key)], self.r[key])

    def with_remainder(self, remainder: Array) -> Taylor:
        """Return the same polynomial with another remainder."""
        return Taylor(self.basis, self.a, remainder)

    def compose(self, series: list[Array], last: Array) -> Taylor:
        """Return a smooth function of this model, from its Taylor coefficients about the centre up to the degree.
        `last` is the largest size of the next coefficient over all values; not finite where it is not smooth.
        """
        centred = Taylor(self.basis, np.concatenate([np.zeros_like(self.a[:1]), self.a[1:]]), self.r)
        out = make_constant(series[-1], self.basis)
        for coefficient in reversed(series[:-1]):
            out = out * centred + coefficient
        return _mark_overflow(out.with_remainder(out.r + last * self.reach ** (self.basis.degree + 1)))

    def reciprocal(self) -> Taylor:
        """Return 1/self; infinitely uncertain where that may be zero."""
        inverse = 1.0 / self.c
        least = np.abs(self.c) - self.reach
        degree = self.basis.degree
        last = np.where(least > 0.0, np.abs(inverse) ** (degree + 1) / np.where(least > 0.0, least, 1.0), np.inf)
        return self.compose([inverse * (-inverse) ** k for k in range(degree + 1)], last)


def make_constant(value: Array, over: Basis) -> Taylor:
    """Return models of values that do not depend on the coordinates."""
    a = np.zeros((over.powers.shape[0], *value.shape))
    a[0] = value
    return Taylor(over, a, np.zeros(value.shape))


def make_linear(centre: Array, slopes: Array, over: Basis) -> Taylor:
    """Return centre + sum of slopes[i] e_i; shapes s and (k, *s)."""
    out = make_constant(centre, over)
    out.a[1 : 1 + over.size] = slopes
    return out


def stack_models(models: list[Taylor]) -> Taylor:
    """Return models as the entries along a new last axis."""
    a, r = (np.stack(parts, axis=-1) for parts in zip(*((model.a, model.r) for model in models), strict=True))
    return Taylor(models[0].basis, a, r)


def mask_models(model: Taylor, mask: Bool[np.ndarray, "..."]) -> Taylor:
    """Return the models where a mask holds, zero elsewhere."""
    return Taylor(model.basis, np.where(mask, model.a, 0.0), np.where(mask, model.r, 0.0))


@np.errstate(over="ignore", invalid="ignore")  # what is not finite becomes an infinite remainder
def _multiply(a: Taylor, b: Taylor, times: Callable[[Array, Array], Array]) -> Taylor:
    over = a.basis
    terms_a, terms_b = _find_monomials(a), _find_monomials(b)
    if terms_a.size > SPARSE and times is np.multiply:
        first, second, starts = over.pairs
        coefficients = np.add.reduceat(a.a[first] * b.a[second], starts, axis=0)
    else:
        coefficients = np.zeros((over.until[-1], *times(a.r, b.r).shape))
        for i in terms_a:
            within = terms_b[: np.searchsorted(terms_b, over.until[over.degree - over.degrees[i]])]
            coefficients[over.target[i, within]] += times(a.a[i], b.a[within])
    sizes_a = a.sizes_by_degree()
    highest_b = np.cumsum(b.sizes_by_degree()[::-1], axis=0)  # entry k: the parts of the k + 1 highest degrees
    rounded_b = b.r + PRODUCT_ROUNDING * (highest_b[-1] + b.r)
    remainder = times(np.sum(sizes_a, axis=0) + a.r, rounded_b) + times(a.r, highest_b[-1])
    if over.degree:
        remainder = remainder + np.sum(times(sizes_a[1:], highest_b[:-1]), axis=0)
    return _mark_overflow(Taylor(over, coefficients, remainder))


def _find_monomials(model: Taylor) -> Int[np.ndarray, " m"]:
    """Return the monomials that some entry has."""
    return np.flatnonzero(np.any(model.a.reshape(model.a.shape[0], -1), axis=1))


def _mark_overflow(model: Taylor) -> Taylor:
    """Return the models, those that overflowed with an infinite remainder."""
    good = np.isfinite(np.sum(model.a, axis=0)) & np.isfinite(model.r)
    if np.all(good):
        return model
    return Taylor(model.basis, np.where(good, model.a, 0.0), np.where(good, model.r, np.inf))
