r"""Spectra of a log's channels on the same windows: mains hum, excitation, coherence and delays.

Windows under Hann's taper that overlap by half (Welch 1967), none across a gap. Long logs are sampled: at most 64
windows of at most 32,768 samples, spread over the log.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Complex, Float

from seaopt import welch
from seaopt.records import record
from seaopt.signals import VectorM, VectorN, bridge

SHORTEST_WINDOW, LONGEST_WINDOW = 32, 1 << 15  # samples in a window
FEWEST_WINDOWS, MOST_WINDOWS = 4, 64
MAINS_HZ = (50.0, 60.0)
HARMONICS = 5
BESIDE_HZ = 12.0  # from a line: where the noise floor is read
LINE_HEIGHT = 4.0  # times the noise floor: 6 dB
OTHER_LINES = 3  # lines beside the mains' in the same channel that make a multisine
BRIDGED_SHARE = 0.02  # share of a window's samples that may be missing: they are bridged by lines


@record(eq=False)
class Spectra:
    """Tapered spectra of every channel, one row per window, from 0 Hz on."""

    frequency_hz: VectorM
    period: float  # seconds between samples
    # channels that have samples missing in most windows are left out, and then windows that have holes
    channels: Mapping[str, Complex[np.ndarray, "d m"]]

    @property
    def windows(self) -> int:
        """Number of windows."""
        return next((len(rows) for rows in self.channels.values()), 0)

    @property
    def averages(self) -> float:
        """Independent averages that the overlapping windows are worth."""
        return welch.count_averages(self.windows)

    def power(self, name: str) -> VectorM:
        """Return the mean power of each line, up to a factor common to all channels."""
        return np.mean(welch.square(self.channels[name]), axis=0)

    def cross(self, first: str, second: str) -> Complex[np.ndarray, " m"]:
        """Return the mean cross-spectrum, first's conjugate times second."""
        return np.mean(np.conj(self.channels[first]) * self.channels[second], axis=0)

    def coherence(self, first: str, second: str) -> VectorM:
        """Return the squared coherence of each line."""
        return welch.coherence(self.cross(first, second), self.power(first), self.power(second))


def compute_spectra(channels: Mapping[str, VectorN], segments: Sequence[slice], period: float) -> Spectra | None:
    """Return the channels' spectra over `segments` (rows) sampled every `period` s; None without a segment."""
    total = sum(segment.stop - segment.start for segment in segments)
    length = 2 * (min(max(total // 16, SHORTEST_WINDOW), LONGEST_WINDOW) // 2)
    starts = welch.thin(welch.list_starts(segments, length), MOST_WINDOWS)
    if len(starts) < FEWEST_WINDOWS:
        return None
    cuts = {name: np.stack([values[start : start + length] for start in starts]) for name, values in channels.items()}
    # A channel with holes everywhere is left out; then a window with a hole in any other channel.
    holed = {name: np.mean(~np.isfinite(cut), axis=1) > BRIDGED_SHARE for name, cut in cuts.items()}
    kept = [name for name in cuts if np.mean(holed[name]) <= 0.5]
    whole = ~np.any([holed[name] for name in kept], axis=0) if kept else np.zeros(len(starts), dtype=bool)
    if np.count_nonzero(whole) < FEWEST_WINDOWS:
        return None
    taper = welch.hann(length)
    transforms = {name: welch.transform(_bridge(cuts[name][whole]), taper) for name in kept}
    return Spectra(frequency_hz=np.fft.rfftfreq(length, period), period=period, channels=transforms)


def _bridge(cut: Float[np.ndarray, "d n"]) -> Float[np.ndarray, "d n"]:
    """Put straight lines across the missing samples of windows, in place."""
    for row in np.flatnonzero(~np.all(np.isfinite(cut), axis=1)):
        cut[row] = bridge(cut[row])
    return cut


@record
class Hum:
    """Lines of the mains in one channel: each line's frequency and height over the noise floor, and their rms."""

    mains_hz: float
    lines_hz: tuple[float, ...]
    over_floor_db: tuple[float, ...]
    rms: float


def find_hum(spectra: Spectra, name: str, inputs: Sequence[str]) -> Hum | None:
    """Return the mains' lines of a channel, None where there are none or the windows are too short to tell. A line
    stands 6 dB over the medians of the spectrum within 12 Hz of it, in the median window: what comes and goes, such as
    a chirp, does not count, nor what an input is coherent with, such as a resonance there. Where other lines stand out
    as well it is a multisine.
    """
    f = spectra.frequency_hz
    width = f[1] - f[0]
    if width > 1.5 or spectra.windows < 6:
        return None
    square = welch.square(spectra.channels[name])
    steady = np.median(square, axis=0)
    # What an input is coherent with is the plant's answer, not hum.
    coherences = [spectra.coherence(other, name) for other in inputs if other in spectra.channels and other != name]
    incoherent = 1.0 - np.max(coherences, axis=0) if coherences else np.ones(f.size)
    # The fewer averages, the further a bin of noise alone stands out.
    limit = LINE_HEIGHT * (1.0 + 2.0 / np.sqrt(spectra.averages))
    for mains in MAINS_HZ:
        lines: list[tuple[float, float, float]] = []
        for k in range(1, HARMONICS + 1):
            line = k * mains
            if line > f[-1] - 2.0 * width:
                break
            at = np.abs(f - line) <= max(0.5, width)
            floor = _floor(f, steady, line)
            ratio = float(np.max(steady[at] * incoherent[at])) / max(floor, 1e-300)
            if k == 1 and (ratio < limit or _lines_beside(f, steady, line, limit) >= OTHER_LINES):
                break
            if ratio >= limit:
                lines.append((line, 10.0 * np.log10(ratio), float(np.sum(np.mean(square[:, at], axis=0) - floor))))
        if lines:
            # Parseval for a Hann window of n samples: a line's power in its bins is a^2/4 times 3 n^2/8.
            n = 2 * (f.size - 1)
            power = sum(max(line_power, 0.0) for _, _, line_power in lines)
            return Hum(
                mains_hz=mains,
                lines_hz=tuple(line for line, _, _ in lines),
                over_floor_db=tuple(round(float(height), 1) for _, height, _ in lines),
                rms=float(np.sqrt(2.0 * power / (welch.MEAN_SQUARE * n**2))),
            )
    return None


def _lines_beside(f: VectorM, steady: VectorM, line: float, limit: float) -> int:
    """Return how many other lines stand out as much within an octave each side, the mains' own multiples left out."""
    inside = np.flatnonzero((f > 0.5 * line) & (f < 2.0 * line))
    count = 0
    for row in inside[1:-1]:
        multiple = any(abs(f[row] - k * mains) <= 2.0 + 3.0 * (f[1] - f[0]) for k in (1, 2, 3) for mains in MAINS_HZ)
        if multiple or steady[row] < max(steady[row - 1], steady[row + 1]):
            continue
        count += bool(steady[row] > limit * _floor(f, steady, float(f[row])))
    return count


def _floor(f: VectorM, steady: VectorM, line: float) -> float:
    """Return the spectrum beside a line: the larger of the medians below and above it, for it may slope."""
    apart, clear = f - line, 3.0 * (f[1] - f[0]) + 0.5
    sides = [steady[(sign * apart > clear) & (sign * apart <= BESIDE_HZ)] for sign in (-1.0, 1.0)]
    return max((float(np.median(side)) for side in sides if side.size >= 3), default=np.inf)
