r"""The closed loop of a digital controller and a sampled plant, and the figures that describe it.

With :math:`L = C_y P z^{-d}`: :math:`S = 1/(1+L)`, :math:`T_r = P z^{-d} C_r / (1 + L)` from reference to force,
:math:`C_y S` from sensor noise to motor force. Stability is decided by the eigenvalues of plant, hold, delay and
controller together, never by a frequency grid; an unstable loop has no margins (zero) and infinite peaks. Peaks and
crossings are bracketed on a grid that resolves every pole of plant and loop, then refined to rounding.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Complex, Float

from seaopt.control.digital import DigitalPlant
from seaopt.control.law import TransferFunction

HALF_POWER = 1.0 / np.sqrt(2.0)
LOWEST_HZ = 1e-3
Curve = Callable[[Float[np.ndarray, " m"]], Float[np.ndarray, " m"]]


@dataclass(frozen=True, slots=True, kw_only=True)
class LoopFigures:
    """What describes a closed loop; frequencies in Hz, None where there is none.

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
    gain_margin_db : float or None
        Smallest change of gain, up or down, that makes the loop unstable; None: no change does.
    phase_margin_deg, delay_margin_s : float or None
        Smallest over all crossovers; None: abs(L) never crosses 1.
    disk_margin : float
        Symmetric disk margin, 2 / peak of abs(S - T) (Seiler, Packard, Gahinet 2020).
    noise_gain : float
        Peak of abs(F_m / noise on F), N/N.

    """

    stable: bool
    spectral_radius: float
    bandwidth_hz: float | None
    tracking_band_hz: tuple[float, float] | None
    crossover_hz: float | None
    sensitivity_bandwidth_hz: float
    ms: float
    mt: float
    ms_hz: float
    reference_peak: float
    gain_margin_db: float | None
    phase_margin_deg: float | None
    delay_margin_s: float | None
    disk_margin: float
    noise_gain: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Loop:
    """A plant closed by C_r (reference) and C_y (measurement)."""

    plant: DigitalPlant
    reference: TransferFunction
    measurement: TransferFunction

    def open_loop(self, f: Float[np.ndarray, " m"]) -> Complex[np.ndarray, " m"]:
        """Return L at frequencies in Hz."""
        return self.plant.response(f) * self.measurement.response(f, self.plant.sample_time_s)

    def sensitivity(self, f: Float[np.ndarray, " m"]) -> Complex[np.ndarray, " m"]:
        """Return S = 1/(1 + L)."""
        return 1.0 / (1.0 + self.open_loop(f))

    def tracking(self, f: Float[np.ndarray, " m"]) -> Complex[np.ndarray, " m"]:
        """Return F/F_ref."""
        reference = self.reference.response(f, self.plant.sample_time_s)
        return self.plant.response(f) * reference * self.sensitivity(f)

    def noise(self, f: Float[np.ndarray, " m"]) -> Complex[np.ndarray, " m"]:
        """Return -F_m/noise = C_y S."""
        return self.measurement.response(f, self.plant.sample_time_s) * self.sensitivity(f)

    def eigenvalues(self) -> Complex[np.ndarray, " n"]:
        """Return the closed loop's eigenvalues."""
        a, b, c, d = self.plant.delayed()
        ac, bc, cc, dc = self.measurement.state_space()
        loop = 1.0 / (1.0 + d * dc)
        n, m = b.size, bc.size
        closed = np.zeros((n + m, n + m))
        closed[:n, :n] = a - np.outer(b, c) * dc * loop
        closed[:n, n:] = -np.outer(b, cc) * loop
        closed[n:, :n] = np.outer(bc, c) * loop
        closed[n:, n:] = ac - np.outer(bc, cc) * d * loop
        return np.linalg.eigvals(closed).astype(complex)

    def grid(self) -> Float[np.ndarray, " m"]:
        """Return frequencies that resolve every pole of plant and closed loop, up to the Nyquist frequency."""
        nyquist = self.plant.nyquist_hz
        base = np.geomspace(LOWEST_HZ, nyquist, 1200)
        poles = np.concatenate([np.linalg.eigvals(self.plant.a), self.eigenvalues()])
        f0 = np.abs(np.angle(poles)) / (2 * np.pi * self.plant.sample_time_s)
        width = np.maximum(np.abs(1.0 - np.abs(poles)) * nyquist / np.pi, 1e-9 * nyquist)
        fan = np.concatenate([[0.0], *[[-x, x] for x in np.geomspace(0.05, 30.0, 20)]])
        near = (f0[:, None] + width[:, None] * fan).ravel()
        inside = near[(near > LOWEST_HZ) & (near < nyquist)]
        return np.unique(np.concatenate([base, inside]))

    def figures(self) -> LoopFigures:
        """Return the loop's figures."""
        radius = float(np.max(np.abs(self.eigenvalues())))
        if radius >= 1.0:
            return LoopFigures(
                stable=False, spectral_radius=radius, bandwidth_hz=None, tracking_band_hz=None, crossover_hz=None,
                sensitivity_bandwidth_hz=0.0, ms=np.inf, mt=np.inf, ms_hz=np.nan, reference_peak=np.inf,
                gain_margin_db=0.0, phase_margin_deg=0.0, delay_margin_s=0.0, disk_margin=0.0, noise_gain=np.inf,
            )  # fmt: skip
        f = self.grid()

        def tracking(x: Float[np.ndarray, " m"]) -> Float[np.ndarray, " m"]:
            return np.abs(self.tracking(x))

        static = float(tracking(f[:1])[0])
        ms_hz, ms = peak(lambda x: np.abs(self.sensitivity(x)), f)
        _, mt = peak(lambda x: np.abs(self.open_loop(x) * self.sensitivity(x)), f)
        _, skew = peak(lambda x: np.abs(2.0 * self.sensitivity(x) - 1.0), f)
        crossovers = crossings(lambda x: np.abs(self.open_loop(x)) - 1.0, f)
        phase, delay = self._phase_margins(crossovers)
        below = crossings(lambda x: tracking(x) - HALF_POWER * static, f)
        slow = crossings(lambda x: np.abs(self.sensitivity(x)) - HALF_POWER, f)
        quiet = float(np.abs(self.sensitivity(f[:1]))[0]) < HALF_POWER
        return LoopFigures(
            stable=True,
            spectral_radius=radius,
            bandwidth_hz=float(below[0]) if below.size else None,
            tracking_band_hz=self._tracking_band(f),
            crossover_hz=float(crossovers[-1]) if crossovers.size else None,
            sensitivity_bandwidth_hz=(float(slow[0]) if slow.size else self.plant.nyquist_hz) if quiet else 0.0,
            ms=ms,
            mt=mt,
            ms_hz=ms_hz,
            reference_peak=peak(tracking, f)[1] / static,
            gain_margin_db=self._gain_margin(f),
            phase_margin_deg=phase,
            delay_margin_s=delay,
            disk_margin=2.0 / skew,
            noise_gain=peak(lambda x: np.abs(self.noise(x)), f)[1],
        )

    def _gain_margin(self, f: Float[np.ndarray, " m"]) -> float | None:
        at = crossings(lambda x: np.imag(self.open_loop(x)), f)
        ends = np.array([LOWEST_HZ * 1e-3, self.plant.nyquist_hz])  # where L is real, unless it integrates
        values: Any = self.open_loop(np.concatenate([at, ends]))
        real = np.abs(values.imag) <= 1e-6 * np.abs(values.real)
        negative = values.real[real & (values.real < 0.0)]
        return float(np.min(np.abs(20.0 * np.log10(-negative)))) if negative.size else None

    def _phase_margins(self, crossovers: Float[np.ndarray, " k"]) -> tuple[float | None, float | None]:
        if not crossovers.size:
            return None, None
        angle = np.angle(-self.open_loop(crossovers))
        lag = np.mod(angle, 2 * np.pi)
        return float(np.degrees(np.min(np.abs(angle)))), float(np.min(lag / (2 * np.pi * crossovers)))

    def _tracking_band(self, f: Float[np.ndarray, " m"]) -> tuple[float, float] | None:
        def outside(x: Float[np.ndarray, " m"]) -> Float[np.ndarray, " m"]:
            return np.abs(np.log(np.abs(self.tracking(x)))) - np.log(np.sqrt(2.0))

        edges = np.concatenate([[0.0], crossings(outside, f), [self.plant.nyquist_hz]])
        middles = np.maximum(0.5 * (edges[:-1] + edges[1:]), LOWEST_HZ)
        inside = outside(middles) < 0.0
        if not np.any(inside):
            return None
        widths = np.where(inside, np.diff(edges), -1.0)
        best = int(np.argmax(widths))
        return float(edges[best]), float(edges[best + 1])


def peak(curve: Curve, f: Float[np.ndarray, " m"]) -> tuple[float, float]:
    """Return where a curve is largest and its value there, each local maximum near the top refined by zooming."""
    values = curve(f)
    inner = np.flatnonzero((values[1:-1] >= values[:-2]) & (values[1:-1] >= values[2:])) + 1
    candidates = [i for i in inner if values[i] > 0.5 * values.max()]
    best = int(np.argmax(values))
    at, top = float(f[best]), float(values[best])
    for i in candidates:
        low, high = f[i - 1], f[i + 1]
        for _ in range(6):
            x = np.linspace(low, high, 15)
            y = curve(x)
            k = int(np.clip(np.argmax(y), 1, x.size - 2))
            low, high = x[k - 1], x[k + 1]
            if y.max() > top:
                at, top = float(x[np.argmax(y)]), float(y.max())
    return at, top


def crossings(curve: Curve, f: Float[np.ndarray, " m"]) -> Float[np.ndarray, " k"]:
    """Return the zeros of a curve between grid points of opposite sign, by bisection, ascending."""
    values = curve(f)
    index = np.flatnonzero(np.sign(values[:-1]) * np.sign(values[1:]) < 0)
    low, high, left = f[index], f[index + 1], np.sign(values[index])
    if not index.size:
        return low
    for _ in range(50):
        middle = 0.5 * (low + high)
        same = np.sign(curve(middle)) == left
        low, high = np.where(same, middle, low), np.where(same, high, middle)
    return 0.5 * (low + high)
