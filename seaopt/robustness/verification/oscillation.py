"""The oscillation in a window of a signal, for verification: one that sustains itself or grows, not noise."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
from jaxtyping import Float

from seaopt.records import record

LINE_SHARE = 0.5  # of the power above lowest_hz: the least that one spectral line must explain
STEADY = 1.3  # largest ratio of the amplitudes of the two halves
Signal = Float[np.ndarray, " n"]  # samples


@record
class Oscillation:
    """A line in the spectrum of a window."""

    frequency_hz: float
    amplitude: float  # in the window's second half, in the signal's unit
    growth: float  # ratio of that to the amplitude in the first half
    peak: float  # the largest deviation in the second half, that of bursts included

    @property
    def sustained(self) -> bool:
        """Whether it neither grows nor dies out."""
        return 1.0 / STEADY <= self.growth <= STEADY

    @property
    def growing(self) -> bool:
        """Whether it grows."""
        return self.growth > STEADY


def find_oscillation(signal: Signal, sample_time_s: float, *, floor: float, lowest_hz: float) -> Oscillation | None:
    """Return the oscillation that stands out in a window, or None: its amplitude is above `floor` (what noise and
    quantisation make), in both halves or only in the second, and it explains at least half of the power above
    `lowest_hz`; noise filtered by a loop does not. Slower movement is removed; half a window should hold two of its
    periods.
    """
    size = float(np.max(np.abs(signal)))
    spread = float(np.std(signal / size)) if size else 0.0
    if 2.0 * spread * size <= floor:  # no line in half of the window can be larger
        return None
    fast = _remove_slow(signal / size, sample_time_s, lowest_hz)  # an unstable loop's squares would overflow
    n = fast.size
    f = _find_frequency(fast, sample_time_s)
    time = sample_time_s * np.arange(n)
    halves = (slice(0, n // 2), slice(n // 2, n))
    first, last = (_fit_amplitude(fast[part], time[part], f) for part in halves)
    power = 2.0 * float(np.mean(fast[halves[1]] ** 2))
    if last <= floor / size or last**2 < LINE_SHARE * power:
        return None
    return Oscillation(
        frequency_hz=f,
        amplitude=size * last,
        growth=last / max(first, 1e-300),
        peak=size * float(np.max(np.abs(fast[halves[1]]))),
    )


def measure_swing(signal: Signal, sample_time_s: float, *, lowest_hz: float) -> Oscillation:
    """Return what swings in a window, whether it is a line or wanders as rounding makes it. Its amplitude is that of a
    sine of the same power in the window's second half, its frequency that of the largest line.
    """
    fast = _remove_slow(signal, sample_time_s, lowest_hz)
    halves = np.array_split(fast, 2)
    first, last = (math.sqrt(2.0 * float(np.mean(half**2))) for half in halves)
    return Oscillation(
        frequency_hz=_find_frequency(fast, sample_time_s) if last else 0.0,
        amplitude=last,
        growth=last / max(first, 1e-300),
        peak=float(np.max(np.abs(halves[1]))),
    )


def _remove_slow(signal: Signal, sample_time_s: float, lowest_hz: float) -> Signal:
    """Return the signal less the least-squares fit of a line and of the window's slow cosines."""
    n = signal.size
    basis = _slow_basis(n, max(int(2 * n * sample_time_s * lowest_hz), 0))
    return signal - basis @ (basis.T @ signal)


@lru_cache(maxsize=8)
def _slow_basis(n: int, harmonics: int) -> Float[np.ndarray, "n k"]:
    """Return orthonormal columns that span a constant, a line and the window's slowest cosines."""
    time = np.linspace(-1.0, 1.0, n)
    slow = np.cos(0.5 * np.pi * np.outer(time + 1.0, np.arange(1, harmonics + 1)))
    return np.linalg.qr(np.column_stack([np.ones(n), time, slow]))[0]


def _find_frequency(signal: Signal, sample_time_s: float) -> float:
    """Return the frequency of the largest line, refined between the bins by a parabola through their logarithms."""
    n = signal.size
    spectrum = np.abs(np.fft.rfft(signal * np.hanning(n)))
    k = int(np.clip(np.argmax(spectrum), 1, spectrum.size - 2))
    left, top, right = np.log(np.maximum(spectrum[k - 1 : k + 2], 1e-300))
    curve = left - 2.0 * top + right
    shift = 0.5 * (left - right) / curve if curve else 0.0
    return float((k + np.clip(shift, -0.5, 0.5)) / (n * sample_time_s))


def _fit_amplitude(signal: Signal, time: Signal, f: float) -> float:
    basis = np.column_stack([np.cos(2 * np.pi * f * time), np.sin(2 * np.pi * f * time)])
    return float(np.hypot(*np.linalg.lstsq(basis, signal, rcond=None)[0]))
