r"""Severity of a loop, by which the worst-case search ranks plants, and its exact derivatives.

An unstable loop is ranked by its spectral radius, a stable one by the fraction of the Ms or Mt limit that it uses.

The plant's matrices are differentiated by CasADi, rest points included, and go through hold and delay as a complex
step. With :math:`L = P C_y z^{-k}` the derivative of the held plant's response at a point z is

.. math:: dP = c (zI - A)^{-1} (dA\, (zI - A)^{-1} b + db) + dc\, (zI - A)^{-1} b + dd .

A peak's angle is stationary, so that it may stay fixed: :math:`d|S| = -|S|\, \mathrm{Re}(S\, dL)` and
:math:`d|T| = |T|\, \mathrm{Re}(S^2 dL / T)` there. A pole of the closed loop is a zero of :math:`1 + L`, so that
:math:`d\lambda = -dL / L'(\lambda)`.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Complex, Float

from seaopt.control import Controller
from seaopt.control.laws.limits import LIMIT_ROUNDING
from seaopt.control.loops.loop import STABLE
from seaopt.control.loops.sampled_plant import DELAYS, differentiate_linearisation, find_delay, hold
from seaopt.control.running.fed_back import close_terms
from seaopt.plants import Plant
from seaopt.records import record
from seaopt.robustness.uncertainty.batch import (
    BatchFigures,
    Levels,
    Products,
    compute_products,
    expand_draws,
    find_peaks,
)
from seaopt.robustness.uncertainty.draws import Column, Points, Uncertainty
from seaopt.robustness.uncertainty.rows import take_rows

UNSTABLE = 1e6
COMPLEX_STEP = 1e-20  # its square vanishes beside 1
LARGEST_MS, LARGEST_MT = np.array([1.0, np.inf]), np.array([np.inf, 1.0])  # levels by which a severity is Ms, and Mt

SeveritySlopes = Points


@record(eq=False)
class _SampledPlants:
    """Plants behind hold and delay, and their derivatives along each coordinate."""

    a: Float[np.ndarray, "n m m"]
    b: Float[np.ndarray, "n m"]
    c: Float[np.ndarray, "n y m"]
    d: Float[np.ndarray, "n y"]
    da: Float[np.ndarray, "n k m m"]
    db: Float[np.ndarray, "n k m"]
    dc: Float[np.ndarray, "n k y m"]
    dd: Float[np.ndarray, "n k y"]


def severities(controller: Controller, figures: BatchFigures, by: Levels | None = None) -> Column:
    """Return the severity of every draw: instability, then the fraction of the limits, or of `by`, that it uses."""
    ms, mt = levels(controller).T if by is None else by.T
    with np.errstate(invalid="ignore"):  # infinite over infinite, of unstable draws, which are ranked apart
        used = np.maximum(figures.ms / ms, figures.mt / mt)
    return np.where(figures.spectral_radius >= STABLE, UNSTABLE + figures.spectral_radius, used)


def limits(controller: Controller) -> tuple[float, float]:
    """Return the limits on Ms and Mt; infinite where none is imposed."""
    ms, mt = controller.spec.level("max_sensitivity"), controller.spec.level("max_complementary")
    return np.inf if ms is None else ms, np.inf if mt is None else mt


def find_failures(controller: Controller, figures: BatchFigures) -> Bool[np.ndarray, "3 n"]:
    """Return which draws are unstable, which are over Ms, and which over Mt; one that lies on its limit keeps it."""
    ms, mt = (limit * (1.0 + LIMIT_ROUNDING) for limit in limits(controller))
    return np.stack([figures.spectral_radius >= STABLE, figures.ms > ms, figures.mt > mt])


def levels(controller: Controller) -> Levels:
    """Return the levels of Ms and Mt that make a severity of 1: the limits, or an Ms of 1 where there are none."""
    both = np.array(limits(controller))
    return both if np.any(np.isfinite(both)) else LARGEST_MS


def severity_slopes(
    controller: Controller, plant: Plant, unknown: Uncertainty, points: Points, by: Levels | None = None
) -> SeveritySlopes:
    """Return the derivatives of the severity of `points` (n, k), coordinates of `unknown`, with respect to these. They
    are of the spectral radius where the loop is unstable, else of the larger of Ms and Mt as fractions of their limits
    or of `by`, as in `severities`; of Ms without a limit. They are zero where there is no derivative: at a plant that
    is not finite, at a double pole.
    """
    controller = close_terms(controller, plant)
    sampled, out = _sample_plants(controller, plant, unknown, points), np.zeros(points.shape)
    finite = np.flatnonzero(np.all(np.isfinite(sampled.a), axis=(1, 2)) & np.all(np.isfinite(sampled.b), axis=1))
    if not finite.size:
        return out
    sampled = take_rows(sampled, finite)
    with np.errstate(all="ignore"):  # where there is no derivative it is not finite
        loop = compute_products(controller, sampled.a, sampled.b, sampled.c, sampled.d)
        stable = np.max(np.abs(loop.closed), axis=1) < STABLE
        ranked = np.broadcast_to(levels(controller) if by is None else by, (points.shape[0], 2))[finite]
        rows, growing = np.flatnonzero(stable), np.flatnonzero(~stable)
        if rows.size:
            out[finite[rows]] = _peak_slopes(controller, take_rows(loop, rows), take_rows(sampled, rows), ranked[rows])
        if growing.size:
            out[finite[growing]] = _radius_slopes(controller, take_rows(loop, growing), take_rows(sampled, growing))
    return np.where(np.isfinite(out), out, 0.0)


def _sample_plants(controller: Controller, plant: Plant, unknown: Uncertainty, points: Points) -> _SampledPlants:
    """Return the plants behind hold and delay, and their derivatives along each coordinate."""
    count, width = points.shape
    repeated = np.repeat(points, width, axis=0)  # once per coordinate: each carries one complex step
    slopes = unknown.slopes(points)
    p, at = expand_draws(plant, controller.delay(unknown.nominal), unknown.values(repeated))
    dp = np.stack([slopes.get(name, np.zeros(points.shape)).ravel() for name in plant.parameters])
    dat = {name: slopes.get(name, np.zeros(points.shape)).ravel() for name in at}
    none = np.zeros(count * width)
    matrices, derivatives = differentiate_linearisation(
        plant, p, at, dp, dat, controller.signals, controller.command.per_effort
    )
    a, b, c, d = (value + 1j * COMPLEX_STEP * slope for value, slope in zip(matrices, derivatives, strict=True))
    late = none + find_delay(plant, at) + 1j * COMPLEX_STEP * sum(dat[name] for name in DELAYS if name in dat)
    stepped = hold(a, b, c, d, controller.sample_time_s, late)
    a, b, c, d = (matrix.reshape(count, width, *matrix.shape[1:]) for matrix in stepped)
    da, db, dc, dd = (np.imag(matrix) / COMPLEX_STEP for matrix in (a, b, c, d))
    return _SampledPlants(
        a=np.real(a[:, 0]), b=np.real(b[:, 0]), c=np.real(c[:, 0]), d=np.real(d[:, 0]), da=da, db=db, dc=dc, dd=dd
    )


def _radius_slopes(controller: Controller, loop: Products, sampled: _SampledPlants) -> SeveritySlopes:
    rows = np.arange(len(loop.closed))
    at = np.argmax(np.abs(loop.closed), axis=1)
    pole = loop.closed[rows, at]
    distances = pole[:, None] - loop.closed
    distances[rows, at] = 1.0
    steepness = np.prod(distances, axis=1) / np.prod(pole[:, None] - loop.opened, axis=1) / loop.scale
    moved = -_loop_slopes(controller, sampled, pole) / steepness[:, None]
    return np.real(np.conj(pole)[:, None] * moved) / np.abs(pole)[:, None]


def _peak_slopes(controller: Controller, loop: Products, sampled: _SampledPlants, by: Levels) -> SeveritySlopes:
    (ms, ms_at), (mt, mt_at) = find_peaks(loop, by)
    ms_limit, mt_limit = by.T
    of_t = mt / mt_limit > ms / ms_limit
    z = np.exp(1j * np.where(of_t, mt_at, ms_at))
    s = loop.sensitivity(z[:, None])
    slope = _loop_slopes(controller, sampled, z)
    of_s = -np.abs(s) * np.real(s * slope)
    complement = np.abs(1.0 - s) * np.real(s**2 / (1.0 - s) * slope)
    return np.where(of_t[:, None], complement, of_s) / np.where(of_t, mt_limit, ms_limit)[:, None]


def _loop_slopes(
    controller: Controller, sampled: _SampledPlants, z: Complex[np.ndarray, " n"]
) -> Complex[np.ndarray, "n k"]:
    """Return the derivatives of L, at one point per plant."""
    law = -controller.law.evaluate(z - 1.0)[1:] * z**-controller.compute_delay_samples  # (y, n)
    inner = z[:, None, None] * np.eye(sampled.b.shape[1]) - sampled.a
    right = np.linalg.solve(inner, sampled.b[:, :, None].astype(complex))[:, :, 0]
    fed_back = np.einsum("yn,nyi->ni", law, sampled.c)
    left = np.linalg.solve(np.swapaxes(inner, 1, 2), fed_back[:, :, None])[:, :, 0]
    driven = np.einsum("nkij,nj->nki", sampled.da, right) + sampled.db
    read = np.einsum("nkyi,ni->nky", sampled.dc, right) + sampled.dd
    return np.einsum("ni,nki->nk", left, driven) + np.einsum("yn,nky->nk", law, read)
