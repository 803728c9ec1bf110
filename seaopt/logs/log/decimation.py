r"""Decimation: a lower sample rate behind an anti-alias filter.

The filter is a linear-phase FIR low-pass (windowed sinc, Kaiser window of 80 dB; Oppenheim and Schafer, Discrete-Time
Signal Processing, 3rd ed., sec. 7.5.3 and 4.6) whose delay is taken out, so that it shifts nothing in time. With
:math:`f_N` half the new sample rate it passes 0 to 0.8 :math:`f_N` within 0.01 dB and takes 80 dB from :math:`f_N` on.
Samples that the filter cannot reach with all its taps, at the ends of a segment, are cut off rather than invented.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np

from seaopt.errors import LogError
from seaopt.logs.quality.clock import sample_rate_hz
from seaopt.signals import Recording, VectorK, VectorM, VectorN, bridge

PASS_BAND = 0.8  # of the new Nyquist frequency
ATTENUATION_DB = 80.0
MISSING_WEIGHT = 0.2  # of the filter's weight on missing samples, beyond which its output is missing


def decimate(
    log: Recording, period: float, segments: Sequence[slice], factor: int
) -> tuple[VectorM, dict[str, VectorM], str]:
    """Return every `factor`-th sample behind the filter, and a note: see `Log.decimate`. `log`: uniformly sampled,
    every `period` s. `segments`: rows between gaps, filtered each on its own. Raises LogError: none is as long as the
    filter.
    """
    taps = _taps(factor)
    half = taps.size // 2
    long = [segment for segment in segments if segment.stop - segment.start > taps.size + factor]
    if not long:
        longest = max((segment.stop - segment.start for segment in segments), default=0)
        raise LogError(
            f"{log.source}: decimation by {factor} needs {taps.size + factor + 1} samples without a gap and the "
            f"longest segment has {longest}; decimate by less"
        )
    # The filter has linear phase: an output stands for the middle of its taps.
    time = np.concatenate([log.time[segment.start + half : segment.stop - half : factor] for segment in long])
    values = {
        name: np.concatenate([_filter(signal.values[segment], taps, factor) for segment in long])
        for name, signal in log.signals.items()
    }
    rate_hz = sample_rate_hz(period) / factor
    dropped = len(segments) - len(long)
    note = (
        f"decimated by {factor} to {rate_hz:.6g} Hz: pass band 0 to "
        f"{0.5 * PASS_BAND * rate_hz:.4g} Hz, {half} samples cut at each end of each segment"
        + (f", {dropped} short segment{'s' if dropped > 1 else ''} left out" if dropped else "")
    )
    return time, values, note


@lru_cache(maxsize=16)
def _taps(factor: int) -> VectorM:
    """Return the filter's taps, an odd number of them, with a gain of 1 at 0 Hz."""
    from scipy.signal import kaiserord  # deferred: 1 s

    count, beta = kaiserord(ATTENUATION_DB, (1.0 - PASS_BAND) / factor)
    half = int(np.ceil(count / (2 * factor))) * factor  # whole periods of the new clock
    cutoff = 0.5 * (1.0 + PASS_BAND) / factor
    taps = np.sinc(cutoff * np.arange(-half, half + 1)) * np.kaiser(2 * half + 1, beta)
    taps = taps / np.sum(taps)
    taps.setflags(write=False)
    return taps


def _filter(values: VectorN, taps: VectorM, factor: int) -> VectorK:
    """Return the filter's output where it has all its input, every `factor`-th sample."""
    missing = ~np.isfinite(values)
    if not np.any(missing):
        return _correlate(values, taps, factor)
    if np.all(missing):
        return np.full(_correlate(np.zeros(values.size), taps, factor).size, np.nan)
    weight = np.abs(taps) / np.sum(np.abs(taps))
    lost = _correlate(missing.astype(float), weight, factor) > MISSING_WEIGHT
    return np.where(lost, np.nan, _correlate(bridge(values), taps, factor))


def _correlate(values: VectorN, taps: VectorM, factor: int) -> VectorK:
    """Return the correlation of values and taps where they overlap entirely, every `factor`-th of it."""
    from scipy.signal import upfirdn

    # upfirdn starts before the first sample: dropping so many taps less one leaves a multiple of the factor to skip.
    lead = (-(taps.size - 1)) % factor
    padded = np.concatenate([np.zeros(lead), values])
    skip = (taps.size - 1 + lead) // factor
    count = (values.size - taps.size) // factor + 1
    return np.asarray(upfirdn(taps, padded, up=1, down=factor))[skip : skip + count]
