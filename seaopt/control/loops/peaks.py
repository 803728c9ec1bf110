"""The peaks and crossings of a stable closed loop: exact, with a proof that none was missed.

A coarse grid and the loop's poles give first candidates; where the slope of a curve changes sign it is refined to
rounding. Then the level set a ten-millionth above each peak is computed (`response`): if any of its arcs is above the
level, the grid has missed a peak, which is climbed in turn; if none is, the peak is proved to that tolerance. Crossings
are bracketed by the arcs of their own level sets.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Complex, Float, Int

from seaopt.control.loops.response import Angles, ClosedLoop, Edges, Indices, find_arcs, find_sign_changes, find_zeros
from seaopt.errors import ControlError
from seaopt.records import record

PerCurve = Float[np.ndarray, " c"]
PerCrossing = Float[np.ndarray, " k"]
PerFactor = Float[np.ndarray, " l"]
HALF_POWER = 1.0 / np.sqrt(2.0)
PROOF = 1e-7
COARSE_ANGLES = np.concatenate([[0.0], np.pi * np.geomspace(1e-5, 1.0, 49)])
SENSITIVITY, TRACKING = 0, 4
REFINED_PER_CURVE = 3  # local maxima of each curve that are refined before the proof
NEARLY_HIGHEST = 0.99  # of a curve's largest value
MAX_PROOF_ROUNDS = 20
# Nearer to a pole of L on the circle -1/L is that pole's: a double one is known to the root of rounding.
POLE_DISTANCE = 1e-5
SMALLEST_FACTOR = 1e-9


@record(eq=False)
class Extremes:
    """Peaks, crossings and ends of a closed loop; angles in radians a sample, ascending."""

    # peaks, at: largest values of S, T, S - T, C_y S and F/F_ref, of further measured signals C_y S, and the angles
    # where
    peaks: PerCurve
    at: PerCurve
    ends: Complex[np.ndarray, "c 2"]  # the curves at 0 and pi, shape (c, 2)
    static: float  # abs(F/F_ref) at 0; zero where a zero of the plant leaves nothing but rounding
    # crossovers, crossover_phases: where abs(L) = 1, and the phase of -L there (rad)
    crossovers: PerCrossing
    crossover_phases: PerCrossing
    gain_factors: PerFactor  # every positive factor on L that puts it through -1
    gain_angles: PerFactor  # where these factors do
    # sensitivity_edges, bandwidth_edges, band_edges: where abs(S) is -3 dB, abs(F/F_ref) -3 dB of its static value, and
    # within 3 dB of 1 or not
    sensitivity_edges: Angles
    bandwidth_edges: Float[np.ndarray, " n"]
    band_edges: Float[np.ndarray, " o"]

    @property
    def gains_db(self) -> PerFactor:
        """The gain factors in dB: margins up positive, down negative."""
        return 20.0 * np.log10(self.gain_factors)

    @property
    def lags_deg(self) -> PerCrossing:
        """The phases at the crossovers in degrees: lag to -1 positive, lead negative."""
        return np.degrees(self.crossover_phases)

    @property
    def delays(self) -> PerCrossing:
        """The delay, in samples, that each crossover's phase amounts to."""
        return np.mod(self.crossover_phases, 2 * np.pi) / self.crossovers


def find_extremes(system: ClosedLoop) -> Extremes:
    """Return the peaks and crossings of a stable closed loop. Raises ControlError: a peak cannot be proved."""
    peaks, at = _find_candidates(system)
    ends = system.curves(np.array([0.0, np.pi]))
    static = float(np.abs(ends[TRACKING, 0]))
    static = static if static > 1e-9 * peaks[TRACKING] else 0.0
    levels = [(SENSITIVITY, HALF_POWER), (TRACKING, np.sqrt(2.0)), (TRACKING, HALF_POWER)]
    levels += [(TRACKING, HALF_POWER * static)] if static else []
    present = np.flatnonzero(peaks > 0.0)
    proofs = [system.modulus(k, peaks[k] * (1.0 + PROOF)) for k in map(int, present)]
    pencils = [system.equal(), system.real(), *(system.modulus(k, level) for k, level in levels)]
    edges = find_arcs([*pencils, *proofs])
    peaks, at = _prove(system, peaks, at, present, edges[len(pencils) :])
    at_peaks = system.sensitivity(at[:3])
    peaks[:3] = np.abs([at_peaks[0], 1.0 - at_peaks[1], 2.0 * at_peaks[2] - 1.0])

    def function(theta: Angles, which: Indices) -> Angles:
        values = system.curves(theta)
        rows = [2.0 * values[0].real - 1.0, values[0].imag]
        rows += [np.abs(values[k] / level) ** 2 - 1.0 for k, level in levels]
        return np.array(rows)[which, np.arange(theta.size)]

    crossings = find_sign_changes(function, edges[: len(pencils)])
    turns = np.concatenate([[0.0], crossings[1], [np.pi]])
    factors, angles = _gain_factors(system, turns)
    return Extremes(
        peaks=peaks,
        at=at,
        ends=ends,
        static=static,
        crossovers=crossings[0],
        crossover_phases=_phases(system, crossings[0]),
        gain_factors=factors,
        gain_angles=angles,
        sensitivity_edges=crossings[2],
        bandwidth_edges=crossings[5] if static else np.empty(0),
        band_edges=np.sort(np.concatenate(crossings[3:5])),
    )


def find_least(system: ClosedLoop, curve: int, until: float) -> float:
    """Return the least magnitude of a curve from 0 to an angle, to a ten-millionth. From the least of some angles the
    level is lowered to the least on its own level set's arcs until none is below.
    """
    modes = np.abs(np.angle(system.poles))
    theta = np.concatenate([until * COARSE_ANGLES / np.pi, modes[modes < until]])
    least = float(np.min(np.abs(system.curves(theta)[curve])))
    for _ in range(MAX_PROOF_ROUNDS):
        if least <= SMALLEST_FACTOR:
            break
        (edges,) = find_arcs([system.modulus(curve, least * (1.0 - PROOF))])
        edges = np.append(edges[edges < until], until)
        middle = 0.5 * (edges[:-1] + edges[1:])
        values = np.abs(system.curves(middle)[curve])
        if not values.size or np.min(values) >= least * (1.0 - PROOF):
            break
        low = edges[:-1][values < least]
        high = edges[1:][values < least]

        def fall(theta: Angles, _: Indices) -> Angles:
            return system.differentiate(theta, np.full(theta.size, curve))[1]

        at_low, at_high = fall(low, np.arange(low.size)), fall(high, np.arange(low.size))
        inside = (at_low < 0.0) & (at_high > 0.0)
        bottom = find_zeros(fall, low[inside], high[inside], at_low[inside], at_high[inside], 1e-8)
        least = float(np.min(np.concatenate([values, np.abs(system.curves(bottom)[curve])])))
    return least


def find_crossovers(system: ClosedLoop) -> tuple[PerCrossing, PerCrossing]:
    """Return where abs(L) = 1, and the phase of -L there (rad); the loop need not be stable."""

    def function(theta: Angles, _: Indices) -> Angles:
        return 2.0 * system.curves(theta)[0].real - 1.0

    (angles,) = find_sign_changes(function, find_arcs([system.equal()]))
    return angles, _phases(system, angles)


def _phases(system: ClosedLoop, theta: PerCrossing) -> PerCrossing:
    s, t = system.curves(theta)[:2]
    return np.angle(-t / s)


def _gain_factors(system: ClosedLoop, turns: Angles) -> tuple[PerFactor, PerFactor]:
    """Return the factors -1/L at angles where L is real and negative, and these angles. A pole of L on the circle, an
    integrator at angle 0, is no crossing, and a zero is none: what -1/L has there is rounding. A pole is on the circle
    if it is no further from it than it is known; next to a light mode, which is off it, a crossing is one.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        factors = -np.real(system.sensitivity(turns) / system.curves(turns)[1])
    poles = system.opened
    beside = np.abs(np.exp(1j * turns)[:, None] - poles) < POLE_DISTANCE
    off_circle = np.abs(np.abs(poles) - 1.0)
    if np.any(beside & (off_circle > 0.0)):
        beside &= off_circle <= system.resolution()
    infinite = np.any(beside, axis=1)
    crossing = (factors > SMALLEST_FACTOR) & (factors < 1.0 / SMALLEST_FACTOR) & ~infinite
    return factors[crossing], turns[crossing]


def _find_candidates(system: ClosedLoop) -> tuple[PerCurve, PerCurve]:
    """Return the largest values on a coarse grid and at the poles, the best of each curve refined."""
    modes = np.abs(np.angle(system.poles))
    theta = np.unique(np.concatenate([COARSE_ANGLES, modes[modes > 1e-9]]))
    values, slopes = system.differentiate(theta)
    values = np.abs(values)
    best = np.argmax(values, axis=1)
    peaks, at = values[np.arange(best.size), best], theta[best]
    curve, cell = np.nonzero((slopes[:, :-1] > 0.0) & (slopes[:, 1:] < 0.0))
    height = np.maximum(values[curve, cell], values[curve, cell + 1])
    order = np.lexsort((-height, curve))
    rank = np.arange(curve.size) - np.searchsorted(curve[order], curve[order])
    kept = order[rank < REFINED_PER_CURVE]
    # Curves are even: the slope at angle 0 is rounding, which may look like a maximum beside it. Such a one is not
    # worth the many steps to it where the curve is higher elsewhere; if it is one after all, the proof finds it.
    wanted = (cell[kept] > 0) | (height[kept] > NEARLY_HIGHEST * peaks[curve[kept]])
    return _climb(system, peaks, at, curve[kept], theta[cell[kept]], theta[cell[kept] + 1], wanted)


def _climb(
    system: ClosedLoop,
    peaks: PerCurve,
    at: PerCurve,
    curve: Indices,
    low: Angles,
    high: Angles,
    wanted: Bool[np.ndarray, " m"] | None = None,
) -> tuple[PerCurve, PerCurve]:
    """Return the peaks with the local maxima from `low` to `high` taken in; unwanted ones only beside wanted ones."""
    if not curve.size:
        return peaks, at

    def slope(theta: Angles, which: Indices) -> Angles:
        return system.differentiate(theta, curve[which])[1]

    every = np.arange(curve.size)
    top = find_zeros(slope, low, high, slope(low, every), slope(high, every), 1e-8, wanted)
    value = np.abs(system.curves(top)[curve, every])
    peaks, at = peaks.copy(), at.copy()
    for k in range(peaks.size):
        on_curve = np.flatnonzero(curve == k)
        if on_curve.size and value[on_curve].max() > peaks[k]:
            best = on_curve[np.argmax(value[on_curve])]
            peaks[k], at[k] = value[best], top[best]
    return peaks, at


def _prove(
    system: ClosedLoop, peaks: PerCurve, at: PerCurve, curves: Int[np.ndarray, " k"], edges: list[Edges]
) -> tuple[PerCurve, PerCurve]:
    """Return the peaks, raised until no arc of the level just above holds more. Raises ControlError: without end."""
    for _ in range(MAX_PROOF_ROUNDS):
        curve = np.repeat(curves, [row.size - 1 for row in edges])
        low, high = np.concatenate([row[:-1] for row in edges]), np.concatenate([row[1:] for row in edges])
        middle = 0.5 * (low + high)
        values = np.abs(system.curves(middle)[curve, np.arange(curve.size)])
        above = values > peaks[curve] * (1.0 + PROOF)
        if not np.any(above):
            return peaks, at
        curve, low, high = curve[above], low[above], high[above]
        for k, value, theta in zip(curve, values[above], middle[above], strict=True):
            if value > peaks[k]:
                peaks[k], at[k] = value, theta
        rising = (system.differentiate(low, curve)[1] > 0.0) & (system.differentiate(high, curve)[1] < 0.0)
        peaks, at = _climb(system, peaks, at, curve[rising], low[rising], high[rising])
        curves = np.unique(curve)
        edges = find_arcs([system.modulus(k, peaks[k] * (1.0 + PROOF)) for k in map(int, curves)])
    raise ControlError(
        f"the peaks of this loop are still rising after {MAX_PROOF_ROUNDS} rounds, so that they cannot be stated; look "
        "at modes of the plant or the law that lie closer to the unit circle than rounding resolves"
    )
