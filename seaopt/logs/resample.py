"""A uniform clock: samples interpolated to one by a declared rule, or rounded timestamps straightened.

Neither bridges a gap: the stretches between gaps keep their places, and the samples of a gap are not invented.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from jaxtyping import Float

from seaopt.errors import LogError
from seaopt.logs.align import Hold, Linear, Nearest, Rule
from seaopt.logs.clock import resolution
from seaopt.logs.log import GAP, Log

LEAST = 0.8  # of the log's rate; below it interpolation would fold what is above the new Nyquist frequency


def resample(log: Log, *, rate_hz: float, rule: Rule | None = None, bridge_s: float | None = None) -> Log:
    """Interpolate a log to a uniform clock.

    Parameters
    ----------
    log : Log
        Sampled with jitter, or at another rate.
    rate_hz : float
        Of the new clock, which starts at the log's first sample; at least 0.8 of the log's own rate.
    rule : Linear, Hold or Nearest, optional
        Linear if left out. A line between samples is a low-pass filter: it takes 0.9 dB at a quarter of the sample
        rate and 3.9 dB at half.
    bridge_s : float, optional
        Longest step of time that is interpolated across; 1.5 periods, which is what a gap is, if left out.

    Returns
    -------
    Log
        With a note of what was done; gaps stay gaps.

    Raises
    ------
    LogError
        The rate is not positive, or so low that interpolation would alias, or no stretch is long enough.

    Examples
    --------
    >>> log = Log.from_arrays(time=[0.0, 0.11, 0.2, 0.29, 0.4], F1=[0.0, 1.1, 2.0, 2.9, 4.0])
    >>> even = log.resample(rate_hz=10)
    >>> even["F1"].round(9).tolist(), even.notes
    ([0.0, 1.0, 2.0, 3.0, 4.0], ('resampled from 10 Hz to 10 Hz by Linear(max_gap_s=inf)',))

    """
    chosen = rule if rule is not None else Linear()
    if not isinstance(chosen, Hold | Linear | Nearest):
        raise LogError(f"{log.source}: rule = {rule!r} is no rule; give Linear(), Hold() or Nearest(tolerance_s=...)")
    if not 0.0 < rate_hz < np.inf:
        raise LogError(f"{log.source}: rate_hz = {rate_hz:g} is not positive; give the rate of the new clock")
    if rate_hz < LEAST * log.rate_hz:
        raise LogError(
            f"{log.source}: rate_hz = {rate_hz:g} is far below the log's {log.rate_hz:.6g} Hz and would alias; "
            "resample near its own rate, then call decimate"
        )
    longest = bridge_s if bridge_s is not None else GAP * log.period
    grid: list[Float[np.ndarray, " _"]] = []
    found: dict[str, list[Float[np.ndarray, " _"]]] = {name: [] for name in log.signals}
    for piece in _stretches(log, longest):
        time = log.time[piece]
        at = _grid(time, float(log.time[0]), rate_hz)
        if at.size < 2:
            continue
        grid.append(at)
        for name, parts in found.items():
            parts.append(chosen(at, time, log[name][piece]))
    if not grid:
        raise LogError(f"{log.source}: no stretch without a gap holds 2 samples at {rate_hz:g} Hz; give bridge_s")
    note = f"resampled from {log.rate_hz:.6g} Hz to {rate_hz:g} Hz by {chosen}"
    return log.with_values(np.concatenate(grid), {name: np.concatenate(parts) for name, parts in found.items()}, note)


def _stretches(log: Log, longest: float) -> list[slice]:
    breaks = np.flatnonzero(np.diff(log.time) > longest) + 1
    return [slice(a, b) for a, b in pairwise([0, *breaks.tolist(), len(log)]) if b - a >= 2]


def _grid(time: Float[np.ndarray, " n"], origin: float, rate_hz: float) -> Float[np.ndarray, " m"]:
    """Return the points k/rate_hz after `origin` that lie within `time`, ends included."""
    tiny = 1e-9
    first = np.ceil((time[0] - origin) * rate_hz - tiny)
    last = np.floor((time[-1] - origin) * rate_hz + tiny)
    return np.clip(origin + np.arange(first, last + 1) / rate_hz, time[0], time[-1])


def restamp(log: Log) -> Log:
    """Put a log whose timestamps were rounded on the uniform clock that explains them; samples are not touched.

    Returns
    -------
    Log
        With a note; each stretch between gaps on a line of its own through its timestamps, at one common period.

    Raises
    ------
    LogError
        Rounding alone does not explain the timestamps: the sampling itself strays.

    Examples
    --------
    >>> import numpy as np
    >>> log = Log.from_arrays(time=np.round(np.arange(400) / 400, 3), F1=np.zeros(400))
    >>> even = log.restamp()
    >>> bool(np.max(np.abs(even.time - np.arange(400) / 400)) < 1e-3), len(even.segments)
    (True, 1)

    """
    step = resolution(log.time)
    pieces = _stretches(log, GAP * log.period)
    time = log.time.copy()
    for piece in pieces:
        stamps = log.time[piece]
        place = log.period * np.arange(stamps.size)
        strays = stamps - place
        if np.ptp(strays) > 2.0 * step + 1e-9 * log.period:
            raise LogError(
                f"{log.source}: the timestamps stray {np.ptp(strays) / 2:.3g} s from a uniform clock, more than their "
                f"rounding to {step:.3g} s explains; call log.resample(rate_hz=...)"
            )
        time[piece] = place + 0.5 * (np.min(strays) + np.max(strays))
    rounded = f", rounded to {step:.3g} s," if step else ""
    note = f"timestamps{rounded} put on a uniform clock of {log.rate_hz:.6g} Hz"
    return log.with_values(time, {name: log[name] for name in log.signals}, note)
