r"""The sampled plant over boxes: numerator and denominator of its pulse transfer function as Taylor models.

With :math:`F = e^{A T} - I = X \varphi(X)`, :math:`X = A T`, :math:`\varphi(X) = \sum_k X^k / (k + 1)!` and
:math:`w = z - 1`, the plant is :math:`c\,\mathrm{adj}(wI - F)\,\Gamma / \det(wI - F)`, :math:`\Gamma = T \varphi(X) b`:
in w, nothing cancels at low frequencies, where z is close to 1. The series is summed where X is small and doubled,
:math:`\varphi(2X) = \varphi(X)(I + X\varphi(X)/2)`; adjugate and determinant are Leverrier's and Faddeev's. All of it is
done in the modal basis of each box's centre, where F is diagonal but for what the box changes: the determinant is then
no difference of large products. A basis does not change a transfer function.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np
from jaxtyping import Float, Int

from seaopt.control import Controller
from seaopt.control.digital import DELAY
from seaopt.errors import ControlError
from seaopt.parameters import ParameterSet
from seaopt.plants import Plant, jacobians
from seaopt.robustness.enclosure import Entry, enclosed, halvings, matrix
from seaopt.robustness.region import Boxes, Region
from seaopt.robustness.taylor import Basis, Taylor, basis, constant, kept, stacked

REACH, DEGREE = 0.25, 9  # of the series: 0.25^10 / 11! = 2e-14, which is enclosed too
WORST_BASIS = 1e5  # condition of a modal basis, beyond which Schur's takes its place
NEWTON_STEPS, WIDENINGS = 30, 4
DEGREES = (6, 6, 6, 6, 6, 5, 4)  # of the models, by the number of coordinates; 3 of more


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Pulse:
    """P(z) = (head + tail / z) / (z^whole denominator), coefficients in ascending powers of w = z - 1.

    Parameters
    ----------
    head, tail, denominator : Taylor
        Shapes (b, n + 1); the denominator is monic.
    whole : array
        Whole samples of the plant's own delay, shape (b,).

    """

    head: Taylor
    tail: Taylor
    denominator: Taylor
    whole: Int[np.ndarray, " b"]


def pulse(controller: Controller, plant: Plant, nominal: ParameterSet, within: Region, boxes: Boxes) -> Pulse:
    """Return the sampled plant, from motor force to the measured output, over boxes.

    Raises
    ------
    ControlError
        The plant's equations have an instruction without an enclosure, or cannot rest at a box's centre.

    """
    uncertain = within.enclosed(boxes, DEGREES[within.size] if within.size < len(DEGREES) else 3)
    count, over = boxes.centre.shape[0], next(iter(uncertain.values())).basis if uncertain else basis(0, 1)
    p: list[Entry] = [
        uncertain.get(name, value)
        for name, value in zip(plant.parameters, plant.parameter_values(nominal), strict=True)
    ]
    at: dict[str, Entry] = {**within.fixed, **{n: item for n, item in uncertain.items() if n not in plant.parameters}}
    delay = at.pop(DELAY, 0.0)
    x, u = _rest(plant, p, at, count, over)
    n, m = len(plant.states), len(plant.inputs)
    found = enclosed(jacobians(plant), [x, u, p])
    row = list(plant.outputs).index(controller.spec.measured)
    a, b, c, d = (matrix(item, rows, count, over) for item, rows in zip(found, (n, n, len(plant.outputs), len(plant.outputs)), strict=True))
    gain = controller.current_per_force_A_per_N
    return _sampled(a, b[:, :, :1] * gain, c[:, row : row + 1], d[:, row : row + 1, :1] * gain, controller.sample_time_s, delay)


def _sampled(a: Taylor, b: Taylor, c: Taylor, d: Taylor, period: float, delay: Entry) -> Pulse:
    count, n = a.c.shape[0], a.c.shape[1]
    over = a.basis
    left, right = _bases(a.c)
    a, b, c = a.between(left, right), b.between(left, np.eye(1)), c.between(np.eye(1), right)
    one = constant(np.broadcast_to(np.eye(n), a.c.shape).copy(), over)
    x, series = _series(a * period, one)
    f, gamma = x @ series, series @ b * period
    late = delay if isinstance(delay, Taylor) else constant(np.full(count, delay), over)
    least = 1e-9 * period if isinstance(delay, Taylor) else 0.0
    whole = np.floor(late.c / period + 1e-9).astype(int)
    rest = late - constant(whole * period, over)
    split = np.any(rest.size > least)
    newer = gamma
    if split:
        left_over = (period - rest)[:, None, None]
        newer = (_series(a * left_over, one)[1] @ b) * left_over
    denominator, (head, tail) = _polynomials(f, c, [newer, gamma - newer] if split else [newer, newer * 0.0])
    through = denominator * d[:, 0]
    late_through = (rest.c > least)[:, None]  # the output is read before the command changes
    head, tail = head + kept(through, ~late_through), tail + kept(through, late_through)
    return Pulse(head=head, tail=tail, denominator=denominator, whole=whole)


def _series(x: Taylor, one: Taylor) -> tuple[Taylor, Taylor]:
    """Return x and phi(x), of matrices."""
    norm = np.max(np.sum(np.abs(x.c) + x.reach, axis=2), axis=1)
    halved = halvings(norm, REACH)
    small = x * 0.5**halved
    out = one
    for k in range(DEGREE, 0, -1):
        out = one + small @ out * (1.0 / (k + 1))
    norm = np.where(np.isfinite(norm), norm * 0.5**halved, np.inf)
    tail = norm ** (DEGREE + 1) / float(np.prod(np.arange(1.0, DEGREE + 3))) / (1.0 - np.minimum(norm, 0.5))
    out = out.with_rest(out.r + tail[:, None, None])
    for _ in range(halved):
        out = out @ (one + small @ out * 0.5)
        small = small * 2.0
    return x, out


def _polynomials(f: Taylor, c: Taylor, drives: list[Taylor]) -> tuple[Taylor, list[Taylor]]:
    """Return det(wI - f) and c adj(wI - f) drive, coefficients ascending along the last axis."""
    count, n = f.c.shape[:2]
    one = np.eye(n)
    unit = constant(np.ones(count), f.basis)
    coefficients, sensed = [unit], [c]
    term: Taylor | None = None  # M_j; the first is the identity
    for j in range(1, n + 1):
        product = f if term is None else f @ term
        trace = _trace(product) * (-1.0 / j)
        coefficients.append(trace)
        if j < n:
            term = product + trace[:, None, None] * one
            sensed.append(c @ term)
    numerators = [
        stacked([*((row @ drive)[:, 0, 0] for row in reversed(sensed)), constant(np.zeros(count), f.basis)])
        for drive in drives
    ]
    return stacked(coefficients[::-1]), numerators


def _trace(item: Taylor) -> Taylor:
    return Taylor(item.basis, *(np.trace(part, axis1=-2, axis2=-1) for part in (item.a, item.r)))


def _bases(a: Float[np.ndarray, "b n n"]) -> tuple[Float[np.ndarray, "b n n"], Float[np.ndarray, "b n n"]]:
    """Return the inverse and the real modal basis of every matrix, or its Schur basis where that is ill conditioned."""
    from scipy.linalg import matrix_balance, schur

    scale = np.asarray(matrix_balance(a[0], permute=False, separate=True)[1][0]) if a.shape[1] else np.ones(0)
    balanced = a * scale / scale[:, None]
    values, vectors = np.linalg.eig(balanced)
    right = np.where(np.imag(values)[:, None] < 0.0, np.imag(vectors), np.real(vectors)).astype(float)
    with np.errstate(divide="ignore", invalid="ignore"):
        poor = ~(np.linalg.cond(right) < WORST_BASIS)
    for k in np.flatnonzero(poor):
        right[k] = np.asarray(schur(balanced[k], output="real")[1])
    return np.linalg.inv(right) / scale, scale[:, None] * right


def _rest(
    plant: Plant, p: list[Entry], at: dict[str, Entry], count: int, over: Basis
) -> tuple[list[Entry], list[Entry]]:
    """Enclose states and inputs at rest: Newton's method to second order, then Krawczyk's test for what is left.

    (Krawczyk, Computing 4, 1969; Neumaier, Interval Methods for Systems of Equations, 1990, chapter 5.)
    """
    names = list(plant.states)
    x: list[Entry] = [at.get(name, 0.0) for name in names]
    u: list[Entry] = [0.0] * len(plant.inputs)
    fixed = [k for k, item in enumerate(x) if isinstance(item, Taylor) or item != 0.0]
    if not fixed:
        return x, u
    if len(fixed) > 1:
        raise ControlError("a plant rests at one given state")
    loose = [k for k in range(len(names)) if k not in fixed]
    key = "dense dynamics"
    if key not in plant.cache:
        rates = ca.densify(ca.substitute(plant.dynamics, plant.t, 0.0))
        plant.cache[key] = ca.Function("dynamics", [plant.x, plant.u, plant.p], [rates])

    def placed(y: list[Entry]) -> tuple[list[Entry], list[Entry]]:
        own = dict(zip(loose, y[:-1], strict=True))
        return [own.get(k, item) for k, item in enumerate(x)], [y[-1], *u[1:]]

    def residual(y: list[Entry], values: list[Entry]) -> Taylor:
        states, inputs = placed(y)
        return matrix(enclosed(plant.cache[key], [states, inputs, values])[0], len(names), count, over)

    def slopes(y: list[Entry], values: list[Entry]) -> Taylor:
        states, inputs = placed(y)
        found = enclosed(jacobians(plant), [states, inputs, values])
        a, b = (matrix(found[k], len(names), count, over) for k in (0, 1))
        return _columns(a, loose, b)

    def entries(y: Taylor) -> list[Entry]:
        return [y[:, k, 0] for k in range(len(names))]

    values = p
    y = constant(np.zeros((count, len(names), 1)), over)
    for _ in range(NEWTON_STEPS):
        step = np.linalg.solve(slopes(entries(y), values).c, residual(entries(y), values).c)
        y = constant(y.c - step, over)
        if np.max(np.abs(step), initial=0.0) <= 1e-13 * np.max(np.abs(y.c), initial=1e-6):
            break
    inverse = np.linalg.inv(slopes(entries(y), values).c)
    same = np.eye(1)
    for _ in range(over.degree + 1):
        y = y - residual(entries(y), values).between(inverse, same)
        y = y.with_rest(np.zeros_like(y.r))
    miss = residual(entries(y), values).between(inverse, same)
    first = np.abs(miss.c) + miss.reach
    wide, moved = y, first
    for _ in range(WIDENINGS):
        wide = y.with_rest(1.2 * moved + 1e-14 * y.size + 1e-20)
        slack = constant(np.broadcast_to(np.eye(len(names)), inverse.shape).copy(), over) - slopes(
            entries(wide), values
        ).between(inverse, np.eye(len(names)))
        moved = first + slack.size @ wide.r
        if np.all(moved <= wide.r):
            break
    proven = np.all(moved <= wide.r, axis=1, keepdims=True)
    return placed(entries(wide.with_rest(np.where(proven, wide.r, np.inf))))


def _columns(a: Taylor, loose: list[int], b: Taylor) -> Taylor:
    return Taylor(
        a.basis, *(np.concatenate([x[..., loose], y[..., :1]], axis=-1) for x, y in ((a.a, b.a), (a.r, b.r)))
    )
