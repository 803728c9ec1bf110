r"""Decimation: a lower sample rate behind an anti-alias filter.

The filter is a linear-phase FIR low-pass (windowed sinc, Kaiser window of 80 dB; Oppenheim and Schafer, Discrete-Time
Signal Processing, 3rd ed., sec. 7.5.3 and 4.6) whose delay is taken out, so that it shifts nothing in time. With
:math:`f_N` half the new sample rate it passes 0 to 0.8 :math:`f_N` within 0.01 dB and takes 80 dB from :math:`f_N` on.
Samples that the filter cannot reach with all its taps, at the ends of a stretch, are cut off rather than invented.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from jaxtyping import Float

from seaopt.errors import LogError
from seaopt.logs.log import Log

PASS_BAND = 0.8  # of the new Nyquist frequency
ATTENUATION_DB = 80.0
MISSING = 0.2  # of the filter's weight on missing samples, beyond which its output is missing


def decimate(log: Log, factor: int) -> Log:
    """Keep every `factor`-th sample of a log behind an anti-alias filter.

    Parameters
    ----------
    log : Log
        Uniformly sampled; stretches between gaps are filtered each on its own.
    factor : int
        2 or more. Give 1 to keep the log.

    Returns
    -------
    Log
        With a note that names the pass band and the samples that were cut at the ends: 25 periods of the new clock at
        each end of each stretch. A short run of missing samples is bridged by a line for the filter, and the output is
        missing where they carry more than 20 % of its weight. An input that was held is no longer: fit with
        ``hold="first"``.

    Raises
    ------
    LogError
        The factor is not a whole number, or no stretch is as long as the filter.

    Examples
    --------
    >>> import numpy as np
    >>> t = np.arange(4000) / 1000
    >>> slow = Log.from_arrays(time=t, F1=np.sin(2 * np.pi * 10 * t) + np.sin(2 * np.pi * 300 * t)).decimate(5)
    >>> bool(np.max(np.abs(slow["F1"] - np.sin(2 * np.pi * 10 * slow.time))) < 1e-3), slow.rate_hz
    (True, 200.0)

    """
    if isinstance(factor, bool) or not isinstance(factor, int) or factor < 1:
        raise LogError(f"{log.source}: factor = {factor!r} is not a whole number; give 2 or more")
    if factor == 1:
        return log
    taps = _taps(factor)
    half = taps.size // 2
    pieces = [piece for piece in log.segments if piece.stop - piece.start > taps.size + factor]
    if not pieces:
        longest = max((piece.stop - piece.start for piece in log.segments), default=0)
        raise LogError(
            f"{log.source}: decimation by {factor} needs {taps.size + factor + 1} samples without a gap and the "
            f"longest stretch has {longest}; decimate by less"
        )
    rows = [slice(piece.start + half, piece.stop - half, factor) for piece in pieces]
    values = {
        name: np.concatenate([_filtered(log[name][piece], taps, factor) for piece in pieces]) for name in log.signals
    }
    lost = len(log.segments) - len(pieces)
    note = (
        f"decimated by {factor} to {log.rate_hz / factor:.6g} Hz: pass band 0 to "
        f"{0.5 * PASS_BAND * log.rate_hz / factor:.4g} Hz, {half} samples cut at each end of each stretch"
        + (f", {lost} short stretch{'es' if lost > 1 else ''} left out" if lost else "")
    )
    return log.with_values(np.concatenate([log.time[row] for row in rows]), values, note)


@lru_cache(maxsize=16)
def _taps(factor: int) -> Float[np.ndarray, " m"]:
    """Return the filter's taps, an odd number of them, with a gain of 1 at 0 Hz."""
    from scipy.signal import kaiserord  # deferred: 1 s

    count, beta = kaiserord(ATTENUATION_DB, (1.0 - PASS_BAND) / factor)
    half = int(np.ceil(count / (2 * factor))) * factor  # whole periods of the new clock
    cutoff = 0.5 * (1.0 + PASS_BAND) / factor
    taps = np.sinc(cutoff * np.arange(-half, half + 1)) * np.kaiser(2 * half + 1, beta)
    taps = taps / np.sum(taps)
    taps.setflags(write=False)
    return taps


def _filtered(values: Float[np.ndarray, " n"], taps: Float[np.ndarray, " m"], factor: int) -> Float[np.ndarray, " k"]:
    """Return the filter's output where it has all its input, every `factor`-th sample."""
    missing = ~np.isfinite(values)
    if not np.any(missing):
        return _every(values, taps, factor)
    if np.all(missing):
        return np.full(_every(np.zeros(values.size), taps, factor).size, np.nan)
    rows = np.arange(values.size)
    bridged = np.interp(rows, rows[~missing], values[~missing])
    weight = np.abs(taps) / np.sum(np.abs(taps))
    lost = _every(missing.astype(float), weight, factor) > MISSING
    return np.where(lost, np.nan, _every(bridged, taps, factor))


def _every(values: Float[np.ndarray, " n"], taps: Float[np.ndarray, " m"], factor: int) -> Float[np.ndarray, " k"]:
    """Return the correlation of values and taps where they overlap entirely, every `factor`-th of it."""
    from scipy.signal import upfirdn

    # upfirdn starts before the first sample: dropping so many taps less one leaves a multiple of the factor to skip.
    lead = (-(taps.size - 1)) % factor
    padded = np.concatenate([np.zeros(lead), values])
    skip = (taps.size - 1 + lead) // factor
    count = (values.size - taps.size) // factor + 1
    return np.asarray(upfirdn(taps, padded, up=1, down=factor))[skip : skip + count]
