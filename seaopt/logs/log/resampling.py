"""A uniform clock: samples interpolated to one by a declared rule, or rounded timestamps straightened.

Neither bridges a gap: the segments between gaps keep their places, and no sample is invented there.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from seaopt.errors import LogError, require_number, suggestion
from seaopt.logs.log.alignment import Hold, Linear, Nearest, Readings, Rule
from seaopt.logs.quality.clock import advise_clock, sample_rate_hz, shorten_rate, split_at_gaps, timestamp_resolution
from seaopt.signals import Recording, VectorK, VectorM, VectorN

AROUND = 20  # samples ahead that tell a gap from a late stamp
PHASED = 200  # samples of a part that has one phase
LEVELS = 5  # numbers of lost samples that are thought of at a row, from one below the least ahead on
MOST_LATE = 0.5  # periods, of which a late stamp is counted as off: less than an early one, which is rarer
RISE = 0.25  # periods that rows have to be off in all before a sample is missing
PARTS = 20  # of a log, whose medians tell the rate at which the timestamps run
MOST_DRIFT = 5e-3  # of a stated rate, as of a ceramic resonator: a sampling clock that is further off has another rate
RESOLVED = 5.0  # standard deviations of the drift's slope: less is jitter
MOST_RESAMPLED = 100  # samples that interpolation may make of one
ROUNDING = 1e-6  # of a period, within which times are the same
LEAST_RATE = 0.8  # of the log's rate; below it interpolation would fold what is above the new Nyquist frequency

HOW_TO_BRIDGE = "bridge_s interpolates across longer ones"

Resampled = tuple[VectorM, dict[str, VectorM], str]


def resample(
    log: Recording,
    period: float,
    *,
    rate_hz: float,
    rule: Rule | None,
    steps: Sequence[str],
    longest_s: float,
    hole_s: float = 0.0,
) -> Resampled:
    """Return time and channels on a uniform clock, and a note: see `Log.resample`. `longest_s`: of a step that is
    interpolated across; `hole_s`: the same of the samples that a channel has. Raises LogError: the rate is not
    positive, or would alias, or no segment is long enough.
    """
    chosen = rule if rule is not None else Linear()
    if not isinstance(chosen, Hold | Linear | Nearest | Readings):
        raise LogError(
            f"{log.source}: rule = {rule!r} is not a valid rule; expected Linear(), Hold(), "
            "Nearest(tolerance_s=...) or Readings()"
        )
    old_rate_hz = sample_rate_hz(period)
    rate_hz = require_number(rate_hz, "rate_hz", LogError)
    if not require_number(longest_s, "bridge_s", LogError) > 0.0:
        raise LogError(f"{log.source}: bridge_s = {longest_s:g} is not a time; give seconds")
    if not 0.0 < rate_hz < np.inf:
        raise LogError(f"{log.source}: rate_hz = {rate_hz:g} is not positive; give the rate of the new clock")
    round_rate = shorten_rate(old_rate_hz)
    if rate_hz < LEAST_RATE * old_rate_hz:
        every = max(round(old_rate_hz / rate_hz), 2)
        raise LogError(
            f"{log.source}: rate_hz = {rate_hz:g} is far below the log's {old_rate_hz:.6g} Hz and would alias; call "
            f"log.resample(rate_hz={round_rate:g}).decimate({every})",
            keys=[{"resample": {"rate_hz": round_rate}, "decimate": every}],
        )
    for name in steps:
        if name not in log.signals:
            raise LogError(f'{log.source}: steps names "{name}"; {suggestion(name, log.signals)}')
    time = log.time
    if (time[-1] - time[0]) * rate_hz > MOST_RESAMPLED * time.size:
        raise LogError(
            f"{log.source}: rate_hz = {rate_hz:g} would make more than {MOST_RESAMPLED} samples of each of the log's, "
            f"which come at {old_rate_hz:.6g} Hz; call log.resample(rate_hz={round_rate:g})",
            keys=[{"resample": {"rate_hz": round_rate}}],
        )
    gaps = int(np.count_nonzero(np.diff(time) > longest_s))
    new_time: list[Float[np.ndarray, " _"]] = []
    new_values: dict[str, list[Float[np.ndarray, " _"]]] = {name: [] for name in log.signals}
    for segment in split_at_gaps(time, longest_s):
        grid = _uniform_grid(time[segment], float(time[0]), rate_hz)
        if grid.size < 2:
            continue
        new_time.append(grid)
        for name, parts in new_values.items():
            values = log.signals[name].values[segment]
            if name in steps or not isinstance(chosen, Readings):
                values = fill_holes(time[segment], values, hole_s, is_step=name in steps)
            if name in steps:
                parts.append(_average_steps(grid, time[segment], values, period, rate_hz))
            else:
                parts.append(chosen(grid, time[segment], values))
    if not new_time:
        raise LogError(f"{log.source}: no segment without a gap holds 2 samples at {rate_hz:g} Hz; {HOW_TO_BRIDGE}")
    note = f"resampled from {old_rate_hz:.6g} Hz to {rate_hz:g} Hz by {chosen}"
    if steps:
        note += f", {', '.join(steps)} as the mean of its steps over each period"
    if gaps:
        times = "1 step of time is" if gaps == 1 else f"{gaps} steps of time are"
        note += f"; {times} longer than {longest_s:.3g} s and stay gaps: {HOW_TO_BRIDGE}"
    return np.concatenate(new_time), {name: np.concatenate(parts) for name, parts in new_values.items()}, note


def fill_holes(time: VectorN, values: VectorN, longest_s: float, *, is_step: bool = False) -> VectorN:
    """Return a channel whose missing samples are on the line between those beside them, or are the one before them of a
    channel that is held, where these are at most so far apart; at an end they are what is next to them. Devices that
    write at times of their own leave such holes.
    """
    present = np.flatnonzero(np.isfinite(values))
    if present.size in (0, values.size) or longest_s <= 0.0:
        return values
    after = np.searchsorted(present, np.arange(values.size))
    late = time[present[np.minimum(after, present.size - 1)]]
    early = time[present[np.maximum(after - 1, 0)]]
    apart = np.maximum(late - time, 0.0) + np.maximum(time - early, 0.0)
    line = values[present[np.maximum(after - 1, 0)]] if is_step else np.interp(time, time[present], values[present])
    return np.where(np.isnan(values) & (apart <= longest_s), line, values)


def _uniform_grid(time: VectorN, origin: float, rate_hz: float) -> VectorM:
    """Return the points k/rate_hz after `origin` that lie within `time`, ends included."""
    rounding = 1e-9
    first = np.ceil((time[0] - origin) * rate_hz - rounding)
    last = np.floor((time[-1] - origin) * rate_hz + rounding)
    return np.clip(origin + np.arange(first, last + 1) / rate_hz, time[0], time[-1])


def _average_steps(grid: VectorM, time: VectorN, values: VectorN, period: float, rate_hz: float) -> VectorM:
    """Return a signal that keeps each value until the next sample as its mean over each of the grid's periods, so that
    what it drives moves as far. Across a lost sample, where the step is not known, it is a line.
    """
    lost = np.maximum(np.round(np.diff(time) / period).astype(np.int64) - 1, 0)
    inner = [
        time[row] + np.arange(1, lost[row] + 1) * (time[row + 1] - time[row]) / (lost[row] + 1)
        for row in np.flatnonzero(lost)
    ]
    starts = np.sort(np.concatenate([time, *inner]))
    levels = np.interp(starts, time, values)
    edges = np.append(grid, grid[-1] + 1.0 / rate_hz)
    widths = np.diff(np.append(starts, max(edges[-1], starts[-1])))

    def integrate(steps: VectorK) -> VectorM:
        area = np.append(0.0, np.cumsum(widths * steps))
        return np.diff(np.interp(edges, np.append(starts, starts[-1] + widths[-1]), area))

    missing = np.isnan(levels)
    means = integrate(np.where(missing, 0.0, levels)) * rate_hz
    return np.where(integrate(missing.astype(np.float64)) * rate_hz > ROUNDING, np.nan, means)


def restamp(log: Recording, period: float, gap_s: float, rate_hz: float | None = None) -> tuple[VectorN, str]:
    """Return the uniform clock behind rounded or late timestamps, and a note: see `Log.restamp`. Raises LogError:
    rounding alone does not explain them and no rate is stated, or the stated one is not theirs.
    """
    if rate_hz is not None:
        return _restamp_at(log, period, rate_hz)
    resolution = timestamp_resolution(log.time)
    uniform = log.time.copy()
    for segment in split_at_gaps(log.time, gap_s):
        stamps = log.time[segment]
        line = period * np.arange(stamps.size)
        # Rounding moves a stamp by at most half a step, so all of them lie within one step; two allow for the period.
        deviations = stamps - line
        if np.ptp(deviations) > 2.0 * resolution + 1e-9 * period:
            remedy, keys = advise_clock(period)
            raise LogError(
                f"{log.source}: the timestamps deviate by {np.ptp(deviations) / 2:.3g} s from a uniform clock, more "
                f"than their rounding to {resolution:.3g} s explains; {remedy}",
                keys=keys,
            )
        uniform[segment] = line + 0.5 * (np.min(deviations) + np.max(deviations))
    rounded = f", rounded to {resolution:.3g} s," if resolution else ""
    return uniform, f"timestamps{rounded} put on a uniform clock of {sample_rate_hz(period):.6g} Hz"


def _restamp_at(log: Recording, mean_period: float, rate_hz: float) -> tuple[VectorN, str]:
    """Return a clock of a stated rate, with gaps of whole samples where the timestamps move on for good. A sample that
    was stamped late is followed by steps that are too short: the timestamps come back to their line. At a gap they do
    not. The stated rate is nominal and says how samples are counted. Where the timestamps show by how much the sampling
    clock is off, as crystals are, theirs is taken.
    """
    time, period = log.time, 1.0 / rate_hz
    lost = _count_lost((time - time[0]) * rate_hz - np.arange(time.size))
    line = period * (np.arange(time.size) + lost)
    drift, left = _measure_drift(line, time - line)
    round_rate = shorten_rate(sample_rate_hz(mean_period))
    if abs(drift) > MOST_DRIFT or left > 0.5 * period:  # a half, and samples would be counted wrongly
        raise LogError(
            f"{log.source}: rate_hz = {rate_hz:g} is not the rate of the timestamps, which drift from it by "
            f"{np.ptp(line) * abs(drift) + left:.3g} s and rise at {sample_rate_hz(mean_period):.6g} Hz on "
            f"average; correct it, or call log.resample(rate_hz={round_rate:g})",
            keys=[{"resample": {"rate_hz": round_rate}}],
        )
    clock = f"the stated clock of {rate_hz:g} Hz"
    if drift:
        line *= 1.0 + drift
        way = "slower" if drift > 0.0 else "faster"
        clock = f"their clock of {rate_hz / (1.0 + drift):.9g} Hz, {1e6 * abs(drift):.3g} ppm {way} than stated"
    off = time - line
    off -= np.median(off)
    gaps = int(np.count_nonzero(np.diff(lost)))
    between = f" with {gaps} gap{'s' * (gaps != 1)} of whole samples" if gaps else ""
    note = (
        f"timestamps, off by {np.sqrt(np.mean(off**2)):.3g} s rms and {np.max(np.abs(off)):.3g} s at most, put on "
        f"{clock}{between}"
    )
    return line + np.median(time - line), note


def _count_lost(late: VectorN) -> VectorN:
    """Return how many samples are missing before each. `late`: by how many periods each is stamped later than its row
    says. It is a whole number that never falls, a phase that drifts slowly, and jitter. What is stamped late comes
    back, so that the number is near the least of those ahead; it rises where that costs least: the sum of what each row
    is off, for one that is late `MOST_LATE` at most and for an early one a whole, and `RISE` for each rise.
    """
    off = late - _follow_phase(late)
    ahead = np.lib.stride_tricks.sliding_window_view(np.append(off, np.full(AROUND, np.inf)), AROUND + 1)
    base = np.maximum.accumulate(np.round(np.min(ahead, axis=1))) - 1.0
    misfits = np.abs(np.clip(off[:, None] - base[:, None] - np.arange(LEVELS), -1.0, MOST_LATE))
    costs, came = misfits[0].tolist(), np.zeros(misfits.shape, dtype=np.int64)
    moves = np.diff(base).astype(int).tolist()
    for row, (moved, misfit) in enumerate(zip(moves, misfits[1:].tolist(), strict=True), start=1):
        lowest = min(range(min(moved, LEVELS)), key=costs.__getitem__, default=-1)
        before, costs = costs, []
        for level in range(LEVELS):
            same = level + moved
            stayed = before[same] if same < LEVELS else np.inf
            risen = before[lowest] + RISE if lowest >= 0 else np.inf
            came[row, level] = same if stayed <= risen else lowest
            costs.append(misfit[level] + min(stayed, risen))
            if same < LEVELS and (lowest < 0 or before[same] < before[lowest]):
                lowest = same
    level = int(np.argmin(costs))
    lost = np.empty_like(late)
    for row in range(late.size - 1, -1, -1):
        lost[row] = base[row] + level
        level = int(came[row, level])
    return lost - lost[0]


def _follow_phase(late: VectorN) -> VectorN:
    """Return the part of a period by which stamps are late, row by row, however many whole ones: its mean rate is the
    peak of a spectrum on the circle, where whole periods do not count; what is left of it the circular mean of parts.
    """
    rows, turns = np.arange(late.size), np.exp(2j * np.pi * late)
    size, drifts = np.abs(np.fft.fft(turns)), np.fft.fftfreq(late.size)
    slow = np.abs(drifts) <= MOST_DRIFT
    size[slow] *= 2.0  # a rate that is further off than clocks are has to be plain
    line = drifts[np.argmax(size)] * rows
    turns *= np.exp(-2j * np.pi * line)
    parts = np.array_split(rows, max(late.size // PHASED, 1))
    phases = np.unwrap([np.angle(np.mean(turns[part])) for part in parts]) / (2.0 * np.pi)
    return line + np.interp(rows, [np.mean(part) for part in parts], phases)


def _measure_drift(line: VectorN, off: VectorN) -> tuple[float, float]:
    """Return by which share timestamps run slower than a line, and how far that leaves them from it, in s. The slope is
    that of the medians of parts of the log, which no spike moves; zero where jitter gives as much. What is left of the
    medians tells whether timestamps and line count alike from end to end.
    """
    count = min(PARTS, line.size)
    x, y = (np.array([np.median(part) for part in np.array_split(values, count)]) for values in (line, off))
    x, y = x - np.mean(x), y - np.mean(y)
    power = float(x @ x)
    drift = float(x @ y) / power
    left = y - drift * x
    if drift**2 * power * max(count - 2, 0) <= RESOLVED**2 * float(left @ left):
        drift, left = 0.0, y
    return drift, float(np.ptp(left))
