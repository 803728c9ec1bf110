r"""Least order: take a transfer function's integrators apart from the rest, and balance a state space.

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
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from jaxtyping import Complex, Float
from scipy.linalg import block_diag, matrix_balance, schur, solve_sylvester

from seaopt.control.loops.transfer_function import TransferFunction
from seaopt.errors import ControlError
from seaopt.records import record

EPS = float(np.finfo(float).eps)
POLE_AT_ONE = 64 * EPS  # a denominator this small at q = 1, against its coefficients, has a root there
ZERO_AT_ONE = 4 * EPS  # stricter for a numerator: a weak integral is to be kept, and one of rounding does no harm
NEGLIGIBLE_HANKEL = 1e-13  # Hankel singular values below this share of the law's gain are rounding
RESPONSE_TOLERANCE = 1e-6  # how well a state space must have the response of its transfer function
MOST_INTEGRATORS = 2  # of a law given as matrices: three poles at 1 lie too far apart to tell from slow lags
ROUNDED_POLES = 1e4  # of the rounding unit, by which matrices may be off that somebody wrote down
VANISHED = 1e-18  # a power of A this small adds nothing to a Gramian


@record(eq=False)
class SplitLaw:
    """A transfer function taken apart: g_1 ... g_m, Y and R."""

    chain: Float[np.ndarray, " m"]
    rest: Float[np.ndarray, " _"]
    den: Float[np.ndarray, " _"]


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
        return SplitLaw(chain=np.zeros(0), rest=np.zeros(1), den=np.ones(1))
    while den.size > 1 and _has_root_at_one(den, POLE_AT_ONE):
        den, m = np.cumsum(den)[:-1], m + 1
        if num.size > 1 and _has_root_at_one(num, ZERO_AT_ONE):
            num, m = np.cumsum(num)[:-1], m - 1
    series = _expand(num, den, m)
    chain = np.zeros(m + 1)  # the coefficients of w^0 ... w^m in X / delta^m, with 1/delta = 1 + w
    for power, value in zip(range(m, 0, -1), series, strict=False):
        chain[: power + 1] += value * np.array([math.comb(power, i) for i in range(power + 1)])
    removed = np.convolve(_flip(series[:m]), den) if m else np.zeros(1)
    rest = np.zeros(max(num.size, removed.size, m + 1))
    rest[: num.size] = num
    rest[: removed.size] -= removed
    for _ in range(m):
        rest = np.cumsum(rest)[:-1]
    return SplitLaw(chain=chain[1:], rest=rest, den=den)


def realise_rest(
    parts: list[SplitLaw],
) -> tuple[Float[np.ndarray, "n n"], Float[np.ndarray, "n k"], Float[np.ndarray, " n"]]:
    """Return Y/R of all in observer form, each of its input: on shared states where R is the same, else side by side.

    The direct terms, Y at q = 0, are left out.
    """
    groups: list[list[tuple[int, SplitLaw]]] = []
    for numbered in enumerate(parts):
        alike = (group for group in groups if np.array_equal(group[0][1].den, numbered[1].den))
        group = next(alike, None)
        if group is None:
            groups.append([numbered])
        else:
            group.append(numbered)
    blocks: list[Float[np.ndarray, "_ _"]] = []
    drives: list[Float[np.ndarray, "_ k"]] = []
    for group in groups:
        den = group[0][1].den
        n = max(p.size for _, part in group for p in (part.rest, den)) - 1
        column = np.pad(den, (0, n + 1 - den.size))[1:]
        a, b = np.eye(n, k=1), np.zeros((n, len(parts)))
        a[:, :1] -= column[:, None]
        for input_number, part in group:
            b[:, input_number] = np.pad(part.rest, (0, n + 1 - part.rest.size))[1:] - part.rest[0] * column
        blocks.append(a)
        drives.append(b)
    c = np.concatenate([np.eye(1, len(block))[0] for block in blocks])
    return np.asarray(block_diag(*blocks)).reshape(c.size, c.size), np.vstack(drives), c


def build_chain(
    chain: Float[np.ndarray, "m k"], a: Float[np.ndarray, "l l"], b: Float[np.ndarray, "l k"],
    c: Float[np.ndarray, " l"],
) -> dict[str, Float[np.ndarray, "..."]]:  # fmt: skip
    """Return a, b and c of a chain of m accumulators, g_j in row j of `chain`, beside a state space."""
    m, n = len(chain), len(chain) + c.size
    whole = np.zeros((n, n))
    whole[:m, :m], whole[m:, m:] = np.eye(m) + np.eye(m, k=1), a
    return {"a": whole, "b": np.vstack([chain, b]), "c": np.concatenate([np.eye(1, m)[0], c])}


def check_same_response(
    name: str, tf: TransferFunction, response: Callable[[Float[np.ndarray, " k"]], Complex[np.ndarray, " k"]],
    sample_time_s: float,
) -> None:  # fmt: skip
    """Refuse a state space whose response is not that of its transfer function, but for its coefficients' rounding.

    Raises
    ------
    ControlError
        It is not.

    """
    f = np.geomspace(1e-4, 0.49, 25) / sample_time_s
    q = np.exp(-2j * np.pi * f * sample_time_s)
    bottom = np.polynomial.polynomial.polyval(q, tf.den)
    wanted = np.polynomial.polynomial.polyval(q, tf.num) / bottom
    rounding = np.sum(np.abs(tf.num)) + np.sum(np.abs(tf.den)) * np.abs(wanted)
    allowed = RESPONSE_TOLERANCE * np.abs(wanted) + 256 * EPS * rounding / np.abs(bottom)
    if not np.all(np.abs(response(f) - wanted) <= allowed):
        raise ControlError(
            f"{name}: slow poles are too close together to tell from integrators in double precision; sample more "
            "slowly, make them faster, or give the law as a state space"
        )


def split_integrators(
    a: Float[np.ndarray, "n n"], b: Float[np.ndarray, "n k"], c: Float[np.ndarray, " n"]
) -> Iterator[
    tuple[Float[np.ndarray, "m k"], Float[np.ndarray, "l l"], Float[np.ndarray, "l k"], Float[np.ndarray, " l"]]
]:
    r"""Yield a state space as chain and rest, with ever fewer of the poles about 1 taken for integrators, none at last.

    Rounding moves an eigenvalue of multiplicity k by its k-th root, so that which poles are integrators is to be
    checked on the response. An invariant subspace each (ordered Schur form and Sylvester's equation) takes the two
    apart: with N = A_1 - I the first is :math:`\sum_j c_1 N^{j-1} b_1 w^j`.
    """
    distance = np.sort(np.abs(np.linalg.eigvals(a) - 1.0))
    # States of very different units would leave the Schur form's poles less exact than these, which are of scaled ones.
    scaled, (scale, _) = matrix_balance(a, permute=False, separate=True)
    b_scaled, c_scaled = b / scale[:, None], c * scale
    for m in range(min(c.size, MOST_INTEGRATORS), 0, -1):
        reach = (ROUNDED_POLES * EPS) ** (1.0 / m)
        if np.count_nonzero(distance < reach) != m:
            continue
        parts: tuple[Any, ...] = schur(scaled, sort=lambda re, im, reach=reach: np.hypot(re - 1.0, im) < reach)
        triangle, basis, first = parts
        if first != m:
            continue
        one, rest = triangle[:m, :m], triangle[m:, m:]
        link = np.asarray(solve_sylvester(one, -rest, -triangle[:m, m:])) if rest.size else np.zeros((m, 0))
        into, out = basis.T @ b_scaled, c_scaled @ basis
        drive, read = into[:m] - link @ into[m:], out[:m]
        chain, power = np.zeros((m, b.shape[1])), np.eye(m)
        for j in range(m):
            chain[j] = read @ power @ drive
            power = power @ (one - np.eye(m))
        yield chain, rest, into[m:], out[m:] + read @ link
    yield np.zeros((0, b.shape[1])), a, b, c


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
    a: Float[np.ndarray, "n n"], b: Float[np.ndarray, "n k"], c: Float[np.ndarray, " n"], gain: float
) -> tuple[Float[np.ndarray, "m m"], Float[np.ndarray, "m k"], Float[np.ndarray, " m"]]:
    """Return a stable system balanced and of least order.

    What is below `NEGLIGIBLE_HANKEL` of `gain`, or of the largest Hankel singular value, is rounding.
    """
    a, turn = (np.asarray(part) for part in schur(a))  # powers of a triangle keep its poles, of a companion form not
    b, c = turn.T @ b, c @ turn
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
