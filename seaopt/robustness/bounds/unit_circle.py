r"""Bounds on abs(S) and abs(T) over boxes of parameters times arcs of the unit circle.

Over a box and an arc, :math:`z = e^{i(\theta_0 + \delta e_\theta)}`, numerator and denominator of

.. math:: S = \frac{N}{D}, \qquad N = d_c(z)\, \phi, \quad D = d_c(z)\, \phi + n_c(z)\, z^{-d} \nu,

with the law :math:`n_c / d_c` and the plant :math:`\nu / \phi`, are Taylor models. Their quotient :math:`S_2` to second
order is exact up to :math:`(N - S_2 D) / D`, which is of third order. If D cannot be zero there, the loop has no pole
on the arc for any parameters of the box.
"""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
from jaxtyping import Bool, Complex, Float, Int

from seaopt.control import Controller
from seaopt.records import record
from seaopt.robustness.bounds.impulse import Pulse
from seaopt.robustness.bounds.region import Boxes
from seaopt.robustness.bounds.taylor import ROUNDING, Taylor

MULTIPLIERS = np.array([0.0, 0.25, 0.5, 1.0, 2.0, 4.0])


@record(eq=False)
class Arcs:
    """Pairs of a box and an arc.

    Parameters
    ----------
    box : array
        Which box, shape (p,).
    middle, half : array
        Angles in rad: the middle of the arc and half its length, shape (p,).
    s, t : array
        Bounds on abs(S) and abs(T) so far.

    """

    box: Int[np.ndarray, " p"]
    middle: Float[np.ndarray, " p"]
    half: Float[np.ndarray, " p"]
    s: Float[np.ndarray, " p"]
    t: Float[np.ndarray, " p"]

    def rows(self, index: Int[np.ndarray, " r"] | Bool[np.ndarray, " p"] | slice) -> Arcs:
        """Return some of them."""
        return Arcs(**{item.name: getattr(self, item.name)[index] for item in fields(Arcs)})

    def moved(self, box: Int[np.ndarray, " p"]) -> Arcs:
        """Return the arcs with other numbers of their boxes."""
        return replace(self, box=box)

    def bounded(self, s: Float[np.ndarray, " p"], t: Float[np.ndarray, " p"]) -> Arcs:
        """Return the arcs with bounds where they are better."""
        return replace(self, s=np.fmin(self.s, s), t=np.fmin(self.t, t))

    def halves(self) -> Arcs:
        """Return both halves of every arc."""
        half = 0.5 * self.half
        middle = np.concatenate([self.middle - half, self.middle + half])
        twice = {name: np.tile(getattr(self, name), 2) for name in ("box", "s", "t")}
        return Arcs(**twice, middle=middle, half=np.tile(half, 2))


@record(eq=False)
class Found:
    """What holds on arcs.

    Parameters
    ----------
    s, t : array
        Bounds on abs(S) and abs(T), infinite where D may be zero, shape (p,).
    by_box, by_angle : array
        How much of D each coordinate changes, shape (p, k), and the angle, shape (p,).
    rest : array
        How much of D the models of the box leave open, shape (p,).
    towards : array
        Where abs(S) and abs(T) grow: the slopes of their squares, shape (2, p, k).

    """

    s: Float[np.ndarray, " p"]
    t: Float[np.ndarray, " p"]
    by_box: Float[np.ndarray, "p k"]
    by_angle: Float[np.ndarray, " p"]
    rest: Float[np.ndarray, " p"]
    towards: Float[np.ndarray, "2 p k"]


Packed = tuple[Float[np.ndarray, "p m j"], Float[np.ndarray, "p j"]]


@record(eq=False)
class Model:
    """A complex Taylor model on each arc: centre (p,), slopes (p, k), half curvatures (p, k, k), rest (p,)."""

    c: Complex[np.ndarray, " p"]
    g: Complex[np.ndarray, "p k"]
    h: Complex[np.ndarray, "p k k"]
    r: Float[np.ndarray, " p"]

    @property
    def slope(self) -> Float[np.ndarray, " p"]:
        """Largest size of the first-order part."""
        return np.sum(np.abs(self.g), axis=1)

    @property
    def curve(self) -> Float[np.ndarray, " p"]:
        """Largest size of the second-order part."""
        return np.sum(np.abs(self.h), axis=(1, 2))


@np.errstate(over="ignore", invalid="ignore", divide="ignore")  # where D may be zero, which is asked for below
def bounded(controller: Controller, plant: Pulse, boxes: Boxes, ball: int, arcs: Arcs) -> Found:
    """Return bounds on the arcs; `ball` coordinates of a box count only where they are in the unit ball."""
    law, own = controller.measurement, arcs.box
    below = _powers(law.den, np.zeros(own.size, dtype=int), arcs, plant.denominator.c.shape[1])
    late = controller.delay_samples + plant.whole[own]
    above = _powers(law.num, late, arcs, below.shape[1])
    older = _powers(law.num, late + 1, arcs, below.shape[1])
    opened = (_packed(plant.denominator, own), below)
    parts = [opened, (_packed(plant.head, own), above), (_packed(plant.tail, own), older)]
    n, d = _modelled([opened]), _modelled(parts)
    s = _quotient(n, d)
    t = Model(c=1.0 - s.c, g=-s.g, h=-s.h, r=s.r)
    at, width = boxes.centre[own], boxes.radius[own]
    (top_s, slope_s), (top_t, slope_t) = (_largest(item, at[:, :ball], width[:, :ball]) for item in (s, t))
    proper = _proper(controller, plant)[own]
    top_s, top_t = np.where(proper, top_s, np.inf), np.where(proper, top_t, np.inf)
    size = np.maximum(np.abs(d.c), 1e-300)
    by_box = np.abs(d.g[:, :-1]) + np.sum(np.abs(d.h[:, :-1]), axis=2)
    return Found(
        s=top_s, t=top_t, by_box=by_box / size[:, None], by_angle=np.abs(d.g[:, -1]) / size,
        rest=sum(_left(item, powers) for (_, item), powers in parts) / size,
        towards=np.stack([slope_s[:, :-1], slope_t[:, :-1]]),
    )  # fmt: skip


def _proper(controller: Controller, plant: Pulse) -> Bool[np.ndarray, " b"]:
    """Tell which boxes' D keeps its degree: 1 + d d_c is not zero without delay, and no pole comes from infinity."""
    last = plant.head[:, -1] * float(controller.measurement.num[0])
    return (controller.delay_samples + plant.whole > 0) | (np.abs(1.0 + last.c) > last.reach)


def _packed(item: Taylor, own: Int[np.ndarray, " p"]) -> Packed:
    """Return every arc's coefficients to second order, and their rests.

    Centre, slopes and half curvatures, as a whole symmetric matrix, are along one axis.
    """
    over, k = item.basis, item.basis.size
    second = np.array([[over.place(i, j) for j in range(k)] for i in range(k)], dtype=int).reshape(k, k)
    half = np.where(np.eye(k) > 0.0, 1.0, 0.5)[:, :, None, None]
    h = (item.a[second] * half).reshape(k * k, *item.r.shape)
    rest = item.r + np.sum(np.abs(item.a[over.until[min(2, over.degree)] :]), axis=0)
    return np.moveaxis(np.concatenate([item.a[: 1 + k], h]), 0, 1)[own], rest[own]


def _powers(
    law: Float[np.ndarray, " m"], late: Int[np.ndarray, " p"], arcs: Arcs, count: int
) -> Complex[np.ndarray, "p j 5"]:
    r"""Return law(1/z) z^-late w^j for every j: value, first and second order, bounds on the rest and on all.

    Each is a product of functions of the angle, whose derivatives up to the third are bounded over the arc.
    """
    z, half = np.exp(1j * arcs.middle), arcs.half
    order = -(np.arange(law.size) + late[:, None])
    terms = law * z[:, None] ** order
    derivatives = [np.sum(terms * (1j * order) ** k, axis=1) for k in range(3)]
    third = np.sum(np.abs(law * order**3.0), axis=1)
    first = [item[:, None] for item in derivatives]
    first_bounds = [item[:, None] for item in _bounds(derivatives, third, half)]
    w, j, turn = (z - 1.0)[:, None], np.arange(count), z[:, None]
    once, twice = (j * w ** np.maximum(j - 1, 0), j * (j - 1) * w ** np.maximum(j - 2, 0))
    second = [w**j, 1j * once * turn, -(once * turn + twice * turn**2)]
    far = np.abs(w) + half[:, None]
    steep = (
        j * far ** np.maximum(j - 1, 0) + 3 * j * (j - 1) * far ** np.maximum(j - 2, 0)
        + j * (j - 1) * (j - 2) * far ** np.maximum(j - 3, 0)
    )  # fmt: skip
    second_bounds = _bounds(second, steep, half[:, None])
    value = first[0] * second[0]
    slope = first[1] * second[0] + first[0] * second[1]
    curve = first[2] * second[0] + 2.0 * first[1] * second[1] + first[0] * second[2]
    (a0, a1, a2, a3), (b0, b1, b2, b3) = first_bounds, second_bounds
    rest = a3 * b0 + 3.0 * a2 * b1 + 3.0 * a1 * b2 + a0 * b3
    step = half[:, None]
    rest = rest * step**3 / 6.0 + ROUNDING * np.sum(np.abs(law)) * b0
    slope, curve = slope * step, 0.5 * curve * step**2
    return np.stack([value, slope, curve, rest, np.abs(value) + np.abs(slope) + np.abs(curve) + rest], axis=2)


def _bounds(
    derivatives: list[Complex[np.ndarray, "..."]], third: Float[np.ndarray, "..."], half: Float[np.ndarray, "..."]
) -> tuple[Float[np.ndarray, "..."], ...]:
    """Return bounds of a function and its derivatives over the arc, from their values at its middle."""
    zeroth, first, second = (np.abs(item) for item in derivatives)
    top = second + half * third
    slope = first + half * second + 0.5 * half**2 * third
    return zeroth + half * first + 0.5 * half**2 * second + half**3 / 6.0 * third, slope, top, third


def _modelled(parts: list[tuple[Packed, Complex[np.ndarray, "p j 5"]]]) -> Model:
    """Return the sum of polynomials whose coefficients are models, over the arcs."""
    sums = np.sum([packed @ powers[:, :, :3] for (packed, _), powers in parts], axis=0)
    count, width = sums.shape[:2]
    k = round(np.sqrt(width - 0.75) - 0.5)
    rest = np.zeros(count)
    for (packed, left), powers in parts:
        open_ends = np.real(powers[:, :, 3]) + ROUNDING * np.real(powers[:, :, 4])
        rest += _left(left, powers) + np.sum(open_ends * np.sum(np.abs(packed), axis=1), axis=1)
    rest += np.sum(np.abs(sums[:, 1 : k + 1, 2]), axis=1) + np.sum(np.abs(sums[:, k + 1 :, 1:]), axis=(1, 2))
    h = np.zeros((count, k + 1, k + 1), dtype=complex)
    h[:, :k, :k] = sums[:, k + 1 :, 0].reshape(count, k, k)
    h[:, :k, k] = h[:, k, :k] = 0.5 * sums[:, 1 : k + 1, 1]
    h[:, k, k] = sums[:, 0, 2]
    g = np.concatenate([sums[:, 1 : k + 1, 0], sums[:, :1, 1]], axis=1)
    return Model(c=sums[:, 0, 0], g=g, h=h, r=rest)


def _left(rest: Float[np.ndarray, "p j"], powers: Complex[np.ndarray, "p j 5"]) -> Float[np.ndarray, " p"]:
    """Return what the rests of a polynomial's coefficients add."""
    return np.sum(np.real(powers[:, :, 4]) * rest, axis=1)


def _quotient(n: Model, d: Model) -> Model:
    """Return n / d; its rest is infinite where d may be zero."""
    c = n.c / d.c
    g = (n.g - c[:, None] * d.g) / d.c[:, None]
    cross = g[:, :, None] * d.g[:, None, :]
    h = (n.h - c[:, None, None] * d.h - 0.5 * (cross + np.swapaxes(cross, 1, 2))) / d.c[:, None, None]
    slope, curve = np.sum(np.abs(g), axis=1), np.sum(np.abs(h), axis=(1, 2))
    miss = slope * d.curve + curve * (d.slope + d.curve) + n.r + (np.abs(c) + slope + curve) * d.r
    least = np.abs(d.c) - d.slope - d.curve - d.r
    rest = np.where(least > 0.0, miss / least, np.inf)
    good = np.isfinite(rest) & np.isfinite(c)
    return Model(
        c=np.where(good, c, 0.0), g=np.where(good[:, None], g, 0.0), h=np.where(good[:, None, None], h, 0.0),
        r=np.where(good, rest, np.inf),
    )  # fmt: skip


def _largest(
    item: Model, at: Float[np.ndarray, "p b"], width: Float[np.ndarray, "p b"]
) -> tuple[Float[np.ndarray, " p"], Float[np.ndarray, "p k"]]:
    """Return a bound on abs(item) and the slopes of its square."""
    centre, g = item.c[:, None], item.g
    top = np.abs(item.c) ** 2
    slopes = 2.0 * np.real(np.conj(centre) * g)
    curves = 2.0 * np.real(np.conj(centre)[:, :, None] * item.h) + np.real(np.conj(g)[:, :, None] * g[:, None, :])
    beyond = 2.0 * item.slope * item.curve + item.curve**2
    square = _maximum(top, slopes, curves, at, width) + beyond
    return np.sqrt(np.maximum(square, 0.0)) + item.r, slopes


def _maximum(
    top: Float[np.ndarray, " p"], a: Float[np.ndarray, "p k"], b: Float[np.ndarray, "p k k"],
    at: Float[np.ndarray, "p b"], width: Float[np.ndarray, "p b"],
) -> Float[np.ndarray, " p"]:  # fmt: skip
    """Return a bound on top + a e + e b e over the cube, where at + width e is in the unit ball.

    A coordinate outside the ball along which it cannot but rise or fall is put at its end. What is left is split into
    parabolas of one coordinate each; the ball enters by Lagrange's dual, any multiplier of which gives a bound.
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
        return top + cross + np.sum(_parabola(bend, a), axis=1)
    pad = np.zeros((count, size - ball))
    at, width = np.hstack([at, pad]), np.hstack([width, pad])
    scale = 0.5 * np.linalg.norm(a[:, :ball] / np.maximum(width[:, :ball], 1e-300), axis=1)
    room = 1.0 - np.sum(at**2, axis=1)
    best = np.full(count, np.inf)
    for factor in MULTIPLIERS:
        m = np.nan_to_num(factor * scale, nan=0.0, posinf=0.0)
        inner = _parabola(bend - m[:, None] * width**2, a - 2.0 * m[:, None] * at * width)
        best = np.minimum(best, m * room + np.sum(inner, axis=1))
    return top + cross + best


def _parabola(bend: Float[np.ndarray, "p k"], slope: Float[np.ndarray, "p k"]) -> Float[np.ndarray, "p k"]:
    """Return the largest bend e^2 + slope e for e from -1 to 1."""
    inner = (bend < 0.0) & (np.abs(slope) <= -2.0 * bend)
    return np.where(inner, -(slope**2) / np.where(inner, 4.0 * bend, 1.0), bend + np.abs(slope))
