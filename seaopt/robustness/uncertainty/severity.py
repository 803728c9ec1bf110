r"""How bad a loop is, and which way it gets worse: exact derivatives of Ms, Mt and the spectral radius.

The plant's matrices are differentiated by CasADi, rest points included, and go through hold and delay as a complex
step. With :math:`L = P C_y z^{-k}` the derivative of the held plant's response at a point z is

.. math:: dP = c (zI - A)^{-1} (dA\, (zI - A)^{-1} b + db) + dc\, (zI - A)^{-1} b + dd .

A peak's angle is stationary, so that it may stay where it is: :math:`d|S| = -|S|\, \mathrm{Re}(S\, dL)` and
:math:`d|T| = |T|\, \mathrm{Re}(S^2 dL / T)` there. A pole of the closed loop is a zero of :math:`1 + L`, so that
:math:`d\lambda = -dL / L'(\lambda)`.
"""

from __future__ import annotations

from dataclasses import fields

import numpy as np
from jaxtyping import Complex, Float, Int

from seaopt.control import Controller
from seaopt.control.loops.loop import STABLE
from seaopt.control.loops.sampled_plant import DELAY, hold, linearised_along
from seaopt.plants import Plant
from seaopt.records import record
from seaopt.robustness.uncertainty.batch import BatchFigures, Products, closed_products, columns, find_peaks
from seaopt.robustness.uncertainty.draws import Uncertainty

UNSTABLE = 1e6
TINY = 1e-20  # of the complex step: its square vanishes beside 1

Slopes = Float[np.ndarray, "n k"]


@record(eq=False)
class _Held:
    """Plants behind hold and delay, and their derivatives along each coordinate."""

    a: Float[np.ndarray, "n m m"]
    b: Float[np.ndarray, "n m"]
    c: Float[np.ndarray, "n m"]
    d: Float[np.ndarray, " n"]
    da: Float[np.ndarray, "n k m m"]
    db: Float[np.ndarray, "n k m"]
    dc: Float[np.ndarray, "n k m"]
    dd: Float[np.ndarray, "n k"]

    def rows(self, index: Int[np.ndarray, " r"]) -> _Held:
        return _Held(**{field.name: getattr(self, field.name)[index] for field in fields(self)})


def severities(controller: Controller, found: BatchFigures) -> Float[np.ndarray, " n"]:
    """Return how bad every draw is: instability first, then the fraction of the limits that it uses."""
    ms, mt = limits(controller)
    with np.errstate(invalid="ignore"):  # infinite over infinite, of unstable draws, which are ranked apart
        used = np.maximum(found.ms / ms, found.mt / mt) if np.isfinite(min(ms, mt)) else found.ms
    return np.where(found.spectral_radius >= STABLE, UNSTABLE + found.spectral_radius, used)


def limits(controller: Controller) -> tuple[float, float]:
    """Return the limits on Ms and Mt; infinite where none is imposed."""
    given = (controller.spec.max_sensitivity, controller.spec.max_complementary)
    return (np.inf if given[0] is None else given[0]), (np.inf if given[1] is None else given[1])


def severity_slopes(
    controller: Controller, plant: Plant, unknown: Uncertainty, points: Float[np.ndarray, "n k"]
) -> Slopes:
    """Return the derivatives of how bad each point is, with respect to its coordinates.

    Of the spectral radius where the loop is unstable, else of the larger of Ms and Mt as fractions of their limits, or
    of Ms where there is no limit. Zero where there is no derivative: a plant that is not finite, a double pole.

    Parameters
    ----------
    controller, plant, unknown
        What is closed around what, and over what.
    points : array, shape (n, k)
        Coordinates of `unknown`.

    """
    held, out = _held(controller, plant, unknown, points), np.zeros(points.shape)
    finite = np.flatnonzero(np.all(np.isfinite(held.a), axis=(1, 2)) & np.all(np.isfinite(held.b), axis=1))
    if not finite.size:
        return out
    held = held.rows(finite)
    with np.errstate(all="ignore"):  # where there is no derivative it is not finite
        loop = closed_products(controller, held.a, held.b, held.c, held.d)
        stable = np.max(np.abs(loop.closed), axis=1) < STABLE
        for part, slopes in ((stable, _peak_slopes), (~stable, _radius_slopes)):
            own = np.flatnonzero(part)
            if own.size:
                out[finite[own]] = slopes(controller, loop.rows(own), held.rows(own))
    return np.where(np.isfinite(out), out, 0.0)


def _held(controller: Controller, plant: Plant, unknown: Uncertainty, points: Float[np.ndarray, "n k"]) -> _Held:
    """Return the held plants and their derivatives along each coordinate."""
    count, width = points.shape
    every = np.repeat(points, width, axis=0)
    slopes = unknown.slopes(points)
    p, at = columns(plant, unknown.nominal, unknown.values(every))
    dp = np.stack([slopes.get(name, np.zeros(points.shape)).ravel() for name in plant.parameters])
    dat = {name: slopes.get(name, np.zeros(points.shape)).ravel() for name in at}
    spec, none = controller.spec, np.zeros(count * width)
    here, turned = linearised_along(plant, p, at, dp, dat, spec.measured, controller.current_per_force_A_per_N)
    a, b, c, d = (value + 1j * TINY * slope for value, slope in zip(here, turned, strict=True))
    late = at.get(DELAY, none) + 1j * TINY * dat.get(DELAY, none)
    held = hold(a, b, c, d, controller.sample_time_s, late)
    a, b, c, d = (item.reshape(count, width, *item.shape[1:]) for item in held)
    return _Held(
        a=np.real(a[:, 0]), b=np.real(b[:, 0]), c=np.real(c[:, 0]), d=np.real(d[:, 0]),
        da=np.imag(a) / TINY, db=np.imag(b) / TINY, dc=np.imag(c) / TINY, dd=np.imag(d) / TINY,
    )  # fmt: skip


def _radius_slopes(controller: Controller, loop: Products, held: _Held) -> Slopes:
    rows = np.arange(len(loop.closed))
    at = np.argmax(np.abs(loop.closed), axis=1)
    pole = loop.closed[rows, at]
    others = pole[:, None] - loop.closed
    others[rows, at] = 1.0
    steepness = np.prod(others, axis=1) / np.prod(pole[:, None] - loop.opened, axis=1) / loop.scale
    moved = -_loop_slopes(controller, held, pole) / steepness[:, None]
    return np.real(np.conj(pole)[:, None] * moved) / np.abs(pole)[:, None]


def _peak_slopes(controller: Controller, loop: Products, held: _Held) -> Slopes:
    (ms, ms_at), (mt, mt_at) = find_peaks(loop)
    most, least = limits(controller)
    of_t = mt / least > ms / most
    z = np.exp(1j * np.where(of_t, mt_at, ms_at))
    s = loop.sensitivity(z[:, None])
    slope = _loop_slopes(controller, held, z)
    of_s = -np.abs(s) * np.real(s * slope)
    complement = np.abs(1.0 - s) * np.real(s**2 / (1.0 - s) * slope)
    limit = np.where(of_t, least, most)[:, None]
    return np.where(of_t[:, None], complement, of_s) / np.where(np.isfinite(limit), limit, 1.0)


def _loop_slopes(controller: Controller, held: _Held, z: Complex[np.ndarray, " n"]) -> Complex[np.ndarray, "n k"]:
    """Return the derivatives of L at one point a plant."""
    inner = z[:, None, None] * np.eye(held.b.shape[1]) - held.a
    right = np.linalg.solve(inner, held.b[:, :, None].astype(complex))[:, :, 0]
    left = np.linalg.solve(np.swapaxes(inner, 1, 2), held.c[:, :, None].astype(complex))[:, :, 0]
    turned = np.einsum("nkij,nj->nki", held.da, right) + held.db
    of_plant = np.einsum("ni,nki->nk", left, turned) + np.einsum("nki,ni->nk", held.dc, right) + held.dd
    law = controller.measurement
    q = 1.0 / z
    return (
        of_plant * (np.polyval(law.num[::-1], q) / np.polyval(law.den[::-1], q) * q**controller.delay_samples)[:, None]
    )
