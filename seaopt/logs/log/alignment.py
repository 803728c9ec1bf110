"""Channels of other clocks, brought to the log's clock by a declared rule; outside their span they are missing."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

from seaopt.errors import LogError
from seaopt.records import record

TICK = 1e-9  # seconds within which two instants are one: an offset that is taken off leaves rounding behind


@record
class Hold:
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

    def __post_init__(self) -> None:
        _check_positive("Hold", "max_age_s", self.max_age_s)

    @property
    def reach_s(self) -> float:
        """How far from an instant the rule looks for samples."""
        return self.max_age_s

    def __call__(
        self, at: Float[np.ndarray, " n"], time: Float[np.ndarray, " m"], values: Float[np.ndarray, " m"]
    ) -> Float[np.ndarray, " n"]:
        """Return the values at the instants `at`, NaN where the rule has none."""
        before, _, inside = _neighbours(at, time)
        return np.where(inside & (at - time[before] <= self.max_age_s), values[before], np.nan)


@record
class Linear:
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

    def __post_init__(self) -> None:
        _check_positive("Linear", "max_gap_s", self.max_gap_s)

    @property
    def reach_s(self) -> float:
        """How far from an instant the rule looks for samples."""
        return self.max_gap_s

    def __call__(
        self, at: Float[np.ndarray, " n"], time: Float[np.ndarray, " m"], values: Float[np.ndarray, " m"]
    ) -> Float[np.ndarray, " n"]:
        """Return the values at the instants `at`, NaN where the rule has none."""
        before, after, inside = _neighbours(at, time)
        step = time[after] - time[before]
        weight = np.divide(at - time[before], step, out=np.zeros_like(at), where=step > 0)
        weight[np.abs(at - time[before]) <= TICK] = 0.0
        # A sample that is met exactly needs no neighbour.
        joined = np.where(weight > 0, (1 - weight) * values[before] + weight * values[after], values[before])
        return np.where(inside & ((step <= self.max_gap_s) | (weight == 0)), joined, np.nan)


@record
class Nearest:
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

    def __post_init__(self) -> None:
        _check_positive("Nearest", "tolerance_s", self.tolerance_s)

    @property
    def reach_s(self) -> float:
        """How far from an instant the rule looks for samples."""
        return self.tolerance_s

    def __call__(
        self, at: Float[np.ndarray, " n"], time: Float[np.ndarray, " m"], values: Float[np.ndarray, " m"]
    ) -> Float[np.ndarray, " n"]:
        """Return the values at the instants `at`, NaN where the rule has none."""
        before, after, inside = _neighbours(at, time)
        best = np.where(time[after] - at < at - time[before], after, before)
        return np.where(inside & (np.abs(time[best] - at) <= self.tolerance_s), values[best], np.nan)


@record
class Readings:
    """Each sample once, at the instant nearest to it, to which the cubic through four samples takes it; elsewhere there
    is none: outputs of a slower or a shifted clock, of which lines between samples would make more than was measured.

    Examples
    --------
    >>> import numpy as np
    >>> time = np.array([0.2, 2.2, 4.2, 6.0])
    >>> Readings()(np.arange(7.0), time, time**3).round(9).tolist()
    [nan, nan, 8.0, nan, 64.0, nan, 216.0]
    """

    @property
    def reach_s(self) -> float:
        """How far from an instant the rule looks for samples."""
        return np.inf

    def __call__(
        self, at: Float[np.ndarray, " n"], time: Float[np.ndarray, " m"], values: Float[np.ndarray, " m"]
    ) -> Float[np.ndarray, " n"]:
        """Return the values at the instants `at`, NaN where the rule has none."""
        out, read = np.full(at.size, np.nan), np.isfinite(values)
        time, values = time[read], values[read]
        points = min(4, time.size)
        if at.size < 2 or not points:
            return out
        after = np.clip(np.searchsorted(at, time), 1, at.size - 1)
        row = np.where(time - at[after - 1] < at[after] - time, after - 1, after)
        near = np.abs(at[row] - time) <= 0.5 * float(np.median(np.diff(at))) + TICK
        row = np.unique(row[near & (at[row] >= time[0] - TICK) & (at[row] <= time[-1] + TICK)])
        first = np.clip(np.searchsorted(time, at[row]) - points // 2, 0, time.size - points)
        nodes = first[:, None] + np.arange(points)
        away = at[row, None] - time[nodes]
        out[row] = 0.0
        for i in range(points):
            beside = np.arange(points) != i
            weights = away[:, beside] / (time[nodes[:, [i]]] - time[nodes[:, beside]])
            out[row] += np.prod(weights, axis=1) * values[nodes[:, i]]
        return out


Rule = Hold | Linear | Nearest | Readings


def check_increasing(time: Float[np.ndarray, " m"], clock: str) -> None:
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


def _neighbours(
    at: Float[np.ndarray, " n"], time: Float[np.ndarray, " m"]
) -> tuple[np.ndarray, np.ndarray, Bool[np.ndarray, " n"]]:
    """Return the samples on either side of each instant, and whether the instant lies in the clock's span."""
    before = np.clip(np.searchsorted(time, at + TICK, side="right") - 1, 0, time.size - 1)
    after = np.minimum(before + 1, time.size - 1)
    return before, after, (at >= time[0] - TICK) & (at <= time[-1] + TICK)


def _check_positive(rule: str, name: str, value: float) -> None:
    if not value > 0:
        raise LogError(f"{rule}: {name} = {value:g} must be above 0; give seconds")
