"""A uniform clock: samples interpolated to one by a declared rule, or rounded timestamps straightened.

Neither bridges a gap: the stretches between gaps keep their places, and no sample is invented there.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from seaopt.errors import LogError
from seaopt.logs.log.alignment import Hold, Linear, Nearest, Rule
from seaopt.logs.quality.clock import GAP, sample_rate_hz, split_at_gaps, timestamp_resolution
from seaopt.signals import Recording

LEAST_RATE = 0.8  # of the log's rate; below it interpolation would fold what is above the new Nyquist frequency

Resampled = tuple[Float[np.ndarray, " m"], dict[str, Float[np.ndarray, " m"]], str]


def resample(log: Recording, period: float, *, rate_hz: float, rule: Rule | None, bridge_s: float | None) -> Resampled:
    """Return time and channels on a uniform clock, and a note of what was done: see `Log.resample`.

    Raises
    ------
    LogError
        The rate is not positive, or so low that interpolation would alias, or no stretch is long enough.

    """
    chosen = rule if rule is not None else Linear()
    if not isinstance(chosen, Hold | Linear | Nearest):
        raise LogError(
            f"{log.source}: rule = {rule!r} is not a valid rule; expected Linear(), Hold() or Nearest(tolerance_s=...)"
        )
    old_rate_hz = sample_rate_hz(period)
    if not 0.0 < rate_hz < np.inf:
        raise LogError(f"{log.source}: rate_hz = {rate_hz:g} is not positive; give the rate of the new clock")
    if rate_hz < LEAST_RATE * old_rate_hz:
        raise LogError(
            f"{log.source}: rate_hz = {rate_hz:g} is far below the log's {old_rate_hz:.6g} Hz and would alias; "
            "resample near its own rate, then call decimate"
        )
    time = log.time
    longest_step = bridge_s if bridge_s is not None else GAP * period
    new_time: list[Float[np.ndarray, " _"]] = []
    new_values: dict[str, list[Float[np.ndarray, " _"]]] = {name: [] for name in log.signals}
    for stretch in split_at_gaps(time, longest_step):
        grid = _uniform_grid(time[stretch], float(time[0]), rate_hz)
        if grid.size < 2:
            continue
        new_time.append(grid)
        for name, parts in new_values.items():
            parts.append(chosen(grid, time[stretch], log.signals[name].values[stretch]))
    if not new_time:
        raise LogError(f"{log.source}: no stretch without a gap holds 2 samples at {rate_hz:g} Hz; give bridge_s")
    note = f"resampled from {old_rate_hz:.6g} Hz to {rate_hz:g} Hz by {chosen}"
    return np.concatenate(new_time), {name: np.concatenate(parts) for name, parts in new_values.items()}, note


def _uniform_grid(time: Float[np.ndarray, " n"], origin: float, rate_hz: float) -> Float[np.ndarray, " m"]:
    """Return the points k/rate_hz after `origin` that lie within `time`, ends included."""
    rounding = 1e-9
    first = np.ceil((time[0] - origin) * rate_hz - rounding)
    last = np.floor((time[-1] - origin) * rate_hz + rounding)
    return np.clip(origin + np.arange(first, last + 1) / rate_hz, time[0], time[-1])


def restamp(log: Recording, period: float) -> tuple[Float[np.ndarray, " n"], str]:
    """Return the uniform clock that explains rounded timestamps, and a note of what was done: see `Log.restamp`.

    Raises
    ------
    LogError
        Rounding alone does not explain the timestamps: the sampling itself is irregular.

    """
    resolution = timestamp_resolution(log.time)
    uniform = log.time.copy()
    for stretch in split_at_gaps(log.time, GAP * period):
        stamps = log.time[stretch]
        line = period * np.arange(stamps.size)
        # Rounding moves a stamp by at most half a step, so all of them lie within one step; two allow for the period.
        deviations = stamps - line
        if np.ptp(deviations) > 2.0 * resolution + 1e-9 * period:
            raise LogError(
                f"{log.source}: the timestamps deviate by {np.ptp(deviations) / 2:.3g} s from a uniform clock, more "
                f"than their rounding to {resolution:.3g} s explains; call log.resample(rate_hz=...)"
            )
        uniform[stretch] = line + 0.5 * (np.min(deviations) + np.max(deviations))
    rounded = f", rounded to {resolution:.3g} s," if resolution else ""
    return uniform, f"timestamps{rounded} put on a uniform clock of {sample_rate_hz(period):.6g} Hz"
