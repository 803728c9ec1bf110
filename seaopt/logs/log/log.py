"""A log: channels sampled on one clock, in SI, that knows where it came from."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from seaopt.errors import LogError, require_number, require_type, suggestion
from seaopt.formatting import format_count, html_list, html_paragraph, html_table
from seaopt.logs.log import decimation, frames, resampling
from seaopt.logs.log.alignment import Rule
from seaopt.logs.quality.clock import (
    GAP,
    JITTER_LIMIT,
    OFTEN,
    advise_clock,
    assess_clock,
    measure_steps,
    sample_rate_hz,
    split_at_gaps,
)
from seaopt.logs.quality.report import Quality, assess_quality
from seaopt.records import PlotAccessor, record
from seaopt.signals import HOLDS, Signal, VectorN, find_taken
from seaopt.units import factor, si_unit

if TYPE_CHECKING:
    import pandas as pd
    import polars as pl

STEPS_PER_CHUNK = 100_000  # steps of time that are checked in one go, so that they stay in the cache


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
    law : str
        Hash of the law that it says it was taken under; empty where it does not.

    Examples
    --------
    >>> import numpy as np
    >>> t = np.arange(5) / 400
    >>> log = Log.from_arrays(time=t, I=np.ones(5), F1=240 * np.ones(5), units={"I": "A", "F1": "N"})
    >>> log.rate_hz, float(log["F1"][0])
    (400.0, 240.0)
    """

    plot = PlotAccessor()

    time: VectorN
    signals: Mapping[str, Signal]
    source: str = "arrays"
    notes: tuple[str, ...] = ()
    law: str = ""
    period: float = field(init=False)
    gap_s: float = field(init=False)

    def __post_init__(self) -> None:
        n = self.time.size
        if self.time.ndim != 1 or n < 2:
            raise LogError(f"{self.source}: time has shape {self.time.shape}; a log needs at least 2 samples")
        if not _increases(self.time):
            raise LogError(f"{self.source}: {_describe_fault(self.time)}")
        for name, signal in self.signals.items():
            if signal.values.size != n:
                raise LogError(
                    f"{self.source}: channel {name} has {signal.values.size} samples and time has {n}; "
                    "give arrays of one length"
                )
        self.time.setflags(write=False)
        for name, value in zip(("period", "gap_s"), _measure_steps(self.time), strict=True):
            object.__setattr__(self, name, value)

    @classmethod
    def from_arrays(
        cls, *, time: Any, units: Mapping[str, str] | None = None, source: str = "arrays", **channels: Any
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
        require_type(units or {}, Mapping, "units", "give a mapping of channel to unit", LogError)
        units = dict(units or {})
        for name, unit in units.items():
            require_type(unit, str, f"unit of {name}", "give a text", LogError)
        for name in units:
            if name not in channels and name != "time":
                raise LogError(f'units names "{name}", which is not a channel; {suggestion(name, channels)}')
        signals = {name: _signal(name, values, units.get(name), source) for name, values in channels.items()}
        seconds = _array("time", time, source) * factor(units.get("time", "s"), "s")
        return cls(time=seconds, signals=signals, source=source)

    def __getitem__(self, name: str) -> VectorN:
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
        """Sample rate in Hz, to nine digits: one over the mean step of time, without the steps across gaps."""
        return sample_rate_hz(self.period)

    @property
    def duration_s(self) -> float:
        """Seconds from the first sample to the last."""
        return float(self.time[-1] - self.time[0])

    @property
    def gaps(self) -> list[tuple[float, float]]:
        """Times (s) of the samples before and after each gap."""
        rows = np.flatnonzero(np.diff(self.time) > self.gap_s)
        return [(float(self.time[row]), float(self.time[row + 1])) for row in rows]

    @property
    def segments(self) -> list[slice]:
        """The segments without a gap, as slices of at least two samples; a single sample between gaps is left out.

        Raises LogError: inside a segment a step differs by more than 5 % from the period: the log is not uniformly
        sampled.
        """
        segments = split_at_gaps(self.time, self.gap_s)
        for segment in segments:
            worst = float(np.max(np.abs(np.diff(self.time[segment]) - self.period)))
            if worst > JITTER_LIMIT * self.period:
                clock = assess_clock(self.time, self.source)
                remedy, keys = advise_clock(clock.period, rounded=clock.rounded_only)
                raise LogError(
                    f"{self.source}: a step of time differs by {worst / self.period:.0%} from the period "
                    f"{self.period:.4g} s (5 % is allowed); {remedy}",
                    keys=keys,
                )
        return segments

    def between(self, start_s: float, stop_s: float) -> Log:
        """Return the samples with start_s <= time - time[0] <= stop_s. Raises LogError: fewer than two samples lie
        there.
        """
        start_s, stop_s = require_number(start_s, "start_s", LogError), require_number(stop_s, "stop_s", LogError)
        elapsed = self.time - self.time[0]
        keep = (elapsed >= start_s - 1e-9) & (elapsed <= stop_s + 1e-9)
        if np.count_nonzero(keep) < 2:
            raise LogError(
                f"{self.source}: slice_s = [{start_s:g}, {stop_s:g}] holds fewer than 2 of its samples; "
                f"the log runs from 0 to {self.duration_s:g} s"
            )
        note = f"cut to {start_s:g} to {stop_s:g} s: {np.count_nonzero(keep)} of {len(self)} samples"
        return self.with_values(self.time[keep], {name: self[name][keep] for name in self.signals}, note)

    def with_values(self, time: VectorN, values: Mapping[str, VectorN], note: str) -> Log:
        """Return the log's channels, units and origins with other samples, and a note of what was done."""
        signals = {name: replace(self.signals[name], values=array.copy()) for name, array in values.items()}
        return replace(self, time=time.copy(), signals=signals, notes=(*self.notes, note))

    @property
    def quality(self) -> Quality:
        """Faults of the data, and what they excite: see `seaopt.logs.assess_quality`."""
        return assess_quality(self)

    def resample(
        self, *, rate_hz: float, rule: Rule | None = None, steps: Sequence[str] = (), bridge_s: float | None = None
    ) -> Log:
        """Interpolate the log to a uniform clock.

        Parameters
        ----------
        rate_hz : float
            Of the new clock, which starts at the log's first sample; at least 0.8 of the log's own rate.
        rule : Linear, Hold, Nearest or Readings, optional
            Linear if left out. A line between samples is a low-pass filter: it attenuates by 0.9 dB at a quarter of the
            sample rate and 3.9 dB at half.
        steps : sequence of str, optional
            Channels that keep their value until the next sample, as a command does: each new sample is the mean over
            its period, so that what is commanded moves as far. A line through them is 30 times as far off.
        bridge_s : float, optional
            Longest step of time that is interpolated across; 1.5 periods, which is what a gap is, if left out, or twice
            the steps that are usual where their lengths vary. A log sampled at irregular times may need a longer one,
            or it falls apart into short segments. If given, a channel whose samples are so far apart, with others
            missing between them, is interpolated across these, too.

        Returns
        -------
        Log
            With a note of what was done; gaps stay gaps.

        Raises
        ------
        LogError
            The rate is not positive, or so low that interpolation would alias, or no segment is long enough.

        Examples
        --------
        >>> log = Log.from_arrays(time=[0.0, 0.11, 0.2, 0.29, 0.4], F1=[0.0, 1.1, 2.0, 2.9, 4.0])
        >>> even = log.resample(rate_hz=10)
        >>> even["F1"].round(9).tolist(), even.notes
        ([0.0, 1.0, 2.0, 3.0, 4.0], ('resampled from 10 Hz to 10 Hz by Linear(max_gap_s=inf)',))
        """
        longest = self.gap_s if bridge_s is None else bridge_s
        return self.with_values(
            *resampling.resample(
                self, self.period, rate_hz=rate_hz, rule=rule, steps=steps, longest_s=longest, hole_s=bridge_s or 0.0
            )
        )

    def restamp(self, *, rate_hz: float | None = None) -> Log:
        """Replace rounded or late timestamps by the uniform clock behind them; samples are not changed.

        Parameters
        ----------
        rate_hz : float, optional
            The nominal rate of the device that sampled, where a PC put the timestamps on: they may then jitter by more
            than their rounding. Where they show that its clock is off, by up to half a per cent, their rate is taken
            and noted. A gap is as many whole samples as it is long.

        Returns
        -------
        Log
            With a note; each segment between gaps on a line of its own through its timestamps, at one common period.

        Raises
        ------
        LogError
            Rounding alone does not explain the timestamps, and no rate is stated; or the stated one is not theirs.

        Examples
        --------
        >>> import numpy as np
        >>> log = Log.from_arrays(time=np.round(np.arange(400) / 400, 3), F1=np.zeros(400))
        >>> even = log.restamp()
        >>> bool(np.max(np.abs(even.time - np.arange(400) / 400)) < 1e-3), len(even.segments)
        (True, 1)
        """
        if rate_hz is not None and not (isinstance(rate_hz, int | float) and 0.0 < rate_hz < 1e12):
            raise LogError(f"{self.source}: rate_hz = {rate_hz!r} is not a sample rate; give samples per second")
        time, note = resampling.restamp(self, self.period, self.gap_s, rate_hz)
        return self.with_values(time, {name: self[name] for name in self.signals}, note)

    def decimate(self, factor: int) -> Log:
        """Keep every `factor`-th sample behind an anti-alias filter.

        Parameters
        ----------
        factor : int
            2 or more; 1 keeps the log. Segments between gaps are filtered each on its own.

        Returns
        -------
        Log
            With a note that names the pass band and the samples that were cut at the ends: 25 periods of the new clock
            at each end of each segment. A short run of missing samples is bridged by a line for the filter, and the
            output is missing where they carry more than 20 % of its weight. An input that was held is so no longer: fit
            with ``hold="first"``.

        Raises
        ------
        LogError
            The factor is not a whole number, or no segment is as long as the filter.

        Examples
        --------
        >>> import numpy as np
        >>> t = np.arange(4000) / 1000
        >>> slow = Log.from_arrays(time=t, F1=np.sin(2 * np.pi * 10 * t) + np.sin(2 * np.pi * 300 * t)).decimate(5)
        >>> bool(np.max(np.abs(slow["F1"] - np.sin(2 * np.pi * 10 * slow.time))) < 1e-3), slow.rate_hz
        (True, 200.0)
        """
        if isinstance(factor, bool) or not isinstance(factor, int) or factor < 1:
            raise LogError(f"{self.source}: factor = {factor!r} is not a whole number; give 2 or more")
        if factor == 1:
            return self
        return self.with_values(*decimation.decimate(self, self.period, self.segments, factor))

    def hold(self, name: str, samples: int, first: int = 0) -> Log:
        """Hold a command as firmware does that takes it only every so many samples of the log.

        Parameters
        ----------
        name : str
            The command's channel.
        samples : int
            Over how many samples each value stands.
        first : int
            A sample at which the firmware takes one; before that the command is what the log begins with.

        Returns
        -------
        Log
            With one more channel, `holds`, that is 0 at samples at which a value is taken and 1 elsewhere: the part
            `servo_sample` of a plant reads its position at the former.

        Raises
        ------
        LogError
            No such channel, or a number that is not whole, or less than one sample.

        Examples
        --------
        >>> log = Log.from_arrays(time=[0.0, 0.1, 0.2, 0.3, 0.4], goal=[0.0, 1.0, 2.0, 3.0, 4.0]).hold("goal", 2, 1)
        >>> log["goal"].tolist(), log["holds"].tolist()
        ([0.0, 1.0, 1.0, 3.0, 3.0], [1.0, 0.0, 1.0, 0.0, 1.0])
        """
        for what, number, least in (("samples", samples, 1), ("first", first, 0)):
            if isinstance(number, bool) or not isinstance(number, int) or number < least:
                raise LogError(f"{self.source}: hold: {what} = {number!r} is not a whole number; give {least} or more")
        taken, since = find_taken(len(self), samples, first)
        held = Signal(name=HOLDS, values=(since > 0).astype(float), unit="")
        command = replace(self.signal(name), values=self[name][taken])
        note = f"{name}: held over {samples} samples each, from sample {first % samples + 1} on"
        return replace(self, signals={**self.signals, name: command, HOLDS: held}, notes=(*self.notes, note))

    def to_arrays(self) -> dict[str, VectorN]:
        """Return copies of time and channels by name, as `from_arrays` takes them."""
        return {"time": self.time.copy()} | {name: self[name].copy() for name in self.signals}

    def to_polars(self) -> pl.DataFrame:
        """Return a polars frame, units in the column names' brackets: "time [s]", "F1 [N]".

        Examples
        --------
        >>> log = Log.from_arrays(time=[0.0, 0.1], F1=[1.0, 2.0], units={"F1": "kN"})
        >>> log.to_polars().columns
        ['time [s]', 'F1 [N]']
        """
        import polars as pl

        return pl.DataFrame(frames.add_headers(self))

    def to_pandas(self) -> pd.DataFrame:
        """Return a pandas frame with the columns of `to_polars`. Raises LogError: pandas is not installed."""
        return frames.to_pandas(self)

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
        arrays, units, notes = frames.read_frame(frame, time, channels, units or {}, source)
        return replace(cls.from_arrays(units=units, source=source, **arrays), notes=notes)

    def __repr__(self) -> str:
        lines = [self._describe()]
        for name, signal in self.signals.items():
            span, missing = _describe_range(signal.values)
            lines.append(f"  {name} [{signal.unit or 'SI'}]  {span}" + (f", {missing} missing" if missing else ""))
        return "\n".join([*lines, *(f"  {note}" for note in self._remarks())])

    def _describe(self) -> str:
        return f"Log {self.source}: {len(self)} samples, {self.duration_s:.6g} s at {self.rate_hz:.6g} Hz"

    def _remarks(self) -> list[str]:
        """Return the notes, and where the first gaps are."""
        count = len(self.gaps)
        if not count:
            return [*self.notes]
        first = ", ".join(f"{start:.6g} to {stop:.6g} s" for start, stop in self.gaps[:3])
        return [*self.notes, f"{format_count(count, 'gap')}: {first}{', ...' if count > 3 else ''}"]

    def _repr_html_(self) -> str:
        rows = [
            (name, signal.unit or "SI", span, str(missing))
            for name, signal in self.signals.items()
            for span, missing in (_describe_range(signal.values),)
        ]
        table = html_table(("channel", "unit", "range", "missing"), rows)
        return html_paragraph(self._describe()) + table + html_list(self._remarks()) + self.plot.to_html()


def _describe_range(values: VectorN) -> tuple[str, int]:
    """Return from where to where the samples of a channel go, and how many are missing."""
    finite = values[np.isfinite(values)]
    span = f"{finite.min():.4g} to {finite.max():.4g}" if finite.size else "no finite sample"
    return span, values.size - finite.size


def _steps(time: VectorN) -> Iterator[Float[np.ndarray, " _"]]:
    """Return the steps of time in chunks that stay in the cache, where they are looked at more than once."""
    for start in range(0, time.size - 1, STEPS_PER_CHUNK):
        yield np.diff(time[start : start + STEPS_PER_CHUNK + 1])


def _increases(time: VectorN) -> bool:
    """Return whether time is finite and strictly increasing; a time that is not finite has a step that is not."""
    with np.errstate(invalid="ignore", over="ignore"):
        return all(step.min() > 0 and step.max() < np.inf for step in _steps(time))


def _describe_fault(time: VectorN) -> str:
    """Return where time does not increase, and what to do."""
    if not np.all(np.isfinite(time)):
        row = int(np.flatnonzero(~np.isfinite(time))[0])
        return f"time is not a number in sample {row + 1}; remove that row"
    with np.errstate(over="ignore"):
        step = np.diff(time)
    row = int(np.flatnonzero((step <= 0) | np.isinf(step))[0]) + 1
    how = "repeats" if step[row - 1] == 0 else "runs backwards" if step[row - 1] < 0 else "leaps"
    remedy = "sort or remove such rows"
    if how == "repeats":
        remedy = 'read it with duplicates = "first" or "mean", or with rate_hz where no clock is'
    return f"time {how} at sample {row + 1} (t = {time[row]:g} s); {remedy}"


def _measure_steps(time: VectorN) -> tuple[float, float]:
    """Return the sample period and the step above which there is a gap: see `measure_steps`. The median that tells the
    gaps is over at most `STEPS_PER_CHUNK` steps; the odd stride meets both of two steps that alternate.
    """
    first = np.arange(0, time.size - 1, (time.size - 2) // STEPS_PER_CHUNK | 1)
    longest = GAP * float(np.median(time[first + 1] - time[first]))
    total, count = 0.0, 0
    for step in _steps(time):
        short = step[step <= longest] if step.max() > longest else step
        total += float(short.sum())
        count += short.size
    if time.size - 1 - count > OFTEN * (time.size - 1):
        return measure_steps(np.diff(time))
    return total / count, max(GAP * total / count, longest)


def _array(name: str, values: Any, source: str) -> VectorN:
    if np.ma.isMaskedArray(values) or np.iscomplexobj(values):
        what = "masked; fill it with NaN" if np.ma.isMaskedArray(values) else "complex; give real numbers"
        raise LogError(f"{source}: channel {name} is {what}")
    try:
        array = np.array(values, dtype=float)
    except (TypeError, ValueError) as error:
        raise LogError(f"{source}: channel {name} is not numeric ({error}); give numbers") from error
    if array.ndim != 1:
        raise LogError(f"{source}: channel {name} has shape {array.shape}; give one value per sample, shape (n,)")
    return array


def _signal(name: str, values: Any, unit: str | None, source: str) -> Signal:
    array = _array(name, values, source)
    if unit is None:
        return Signal(name=name, values=array)
    to = si_unit(unit)
    return Signal(name=name, values=array * factor(unit, to), unit=to)
