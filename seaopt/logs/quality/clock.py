"""The clock of a log: its rate, its jitter, and where it stands still, runs backwards or skips samples."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
from jaxtyping import Int

from seaopt.errors import LogError
from seaopt.records import record
from seaopt.signals import RowsK, VectorM, VectorN

GAP = 1.5  # periods between two samples that make a gap
LONG = 2.0  # times a step that is usual, where their lengths vary: what is longer is a gap
OFTEN = 0.05  # share of longer steps from which they are usual themselves
WHOLE = 0.1  # of a period, off a whole number of them: a longer step is that of lost samples
JITTER_LIMIT = 0.05  # of the period; beyond it a log is not uniformly sampled
SAME_RATE = 1e-3  # relative: a rate of few digits that is nearer is meant
ROUNDING_STEPS = 200_000  # steps of time that are enough to see the rounding of timestamps


@record(eq=False)
class ClockQuality:
    """Rate, jitter, gaps and faults of a log's timestamps; rows are counted from 0."""

    samples: int
    period: float  # mean step between samples that are not across a gap, in s
    gap_s: float  # step above which it is a gap
    # jitter_rms, jitter_max: of those steps, from the period, in s
    jitter_rms: float
    jitter_max: float
    rounding: float  # step that the timestamps are rounded to, in s; 0 where none is seen
    rounded_only: bool  # whether the rounding explains the jitter: behind it the sampling may be perfect
    # not_numbers, backwards, repeated, gaps: rows whose time is not a number, lies before or at that of the row ahead
    # of it, or follows a gap
    not_numbers: Int[np.ndarray, " a"]
    backwards: Int[np.ndarray, " b"]
    repeated: Int[np.ndarray, " c"]
    gaps: Int[np.ndarray, " d"]
    lost: Int[np.ndarray, " d"]  # samples that are missing in each gap

    @property
    def rate_hz(self) -> float:
        """Sample rate in Hz."""
        return sample_rate_hz(self.period)

    @property
    def irregular(self) -> bool:
        """Whether its steps vary so much that samples in a row mean little: it has no rate but on average."""
        return self.gap_s > (1.0 + JITTER_LIMIT) * GAP * self.period and not self.rounded_only


def sample_rate_hz(period: float) -> float:
    """Return the sample rate of a period in s, to nine digits."""
    return float(f"{1.0 / period:.9g}")


def shorten_rate(rate_hz: float) -> float:
    """Return a rate to the fewest digits that mean it: stamps tell themselves by how much a clock is off."""
    rates = (float(f"{rate_hz:.{digits}g}") for digits in range(2, 9))
    return next(each for each in rates if abs(each / rate_hz - 1.0) < SAME_RATE)


def advise_clock(period: float, *, rounded: bool = False) -> tuple[str, list[dict[str, Any]]]:
    """Return how an uneven clock is made uniform, as calls and as keys; `rounded`: only its timestamps are."""
    if rounded:
        return "call log.restamp()", [{"resample": "restamp"}]
    rate_hz = shorten_rate(1.0 / period)
    text = f"call log.resample(rate_hz={rate_hz:g}), or log.restamp(rate_hz={rate_hz:g}) where a PC stamped the "
    uniform = {"rate_hz": rate_hz}
    return text + "samples of a perfect clock", [{"resample": uniform}, {"resample": {**uniform, "rule": "restamp"}}]


def assess_clock(time: VectorN, source: str) -> ClockQuality:
    """Return rate, jitter, gaps and faults of timestamps. Raises LogError: fewer than two of them increase."""
    finite = np.flatnonzero(np.isfinite(time))
    stamps = time if finite.size == time.size else time[finite]
    step = np.diff(stamps)
    onward = step[step > 0.0]
    if not onward.size:
        raise LogError(f"{source}: time never increases; name the column that is the clock")
    period, gap_s = measure_steps(onward)
    across = step > gap_s
    inside = step[(step > 0.0) & ~across]
    deviations = inside - period
    rounding = timestamp_resolution(stamps)
    return ClockQuality(
        samples=time.size,
        period=period,
        gap_s=gap_s,
        jitter_rms=float(np.sqrt(np.mean(deviations**2))),
        jitter_max=float(np.max(np.abs(deviations))),
        rounding=rounding,
        rounded_only=rounding > 0.0 and _rounding_explains(stamps, step, across, rounding, period),
        not_numbers=np.flatnonzero(~np.isfinite(time)),
        backwards=finite[1:][step < 0.0],
        repeated=finite[1:][step == 0.0],
        gaps=finite[1:][across],
        lost=np.maximum(np.round(step[across] / period).astype(int) - 1, 1),
    )


def measure_steps(step: VectorN) -> tuple[float, float]:
    """Return the mean of steps of time that are not across a gap, and the length above which one is. The mean is
    insensitive to rounded stamps, the median only tells the gaps. Longer steps that come often are of the clock itself,
    as where two devices' times alternate, unless they are whole periods: samples were lost there. Whole periods that
    come in turn are those of timestamps rounded to nearly a period.
    """
    usual = float(np.median(step))
    short = step <= GAP * usual
    if np.mean(~short) > OFTEN:
        longer = step[~short] / usual
        stamps, row = np.cumsum(step), np.arange(step.size)
        rounded = np.ptp(stamps - np.polyval(np.polyfit(row, stamps, 1), row)) <= (1.0 + WHOLE) * usual
        if rounded or np.median(np.abs(longer - np.round(longer))) > WHOLE:
            longest = LONG * float(np.quantile(step, 1.0 - OFTEN))
            return float(np.mean(step[step <= longest])), longest
    period = float(np.mean(step[short]))
    return period, GAP * max(period, usual)  # where most steps are the long ones, these are no gaps


def split_at_gaps(time: VectorN, longest_step: float) -> list[slice]:
    """Return the rows of the segments without a longer step, of two samples or more each."""
    return split_rows(np.flatnonzero(np.diff(time) > longest_step) + 1, time.size, 2)


def split_rows(breaks: RowsK, n: int, least: int = 1) -> list[slice]:
    """Return the rows between breaks, of at least so many samples; a break is the first row of what follows."""
    return [slice(first, last) for first, last in pairwise([0, *breaks.tolist(), n]) if last - first >= least]


def timestamp_resolution(time: VectorN) -> float:
    """Return the step that timestamps are rounded to; 0 where they are as fine as floats."""
    step = np.diff(time[:ROUNDING_STEPS])
    noise = 16.0 * np.finfo(float).eps * float(np.max(np.abs(time[: step.size + 1])))
    # Differences of rounded stamps are whole multiples of the rounding step, up to the noise of floats.
    kinds = np.unique(step)
    apart = np.diff(kinds)
    apart = apart[apart > noise]
    if not apart.size or float(np.ptp(step)) <= 1e-6 * float(np.median(np.abs(step))):
        return 0.0
    unit = float(np.min(apart))
    multiples = kinds / unit
    off = np.abs(multiples - np.round(multiples)) * unit
    return unit if float(np.max(off)) <= max(0.02 * unit, noise) and unit > 4.0 * noise else 0.0


def _rounding_explains(
    stamps: VectorN, step: VectorM, across: VectorM | np.ndarray, rounding: float, period: float
) -> bool:
    """Return whether every segment between gaps lies on a line through its timestamps, within their rounding."""
    if np.any(step < 0.0):
        return False
    segments = [stamps[rows] for rows in split_rows(np.flatnonzero(across) + 1, stamps.size)]
    spans = [float(np.ptp(segment - period * np.arange(segment.size))) for segment in segments]
    return max(spans) <= 2.0 * rounding + 1e-9 * period
