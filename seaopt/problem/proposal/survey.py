"""The columns of a raw log with their headers and samples, before they have roles."""

from __future__ import annotations

import shlex
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import field
from pathlib import Path

import numpy as np

from seaopt.errors import LogError, suggestion
from seaopt.formatting import join_words
from seaopt.logs import contents
from seaopt.logs.formats import Field, open_source
from seaopt.logs.log.alignment import MOST_PACE, measure_pace
from seaopt.logs.log.resampling import fill_holes
from seaopt.logs.quality.faults import find_quantisation
from seaopt.logs.quality.findings import MOST_BRIDGED
from seaopt.logs.reading.clock_samples import guess_time_unit, runs_on
from seaopt.logs.reading.vocabulary import Header, is_count, is_named_time, read_header
from seaopt.records import record
from seaopt.signals import VectorM, VectorN
from seaopt.units import factor, is_unit

SLOW_HZ = 1.0
ALIKE = 0.5  # of the correlation below SLOW_HZ, from which its sign means something
ENOUGH = 64  # samples for a correlation
ESTIMATED = 0.9999  # share of variance from which a torque is a current times a constant
MOST_NAMED = 5  # columns in a message
SAME = 1.0 - 1e-6  # share of variance from which a column is another one, rounded


@record(eq=False)
class SurveyedColumn:
    """A column as the file holds it; `values` are raw numbers in whatever unit it has."""

    header: Header
    values: VectorN
    # the column of its own times, or the format's own clock, where they are not the log's: `values` are then
    # interpolated to that
    clock: str = ""
    readings: VectorM | None = None  # before they were interpolated, if they were
    fast: bool = False  # whether its own times are too many for the log's to have each reading once
    hole: int = 0  # the largest number of rows that were empty in turn, and interpolated

    @property
    def name(self) -> str:
        """The column's name, as a problem file gives it."""
        return self.header.name

    @property
    def swing(self) -> float:
        """Robust spread of the samples: half of what lies between their 1 % and 99 % quantiles."""
        present = self.values[np.isfinite(self.values)]
        return float(np.subtract(*np.quantile(present, [0.99, 0.01])) / 2.0) if present.size else 0.0

    @property
    def largest(self) -> float:
        """The largest magnitude."""
        return float(np.max(np.abs(self.values[np.isfinite(self.values)]), initial=0.0))

    @property
    def noise(self) -> float:
        """Standard deviation of what changes from sample to sample: third differences remove what is smooth."""
        read = self.values if self.readings is None else self.readings
        third = np.diff(read[np.isfinite(read)], 3)
        return float(np.median(np.abs(third)) / 0.6745 / np.sqrt(20.0)) if third.size else 0.0

    @property
    def quantum(self) -> float:
        """The step whose multiples the samples are; 0 where there is none."""
        return find_quantisation(self.values if self.readings is None else self.readings)

    @property
    def whole(self) -> bool:
        """Whether all samples are whole numbers, as of an encoder's steps."""
        return bool(np.all(self.values[np.isfinite(self.values)] % 1.0 == 0.0)) and self.swing > 0.0


@record(eq=False)
class LogSurvey:
    """The columns of one log."""

    path: Path
    clock: SurveyedColumn | None  # the column of times; None where the file has none
    # columns that may be the time by their names; none where the clock was found by its samples
    clocks: tuple[str, ...]
    columns: tuple[SurveyedColumn, ...]  # all others that hold numbers and vary
    left_out: Mapping[str, str]  # why other columns cannot be used: text, constants, and those without a number
    # which part of the log's time, s, all clocks have; None where there is one clock
    overlap_s: tuple[float, float] | None = None
    clock_units: Mapping[str, str] = field(default_factory=dict[str, str])  # of other clocks
    law: str = ""  # of the law that wrote it; empty where it does not say

    @property
    def name(self) -> str:
        """The log's file name."""
        return self.path.name

    def clock_unit(self) -> tuple[str, bool]:
        """Return the clock's unit, and whether the file says so or the size of its steps suggests it."""
        if self.clock is None:
            return "s", False
        if self.clock.header.unit:
            return self.clock.header.unit, True
        return guess_time_unit(self.clock.values), False


def survey_log(path: Path, clock: str | None = None, units: Mapping[str, str] | None = None) -> LogSurvey:
    r"""Read every column of a log. `clock` names the time where the file leaves that open, `units` are those of columns
    whose headers have none, or a wrong one. Raises LogError: the file cannot be read, or holds no numbers that vary.
    """
    listing = contents(path)
    numeric = {field.name: field for field in listing.fields if field.numeric}
    if not numeric:
        command = f"seaopt inspect {shlex.quote(str(path))} --list"
        raise LogError(f"{path}: holds no column of numbers; list what it holds with {command}")
    stated = {name: (units or {}).get(name, field.unit) for name, field in numeric.items()}
    odd = any(unit and not is_unit(unit) and not is_count(unit) and name.endswith(")") for name, unit in stated.items())
    headers = {name: _read_header(name, unit, odd=odd) for name, unit in stated.items()}
    raw = _read_raw(path, numeric)
    times = [name for name, header in headers.items() if _is_time(header, raw[name])]
    groups = _group_by_clock(list(numeric.values()), times, raw)
    if clock is not None:
        if clock not in numeric:
            raise LogError(f'{path}: no column "{clock}" for time; {suggestion(clock, numeric)}')
        groups = _lead_with(clock, groups)
    chosen, members = next(iter(groups.items()))
    if not chosen:
        chosen = next((name for name in members if runs_on(raw[name])), None)
    columns = {name: _fill_column(headers[name], raw[name], name == chosen) for name in members}
    overlap = None
    if chosen is not None:
        clocks = {clock: names for clock, names in groups.items() if clock and clock != chosen}
        moved, overlap = _move_to_clock(columns[chosen], clocks, headers, raw)
        columns |= moved
    size = raw[chosen or members[0]].size
    wrong = {name: _describe_length(raw[name], size) for name in numeric if name not in {**columns, **groups}}
    moving = [column for name, column in columns.items() if name != chosen and name not in times and column.swing > 0.0]
    if not moving:
        longer = [name for name in wrong if raw[name].size > 1]
        if longer:
            raise LogError(
                f"{path}: {join_words(longer[:MOST_NAMED])} have other numbers of samples than "
                f'"{chosen or members[0]}" ({size}); save each with times of its own, or cut them to one length'
            )
        raise LogError(f"{path}: no column varies; record a log in which the actuator moves")
    copies = _find_copies(moving)
    copies |= _find_estimates([column for column in moving if column.name not in copies])
    moving = [column for column in moving if column.name not in copies]
    still = {
        name: "constant" if np.any(np.isfinite(column.values)) else "holds no number"
        for name, column in columns.items()
        if column.swing == 0.0 and name != chosen
    }
    words = {field.name: "text" for field in listing.fields if not field.numeric}
    return LogSurvey(
        path=path,
        clock=columns[chosen] if chosen is not None else None,
        clocks=tuple(name for name in times if name in members) or ((chosen,) if chosen and chosen in groups else ()),
        columns=tuple(moving),
        left_out=words | wrong | still | copies,
        overlap_s=overlap,
        clock_units={column.clock: _read_unit(column.clock, headers, raw) for column in moving if column.clock},
        law=listing.law,
    )


def _fill_column(header: Header, values: VectorN, is_clock: bool) -> SurveyedColumn:
    """Return a column; one that has samples only in some rows, all over the log, with lines between them."""
    present = np.flatnonzero(np.isfinite(values))
    holes = np.diff(present) - 1
    if is_clock or not np.any(holes) or np.max(holes) > MOST_BRIDGED:
        return SurveyedColumn(header=header, values=values)
    rows = np.arange(values.size, dtype=float)
    filled = fill_holes(rows, values, MOST_BRIDGED + 1.0)
    return SurveyedColumn(header=header, values=filled, readings=values[present], hole=int(np.max(holes)))


def _read_header(name: str, unit: str | None, *, odd: bool) -> Header:
    """Return a header, read; `odd`: round brackets in the file are names, not units."""
    header = read_header(name, unit)
    named = odd and name.endswith(")") and header.quantity != "time"
    return read_header(name, brackets=False) if named else header


def _is_time(header: Header, values: VectorN) -> bool:
    """Tell whether a column is a time by its name, or the beginning of it and its samples: t_cell, not t_winding, and
    not T_w in degrees, which may only rise as well.
    """
    rows = _count_rows(values)
    begins = not header.unit and is_named_time(header.name)
    return rows > 1 and (header.quantity == "time" or (begins and runs_on(values[:rows])))


def _read_raw(path: Path, fields: Mapping[str, Field]) -> dict[str, VectorN]:
    """Return the numbers of columns as they are, without their units or clocks."""
    source = open_source(path)
    groups: dict[tuple[str | None, int | None], list[str]] = {}
    for name, each in fields.items():
        groups.setdefault((each.clock, each.length), []).append(name)
    return {name: values for names in groups.values() for name, values in source.read(names).items()}


def _group_by_clock(
    fields: Sequence[Field], times: Sequence[str], raw: Mapping[str, VectorN]
) -> dict[str | None, list[str]]:
    """Return the columns of each clock, those of most samples first; of no clock those as long as most are. A column
    without a clock of the format's belongs to the time that has as many samples; of several of one length, to the
    first.
    """
    clocks = dict.fromkeys(each.clock for each in fields if each.clock)
    if clocks:
        groups: dict[str | None, list[str]] = {clock: [] for clock in clocks}
        for each in fields:
            if each.clock:
                groups[each.clock].append(each.name)
        return dict(sorted(groups.items(), key=lambda item: -raw[item[0] or ""].size if item[0] in raw else 0))
    sizes = {each.name: _count_rows(raw[each.name]) for each in fields}
    by_size = {sizes[name]: name for name in reversed(times) if sizes[name] > 1}
    if not by_size:
        counts = Counter(size for size in sizes.values() if size > 1)
        usual = max(counts, key=lambda size: (counts[size] * size, size), default=1)
        return {None: [name for name, size in sizes.items() if size == usual]}
    groups = {by_size[size]: [] for size in sorted(by_size, reverse=True)}
    last = next(iter(groups))
    # A column that ends early, side by side with others, belongs to the time before it.
    for name, size in sizes.items():
        last = name if name in groups else last
        early = size not in by_size and size > 1 and raw[name].size == raw[last or ""].size
        if size in by_size or early:
            groups[by_size.get(size, last)].append(name)
    return groups


def _count_rows(values: VectorN) -> int:
    """Return how many samples a column has, without those missing at its end."""
    return int(np.flatnonzero(np.isfinite(values))[-1]) + 1 if np.any(np.isfinite(values)) else values.size


def _lead_with(clock: str, groups: Mapping[str | None, list[str]]) -> dict[str | None, list[str]]:
    """Return the groups with the clock that was named in front."""
    first = next((name for name, members in groups.items() if clock == name or clock in members), None)
    members = groups.get(first, [])
    return {clock: [*members], **{name: each for name, each in groups.items() if name != first}}


def _read_unit(name: str, headers: Mapping[str, Header], raw: Mapping[str, VectorN]) -> str:
    """Return a clock's unit, by its header or the size of its steps."""
    header = headers[name]
    return header.unit if header.unit and header.quantity == "time" else guess_time_unit(raw[name])


def _move_to_clock(
    clock: SurveyedColumn,
    groups: Mapping[str, Sequence[str]],
    headers: Mapping[str, Header],
    raw: Mapping[str, VectorN],
) -> tuple[dict[str, SurveyedColumn], tuple[float, float] | None]:
    """Return columns of other clocks, interpolated to the log's, and which part of the log all clocks have, in s."""
    if not groups:
        return {}, None
    time, moved = raw[clock.name] * factor(_read_unit(clock.name, headers, raw), "s"), dict[str, SurveyedColumn]()
    low, high, instants = float(np.nanmin(time)), float(np.nanmax(time)), np.unique(time[np.isfinite(time)])
    for other, names in groups.items():
        stamps = raw[other] * factor(_read_unit(other, headers, raw), "s")
        there = np.isfinite(stamps)
        if np.count_nonzero(there) < 2 or np.any(np.diff(stamps[there]) <= 0.0):
            continue
        low, high = max(low, float(stamps[there][0])), min(high, float(stamps[there][-1]))
        for name in names:
            if name != other:
                good = there & np.isfinite(raw[name])
                values = np.interp(time, stamps[good], raw[name][good], np.nan, np.nan) if np.any(good) else raw[name]
                moved[name] = SurveyedColumn(
                    header=headers[name], values=values, clock=other, readings=raw[name][good],
                    fast=bool(np.any(good)) and measure_pace(instants, stamps[good]) > MOST_PACE,
                )  # fmt: skip
    return moved, (low, high) if low < high else None


def _describe_length(values: VectorN, usual: int) -> str:
    if values.size == 1:
        return f"one number beside the log, {values[0]:.6g}"
    return f"{values.size} samples, where the log has {usual}"


def _find_copies(columns: Sequence[SurveyedColumn]) -> dict[str, str]:
    """Return the columns that are another one but for a factor, as raw counts beside newtons, and what they are."""
    kept, copies = list[SurveyedColumn](), dict[str, str]()
    for column in sorted(columns, key=lambda column: not column.header.unit):
        for other in kept:
            if column.header.quantity != other.header.quantity or column.values.size < ENOUGH:
                continue
            slope, share = regress(column.values, other.values)
            if share > SAME:
                copies[column.name] = f"{slope:.4g} times {other.name}"
                break
        else:
            kept.append(column)
    return copies


def _find_estimates(columns: Sequence[SurveyedColumn]) -> dict[str, str]:
    """Return the torques and forces that are a current times a constant: a drive's estimates, not a sensor's."""
    estimates = dict[str, str]()
    currents = [column for column in columns if column.header.quantity == "current"]
    for column in columns:
        if column.header.quantity not in ("torque", "force") or column.header.commanded or column.values.size < ENOUGH:
            continue
        for current in currents:
            slope, share = regress(column.values, current.values)
            if share > ESTIMATED:
                estimates[column.name] = f"{slope:.4g} times {current.name}: the drive's estimate, not a sensor"
                break
    return estimates


def find_leader(columns: Sequence[SurveyedColumn]) -> SurveyedColumn:
    """Return the column that the others follow: what drives an actuator is there before anything answers."""
    used = [column for column in columns if column.values.size >= ENOUGH]
    if not used:
        return columns[0]
    return max(
        used, key=lambda column: sum(_lead(column.values, other.values) for other in used if other is not column)
    )


def _lead(first: VectorN, second: VectorN) -> float:
    """Return by how many samples `first` leads `second`, weighted with how well they correlate."""
    a, b = (np.nan_to_num(np.diff(values)) for values in (first, second))
    a, b = a - np.mean(a), b - np.mean(b)
    size = 2 * a.size
    cross = np.fft.irfft(np.conj(np.fft.rfft(a, size)) * np.fft.rfft(b, size), size)
    reach = min(a.size // 4, 200)
    cross = np.concatenate([cross[-reach:], cross[: reach + 1]])
    scale = float(np.sqrt(np.sum(a**2) * np.sum(b**2))) or 1.0
    at = int(np.argmax(np.abs(cross)))
    return (at - reach) * float(np.abs(cross[at])) / scale


def share_of_jerk(column: SurveyedColumn, driver: SurveyedColumn) -> float:
    """Return the share of a column's third differences that the first ones of another explain within two samples: a
    force accelerates what it acts on at once, and what is behind a spring later.
    """
    jerk, push = np.diff(column.values, 3), np.diff(driver.values)
    if jerk.size <= ENOUGH:
        return 0.0
    return max(regress(jerk[late:], push[1 : push.size - 1 - late])[1] for late in range(3))


def slow_sign(first: VectorN, second: VectorN, rate_hz: float) -> int:
    """Return 1 where two columns move alike below 1 Hz, -1 where one falls as the other rises, else 0."""
    f = np.fft.rfftfreq(first.size, 1.0 / rate_hz)
    slow = (f > 0.0) & (f <= max(SLOW_HZ, 2.0 * rate_hz / first.size))
    a, b = (np.fft.rfft(np.nan_to_num(values - np.nanmean(values)))[slow] for values in (first, second))
    scale = float(np.sqrt(np.sum(np.abs(a) ** 2) * np.sum(np.abs(b) ** 2))) or 1.0
    alike = float(np.real(np.vdot(a, b))) / scale
    return 0 if abs(alike) < ALIKE else 1 if alike > 0.0 else -1


def regress(values: VectorN, on: VectorN) -> tuple[float, float]:
    """Return the slope of a column on another, and the share of its variance that this explains."""
    good = np.isfinite(values) & np.isfinite(on)
    y, x = values[good] - np.mean(values[good]), on[good] - np.mean(on[good])
    power, of_values = float(x @ x), float(y @ y)
    if not (0.0 < power < np.inf and 0.0 < of_values < np.inf):
        return 0.0, 0.0
    slope = float(x @ y) / power
    return float(f"{slope:.12g}"), float(f"{(slope * np.sqrt(power / of_values)) ** 2:.12g}")
