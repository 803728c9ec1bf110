"""A log: channels sampled on one clock, in SI, that knows where it came from."""

from __future__ import annotations

import html
from collections.abc import Iterator, Mapping
from dataclasses import field, replace
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from seaopt.errors import LogError, suggestion
from seaopt.records import record
from seaopt.signals import Signal
from seaopt.units import factor, si_unit

if TYPE_CHECKING:
    import pandas as pd
    import polars as pl

    from seaopt.logs.align import Rule
    from seaopt.logs.quality import Quality

JITTER_LIMIT = 0.05  # of the period; beyond it a log is not uniformly sampled
GAP = 1.5  # periods between two samples that make a gap
BLOCK = 100_000  # samples that are looked at in one go


@record(eq=False)
class Log:
    """Channels on one clock.

    Parameters
    ----------
    time : array, shape (n,)
        Seconds, strictly increasing.
    signals : mapping of name to Signal
        Channels of n samples each, in SI.
    source : str
        Where the log came from, for messages and reports.
    notes : tuple of str
        What was done to it since, one sentence each.

    Examples
    --------
    >>> import numpy as np
    >>> t = np.arange(5) / 400
    >>> log = Log.from_arrays(time=t, I=np.ones(5), F1=240 * np.ones(5), units={"I": "A", "F1": "N"})
    >>> log.rate_hz, float(log["F1"][0])
    (400.0, 240.0)

    """

    time: Float[np.ndarray, " n"]
    signals: Mapping[str, Signal]
    source: str = "arrays"
    notes: tuple[str, ...] = ()
    period: float = field(init=False)

    def __post_init__(self) -> None:
        n = self.time.size
        if self.time.ndim != 1 or n < 2:
            raise LogError(f"{self.source}: time has shape {self.time.shape}; a log needs at least 2 samples")
        if not _rises(self.time):
            raise LogError(f"{self.source}: {_fault(self.time)}")
        for name, signal in self.signals.items():
            if signal.values.size != n:
                raise LogError(
                    f"{self.source}: channel {name} has {signal.values.size} samples and time has {n}; "
                    "give arrays of one length"
                )
        self.time.setflags(write=False)
        object.__setattr__(self, "period", _period(self.time))

    @classmethod
    def from_arrays(
        cls,
        *,
        time: Any,
        units: Mapping[str, str] | None = None,
        source: str = "arrays",
        **channels: Any,
    ) -> Log:
        """Build a log from arrays.

        Parameters
        ----------
        time : array-like, shape (n,)
            Seconds, or in ``units["time"]``.
        units : mapping of name to unit, optional
            Units of the arrays; what is left out is SI already.
        source : str
            A name for messages.
        **channels : array-like, shape (n,)
            The channels by name.

        Raises
        ------
        LogError
            Shapes differ, an array is not numeric, or time does not increase.
        UnitError
            A unit is unknown.

        """
        given = dict(units or {})
        for name in given:
            if name not in channels and name != "time":
                raise LogError(f'units names "{name}", which is no channel; {suggestion(name, channels)}')
        signals = {name: _signal(name, values, given.get(name), source) for name, values in channels.items()}
        clock = _array("time", time, source) * factor(given.get("time", "s"), "s")
        return cls(time=clock, signals=signals, source=source)

    def __getitem__(self, name: str) -> Float[np.ndarray, " n"]:
        """Return the samples of a channel."""
        return self.signal(name).values

    def signal(self, name: str) -> Signal:
        """Return a channel with its unit."""
        try:
            return self.signals[name]
        except KeyError:
            raise LogError(f'{self.source}: no channel "{name}"; {suggestion(name, self.signals)}') from None

    def __len__(self) -> int:
        return int(self.time.size)

    @property
    def rate_hz(self) -> float:
        """Sample rate in Hz: one over the median step of time, to nine digits."""
        return float(f"{1.0 / self.period:.9g}")

    @property
    def duration_s(self) -> float:
        """Seconds from the first sample to the last."""
        return float(self.time[-1] - self.time[0])

    @property
    def gaps(self) -> list[tuple[float, float]]:
        """Times (s) of the samples before and after each gap."""
        rows = np.flatnonzero(np.diff(self.time) > GAP * self.period)
        return [(float(self.time[row]), float(self.time[row + 1])) for row in rows]

    @property
    def segments(self) -> list[slice]:
        """The stretches without a gap, as slices of at least two samples; a sample alone between gaps is in none.

        Raises
        ------
        LogError
            Inside a stretch the clock strays by more than 5 % of the period: the log is not uniformly sampled.

        """
        breaks = np.flatnonzero(np.diff(self.time) > GAP * self.period) + 1
        edges = [0, *breaks.tolist(), len(self)]
        pieces = [slice(a, b) for a, b in pairwise(edges) if b - a >= 2]
        for piece in pieces:
            worst = float(np.max(np.abs(np.diff(self.time[piece]) - self.period)))
            if worst > JITTER_LIMIT * self.period:
                raise LogError(
                    f"{self.source}: a step of time strays {worst / self.period:.0%} from the period "
                    f"{self.period:.4g} s (5 % is allowed); call log.resample(rate_hz={self._round_rate:g}), or "
                    "log.restamp() where only the timestamps are rounded (in a problem file: resample)"
                )
        return pieces

    def between(self, start_s: float, stop_s: float) -> Log:
        """Return the samples with start_s <= time - time[0] <= stop_s.

        Raises
        ------
        LogError
            Fewer than two samples lie there.

        """
        clock = self.time - self.time[0]
        keep = (clock >= start_s - 1e-9) & (clock <= stop_s + 1e-9)
        if np.count_nonzero(keep) < 2:
            raise LogError(
                f"{self.source}: slice_s = [{start_s:g}, {stop_s:g}] holds fewer than 2 of its samples; "
                f"the log runs from 0 to {self.duration_s:g} s"
            )
        note = f"cut to {start_s:g} to {stop_s:g} s: {np.count_nonzero(keep)} of {len(self)} samples"
        return self.with_values(self.time[keep], {name: self[name][keep] for name in self.signals}, note)

    def with_values(
        self, time: Float[np.ndarray, " n"], values: Mapping[str, Float[np.ndarray, " n"]], note: str
    ) -> Log:
        """Return the log's channels, units and origins with other samples, and a note of what was done."""
        signals = {name: replace(self.signals[name], values=array.copy()) for name, array in values.items()}
        return replace(self, time=time.copy(), signals=signals, notes=(*self.notes, note))

    @property
    def quality(self) -> Quality:
        """What is wrong with the data, and what they can tell: see `seaopt.logs.quality`."""
        from seaopt.logs.quality import quality

        return quality(self)

    def resample(self, *, rate_hz: float, rule: Rule | None = None, bridge_s: float | None = None) -> Log:
        """Return the log on a uniform clock: see `seaopt.logs.resample.resample`."""
        from seaopt.logs.resample import resample

        return resample(self, rate_hz=rate_hz, rule=rule, bridge_s=bridge_s)

    def restamp(self) -> Log:
        """Return the log with rounded timestamps made uniform: see `seaopt.logs.resample.restamp`."""
        from seaopt.logs.resample import restamp

        return restamp(self)

    def decimate(self, factor: int) -> Log:
        """Return every `factor`-th sample behind an anti-alias filter: see `seaopt.logs.decimate.decimate`."""
        from seaopt.logs.decimate import decimate

        return decimate(self, factor)

    def to_arrays(self) -> dict[str, Float[np.ndarray, " n"]]:
        """Return copies of time and channels by name, as `from_arrays` takes them."""
        return {"time": self.time.copy()} | {name: self[name].copy() for name in self.signals}

    def to_polars(self) -> pl.DataFrame:
        """Return a polars frame, units in the column names' brackets: "time [s]", "F1 [N]"."""
        from seaopt.logs.frames import to_polars

        return to_polars(self)

    def to_pandas(self) -> pd.DataFrame:
        """Return a pandas frame with the columns of `to_polars`.

        Raises
        ------
        LogError
            pandas is not installed.

        """
        from seaopt.logs.frames import to_pandas

        return to_pandas(self)

    @classmethod
    def from_frame(
        cls,
        frame: Any,
        *,
        time: str = "time [s]",
        channels: Mapping[str, str] | None = None,
        units: Mapping[str, str] | None = None,
        source: str = "frame",
    ) -> Log:
        """Build a log from a polars or pandas frame.

        Parameters
        ----------
        frame : polars.DataFrame or pandas.DataFrame
            Columns of numbers; nulls and NaN are missing samples.
        time : str
            Name of the time column.
        channels : mapping of channel name to column name, optional
            Every other column if left out, under its name without the brackets where that is clear.
        units : mapping of channel name to unit, optional
            Of columns without brackets; what has neither is SI already.
        source : str
            A name for messages.

        Raises
        ------
        LogError
            A column is missing, not numeric, or given for two channels of one unit; or time does not increase.
        UnitError
            A unit is unknown.

        Examples
        --------
        >>> import polars as pl
        >>> log = Log.from_frame(pl.DataFrame({"t [ms]": [0.0, 2.5], "cur [mA]": [100, None]}), time="t [ms]")
        >>> log.time.tolist(), log["cur"].tolist(), log.signal("cur").unit
        ([0.0, 0.0025], [0.1, nan], 'A')

        """
        from seaopt.logs.frames import from_frame

        return from_frame(frame, time, channels, units or {}, source)

    @property
    def _round_rate(self) -> float:
        """The rate to three digits: what one would resample to."""
        return float(f"{1.0 / self.period:.3g}")

    def __repr__(self) -> str:
        lines = [f"Log {self.source}: {len(self)} samples, {self.duration_s:.6g} s at {self.rate_hz:.6g} Hz"]
        for name, signal in self.signals.items():
            good = signal.values[np.isfinite(signal.values)]
            span = f"{good.min():.4g} to {good.max():.4g}" if good.size else "no finite sample"
            lost = signal.values.size - good.size
            lines.append(f"  {name} [{signal.unit or 'SI'}]  {span}" + (f", {lost} missing" if lost else ""))
        lines += [f"  {note}" for note in self.notes]
        count = len(self.gaps)
        if count:
            shown = ", ".join(f"{start:.6g} to {stop:.6g} s" for start, stop in self.gaps[:3])
            lines.append(f"  {count} gap{'s' if count > 1 else ''}: {shown}{', ...' if count > 3 else ''}")
        return "\n".join(lines)

    def _repr_html_(self) -> str:
        return f"<pre>{html.escape(repr(self))}</pre>"


def _steps(time: Float[np.ndarray, " n"]) -> Iterator[Float[np.ndarray, " _"]]:
    """Return the steps of time in blocks that stay in the cache, where they are looked at more than once."""
    for start in range(0, time.size - 1, BLOCK):
        yield np.diff(time[start : start + BLOCK + 1])


def _rises(time: Float[np.ndarray, " n"]) -> bool:
    """Tell whether time is finite and strictly increasing; a time that is not finite has a step that is not."""
    with np.errstate(invalid="ignore", over="ignore"):
        return all(step.min() > 0 and step.max() < np.inf for step in _steps(time))


def _fault(time: Float[np.ndarray, " n"]) -> str:
    """Say where time does not increase, and what to do."""
    if not np.all(np.isfinite(time)):
        row = int(np.flatnonzero(~np.isfinite(time))[0])
        return f"time is not a number in sample {row + 1}; remove that row"
    with np.errstate(over="ignore"):
        step = np.diff(time)
    row = int(np.flatnonzero((step <= 0) | np.isinf(step))[0]) + 1
    how = "repeats" if step[row - 1] == 0 else "runs backwards" if step[row - 1] < 0 else "leaps"
    return f"time {how} at sample {row + 1} (t = {time[row]:g} s); sort or remove such rows"


def _period(time: Float[np.ndarray, " n"]) -> float:
    """Return the sample period: the mean step between samples that are not across a gap.

    The mean over gap-free steps is insensitive to timestamps rounded to a few digits; the median is not. The median
    that tells the gaps is over at most `BLOCK` steps; the odd stride meets both of two steps that alternate.
    """
    first = np.arange(0, time.size - 1, (time.size - 2) // BLOCK | 1)
    longest = GAP * float(np.median(time[first + 1] - time[first]))
    total, count = 0.0, 0
    for step in _steps(time):
        short = step[step <= longest] if step.max() > longest else step
        total += float(short.sum())
        count += short.size
    return total / count


def _array(name: str, values: Any, source: str) -> Float[np.ndarray, " n"]:
    try:
        array = np.array(values, dtype=float)
    except (TypeError, ValueError) as error:
        raise LogError(f"{source}: channel {name} is not numeric ({error}); give numbers") from error
    if array.ndim != 1:
        raise LogError(f"{source}: channel {name} has shape {array.shape}; give one value a sample, shape (n,)")
    return array


def _signal(name: str, values: Any, unit: str | None, source: str) -> Signal:
    array = _array(name, values, source)
    if unit is None:
        return Signal(name=name, values=array)
    to = si_unit(unit)
    return Signal(name=name, values=array * factor(unit, to), unit=to)
