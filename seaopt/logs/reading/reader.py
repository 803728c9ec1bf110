"""Raw files to tables and logs: which columns, on which clock, brought together by which rule."""

from __future__ import annotations

import collections
import hashlib
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np

from seaopt.errors import LogError, require_number, require_type
from seaopt.files import write_text
from seaopt.formatting import format_count
from seaopt.logs.formats import Source, Window, open_source
from seaopt.logs.log.alignment import Hold, Linear, Nearest, Readings, Rule, check_increasing
from seaopt.logs.log.log import Log
from seaopt.logs.quality.faults import find_counter_losses
from seaopt.logs.reading.column import Column, spell_column, suspect_wrap
from seaopt.logs.reading.counter import Counter
from seaopt.logs.reading.selection import (
    ALIGNED,
    HOW_TO_ALIGN,
    ClockColumn,
    SelectedChannel,
    Selection,
    advise_time,
    select,
)
from seaopt.signals import STATUS, Origin, RawLog, Signal, VectorM, VectorN
from seaopt.units import factor, si_unit


def read_table(
    path: str | Path | Sequence[str | Path],
    *,
    time: str | int | Column | None = None,
    channels: Mapping[str, str | int | Column] | None = None,
    align: Rule | None = None,
    window_s: tuple[float, float] | None = None,
    counter: Counter | None = None,
    rate_hz: float | None = None,
    digest: bool = True,
) -> RawLog:
    r"""Read a file as it is: time may repeat or run backwards, and a channel may be empty.

    Parameters
    ----------
    path : path, or several
        CSV and other text, MAT, HDF5, Parquet, NPZ, JSON, ROS bags, MCAP, MDF or TDMS, recognised by content.
    time : str, int or Column, optional
        The clock: a column, or in a bag a topic. Where it is left out, the format's own clock, or the one column that
        is named like a time.
    channels : mapping of channel name to str, int or Column, optional
        Which column is which channel; where it is left out, every column of numbers on the clock, named by its header
        without the unit's brackets.
    align : Hold, Linear, Nearest or Readings, optional
        How channels of other clocks are aligned to this one; a Column's own rule takes precedence.
    window_s : tuple, optional
        Read only what lies between these times of the clock; formats with an index skip the rest of the file.
    counter : Counter, optional
        A column that counts samples: where it skips, the later times are moved to open a gap.
    rate_hz : float, optional
        Samples per second of a file without a clock, in place of `time`.
    digest : bool
        Whether to note the files' SHA-256, for which each is read as a whole, but not kept in memory.

    Raises
    ------
    LogError
        The file is missing or damaged, a column is missing or occurs twice, a cell is not a number, a channel is on
        another clock and no rule is given, or two channels of one SI unit are one column.
    UnitError
        A unit is unknown or of the wrong dimension.

    Examples
    --------
    >>> import tempfile, pathlib
    >>> file = pathlib.Path(tempfile.mkdtemp()) / "chirp.csv"
    >>> _ = file.write_text("time [ms],cur [mA],note\n0.0,100,a\n2.5,150,b\n")
    >>> table = read_table(file)
    >>> table.time.tolist(), {name: (signal.values.tolist(), signal.unit) for name, signal in table.signals.items()}
    ([0.0, 0.0025], {'cur': ([0.1, 0.15], 'A')})
    >>> table.notes
    ('columns that hold no numbers were left out: note',)
    """
    sources = _open_sources(path)
    require_type(channels or {}, Mapping, "channels", "give a mapping of channel to column", LogError)
    if counter is not None:
        require_type(counter, Counter, "counter", "give a Counter", LogError)
    if align is not None:
        require_type(
            align,
            (Hold, Linear, Nearest, Readings),
            "align",
            "give Hold(), Linear(), Nearest(...) or Readings()",
            LogError,
        )
    if window_s is not None:
        require_type(window_s, (tuple, list), "window_s", "give (start, stop)", LogError)
        edges = [require_number(edge, "window_s", LogError) for edge in window_s]
        if not (len(edges) == 2 and edges[0] < edges[1]):
            raise LogError(f"window_s = {window_s}: give (start, stop) with start before stop")
    with ThreadPoolExecutor(max_workers=1) as pool:  # the files are hashed while they are parsed
        digests = {source.path: pool.submit(_hash_file, source.path) if digest else None for source in sources}
        chosen = select(sources, time, channels, align, counter, rate_hz)
        arrays, clock, notes = _read_channels(chosen, window_s, counter)
        hashes = {file: future.result() if future is not None else "" for file, future in digests.items()}
    notes = [*chosen.notes, *notes]
    signals = {}
    for name, channel in chosen.channels.items():
        digest_of_file = hashes[channel.file_column.source.path]
        signals[name] = _build_signal(name, channel, arrays.pop(name), chosen.clock, digest_of_file)
        notes += _remark_on(signals[name], at_rest=channel.file_column.column.at_rest)
    names = ", ".join(str(source.path) for source in sources)
    law = next((source.law for source in sources if source.law), "")
    return RawLog(time=clock, signals=signals, source=names, notes=tuple(notes), law=law)


def _open_sources(path: str | Path | Sequence[str | Path]) -> list[Source]:
    """Return files, opened and listed."""
    files = [path] if isinstance(path, str | Path) else path
    require_type(files, Sequence, "path", "give a path, or a list of them", LogError)
    for file in files:
        require_type(file, (str, Path), "path", "give a path, or a list of them", LogError)
    if not files:
        raise LogError("path is an empty list; give a file")
    return [open_source(Path(file)) for file in files]


def read_log(
    path: str | Path | Sequence[str | Path],
    *,
    time: str | int | Column | None = None,
    channels: Mapping[str, str | int | Column] | None = None,
    align: Rule | None = None,
    window_s: tuple[float, float] | None = None,
    counter: Counter | None = None,
    rate_hz: float | None = None,
    duplicates: Literal["first", "mean"] | None = None,
    digest: bool = True,
) -> Log:
    r"""Read a file, and check that it is a log.

    Parameters
    ----------
    path, time, channels, align, window_s, counter, rate_hz, digest
        As in `read_table`; channels are named as the plant's inputs and outputs, as a rule.
    duplicates : {"first", "mean"}, optional
        What becomes of samples at one time: the first is kept, or their mean (of those that are not missing). They are
        refused if it is left out.

    Returns
    -------
    Log
        In SI. Empty cells and NaN are missing samples (NaN); the fit gives them no weight.

    Raises
    ------
    LogError
        What `read_table` raises; or a channel contains no number, or time does not increase.
    UnitError
        A unit is unknown or of the wrong dimension.

    Examples
    --------
    >>> import tempfile, pathlib
    >>> file = pathlib.Path(tempfile.mkdtemp()) / "chirp.csv"
    >>> _ = file.write_text("time [s],cur\n0.0,100\n0.0025,150\n")
    >>> read_log(file, time="time [s]", channels={"I": Column(column="cur", unit="mA")})["I"].tolist()
    [0.1, 0.15]
    """
    table = read_table(
        path,
        time=time,
        channels=channels,
        align=align,
        window_s=window_s,
        counter=counter,
        rate_hz=rate_hz,
        digest=digest,
    )
    if duplicates is not None:
        table = _merge_duplicates(table, duplicates)
    for signal in table.signals.values():
        if not np.any(np.isfinite(signal.values)):
            raise LogError(f'{table.source}: column "{signal.origin.column}" holds no number; choose another column')
    try:
        return Log(time=table.time, signals=table.signals, source=table.source, notes=table.notes, law=table.law)
    except LogError as error:  # the columns have one length: it is their time
        clock = select(_open_sources(path), time, channels, align, counter, rate_hz).clock
        raise LogError(f'{error}; if "{clock.name}" is not the time, {advise_time(clock.source)}') from error


def _merge_duplicates(table: RawLog, how: str) -> RawLog:
    """Return a table with one sample of each run of samples at one time, and a note of how many there were."""
    if how not in ("first", "mean"):
        raise LogError(f'duplicates = "{how}" is not known; give "first" or "mean"')
    starts = np.flatnonzero(np.concatenate([[True], np.diff(table.time) != 0.0]))
    if starts.size == table.time.size:
        return table

    def merge(values: VectorN) -> VectorM:
        if how == "first":
            return values[starts]
        there = np.isfinite(values)
        counts = np.add.reduceat(there.astype(float), starts)
        with np.errstate(invalid="ignore"):  # none of them is there: missing
            return np.add.reduceat(np.where(there, values, 0.0), starts) / counts

    signals = {name: replace(signal, values=merge(signal.values)) for name, signal in table.signals.items()}
    kept = "their mean" if how == "mean" else "the first"
    note = f"{format_count(table.time.size - starts.size, 'sample')} at the time of the one before merged: {kept} kept"
    return replace(table, time=table.time[starts], signals=signals, notes=(*table.notes, note))


def write_log(log: Log, path: str | Path) -> Path:
    """Write a log as CSV, with units in the header's brackets and numbers with all their digits."""
    return write_text(path, log.to_polars().write_csv())


def _hash_file(path: Path) -> str:
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def _read_channels(
    chosen: Selection, window: tuple[float, float] | None, counter: Counter | None
) -> tuple[dict[str, VectorN], VectorN, list[str]]:
    """Return the channels in their files' units and the clock in seconds, and what was done."""
    notes: list[str] = []
    # Each clock is read once, for all of its channels.
    groups: dict[ClockColumn, dict[str, SelectedChannel]] = {chosen.clock: {}}
    for name, channel in chosen.channels.items():
        if channel.constant is None:
            groups.setdefault(channel.clock, {})[name] = channel
    on_clock, path = groups.pop(chosen.clock), str(chosen.clock.path)
    extra = [counter.column] if counter is not None else []
    columns, clock = _read_clock(chosen.clock, [*_name_fields(on_clock), *extra], window)
    if clock.size < 2:
        span = f" in window_s = {window}" if window else ""
        raise LogError(f"{path}: too few samples ({clock.size}){span}; a log needs at least 2")
    if counter is not None:
        clock, note = counter.open_gaps(clock, columns[counter.column], path)
        notes.append(note)
    arrays = _separate_arrays(on_clock, columns)
    for name, channel in chosen.channels.items():
        if channel.constant is not None:
            arrays[name] = np.full(clock.size, channel.constant)
    for other, group in groups.items():
        columns, time = _read_clock(other, _name_fields(group), _widen_window(window, group))
        if all(channel.rule is None for channel in group.values()) and np.array_equal(time, clock):
            arrays |= _separate_arrays(group, columns)  # rows of one table, at the same instants
            continue
        where = f'{other.path}: clock "{other.name}"' + (f" of {other.rows}" if other.rows else "")
        check_increasing(time, where)
        for name, channel in group.items():
            if channel.rule is None:
                raise LogError(f"{where}: has other instants than the log's clock; {HOW_TO_ALIGN}", keys=ALIGNED)
            try:
                arrays[name] = channel.rule(clock, time, columns[channel.file_column.field.name])
            except LogError as error:
                raise LogError(f"{where}: {name}: {error}", keys=ALIGNED[1:]) from error
            outside = int(np.sum(~((clock >= time[0]) & (clock <= time[-1]))))
            note = f'{name}: brought from clock "{other.name}" by {channel.rule}'
            if outside:
                note += f"; {outside} of {clock.size} samples lie outside its {time[0]:.6g} to {time[-1]:.6g} s "
                note += "and are missing"
            notes.append(note)
    return arrays, clock, notes


def _name_fields(group: Mapping[str, SelectedChannel]) -> list[str]:
    return [channel.file_column.field.name for channel in group.values()]


def _read_clock(
    clock: ClockColumn, names: list[str], window: tuple[float, float] | None
) -> tuple[dict[str, VectorN], VectorN]:
    """Return columns that share a clock, and the clock in seconds, cut to the window."""
    if clock.rate_hz is not None:
        columns = clock.source.read(names)
        sizes = {values.size for values in columns.values()}
        if len(sizes) > 1:
            raise LogError(f"{clock.path}: its columns hold {min(sizes)} to {max(sizes)} samples; choose one length")
        time = np.arange(float(max(sizes, default=0))) / clock.rate_hz + clock.offset_s
        return _cut_window(columns, time, window)
    scale, span = factor(clock.unit, "s"), None
    if window is not None:
        start, stop = ((edge - clock.offset_s) / scale for edge in window)
        slack = 1e-9 * max(abs(start), abs(stop))  # the exact cut is below, in seconds
        span = Window(clock=clock.name, start=start - slack, stop=stop + slack)
    columns = clock.source.read([clock.name, *names], span)
    time = columns[clock.name] * scale if scale != 1.0 or clock.name in names else columns[clock.name]
    if clock.offset_s:
        time = time + clock.offset_s
    # The shorter one of two tables side by side ends in empty rows.
    empty = np.isnan(time)
    if empty.size and empty[-1]:
        full = max((np.flatnonzero(~np.isnan(values))[-1:].tolist() or [-1])[0] for values in [time, *columns.values()])
        time, columns = time[: full + 1], {name: values[: full + 1] for name, values in columns.items()}
    return _cut_window(columns, time, window)


def _cut_window(
    columns: dict[str, VectorN], time: VectorN, window: tuple[float, float] | None
) -> tuple[dict[str, VectorM], VectorM]:
    if window is None:
        return columns, time
    keep = (time >= window[0]) & (time <= window[1])
    return {name: values[keep] for name, values in columns.items()}, time[keep]


def _separate_arrays(group: Mapping[str, SelectedChannel], columns: dict[str, VectorN]) -> dict[str, VectorN]:
    """Return an array of its own for each channel: two channels of one column are converted apart."""
    fields = _name_fields(group)
    counts = collections.Counter(fields)
    return {
        name: columns[field].copy() if counts[field] > 1 else columns[field]
        for name, field in zip(group, fields, strict=True)
    }


def _widen_window(
    window: tuple[float, float] | None, group: Mapping[str, SelectedChannel]
) -> tuple[float, float] | None:
    """Return the window in which the rules may find neighbours."""
    if window is None:
        return None
    margin = max(channel.rule.reach_s for channel in group.values() if channel.rule is not None)
    return window[0] - margin, window[1] + margin


def _build_signal(name: str, channel: SelectedChannel, values: VectorN, clock: ClockColumn, digest: str) -> Signal:
    file_column, unit = channel.file_column, channel.unit
    path = str(file_column.source.path)
    steps = [file_column.column.describe_conversion(unit), "" if channel.clock == clock else str(channel.rule)]
    conversion = ", then ".join(filter(None, steps))
    return Signal(
        name=name,
        values=file_column.column.to_si(values, unit, path),
        unit=si_unit(unit),
        origin=Origin(file=path, sha256=digest, column=file_column.field.name, conversion=conversion),
    )


def _remark_on(signal: Signal, *, at_rest: bool) -> list[str]:
    """Return notes on what looks wrong with a channel at first sight."""
    low, high = np.fmin.reduce(signal.values), np.fmax.reduce(signal.values)
    if not np.isfinite(low):
        return [f"{signal.name}: holds no number"]
    if low == high and (at_rest or signal.name == STATUS):  # which stays where nothing happens
        return []
    if low == high:
        return [f"{signal.name}: is constant at {low:.6g} {signal.unit}".rstrip()]
    bits = suspect_wrap(signal.values, low, high)
    if bits is not None:
        return [
            f"{signal.name}: looks like signed numbers in an unsigned field of {bits} bits; if so, give "
            f"{spell_column(column=signal.origin.column, wrap_bits=bits)}"
        ]
    losses = find_counter_losses(signal.values)
    if losses is not None and losses.rows.size and np.all(np.diff(signal.values) >= 0.0):
        lost = format_count(int(losses.lost.sum()), "sample")
        return [
            f"{signal.name}: looks like a sample counter that misses {lost}; to open gaps "
            f"there, give it as counter: {spell_column(column=signal.origin.column, samples_per_count='...')}"
        ]
    return []
