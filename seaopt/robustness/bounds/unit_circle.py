r"""Bounds on abs(S) and abs(T) over boxes of parameters times arcs of the unit circle, for branch and bound.

Over a box and an arc, :math:`z = e^{i(\theta_0 + \delta e_\theta)}`, numerator and denominator of

.. math:: S = \frac{N}{D}, \qquad N = d_c(z)\, \phi, \quad D = d_c(z)\, \phi + \sum_i n_{ci}(z)\, z^{-d} \nu_i,

with the law :math:`n_{ci} / d_c` (all in powers of :math:`1 - 1/z`) and the plant :math:`\nu_i / \phi` of each measured
signal, are Taylor models.
Their quotient :math:`S_2` to second order is exact up to :math:`(N - S_2 D) / D`, which is of third order. If D cannot
be zero there, the loop has no pole on the arc for any parameters of the box.
"""

from __future__ import annotations

import functools
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Complex, Float, Int

from seaopt.control import Controller
from seaopt.records import record
from seaopt.robustness.bounds.impulse import ImpulseTransfer
from seaopt.robustness.bounds.region import Boxes
from seaopt.robustness.bounds.taylor import PRODUCT_ROUNDING, Array, Taylor

MULTIPLIERS = np.array([0.0, 0.25, 0.5, 1.0, 2.0, 4.0])
PerArc = Float[np.ndarray, " p"]
Slopes = Float[np.ndarray, "p k"]
BallCoordinates = Float[np.ndarray, "p b"]
Powers = Complex[np.ndarray, "p j 5"]  # value, first and second order, bounds on the remainder and on all
Coefficients = Float[np.ndarray, " m"]  # of a polynomial, ascending


@record(eq=False)
class LawPolynomials:
    """Numerators of every C_y and their denominator, in ascending powers of 1 - 1/z. In these, as in w, nothing cancels
    near z = 1, where the law's slow poles and its integrators lie.
    """

    numerators: tuple[Coefficients, ...]
    denominator: Coefficients
    through: tuple[float, ...]  # what every C_y has at infinity
    delay_samples: int  # until the command is put out


@record(eq=False)
class Arcs:
    """Pairs of a box, by index, and an arc: middle and half length, rad; `s`, `t` bound abs(S) and abs(T) so far."""

    box: Int[np.ndarray, " p"]
    middle: PerArc
    half: PerArc
    s: PerArc
    t: PerArc

    def renumber(self, box: Int[np.ndarray, " p"]) -> Arcs:
        """Return the arcs with other indices of their boxes."""
        return replace(self, box=box)

    def tighten(self, s: PerArc, t: PerArc) -> Arcs:
        """Return the arcs with new bounds where those are smaller."""
        return replace(self, s=np.fmin(self.s, s), t=np.fmin(self.t, t))

    def halve(self) -> Arcs:
        """Return both halves of every arc."""
        half = 0.5 * self.half
        middle = np.concatenate([self.middle - half, self.middle + half])
        twice = {name: np.tile(getattr(self, name), 2) for name in ("box", "s", "t")}
        return Arcs(**twice, middle=middle, half=np.tile(half, 2))


@record(eq=False)
class ArcBounds:
    """Bounds on arcs, and where their width comes from."""

    s: PerArc  # bounds on abs(S) and abs(T), infinite where D may be zero
    t: PerArc
    by_box: Slopes  # share of D that each coordinate changes
    by_angle: PerArc  # share of D that the angle changes
    remainder: PerArc  # share of D that the models of the box leave open
    gradients: Float[np.ndarray, "2 p k"]  # slopes of abs(S)^2 and abs(T)^2 along the coordinates


Packed = tuple[Float[np.ndarray, "p m j"], Float[np.ndarray, "p j"]]


@record(eq=False)
class ArcModel:
    """A complex Taylor model on each arc: centre (p,), slopes (p, k), half curvatures (p, k, k), remainder (p,)."""

    c: Complex[np.ndarray, " p"]
    g: Complex[np.ndarray, "p k"]
    h: Complex[np.ndarray, "p k k"]
    r: PerArc

    @property
    def slope(self) -> PerArc:
        """Largest size of the first-order part."""
        return np.sum(np.abs(self.g), axis=1)

    @property
    def curve(self) -> PerArc:
        """Largest size of the second-order part."""
        return np.sum(np.abs(self.h), axis=(1, 2))


@np.errstate(over="ignore", invalid="ignore", divide="ignore")  # where D may be zero, which `_divide` handles
def bound_arcs(law: LawPolynomials, plant: ImpulseTransfer, boxes: Boxes, ball: int, arcs: Arcs) -> ArcBounds:
    """Return bounds on the arcs; `ball` coordinates of a box count only where they are in the unit ball."""
    box = arcs.box
    below = _expand_powers(law.denominator, np.zeros(box.size, dtype=int), arcs, plant.denominator.c.shape[1])
    delay = law.delay_samples + plant.whole[box]
    open_loop = (_pack(plant.denominator, box), below)
    parts = [open_loop]
    for num, head, tail in zip(law.numerators, plant.heads, plant.tails, strict=True):
        parts.append((_pack(head, box), _expand_powers(num, delay, arcs, below.shape[1])))
        parts.append((_pack(tail, box), _expand_powers(num, delay + 1, arcs, below.shape[1])))
    n, d = _sum_models([open_loop]), _sum_models(parts)
    s = _divide(n, d)
    t = ArcModel(c=1.0 - s.c, g=-s.g, h=-s.h, r=s.r)
    at, width = boxes.centre[box], boxes.radius[box]
    (top_s, slope_s), (top_t, slope_t) = (_bound_magnitude(model, at[:, :ball], width[:, :ball]) for model in (s, t))
    proper = _keeps_degree(law, plant)[box]
    top_s, top_t = np.where(proper, top_s, np.inf), np.where(proper, top_t, np.inf)
    size = np.maximum(np.abs(d.c), 1e-300)
    by_box = np.abs(d.g[:, :-1]) + np.sum(np.abs(d.h[:, :-1]), axis=2)
    return ArcBounds(
        s=top_s,
        t=top_t,
        by_box=by_box / size[:, None],
        by_angle=np.abs(d.g[:, -1]) / size,
        remainder=sum(_weigh_remainders(remainders, powers) for (_, remainders), powers in parts) / size,
        gradients=np.stack([slope_s[:, :-1], slope_t[:, :-1]]),
    )


def _keeps_degree(law: LawPolynomials, plant: ImpulseTransfer) -> Bool[np.ndarray, " b"]:
    """Tell which boxes' D keeps its degree: 1 + d d_c is not zero without delay, and no pole comes from infinity."""
    last = plant.heads[0][:, -1] * law.through[0]
    for head, through in zip(plant.heads[1:], law.through[1:], strict=True):
        last = last + head[:, -1] * through
    return (law.delay_samples + plant.whole > 0) | (np.abs(1.0 + last.c) > last.reach)


def _pack(model: Taylor, box: Int[np.ndarray, " p"]) -> Packed:
    """Return every arc's centre, slopes and half curvatures (a symmetric matrix) along an axis, and remainders."""
    over, k = model.basis, model.basis.size
    second = np.array([[over.index_of(i, j) for j in range(k)] for i in range(k)], dtype=int).reshape(k, k)
    half = np.where(np.eye(k) > 0.0, 1.0, 0.5)[:, :, None, None]
    h = (model.a[second] * half).reshape(k * k, *model.r.shape)
    remainder = model.truncate(2).r
    return np.moveaxis(np.concatenate([model.a[: 1 + k], h]), 0, 1)[box], remainder[box]


def expand_controller(controller: Controller) -> LawPolynomials:
    """Return the polynomials of a controller's law."""
    law = controller.law
    m, (a, b, c) = law.integrators, law.remainder
    delta, q = np.array([0.0, 1.0]), np.array([1.0, -1.0])

    def characteristic(matrix: Float[np.ndarray, "n n"]) -> Coefficients:
        poles = np.linalg.eigvals(matrix)
        return np.real(multiply(*(np.array([1.0 - pole, pole]) for pole in poles)))

    def multiply(*factors: np.ndarray) -> np.ndarray:
        return functools.reduce(np.convolve, factors, np.ones(1))

    slow, nums = characteristic(a), list[np.ndarray]()
    for column in range(1, law.d.size):
        drive = b[:, column]
        scale = max(float(np.linalg.norm(drive) * np.linalg.norm(c)), 1e-300)
        moved = (characteristic(a - np.outer(drive / scale, c)) - slow) * scale
        num = multiply(*[delta] * m, moved + law.d[column] * slow)
        for j, gain in enumerate(law.b[:m, column], start=1):
            num = num + gain * multiply(*[q] * j, *[delta] * (m - j), slow)
        nums.append(-num)
    return LawPolynomials(
        numerators=tuple(nums),
        denominator=multiply(*[delta] * m, slow),
        through=tuple((-law.d[1:]).tolist()),
        delay_samples=controller.compute_delay_samples,
    )


def expand_nothing(controller: Controller) -> LawPolynomials:
    """Return the polynomials beside a plant that has the law of a controller in front of it."""
    constant, signals = np.ones(1), len(controller.signals)
    return LawPolynomials(
        numerators=(constant,) * signals,
        denominator=constant,
        through=(1.0,) * signals,
        delay_samples=controller.compute_delay_samples,
    )


def _expand_powers(law: Coefficients, delay: Int[np.ndarray, " p"], arcs: Arcs, count: int) -> Powers:
    r"""Return law(1 - 1/z) z^-delay w^j for every j: value, first and second order, bounds on the remainder and on all.
    Each is a product of functions of the angle, whose derivatives up to the third are bounded over the arc: of
    :math:`p(\delta) q^D`, :math:`q = 1/z`, :math:`\delta = 1 - q`, with :math:`\delta' = iq`, these are
    :math:`i q^D (q p' - D p)`, :math:`q^D (-q^2 p'' + (2D + 1) q p' - D^2 p)`, and at most
    :math:`|p^{(3)}| + 3(D + 1)|p''| + (3D^2 + 3D + 1)|p'| + D^3 |p|`.
    """
    z, half = np.exp(1j * arcs.middle), arcs.half
    w, turn = np.expm1(1j * arcs.middle), z[:, None]
    q, delta = 1.0 / z, w / z
    slopes = [law, *(np.polynomial.polynomial.polyder(law, k) for k in (1, 2, 3))]
    p0, p1, p2, _ = (np.polynomial.polynomial.polyval(delta, slope) for slope in slopes)
    late = q**delay
    derivatives = [
        late * p0, 1j * late * (q * p1 - delay * p0),
        late * (-(q**2) * p2 + (2 * delay + 1) * q * p1 - delay**2 * p0),
    ]  # fmt: skip
    sizes = [np.polynomial.polynomial.polyval(np.abs(delta) + half, np.abs(slope)) for slope in slopes]
    third = sizes[3] + 3 * (delay + 1) * sizes[2] + (3 * delay**2 + 3 * delay + 1) * sizes[1] + delay**3 * sizes[0]
    first = [derivative[:, None] for derivative in derivatives]
    first_bounds = [bound[:, None] for bound in _bound_derivatives(derivatives, third, half)]
    w, j = w[:, None], np.arange(count)
    once, twice = (j * w ** np.maximum(j - 1, 0), j * (j - 1) * w ** np.maximum(j - 2, 0))
    second = [w**j, 1j * once * turn, -(once * turn + twice * turn**2)]
    far = np.abs(w) + half[:, None]
    steep = (
        j * far ** np.maximum(j - 1, 0)
        + 3 * j * (j - 1) * far ** np.maximum(j - 2, 0)
        + j * (j - 1) * (j - 2) * far ** np.maximum(j - 3, 0)
    )
    second_bounds = _bound_derivatives(second, steep, half[:, None])
    value = first[0] * second[0]
    slope = first[1] * second[0] + first[0] * second[1]
    curve = first[2] * second[0] + 2.0 * first[1] * second[1] + first[0] * second[2]
    (a0, a1, a2, a3), (b0, b1, b2, b3) = first_bounds, second_bounds
    jerk = a3 * b0 + 3.0 * a2 * b1 + 3.0 * a1 * b2 + a0 * b3
    step = half[:, None]
    remainder = jerk * step**3 / 6.0 + PRODUCT_ROUNDING * sizes[0][:, None] * b0
    slope, curve = slope * step, 0.5 * curve * step**2
    size = np.abs(value) + np.abs(slope) + np.abs(curve) + remainder
    return np.stack([value, slope, curve, remainder, size], axis=2)


def _bound_derivatives(derivatives: list[Complex[np.ndarray, "..."]], third: Array, half: Array) -> tuple[Array, ...]:
    """Return bounds of a function and its derivatives over the arc, from their values at its middle."""
    zeroth, first, second = (np.abs(derivative) for derivative in derivatives)
    top = second + half * third
    slope = first + half * second + 0.5 * half**2 * third
    return zeroth + half * first + 0.5 * half**2 * second + half**3 / 6.0 * third, slope, top, third


def _sum_models(parts: list[tuple[Packed, Powers]]) -> ArcModel:
    """Return the sum of polynomials whose coefficients are models, over the arcs."""
    sums = np.sum([packed @ powers[:, :, :3] for (packed, _), powers in parts], axis=0)
    count, width = sums.shape[:2]
    k = round(np.sqrt(width - 0.75) - 0.5)
    remainder = np.zeros(count)
    for (packed, remainders), powers in parts:
        rounded = np.real(powers[:, :, 3]) + PRODUCT_ROUNDING * np.real(powers[:, :, 4])
        remainder += _weigh_remainders(remainders, powers) + np.sum(rounded * np.sum(np.abs(packed), axis=1), axis=1)
    remainder += np.sum(np.abs(sums[:, 1 : k + 1, 2]), axis=1) + np.sum(np.abs(sums[:, k + 1 :, 1:]), axis=(1, 2))
    h = np.zeros((count, k + 1, k + 1), dtype=complex)
    h[:, :k, :k] = sums[:, k + 1 :, 0].reshape(count, k, k)
    h[:, :k, k] = h[:, k, :k] = 0.5 * sums[:, 1 : k + 1, 1]
    h[:, k, k] = sums[:, 0, 2]
    g = np.concatenate([sums[:, 1 : k + 1, 0], sums[:, :1, 1]], axis=1)
    return ArcModel(c=sums[:, 0, 0], g=g, h=h, r=remainder)


def _weigh_remainders(remainders: Float[np.ndarray, "p j"], powers: Powers) -> PerArc:
    """Return what the remainders of a polynomial's coefficients add to its own."""
    return np.sum(np.real(powers[:, :, 4]) * remainders, axis=1)


def _divide(n: ArcModel, d: ArcModel) -> ArcModel:
    """Return n / d; its remainder is infinite where d may be zero."""
    c = n.c / d.c
    g = (n.g - c[:, None] * d.g) / d.c[:, None]
    cross = g[:, :, None] * d.g[:, None, :]
    h = (n.h - c[:, None, None] * d.h - 0.5 * (cross + np.swapaxes(cross, 1, 2))) / d.c[:, None, None]
    slope, curve = np.sum(np.abs(g), axis=1), np.sum(np.abs(h), axis=(1, 2))
    miss = slope * d.curve + curve * (d.slope + d.curve) + n.r + (np.abs(c) + slope + curve) * d.r
    least = np.abs(d.c) - d.slope - d.curve - d.r
    remainder = np.where(least > 0.0, miss / least, np.inf)
    good = np.isfinite(remainder) & np.isfinite(c)
    return ArcModel(
        c=np.where(good, c, 0.0),
        g=np.where(good[:, None], g, 0.0),
        h=np.where(good[:, None, None], h, 0.0),
        r=np.where(good, remainder, np.inf),
    )


def _bound_magnitude(model: ArcModel, at: BallCoordinates, width: BallCoordinates) -> tuple[PerArc, Slopes]:
    """Return a bound on abs(model) and the slopes of its square."""
    centre, g = model.c[:, None], model.g
    top = np.abs(model.c) ** 2
    slopes = 2.0 * np.real(np.conj(centre) * g)
    curves = 2.0 * np.real(np.conj(centre)[:, :, None] * model.h) + np.real(np.conj(g)[:, :, None] * g[:, None, :])
    beyond = 2.0 * model.slope * model.curve + model.curve**2
    square = _bound_quadratic(top, slopes, curves, at, width) + beyond
    return np.sqrt(np.maximum(square, 0.0)) + model.r, slopes


def _bound_quadratic(
    top: PerArc, a: Slopes, b: Float[np.ndarray, "p k k"], at: BallCoordinates, width: BallCoordinates
) -> PerArc:
    """Return a bound on top + a e + e b e over the cube, where at + width e is in the unit ball. A coordinate outside
    the ball along which it cannot but rise or fall is put at its end. What is left is split into parabolas of one
    coordinate each; the ball enters by Lagrange's dual, any multiplier of which gives a bound.
    """
    count, size = a.shape
    ball = at.shape[1]
    monotone = np.abs(a) >= 2.0 * np.sum(np.abs(b), axis=2)
    monotone[:, :ball] = False
    end = np.where(monotone, np.sign(a), 0.0)
    pull = np.einsum("pij,pj->pi", b, end)
    top = top + np.sum(a * end, axis=1) + np.sum(pull * end, axis=1)
    a = np.where(monotone, 0.0, a + 2.0 * pull)
    free = ~monotone
    b = b * free[:, :, None] * free[:, None, :]
    bend = np.diagonal(b, axis1=1, axis2=2)
    cross = np.sum(np.abs(b), axis=(1, 2)) - np.sum(np.abs(bend), axis=1)
    if not ball:
        return top + cross + np.sum(_maximise_parabola(bend, a), axis=1)
    pad = np.zeros((count, size - ball))
    at, width = np.hstack([at, pad]), np.hstack([width, pad])
    scale = 0.5 * np.linalg.norm(a[:, :ball] / np.maximum(width[:, :ball], 1e-300), axis=1)
    room = 1.0 - np.sum(at**2, axis=1)
    best = np.full(count, np.inf)
    for factor in MULTIPLIERS:
        m = np.nan_to_num(factor * scale, nan=0.0, posinf=0.0)
        inner = _maximise_parabola(bend - m[:, None] * width**2, a - 2.0 * m[:, None] * at * width)
        best = np.minimum(best, m * room + np.sum(inner, axis=1))
    return top + cross + best


def _maximise_parabola(bend: Slopes, slope: Slopes) -> Slopes:
    """Return the largest bend e^2 + slope e for e from -1 to 1."""
    inner = (bend < 0.0) & (np.abs(slope) <= -2.0 * bend)
    return np.where(inner, -(slope**2) / np.where(inner, 4.0 * bend, 1.0), bend + np.abs(slope))
