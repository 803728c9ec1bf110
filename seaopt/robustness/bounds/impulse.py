r"""Enclosures of the sampled plant over boxes: its impulse transfer function P(z), as Taylor models, for the bounds.

With :math:`F = e^{A T} - I = X \varphi(X)`, :math:`X = A T`, :math:`\varphi(X) = \sum_k X^k / (k + 1)!` and
:math:`w = z - 1`, the plant is :math:`c\,\mathrm{adj}(wI - F)\,\Gamma / \det(wI - F)`, :math:`\Gamma = T \varphi(X) b`:
in w, nothing cancels at low frequencies, where z is close to 1. The series is summed where X is small and doubled,
:math:`\varphi(2X) = \varphi(X)(I + X\varphi(X)/2)`; adjugate and determinant are Leverrier's and Faddeev's. All of it
is done in the modal basis of each box's centre, where F is diagonal but for what the box changes: the determinant is
then no difference of large products. A basis does not change a transfer function.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int

from seaopt.control import Controller
from seaopt.control.loops.drift import take_linear
from seaopt.control.loops.sampled_plant import DELAYS, find_rows
from seaopt.plants import Plant, jacobians
from seaopt.records import record
from seaopt.robustness.bounds.enclosure import Entry, assemble_matrix, count_halvings, enclose
from seaopt.robustness.bounds.region import Boxes, Region
from seaopt.robustness.bounds.rest_enclosure import enclose_equilibrium
from seaopt.robustness.bounds.taylor import Taylor, build_basis, make_constant, mask_models, stack_models

REACH, DEGREE = 0.25, 12  # of the series: 0.25^13 / 14! = 2e-19, which is enclosed too
WORST_BASIS = 1e5  # condition of a modal basis, beyond which Schur's takes its place
DEGREES = (6, 6, 6, 6, 6, 5, 4)  # of the models, by the number of coordinates; 3 beyond


@record(eq=False)
class ImpulseTransfer:
    """P_i(z) = (head_i + tail_i / z) / (z^whole denominator) of polynomials (b, n + 1), ascending in w = z - 1."""

    heads: tuple[Taylor, ...]  # of each measured output
    tails: tuple[Taylor, ...]
    denominator: Taylor  # monic
    whole: Int[np.ndarray, " b"]  # samples of the plant's own delay


def enclose_plant(controller: Controller, plant: Plant, within: Region, boxes: Boxes) -> ImpulseTransfer:
    """Return the sampled plant over boxes, from motor force to every measured output."""
    plant = take_linear(plant, controller.signals)
    degree = DEGREES[within.size] if within.size < len(DEGREES) else 3
    uncertain = within.enclose(boxes, degree)
    count, over = boxes.centre.shape[0], build_basis(within.size, degree)
    p: list[Entry] = [
        # A range of no width is another value, not an uncertainty.
        uncertain.get(name, within.fixed.get(name, parameter.value))
        for name, parameter in within.nominal.items()
    ]
    conditions: dict[str, Entry] = {
        name: entry for name, entry in (within.fixed | uncertain).items() if name not in plant.parameters
    }
    delay: Entry = plant.drive_offset_s
    for name in DELAYS:
        delay = conditions.pop(name, 0.0) + delay
    x, u = enclose_equilibrium(plant, p, conditions, count, over)
    n, outputs = len(plant.states), len(plant.outputs)
    blocks = enclose(jacobians(plant), [x, u, p])
    measured = find_rows(plant, controller.signals)
    a, b, c, d = (
        assemble_matrix(block, rows, count, over) for block, rows in zip(blocks, (n, n, outputs, outputs), strict=True)
    )
    gain = controller.command.per_effort
    read = [(c[:, row : row + 1], d[:, row : row + 1, :1] * gain) for row in measured]
    return _sample(a, b[:, :, :1] * gain, read, controller.sample_time_s, delay)


def _sample(
    a: Taylor, b: Taylor, read: Sequence[tuple[Taylor, Taylor]], period: float, delay: Entry
) -> ImpulseTransfer:
    """Return the plant behind a hold and a delay that splits the command; `read` are c and d of each output."""
    count, n = a.c.shape[0], a.c.shape[1]
    over = a.basis
    left, right = _compute_bases(a.c)
    a, b = a.transform(left, right), b.transform(left, np.eye(1))
    identity = make_constant(np.broadcast_to(np.eye(n), a.c.shape).copy(), over)
    x, series = _sum_series(a * period, identity)
    f, gamma = x @ series, series @ b * period
    late = delay if isinstance(delay, Taylor) else make_constant(np.full(count, delay), over)
    least = 1e-9 * period if isinstance(delay, Taylor) else 0.0
    whole = np.floor(late.c / period + 1e-9).astype(int)
    fraction = late - make_constant(whole * period, over)
    split = np.any(fraction.size > least)
    newer = gamma
    if split:
        remaining = (period - fraction)[:, None, None]
        newer = (_sum_series(a * remaining, identity)[1] @ b) * remaining
    late_through = (fraction.c > least)[:, None]  # the output is read before the command changes
    heads, tails, denominator = list[Taylor](), list[Taylor](), None
    for c, d in read:
        drives = [newer, gamma - newer] if split else [newer, newer * 0.0]
        denominator, (head, tail) = expand_polynomials(f, c.transform(np.eye(1), right), drives)
        through = denominator * d[:, 0]
        heads.append(head + mask_models(through, ~late_through))
        tails.append(tail + mask_models(through, late_through))
    assert denominator is not None, "a law measures something"
    return ImpulseTransfer(heads=tuple(heads), tails=tuple(tails), denominator=denominator, whole=whole)


def _sum_series(x: Taylor, identity: Taylor) -> tuple[Taylor, Taylor]:
    """Return x and phi(x), for matrices."""
    norm = np.max(np.sum(np.abs(x.c) + x.reach, axis=2), axis=1)
    halvings = count_halvings(norm, REACH)
    small = x * 0.5**halvings
    out = identity
    for k in range(DEGREE, 0, -1):
        out = identity + small @ out * (1.0 / (k + 1))
    norm = np.where(np.isfinite(norm), norm * 0.5**halvings, np.inf)
    tail = norm ** (DEGREE + 1) / float(np.prod(np.arange(1.0, DEGREE + 3))) / (1.0 - np.minimum(norm, 0.5))
    out = out.with_remainder(out.r + tail[:, None, None])
    for _ in range(halvings):
        out = out @ (identity + small @ out * 0.5)
        small = small * 2.0
    return x, out


def expand_polynomials(f: Taylor, c: Taylor, drives: list[Taylor]) -> tuple[Taylor, list[Taylor]]:
    """Return det(wI - f) and c adj(wI - f) drive, coefficients ascending along the last axis."""
    count, n = f.c.shape[:2]
    identity = np.eye(n)
    unit = make_constant(np.ones(count), f.basis)
    coefficients, sensed = [unit], [c]
    term: Taylor | None = None  # M_j; the first is the identity
    for j in range(1, n + 1):
        product = f if term is None else f @ term
        trace = _take_trace(product) * (-1.0 / j)
        coefficients.append(trace)
        if j < n:
            term = product + trace[:, None, None] * identity
            sensed.append(c @ term)
    numerators = [
        stack_models([*((row @ drive)[:, 0, 0] for row in reversed(sensed)), make_constant(np.zeros(count), f.basis)])
        for drive in drives
    ]
    return stack_models(coefficients[::-1]), numerators


def _take_trace(model: Taylor) -> Taylor:
    return Taylor(model.basis, *(np.trace(part, axis1=-2, axis2=-1) for part in (model.a, model.r)))


def _compute_bases(a: Float[np.ndarray, "b n n"]) -> tuple[Float[np.ndarray, "b n n"], Float[np.ndarray, "b n n"]]:
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
