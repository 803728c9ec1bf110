"""Channels of other clocks, brought to the log's clock by a declared rule; outside their span they are missing."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int

from seaopt.errors import LogError
from seaopt.logs.quality.clock import measure_steps
from seaopt.records import record
from seaopt.signals import RowsK, VectorM, VectorN

TICK = 1e-9  # seconds within which two instants are one: an offset that is taken off leaves rounding behind
MOST_PACE = 1.25  # readings for an instant: of a faster clock `Readings` would leave out too many


class _Reaching:
    """A rule whose one option, where it has one, says how far from an instant it looks for samples."""

    __slots__ = ()

    def __post_init__(self) -> None:
        for name in self.__slots__:
            if not self.reach_s > 0:
                raise LogError(f"{type(self).__name__}: {name} = {self.reach_s:g} must be above 0; give seconds")

    @property
    def reach_s(self) -> float:
        """How far from an instant the rule looks for samples."""
        return next((getattr(self, name) for name in self.__slots__), np.inf)


@record
class Hold(_Reaching):
    """The last sample at or before each instant: commands, switches, and what a controller saw.

    Parameters
    ----------
    max_age_s : float
        Older samples are not held.

    Examples
    --------
    >>> import numpy as np
    >>> Hold()(np.array([0.0, 1.0, 2.5, 3.1]), np.array([1.0, 3.0]), np.array([5.0, 7.0])).tolist()
    [nan, 5.0, 5.0, nan]
    """

    max_age_s: float = np.inf

    def __call__(self, at: VectorN, time: VectorM, values: VectorM) -> VectorN:
        """Return the values at the instants `at`, NaN where the rule has none."""
        before, _, inside = _neighbours(at, time)
        return np.where(inside & (at - time[before] <= self.max_age_s), values[before], np.nan)


@record
class Linear(_Reaching):
    """The straight line between the samples on either side: quantities that are smooth between samples.

    Parameters
    ----------
    max_gap_s : float
        Samples further apart than this are not joined.

    Examples
    --------
    >>> import numpy as np
    >>> Linear(max_gap_s=2)(np.array([1.5, 4.0]), np.array([1.0, 3.0, 6.0]), np.array([5.0, 7.0, 8.0])).tolist()
    [5.5, nan]
    """

    max_gap_s: float = np.inf

    def __call__(self, at: VectorN, time: VectorM, values: VectorM) -> VectorN:
        """Return the values at the instants `at`, NaN where the rule has none."""
        before, after, inside = _neighbours(at, time)
        step = time[after] - time[before]
        weight = np.divide(at - time[before], step, out=np.zeros_like(at), where=step > 0)
        weight[np.abs(at - time[before]) <= TICK] = 0.0
        # A sample that is met exactly needs no neighbour.
        joined = np.where(weight > 0, (1 - weight) * values[before] + weight * values[after], values[before])
        return np.where(inside & ((step <= self.max_gap_s) | (weight == 0)), joined, np.nan)


@record
class Nearest(_Reaching):
    """The sample nearest in time, if it is within the tolerance: clocks of one rate with a little jitter.

    Parameters
    ----------
    tolerance_s : float
        Further samples are not taken.

    Examples
    --------
    >>> import numpy as np
    >>> Nearest(tolerance_s=0.2)(np.array([1.1, 2.0]), np.array([1.0, 3.0]), np.array([5.0, 7.0])).tolist()
    [5.0, nan]
    """

    tolerance_s: float

    def __call__(self, at: VectorN, time: VectorM, values: VectorM) -> VectorN:
        """Return the values at the instants `at`, NaN where the rule has none."""
        before, after, inside = _neighbours(at, time)
        best = np.where(time[after] - at < at - time[before], after, before)
        return np.where(inside & (np.abs(time[best] - at) <= self.tolerance_s), values[best], np.nan)


@record
class Readings(_Reaching):
    """Each sample once, at the instant nearest to it, to which the cubic through four samples takes it; elsewhere there
    is none: outputs of a slower or a shifted clock, of which lines between samples would make more than was measured.
    Nothing is taken across a hole of the channel. A clock of more than 1.25 times the log's rate is refused (LogError).

    Examples
    --------
    >>> import numpy as np
    >>> time = np.array([0.2, 2.2, 4.2, 6.0])
    >>> Readings()(np.arange(7.0), time, time**3).round(9).tolist()
    [nan, nan, 8.0, nan, 64.0, nan, 216.0]
    """

    def __call__(self, at: VectorN, time: VectorM, values: VectorM) -> VectorN:
        """Return the values at the instants `at`, NaN where the rule has none."""
        out, read = np.full(at.size, np.nan), np.isfinite(values)
        time, values = time[read], values[read]
        if at.size < 2 or not time.size:
            return out
        pace = measure_pace(at, time)
        if pace > MOST_PACE:
            raise LogError(
                f"Readings: time has about {pace:.2g} times as many samples as the log's clock has instants, and those "
                "in excess would be left out; make it the log's clock, or align by Linear()"
            )
        row, near = _find_nearest(at, time)
        row = np.unique(row[near])
        first, last = _split_at_holes(time)
        part = np.searchsorted(time[first], at[row] + TICK) - 1
        inside = (part >= 0) & (at[row] <= time[last[part]] + TICK)
        row, first, last = row[inside], first[part[inside]], last[part[inside]]
        size = np.minimum(last - first + 1, 4)
        for points in range(1, 5):  # a short part between holes has less than four
            few = size == points
            start = np.searchsorted(time, at[row[few]]) - points // 2
            nodes = np.clip(start, first[few], last[few] - points + 1)[:, None] + np.arange(points)
            out[row[few]] = _interpolate(at[row[few]], time[nodes], values[nodes])
        return out


Rule = Hold | Linear | Nearest | Readings


def check_increasing(time: VectorM, clock: str) -> None:
    """Refuse (LogError) a clock that is empty, has NaN, repeats or runs backwards: no rule can work on it."""
    if time.size == 0:
        raise LogError(f"{clock} holds no sample; choose another channel or window_s")
    if not np.all(np.isfinite(time)):
        row = int(np.flatnonzero(~np.isfinite(time))[0])
        raise LogError(f"{clock} is not a number in sample {row + 1}; remove that row")
    step = np.diff(time)
    if np.any(step <= 0):
        row = int(np.flatnonzero(step <= 0)[0]) + 1
        how = "repeats" if step[row - 1] == 0 else "runs backwards"
        raise LogError(f"{clock} {how} at sample {row + 1} (t = {time[row]:g} s); sort or remove such rows")


def measure_pace(at: VectorN, time: VectorM) -> float:
    """Return how many samples a clock has for an instant of another, where both run; rather too few than too many."""
    first, last = _split_at_holes(time)
    inside = np.searchsorted(at, time[last] + TICK) - np.searchsorted(at, time[first] - TICK)
    _, near = _find_nearest(at, time)
    return float((np.count_nonzero(near) - first.size) / (np.sum(inside) + first.size))


def _split_at_holes(time: VectorM) -> tuple[RowsK, RowsK]:
    """Return the first and the last sample of each part of a clock between its holes."""
    step = np.diff(time)
    holes = np.flatnonzero(step > measure_steps(step)[1]) if step.size else np.empty(0, np.int64)
    return np.append(0, holes + 1), np.append(holes, time.size - 1)


def _find_nearest(at: VectorN, time: VectorM) -> tuple[Int[np.ndarray, " m"], Bool[np.ndarray, " m"]]:
    """Return the instant nearest to each sample, and whether it is within half a step."""
    after = np.clip(np.searchsorted(at, time), 1, at.size - 1)
    row = np.where(time - at[after - 1] < at[after] - time, after - 1, after)
    return row, np.abs(at[row] - time) <= 0.5 * float(np.median(np.diff(at))) + TICK


def _interpolate(at: VectorN, time: Float[np.ndarray, "n p"], values: Float[np.ndarray, "n p"]) -> VectorN:
    """Return the polynomial through the points of each instant."""
    out = np.zeros(at.size)
    for i in range(time.shape[1]):
        beside = np.arange(time.shape[1]) != i
        weights = (at[:, None] - time[:, beside]) / (time[:, [i]] - time[:, beside])
        out += np.prod(weights, axis=1) * values[:, i]
    return out


def _neighbours(at: VectorN, time: VectorM) -> tuple[np.ndarray, np.ndarray, Bool[np.ndarray, " n"]]:
    """Return the samples on either side of each instant, and whether the instant lies in the clock's span."""
    before = np.clip(np.searchsorted(time, at + TICK, side="right") - 1, 0, time.size - 1)
    after = np.minimum(before + 1, time.size - 1)
    return before, after, (at >= time[0] - TICK) & (at <= time[-1] + TICK)
