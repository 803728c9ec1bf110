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

from seaopt.control.loops.transfer_function import TransferFunction
from seaopt.errors import ControlError
from seaopt.signals import VectorK, VectorM

EPS = float(np.finfo(float).eps)
POLE_AT_ONE = 64 * EPS  # a denominator this small at q = 1, against its coefficients, has a root there
COEFFICIENTS = EPS  # to which the value of a polynomial at 1 is known, against its coefficients
ZERO_AT_ONE = 4 * EPS  # stricter for a numerator: a weak integral is to be kept, and one of rounding does no harm
NEGLIGIBLE_HANKEL = 1e-13  # Hankel singular values below this share of the law's gain are rounding
RESPONSE_TOLERANCE = 1e-6  # how well a state space must have the response of its transfer function
MOST_INTEGRATORS = 2  # of a law given as matrices: three poles at 1 lie too far apart to tell from slow lags
NEAR_ONE = 1e-6  # a pole of matrices that is nearer to 1 is an integrator, where the response stays the same
TINY = 1e-300
VANISHED = 1e-18  # a power of A this small adds nothing to a Gramian

Vector = Float[np.ndarray, " n"]  # coefficients of a polynomial, or a row of states
Matrix = Float[np.ndarray, "n n"]
Inputs = Float[np.ndarray, "n k"]
Split = tuple[VectorM, Float[np.ndarray, " _"], Float[np.ndarray, " _"]]  # g_1 ... g_m, Y and R


def split(name: str, tf: TransferFunction) -> Split:
    """Take a transfer function apart as the module's docstring does, m as small as the numerator lets it be. Raises
    ControlError: a coefficient is not finite, den[0] is not 1, or slow poles make a root at 1 of rounding.
    """
    num, den, m = tf.num.astype(float), np.trim_zeros(tf.den.astype(float), "b"), 0
    if not (np.all(np.isfinite(num)) and np.all(np.isfinite(den)) and tf.den[0] == 1.0):
        raise ControlError(f"{name}: num or den has a number that is not finite, or den[0] is not 1; tune again")
    if not np.any(num):
        return np.zeros(0), np.zeros(1), np.ones(1)
    for _ in range(_count_roots_at_one(name, den)):
        den, m = np.cumsum(den)[:-1], m + 1
        if num.size > 1 and _has_root_at_one(num, ZERO_AT_ONE):
            num, m = np.cumsum(num)[:-1], m - 1
    series = _expand(num, den, m)
    chain = np.zeros(m + 1)  # the coefficients of w^0 ... w^m in X / delta^m, with 1/delta = 1 + w
    for power, value in zip(range(m, 0, -1), series, strict=False):
        chain[: power + 1] += value * np.array([math.comb(power, i) for i in range(power + 1)])
    removed = np.convolve(_flip(series[:m]), den) if m else np.zeros(1)
    numerator = np.zeros(max(num.size, removed.size, m + 1))
    numerator[: num.size] = num
    numerator[: removed.size] -= removed
    for _ in range(m):
        numerator = np.cumsum(numerator)[:-1]
    return chain[1:], numerator, den


def refuse_slow_poles(name: str) -> ControlError:
    """Return what is raised where coefficients do not tell slow poles from integrators."""
    return ControlError(
        f"{name}: slow poles are too close together to tell from integrators in double precision; sample more slowly, "
        "make them faster, or give the law as a state space"
    )


def _count_roots_at_one(name: str, den: Vector) -> int:
    """Return how many roots at 1 a denominator has. A value p(1) of rounding alone is that of a root there, or the
    product of the distances of slow poles. What it is known to, over the value that is left without the root, is how
    far from 1 the root may lie.
    """
    count, reach = 0, 0.0
    while den.size > 1 and _has_root_at_one(den, POLE_AT_ONE):
        value = abs(math.fsum(den)) + COEFFICIENTS * np.sum(np.abs(den))
        den, count = np.cumsum(den)[:-1], count + 1
        reach = value / max(abs(math.fsum(den)), TINY)
    if reach > NEAR_ONE:
        raise refuse_slow_poles(name)
    return count


def realise_remainder(
    parts: list[tuple[Float[np.ndarray, " _"], Float[np.ndarray, " _"]]],
) -> tuple[Matrix, Inputs, Vector]:
    """Return Y/R of all parts (Y, R) in observer form, each of its input: on shared states where R is the same, else
    side by side. The direct terms, Y at q = 0, are left out. The form is of polynomials in z - 1, in which slow poles
    have digits that they do not have in z, with its states scaled.
    """
    from scipy.linalg import block_diag  # deferred: scipy is slow to load

    groups: dict[tuple[float, ...], list[int]] = {}  # by denominator
    for number, (_, den) in enumerate(parts):
        groups.setdefault(tuple(den), []).append(number)
    blocks: list[Float[np.ndarray, "_ _"]] = []
    drives: list[Float[np.ndarray, "_ k"]] = []
    rows: list[Float[np.ndarray, " _"]] = []
    for den, numbers in groups.items():
        n = max(len(den), *(parts[number][0].size for number in numbers)) - 1
        whole = np.pad(den, (0, n + 1 - len(den)))
        a, b = np.eye(n, k=1), np.zeros((n, len(parts)))
        a[:, :1] -= _shift(whole)[1:, None]
        for number in numbers:
            num, _ = parts[number]
            b[:, number] = _shift((np.pad(num, (0, n + 1 - num.size)) - num[0] * whole)[1:])
        a, scale = _scale(a)
        blocks.append(np.eye(n) + a)
        drives.append(b / scale[:, None])
        rows.append(np.eye(1, n)[0] * scale)
    c = np.concatenate(rows)
    return np.asarray(block_diag(*blocks)).reshape(c.size, c.size), np.vstack(drives), c


def build_chain(
    chain: Float[np.ndarray, "m k"],
    a: Float[np.ndarray, "l l"],
    b: Float[np.ndarray, "l k"],
    c: Float[np.ndarray, " l"],
) -> dict[str, Float[np.ndarray, "..."]]:
    """Return a, b and c of a chain of m accumulators, g_j in row j of `chain`, beside a state space."""
    m, n = len(chain), len(chain) + c.size
    whole = np.zeros((n, n))
    whole[:m, :m], whole[m:, m:] = np.eye(m) + np.eye(m, k=1), a
    return {"a": whole, "b": np.vstack([chain, b]), "c": np.concatenate([np.eye(1, m)[0], c])}


def has_response(
    tf: TransferFunction,
    response: Callable[[VectorK], Complex[np.ndarray, " k"]],
    sample_time_s: float,
    roundings: float = 256.0,
) -> bool:
    """Tell whether a state space has the response of its transfer function, but for its coefficients' rounding."""
    f = np.geomspace(1e-4, 0.49, 25) / sample_time_s
    q = np.exp(-2j * np.pi * f * sample_time_s)
    bottom = np.polynomial.polynomial.polyval(q, tf.den)
    wanted = np.polynomial.polynomial.polyval(q, tf.num) / bottom
    rounding = np.sum(np.abs(tf.num)) + np.sum(np.abs(tf.den)) * np.abs(wanted)
    allowed = RESPONSE_TOLERANCE * np.abs(wanted) + roundings * EPS * rounding / np.abs(bottom)
    return bool(np.all(np.abs(response(f) - wanted) <= allowed))


def split_integrators(
    a: Matrix, b: Inputs, c: Vector
) -> Iterator[
    tuple[Float[np.ndarray, "m k"], Float[np.ndarray, "l l"], Float[np.ndarray, "l k"], Float[np.ndarray, " l"]]
]:
    r"""Yield a state space as chain and rest, with ever fewer of the poles next to 1 taken for integrators.

    Rounding moves an eigenvalue of multiplicity m by its m-th root, but the mean of the m by no more than a single one:
    the mean decides whether they are tried, and the caller's comparison of responses whether they are integrators. An
    invariant subspace each (ordered Schur form and Sylvester's equation, whose solution X takes the rest out) takes the
    two apart: with N = A_1 - I the first is :math:`\sum_j c_1 N^{j-1} b_1 w^j`, and what is left of :math:`N^m` is
    rounding. The mean is known to :math:`\epsilon |A| \sqrt{1 + |X|^2}` (Golub, Van Loan, Matrix Computations, 7.2),
    and not taken for 1 where that is more than `NEAR_ONE`: slow poles beside it then hide where it lies.
    """
    from scipy.linalg import schur, solve_sylvester  # deferred: scipy is slow to load

    # States of very different units would leave the Schur form's poles less exact than these, which are of scaled ones.
    scaled, scale = _scale(a)
    b_scaled, c_scaled = b / scale[:, None], c * scale
    offsets = np.linalg.eigvals(scaled) - 1.0
    offsets = offsets[np.argsort(np.abs(offsets))]
    distance = np.append(np.abs(offsets), np.inf)
    for m in range(min(c.size, MOST_INTEGRATORS), 0, -1):
        if abs(np.mean(offsets[:m])) > NEAR_ONE or distance[m] <= distance[m - 1]:
            continue
        between = min(0.5 * (distance[m - 1] + distance[m]), 1.0)
        parts: tuple[Any, ...] = schur(scaled, sort=lambda re, im, reach=between: np.hypot(re - 1.0, im) < reach)
        triangle, basis, first = parts
        if first != m:
            continue
        near, far = triangle[:m, :m], triangle[m:, m:]
        link = np.asarray(solve_sylvester(near, -far, -triangle[:m, m:])) if far.size else np.zeros((m, 0))
        rounding = COEFFICIENTS * np.linalg.norm(scaled) * np.hypot(1.0, np.linalg.norm(link))
        if abs(np.mean(offsets[:m])) + rounding > NEAR_ONE:
            continue
        into, out = basis.T @ b_scaled, c_scaled @ basis
        drive, read = into[:m] - link @ into[m:], out[:m]
        chain, power = np.zeros((m, b.shape[1])), np.eye(m)
        for j in range(m):
            chain[j] = read @ power @ drive
            power = power @ (near - np.eye(m))
        yield chain, far, into[m:], out[m:] + read @ link


def read_companion(a: Matrix, b: Inputs, c: Vector, d: VectorK) -> list[TransferFunction]:
    """Return the transfer function of each input of a companion form, whose entries are coefficients; of others none.
    The coefficients may stand in the first or last row (controllable) or column (observable).
    """
    if not c.size:
        return []
    turned = [(a, b, c[:, None]), (a.T, c[:, None], b)]
    for matrix, drive, read in turned + [(x[::-1, ::-1], y[::-1], z[::-1]) for x, y, z in turned]:
        if not np.array_equal(matrix[:, 1:], np.eye(c.size, k=1)[:, 1:]) or np.any(read[1:]):
            continue
        den = np.concatenate([[1.0], -matrix[:, 0]])
        top = drive * read[:1]  # one of the two has a column for each input
        return [TransferFunction(num=np.concatenate([[0.0], num]) + d[i] * den, den=den) for i, num in enumerate(top.T)]
    return []


def _scale(a: Matrix) -> tuple[Matrix, Vector]:
    """Return a matrix with rows and columns of like norms, and each state's factor."""
    from scipy.linalg import matrix_balance  # deferred: scipy is slow to load

    if not a.size:
        return a, np.zeros(0)
    scaled, (scale, _) = matrix_balance(a, permute=False, separate=True)
    return scaled, scale


def _has_root_at_one(polynomial: Vector, share: float) -> bool:
    return bool(abs(np.sum(polynomial)) <= share * np.sum(np.abs(polynomial)))


def _shift(polynomial: Vector) -> Vector:
    """Return the coefficients in z - 1 of a polynomial in z, descending powers."""
    out = polynomial.copy()
    for count in range(out.size, 0, -1):  # Horner's rule: what is left at z = 1 is the lowest coefficient
        out[:count] = np.cumsum(out[:count])
    return out


def _flip(polynomial: Vector) -> Vector:
    """Return the coefficients in 1 - q of a polynomial in q, or the other way."""
    out = np.zeros(polynomial.size)
    for value in polynomial[::-1]:  # Horner's rule; the last coefficient shifted out is zero
        out = out - np.concatenate([[0.0], out[:-1]])
        out[0] += value
    return out


def _expand(num: Vector, den: VectorK, terms: int) -> Float[np.ndarray, " terms"]:
    """Return the first terms of num/den in powers of 1 - q."""
    top, bottom = (np.concatenate([_flip(p), np.zeros(terms)]) for p in (num, den))
    out = np.zeros(terms)
    for j in range(terms):
        out[j] = (top[j] - np.dot(out[:j], bottom[j:0:-1])) / bottom[0]
    return out


def balance(
    a: Matrix, b: Inputs, c: Vector, gain: float
) -> tuple[Float[np.ndarray, "m m"], Float[np.ndarray, "m k"], VectorM]:
    """Return a stable system balanced and of least order. What is below `NEGLIGIBLE_HANKEL` of `gain`, or of the
    largest Hankel singular value, is rounding. Raises LinAlgError: a pole is so close to the unit circle that a Gramian
    is not finite.
    """
    from scipy.linalg import schur  # deferred: scipy is slow to load

    a, turn = (np.asarray(part) for part in schur(a))  # powers of a triangle keep its poles, of a companion form not
    b, c = turn.T @ b, c @ turn
    reach, show = _factor(a, b), _factor(a.T, c[:, None])
    left, hankel, right = np.linalg.svd(show.T @ reach)
    kept = hankel > NEGLIGIBLE_HANKEL * max(float(hankel[0]), gain)
    root = np.sqrt(hankel[kept])
    into, back = reach @ right[kept].T / root, (show @ left[:, kept] / root).T
    return back @ a @ into, back @ b, c @ into


def _factor(a: Matrix, b: Float[np.ndarray, "n _"]) -> Matrix:
    """Return G with G G' = the sum of a^k b b' a^k' over k >= 0, never squared: small directions keep their digits."""

    def triangle(wide: Float[np.ndarray, "n _"]) -> Matrix:
        return np.asarray(np.linalg.qr(wide.T, mode="r")).T

    g = triangle(np.hstack([b, np.zeros(a.shape)]))
    with np.errstate(over="ignore", invalid="ignore"):
        while np.linalg.norm(a) > VANISHED:
            g, a = triangle(np.hstack([g, a @ g])), a @ a
    if not np.all(np.isfinite(g)):
        raise np.linalg.LinAlgError("a Gramian is not finite")
    return g
