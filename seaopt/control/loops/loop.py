r"""The closed loop of a digital controller and a sampled plant, and the figures that describe it.

With :math:`L = C_y P z^{-d}`: :math:`S = 1/(1+L)`, :math:`T_r = P z^{-d} C_r / (1 + L)` from reference to force,
:math:`C_y S` from sensor noise to motor force. Where a law reads several signals, :math:`L = \sum_i C_i P_i z^{-d}` is
the loop broken at the command, where it is scalar: S, T and all margins are those there, and there is a noise gain
:math:`C_i S` for every signal. Stability is decided by the eigenvalues of plant, hold, delay and
controller together, never by a frequency grid; an unstable loop has no margins (zero) and infinite peaks. Peaks and
crossings come from the eigenvalues of level sets (`response`, `peaks`), so that none is missed, however narrow.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from seaopt.control.loops.law import Law
from seaopt.control.loops.peaks import HALF_POWER, TRACKING, find_extremes, find_least
from seaopt.control.loops.response import LARGEST_ENTRY, ClosedLoop, close
from seaopt.control.loops.sampled_plant import DigitalPlant
from seaopt.control.loops.transfer_function import Frequencies, Response
from seaopt.control.systems.block import connect
from seaopt.control.systems.crossings import add_minima, find_crossings
from seaopt.formatting import format_number
from seaopt.records import record
from seaopt.signals import ComplexN, VectorK, VectorN

if TYPE_CHECKING:
    import control

GRID_LOWEST_HZ = 1e-3
DROOP_BAND = 1.0 / 3.0  # of the bandwidth
FALLEN_ABOVE = 1.03  # of the bandwidth: from here abs(F/F_ref) must be below -3 dB,
SHOULDER = 3.0  # up to here it must not come back,
SHOULDER_FALL = 0.25  # and be below by more and more, by this power of frequency, so that it does not linger there
SHALLOW = 30.0  # times what a minimum on a grid is below its neighbours: further from zero it does not reach it
# A spectral radius from STABLE to GROWING is 1 to rounding. A loop there is not stable: it has no margins. What has
# nothing to damp it (an actuator or an environment without friction) is there too, and does not grow: growth by e
# takes longer than 11 days at 1 kHz.
STABLE, GROWING = 1.0 - 1e-11, 1.0 + 1e-9


@record
class LoopFigures:
    """Figures of a closed loop; frequencies in Hz, None where there is none. The defaults are those of an unstable one.

    Parameters
    ----------
    stable : bool
        All closed-loop eigenvalues inside the unit circle.
    spectral_radius : float
        The largest of their magnitudes.
    bandwidth_hz : float or None
        Lowest frequency at which abs(F/F_ref) is 3 dB below its value at 0 Hz.
    tracking_band_hz : (lo, hi) or None
        Widest band in which abs(F/F_ref) stays within 3 dB of 1.
    crossover_hz : float or None
        Highest frequency at which abs(L) = 1.
    sensitivity_bandwidth_hz : float
        abs(S) stays below -3 dB up to here.
    ms, mt : float
        Peaks of abs(S) and abs(L S).
    ms_hz : float
        Where abs(S) peaks.
    reference_peak : float
        Peak of abs(F/F_ref) over its static value.
    droop_db : float
        How far abs(F/F_ref) falls below its static value up to a third of the bandwidth.
    return_hz : float or None
        Lowest frequency from 1.03 to 3 times the bandwidth at which abs(F/F_ref), times (f/bandwidth)^0.25, is above
        -3 dB: it comes back, or lingers there.
    gain_margin_db : float or None
        Smallest change of gain, up or down, that makes the loop unstable; None: no change does.
    phase_margin_deg, delay_margin_s : float or None
        Smallest over all crossovers; None: abs(L) never crosses 1.
    disk_margin : float
        Symmetric disk margin, 2 / peak of abs(S - T) (Seiler, Packard, Gahinet 2020).
    noise_gain : float
        Peak of abs(F_m / noise on F), N/N.
    other_noise_gains : tuple of float
        The same of the further signals that the law reads, effort per unit of each.
    """

    stable: bool
    spectral_radius: float
    bandwidth_hz: float | None = None
    tracking_band_hz: tuple[float, float] | None = None
    crossover_hz: float | None = None
    sensitivity_bandwidth_hz: float = 0.0
    ms: float = np.inf
    mt: float = np.inf
    ms_hz: float = np.nan
    reference_peak: float = np.inf
    droop_db: float = np.inf
    return_hz: float | None = None
    gain_margin_db: float | None = 0.0
    phase_margin_deg: float | None = 0.0
    delay_margin_s: float | None = 0.0
    disk_margin: float = 0.0
    noise_gain: float = np.inf
    other_noise_gains: tuple[float, ...] = ()

    def with_margins(self, other: LoopFigures) -> LoopFigures:
        """Return these figures with another loop's stability, peaks and margins; without stability those of neither."""
        names = (
            "stable", "spectral_radius", "crossover_hz", "ms", "mt", "ms_hz", "gain_margin_db", "phase_margin_deg",
            "delay_margin_s", "disk_margin",
        )  # fmt: skip
        return replace(self, **{name: getattr(other, name) for name in names})

    @property
    def delay_margin_ms(self) -> float | None:
        """The delay margin in milliseconds."""
        return None if self.delay_margin_s is None else 1e3 * self.delay_margin_s

    def describe_peaks(self) -> str:
        """Return the peaks, for print."""
        return (
            f"Ms {self.ms:.4g}, Mt {self.mt:.4g}, reference peak {self.reference_peak:.4g}, "
            f"noise gain {self.noise_gain:.4g}"
        )

    def describe_margins(self) -> str:
        """Return the classical margins, for print."""
        gain, phase, delay = (
            format_number(value, missing="none")
            for value in (self.gain_margin_db, self.phase_margin_deg, self.delay_margin_ms)
        )
        return f"gain margin {gain} dB, phase margin {phase} deg, delay margin {delay} ms"


@record(eq=False)
class Loop:
    """A plant closed by a law, F_m = C_r F_ref - C_y F."""

    plant: DigitalPlant
    law: Law

    def open_loop(self, f: Frequencies) -> Response:
        """Return L at frequencies in Hz."""
        return np.sum(self.plant.responses(f) * self.law.feedback_responses(f), axis=0)

    def sensitivity(self, f: Frequencies) -> Response:
        """Return S = 1/(1 + L)."""
        return 1.0 / (1.0 + self.open_loop(f))

    def tracking(self, f: Frequencies) -> Response:
        """Return F/F_ref."""
        plant = self.plant.responses(f)
        reference, *measured = self.law.responses(f)
        return plant[0] * reference / (1.0 - np.sum(plant * np.array(measured), axis=0))

    def noise(self, f: Frequencies) -> Response:
        """Return -F_m/noise = C_y S, the noise being on the first measured signal."""
        return self.law.measurement_response(f) / (1.0 + self.open_loop(f))

    def system(self) -> ClosedLoop:
        """Return plant, hold, delay and controller as one system."""
        return close(self.plant.block, self.law)

    def to_control(self) -> control.StateSpace:
        """Return the closed loop as python-control's `StateSpace`: from noise and reference to measured and effort.

        What is measured includes the noise; the delay between the two is inside. Where several signals are measured it
        is from a disturbance of the command, the reference and each signal's noise to command, effort and the first.
        """
        import control  # deferred: slow to import

        block, signals = self.system().block, self.law.d.size - 1
        names = {"inputs": ["noise", "reference"], "outputs": ["measured", "effort"]}
        if signals > 1:
            noises = [f"noise{number}" for number in range(1, signals + 1)]
            names = {"inputs": ["disturbance", "reference", *noises], "outputs": ["command", "effort", "measured1"]}
        ts = self.plant.sample_time_s
        return control.StateSpace(block.a, block.b, block.c, block.d, ts, name="loop", **names)

    def eigenvalues(self) -> ComplexN:
        """Return the closed loop's eigenvalues."""
        return self.system().poles

    def grows(self) -> bool:
        """Tell whether the closed loop grows without end, from its eigenvalues; one that is at its limit does not."""
        return float(np.max(np.abs(self.eigenvalues()), initial=0.0)) > GROWING

    def is_stable(self) -> bool:
        """Tell whether all of them are inside the unit circle, without preparing responses, which takes far longer."""
        a = connect([self.plant.block, self.law.block], (), ()).a
        finite = bool(np.all(np.abs(a) < LARGEST_ENTRY))
        return finite and bool(np.max(np.abs(np.linalg.eigvals(a)), initial=0.0) < STABLE)

    def measure_step_left(self, seconds: float) -> float:
        r"""Return how far a step of the reference, of one, is from where it ends after a time; the loop is stable.

        What slow poles leave is read in closed form: of :math:`x^+ = A x + B`, :math:`y = C x + D` the response is
        :math:`G(1) - C A^k (I - A)^{-1} B` after k samples.
        """
        block = self.system().block
        a, b, c = block.a, block.b[:, 1], block.c[0]
        samples = max(round(seconds / self.plant.sample_time_s), 0)
        return float(c @ np.linalg.matrix_power(a, samples) @ np.linalg.solve(np.eye(b.size) - a, b))

    def simulate(self, reference: VectorN) -> tuple[VectorN, VectorN]:
        """Return what is measured, and the effort, at each sample of a reference, from rest; linear.

        Examples
        --------
        >>> import seaopt as so
        >>> stand, thor = so.plants.high_impedance(), so.plants.thor()
        >>> loop = so.tune(stand, thor, so.ControllerSpec(bandwidth_hz=30)).close(stand, thor)
        >>> force, effort = loop.simulate(np.ones(1000))
        >>> print(f"{force[-1]:.2f} N of {effort[-1]:.2f} N")
        1.00 N of 1.00 N
        """
        system = self.system()
        rows = [int(system.table.outputs[TRACKING]), 1]  # what is measured, and the effort
        a, drive, through, c = system.block.a, system.block.b[:, 1], system.block.d[rows, 1], system.block.c[rows]
        x, out = np.zeros(len(a)), np.empty((reference.size, 2))
        for k, r in enumerate(reference):
            out[k] = c @ x + r * through
            x = a @ x + r * drive
        return out[:, 0], out[:, 1]

    def grid(self) -> Frequencies:
        """Return frequencies that resolve every pole of plant and closed loop, up to the Nyquist frequency."""
        return self._make_grid(self.eigenvalues())

    def _make_grid(self, poles: ComplexN) -> Frequencies:
        """Return the grid, of the closed loop's eigenvalues."""
        base = np.geomspace(GRID_LOWEST_HZ, self.plant.nyquist_hz, 1200)
        return np.union1d(base, self.about(np.concatenate([np.linalg.eigvals(self.plant.a), poles])))

    def about(self, poles: ComplexN) -> Frequencies:
        """Return frequencies that resolve poles, up to the Nyquist frequency, unsorted."""
        nyquist = self.plant.nyquist_hz
        f0 = np.abs(np.angle(poles)) / (2 * np.pi * self.plant.sample_time_s)
        width = np.maximum(np.abs(1.0 - np.abs(poles)) * nyquist / np.pi, 1e-9 * nyquist)
        fan = np.concatenate([[0.0], *[[-x, x] for x in np.geomspace(0.05, 30.0, 20)]])
        near = (f0[:, None] + width[:, None] * fan).ravel()
        return near[(near > GRID_LOWEST_HZ) & (near < nyquist)]

    def figures(self) -> LoopFigures:
        """Return the loop's figures."""
        system = self.system()
        radius = float(np.max(np.abs(system.poles), initial=0.0))
        if not radius < STABLE:
            return LoopFigures(
                stable=False, spectral_radius=radius, other_noise_gains=(np.inf,) * (self.law.d.size - 2)
            )
        extremes = find_extremes(system)
        per_hz = 2 * np.pi * self.plant.sample_time_s
        (ms, mt, skew, noise, reference, *further), ms_at = extremes.peaks, extremes.at[0]
        crossovers, slow, below = extremes.crossovers, extremes.sensitivity_edges, extremes.bandwidth_edges
        least = find_least(system, TRACKING, DROOP_BAND * (float(below[0]) if below.size else np.pi))
        band_hz = float(below[0]) / per_hz if below.size else None
        quiet = abs(extremes.ends[0, 0]) < HALF_POWER
        band = _tracking_band(system, extremes.band_edges)
        return LoopFigures(
            stable=True,
            spectral_radius=radius,
            bandwidth_hz=band_hz,
            tracking_band_hz=None if band is None else (band[0] / per_hz, band[1] / per_hz),
            crossover_hz=float(crossovers[-1]) / per_hz if crossovers.size else None,
            sensitivity_bandwidth_hz=float(slow[0] if slow.size else np.pi) / per_hz if quiet else 0.0,
            ms=float(ms),
            mt=float(mt),
            ms_hz=float(ms_at) / per_hz,
            reference_peak=float(reference) / extremes.static if extremes.static else np.inf,
            droop_db=_droop_db(least, extremes.static),
            return_hz=None if band_hz is None else self._find_return(system, band_hz, extremes.static),
            gain_margin_db=_least(extremes.gains_db),
            phase_margin_deg=_least(extremes.lags_deg),
            delay_margin_s=_least(extremes.delays * self.plant.sample_time_s),
            disk_margin=2.0 / float(skew),
            noise_gain=float(noise),
            other_noise_gains=tuple(map(float, further)),
        )

    def _find_return(self, system: ClosedLoop, bandwidth_hz: float, static: float) -> float | None:
        """Return where abs(F/F_ref) comes back, or lingers, above its bandwidth."""
        low, high = FALLEN_ABOVE * bandwidth_hz, min(SHOULDER * bandwidth_hz, self.plant.nyquist_hz)
        if low >= high:
            return None

        def room(f: Frequencies) -> Frequencies:
            return HALF_POWER * static * (bandwidth_hz / f) ** SHOULDER_FALL - np.abs(self.tracking(f))

        if room(np.array([low]))[0] < 0.0:
            return low
        grid = self._make_grid(system.poles)
        f = add_minima(room, np.concatenate([[low], grid[(grid > low) & (grid < high)], [high]]), SHALLOW)
        crossings = find_crossings(room, f)
        return float(crossings[0]) if crossings.size else None


def _droop_db(least: float, static: float) -> float:
    """Return how far a magnitude falls below its static value; what is zero there cannot fall."""
    if least >= static:
        return 0.0
    return -20.0 * float(np.log10(least / static)) if least > 0.0 else np.inf


def _least(sizes: VectorK) -> float | None:
    return float(np.min(np.abs(sizes))) if sizes.size else None


def _tracking_band(system: ClosedLoop, inner: VectorK) -> tuple[float, float] | None:
    edges = np.concatenate([[0.0], inner, [np.pi]])
    middles = 0.5 * (edges[:-1] + edges[1:])
    size = np.abs(system.curves(middles)[TRACKING])
    inside = (size > HALF_POWER) & (size < 1.0 / HALF_POWER)
    if not np.any(inside):
        return None
    best = int(np.argmax(np.where(inside, np.diff(edges), -1.0)))
    return float(edges[best]), float(edges[best + 1])
