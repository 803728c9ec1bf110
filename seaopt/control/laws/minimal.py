r"""Realise a law's two transfer functions as one state space of least order, integrators apart, for `realisation`.

C_r and C_y become one system with two inputs, of least order, in coordinates that single precision can hold. With
:math:`\delta = 1 - q`, every denominator is :math:`\delta^m R(q)`, R without a root at 1, and the m integrators split
off exactly: with X the first m terms of the Taylor series of N/R at :math:`\delta = 0`,

.. math:: \frac{N}{\delta^m R} = \frac{X(\delta)}{\delta^m} + \frac{Y(q)}{R(q)}, \qquad Y = \frac{N - X R}{\delta^m}

and in :math:`w = 1/(z - 1)`, where :math:`1/\delta = 1 + w`, the first part is :math:`g_0 + g_1 w + \dots + g_m w^m`:
a chain of m accumulators whose poles are 1 to the last bit. The rest is balanced (Moore, IEEE Trans. Automatic
Control 26(1), 1981): controllability and observability Gramians are equal and diagonal, which keeps rounding noise
low (Mullis, Roberts, IEEE Trans. Circuits and Systems 23(9), 1976), and states that C_r and C_y share, or that
nothing drives, show as Hankel singular values of zero and are left out.
"""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float
from scipy.linalg import schur

from seaopt.control.loops.transfer_function import TransferFunction
from seaopt.errors import ControlError
from seaopt.records import record

EPS = float(np.finfo(float).eps)
POLE_AT_ONE = 64 * EPS  # a denominator this small at q = 1, against its coefficients, has a root there
ZERO_AT_ONE = 4 * EPS  # stricter for a numerator: a weak integral is to be kept, and one of rounding does no harm
NEGLIGIBLE_HANKEL = 1e-13  # Hankel singular values below this share of the law's gain are rounding
VANISHED = 1e-18  # a power of A this small adds nothing to a Gramian


@record(eq=False)
class SplitLaw:
    """A transfer function taken apart: g_1 ... g_m, Y, R, and the first m + 2 terms of the series of N/R."""

    chain: Float[np.ndarray, " m"]
    rest: Float[np.ndarray, " _"]
    den: Float[np.ndarray, " _"]
    series: Float[np.ndarray, " _"]


def split(name: str, tf: TransferFunction) -> SplitLaw:
    """Take a transfer function apart as the module's docstring does, m as small as the numerator lets it be.

    Raises
    ------
    ControlError
        A coefficient is not finite, or den[0] is not 1.

    """
    num, den, m = tf.num.astype(float), np.trim_zeros(tf.den.astype(float), "b"), 0
    if not (np.all(np.isfinite(num)) and np.all(np.isfinite(den)) and tf.den[0] == 1.0):
        raise ControlError(f"{name}: num or den has a number that is not finite, or den[0] is not 1; tune again")
    if not np.any(num):
        return SplitLaw(chain=np.zeros(0), rest=np.zeros(1), den=np.ones(1), series=np.zeros(2))
    while den.size > 1 and _has_root_at_one(den, POLE_AT_ONE):
        den, m = np.cumsum(den)[:-1], m + 1
        if num.size > 1 and _has_root_at_one(num, ZERO_AT_ONE):
            num, m = np.cumsum(num)[:-1], m - 1
    series = _expand(num, den, m + 2)
    chain = np.zeros(m + 1)  # the coefficients of w^0 ... w^m in X / delta^m, with 1/delta = 1 + w
    for power, value in zip(range(m, 0, -1), series, strict=False):
        chain[: power + 1] += value * np.array([math.comb(power, i) for i in range(power + 1)])
    removed = np.convolve(_flip(series[:m]), den) if m else np.zeros(1)
    rest = np.zeros(max(num.size, removed.size, m + 1))
    rest[: num.size] = num
    rest[: removed.size] -= removed
    for _ in range(m):
        rest = np.cumsum(rest)[:-1]
    return SplitLaw(chain=chain[1:], rest=rest, den=den, series=series)


def put_over_one_denominator(parts: list[SplitLaw]) -> tuple[list[Float[np.ndarray, " _"]], Float[np.ndarray, " _"]]:
    """Return both Y over one R."""
    one, other = parts
    if np.array_equal(one.den, other.den):
        return [one.rest, other.rest], one.den
    return [np.convolve(one.rest, other.den), np.convolve(other.rest, one.den)], np.convolve(one.den, other.den)


def _has_root_at_one(polynomial: Float[np.ndarray, " n"], share: float) -> bool:
    return bool(abs(np.sum(polynomial)) <= share * np.sum(np.abs(polynomial)))


def _flip(polynomial: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Return the coefficients in 1 - q of a polynomial in q, or the other way."""
    out = np.zeros(polynomial.size)
    for value in polynomial[::-1]:  # Horner's rule; the last coefficient shifted out is zero
        out = out - np.concatenate([[0.0], out[:-1]])
        out[0] += value
    return out


def _expand(num: Float[np.ndarray, " n"], den: Float[np.ndarray, " k"], terms: int) -> Float[np.ndarray, " terms"]:
    """Return the first terms of num/den in powers of 1 - q."""
    top, bottom = (np.concatenate([_flip(p), np.zeros(terms)]) for p in (num, den))
    out = np.zeros(terms)
    for j in range(terms):
        out[j] = (top[j] - np.dot(out[:j], bottom[j:0:-1])) / bottom[0]
    return out


def balance(
    numerators: list[Float[np.ndarray, " _"]], den: Float[np.ndarray, " k"], gain: float
) -> tuple[Float[np.ndarray, "m m"], Float[np.ndarray, "m 2"], Float[np.ndarray, " m"]]:
    """Return a balanced realisation of least order of two transfer functions over one denominator, each of its input.

    What is below `NEGLIGIBLE_HANKEL` of `gain`, or of the largest Hankel singular value, is rounding.

    Raises
    ------
    ControlError
        A pole is not inside the unit circle.

    """
    n = max(p.size for p in (*numerators, den)) - 1
    column = np.pad(den, (0, n + 1 - den.size))[1:]
    a, c = np.eye(n, k=1), np.eye(1, n)[0]
    a[:, :1] -= column[:, None]
    b = np.column_stack([np.pad(p, (0, n + 1 - p.size))[1:] - p[0] * column for p in numerators])
    if not c.size:
        return a, b, c
    a, turn = (np.asarray(part) for part in schur(a))  # powers of a triangle keep its poles, of a companion form not
    b, c = turn.T @ b, c @ turn
    radius = float(np.max(np.abs(np.linalg.eigvals(a))))
    if radius >= 1.0:
        raise ControlError(f"the law has a pole at |z| = {radius:.9g} besides its integrators; tune a stable one")
    reach, show = _factor(a, b), _factor(a.T, c[:, None])
    left, hankel, right = np.linalg.svd(show.T @ reach)
    kept = hankel > NEGLIGIBLE_HANKEL * max(float(hankel[0]), gain)
    root = np.sqrt(hankel[kept])
    into, back = reach @ right[kept].T / root, (show @ left[:, kept] / root).T
    return back @ a @ into, back @ b, c @ into


def _factor(a: Float[np.ndarray, "n n"], b: Float[np.ndarray, "n _"]) -> Float[np.ndarray, "n n"]:
    """Return G with G G' = the sum of a^k b b' a^k' over k >= 0, never squared: small directions keep their digits."""

    def triangle(wide: Float[np.ndarray, "n _"]) -> Float[np.ndarray, "n n"]:
        return np.asarray(np.linalg.qr(wide.T, mode="r")).T

    g = triangle(np.hstack([b, np.zeros(a.shape)]))
    while np.linalg.norm(a) > VANISHED:
        g, a = triangle(np.hstack([g, a @ g])), a @ a
    return g
