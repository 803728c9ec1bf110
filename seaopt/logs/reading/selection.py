"""Which columns of which files are the channels, and which clock each is on; whatever is not said is asked for."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import field
from pathlib import Path

from seaopt.errors import LogError, SeaoptError, suggestion
from seaopt.logs.formats import Field, Source
from seaopt.logs.log.alignment import Rule
from seaopt.logs.reading.column import Column
from seaopt.logs.reading.counter import Counter
from seaopt.records import record
from seaopt.signals import check_distinct
from seaopt.units import bare_name, factor, is_unit, same_dimension, si_unit

_TIME_NAMES = frozenset({"time", "t", "timestamp", "timestamps", "zeit", "tout"})
SHOWN = 20  # names in a message


@record
class Clock:
    """A column of times: two are the same clock if all of this is the same."""

    source: Source = field(compare=False)
    path: Path
    name: str
    unit: str
    offset_s: float = 0.0


@record
class Channel:
    """A channel before it is read."""

    column: Column
    source: Source
    field: Field
    unit: str
    clock: Clock
    rule: Rule | None


@record
class Selection:
    """What is to be read."""

    clock: Clock
    channels: Mapping[str, Channel]
    notes: tuple[str, ...]


def select(
    sources: Sequence[Source],
    time: str | Column | None,
    channels: Mapping[str, str | Column] | None,
    align: Rule | None,
    counter: Counter | None,
) -> Selection:
    """Return the log's clock and its channels.

    Raises
    ------
    LogError
        A column is missing, doubled or has no unit, the clock is not clear, or a channel is on another clock without a
        rule.
    UnitError
        A unit is unknown or of the wrong dimension.

    """
    if channels is not None and "time" in channels:
        raise LogError(f'{sources[0].path}: a channel is named "time"; rename it, time is the clock')
    given = None if channels is None else {name: as_column(item) for name, item in channels.items()}
    found = None if given is None else {name: find(sources, name, column) for name, column in given.items()}
    clock = _log_clock(sources, time, None if found is None else list(found.values()))
    notes = [note for source in sources for note in source.notes]
    if given is None or found is None:
        given, found, more = _every_channel(sources, clock, align)
        notes += more
    if counter is not None:
        find([clock.source], "the counter", Column(column=counter.column))
    out: dict[str, Channel] = {}
    for name, column in given.items():
        source, item = found[name]
        own = _channel_clock(sources, clock, column, source, item)
        rule = column.align or align
        if own != clock and rule is None:
            raise LogError(
                f'{source.path}: "{item.name}" is on the clock "{own.name}", the log on "{clock.name}" of '
                f"{clock.path.name}; bring it over by align=Hold(), Linear() or Nearest(tolerance_s=...)"
            )
        unit = unit_of(source, column, item)
        out[name] = Channel(
            column=column, source=source, field=item, unit=unit, clock=own, rule=rule if own != clock else None
        )
    notes += check_distinct(
        {name: ((str(item.source.path), item.field.name), si_unit(item.unit)) for name, item in out.items()}
    )
    return Selection(clock=clock, channels=out, notes=tuple(notes))


def as_column(given: str | Column) -> Column:
    """Return a column; a bare header is one."""
    return given if isinstance(given, Column) else Column(column=given)


def find(sources: Sequence[Source], name: str, column: Column) -> tuple[Source, Field]:
    """Return the file and the field that a column names."""
    places = [source for source in sources if column.file is None or source.path == Path(column.file)]
    if not places:
        known = ", ".join(str(source.path) for source in sources)
        raise LogError(f'{name}: file = "{column.file}" is none of those read; give one of {known}')
    hits = [(source, item) for source in places for item in source.fields if item.name == column.column]
    if not hits:
        names = [item.name for source in places for item in source.fields]
        raise LogError(f'{_paths(places)}: no column "{column.column}" for {name}; {known_names(column.column, names)}')
    if len(hits) > 1 and hits[0][0] is hits[1][0]:
        raise LogError(f'{hits[0][0].path}: {len(hits)} columns are named "{column.column}"; rename all but one')
    if len(hits) > 1:
        raise LogError(
            f'"{column.column}" for {name} is in {_paths([source for source, _ in hits])}; say which with '
            f'Column(column="{column.column}", file=...)'
        )
    source, item = hits[0]
    if not item.numeric and source.format != "CSV":  # a text file names the cell, on reading
        raise LogError(f'{source.path}: "{item.name}" holds {item.kind}, no numbers; {item.remedy}')
    return source, item


def known_names(name: str, names: Sequence[str]) -> str:
    """Return what to say after an unknown name, however many names there are."""
    said = suggestion(name, names)
    if said.startswith("known") and len(names) > SHOWN:
        shown = ", ".join(names[:SHOWN])
        return f"known: {shown}, ... ({len(names)} in all; contents(path), or seaopt inspect --list, lists them)"
    return said


def unit_of(source: Source, column: Column, item: Field) -> str:
    """Return a column's unit: as given, else as the file says."""
    unit = column.unit if column.unit is not None else item.unit
    if unit is None:
        how = (
            f'write it in the header\'s brackets, "{item.name} [unit]", or give it with the column (--unit)'
            if source.format == "CSV"
            else f'give it: Column(column="{item.name}", unit="...") (--unit)'
        )
        raise LogError(f'{source.path}: column "{item.name}" has no unit; {how}')
    try:
        factor(unit, si_unit(unit))
    except SeaoptError as error:
        raise type(error)(f'{source.path}: column "{item.name}": {error}') from error
    return unit


def _paths(sources: Sequence[Source]) -> str:
    return ", ".join(str(source.path) for source in sources)


def _clock(source: Source, column: Column, item: Field) -> Clock:
    unit = unit_of(source, column, item)
    try:
        factor(unit, "s")
    except SeaoptError as error:
        raise type(error)(f"{source.path}: time: {error}") from error
    return Clock(source=source, path=source.path, name=item.name, unit=unit, offset_s=column.clock_offset_s)


def _log_clock(sources: Sequence[Source], time: str | Column | None, found: list[tuple[Source, Field]] | None) -> Clock:
    """Return the log's clock: as given, else the one that all channels share."""
    if time is not None:
        column = as_column(time)
        if len(sources) > 1 and column.file is None and found:
            # A header that several files have is the clock of the first channel's file.
            sources = [found[0][0]] if any(item.name == column.column for item in found[0][0].fields) else sources
        return _clock(*_with(column, find(sources, "time", column)))
    if found is None:
        found = [(source, item) for source in sources for item in source.fields if item.numeric]
    files = list(dict.fromkeys(str(source.path) for source, _ in found))
    if len(files) > 1:
        raise LogError(f"{', '.join(files)}: several files have several clocks; name the log's with time= (--time)")
    if not found:
        raise LogError(
            f"{_paths(sources)}: holds no column of numbers; list it with contents(path) (seaopt inspect --list)"
        )
    if all(item.length == 0 for _, item in found):
        raise LogError(f"{_paths(sources)}: holds no sample; record the log again")
    source = found[0][0]
    clocks = list(dict.fromkeys(item.clock for _, item in found))
    if len(clocks) > 1:
        names = [clock for clock in clocks if clock is not None]
        shown = ", ".join(names[:SHOWN]) + (", ..." if len(names) > SHOWN else "")
        raise LogError(f"{source.path}: holds several clocks ({shown}); name the log's with time= (--time)")
    column = Column(column=clocks[0]) if clocks[0] is not None else _time_like(source)
    return _clock(*_with(column, find([source], "time", column)))


def _with(column: Column, found: tuple[Source, Field]) -> tuple[Source, Column, Field]:
    return found[0], column, found[1]


def _time_like(source: Source) -> Column:
    """Return the one column that is named like a time."""
    names = [item.name for item in source.fields if item.numeric]
    named = [item for item in source.fields if item.numeric and _last(item.name).casefold() in _TIME_NAMES]
    # Of several, T in degrees is a temperature.
    found = [item.name for item in named if len(named) == 1 or _maybe_time(item.unit)]
    if len(found) == 1:
        return Column(column=found[0])
    why = "no column is" if not found else f"{len(found)} columns are"
    shown = ", ".join(names[:SHOWN]) + (", ..." if len(names) > SHOWN else "")
    raise LogError(
        f"{source.path}: {why} named like a time; give time= (--time), one of the columns: {shown or 'none'}"
    )


def _maybe_time(unit: str | None) -> bool:
    return not unit or not is_unit(unit) or same_dimension(unit, "s")


def _last(name: str) -> str:
    return re.split(r"[./]", bare_name(name))[-1]


def _channel_clock(sources: Sequence[Source], clock: Clock, column: Column, source: Source, item: Field) -> Clock:
    """Return the clock a channel is on."""
    if column.time is not None:
        own = as_column(column.time)
        return _shifted(_clock(*_with(own, find([source], f'time of "{item.name}"', own))), column)
    reference = next(known for known in clock.source.fields if known.name == clock.name)
    if source is clock.source and item.clock == reference.clock:
        if None not in (item.length, reference.length) and item.length != reference.length:
            raise LogError(
                f'{source.path}: "{item.name}" has {item.length} samples and the clock "{clock.name}" '
                f'{reference.length}; give it its own with Column(column=..., time="...")'
            )
        return _shifted(clock, column)
    if item.clock is not None:
        known = Column(column=item.clock)
    elif source is not clock.source:
        same = [known.name for known in source.fields if known.name == clock.name]
        known = Column(column=same[0], unit=clock.unit) if same else _time_like(source)
    else:
        raise LogError(f'{source.path}: "{item.name}" has no clock of its own; give it one with Column(time="...")')
    return _shifted(_clock(*_with(known, find([source], f'time of "{item.name}"', known))), column)


def _shifted(clock: Clock, column: Column) -> Clock:
    if not column.clock_offset_s:
        return clock
    return Clock(
        source=clock.source, path=clock.path, name=clock.name, unit=clock.unit,
        offset_s=clock.offset_s + column.clock_offset_s,
    )  # fmt: skip


def _every_channel(
    sources: Sequence[Source], clock: Clock, align: Rule | None
) -> tuple[dict[str, Column], dict[str, tuple[Source, Field]], list[str]]:
    """Return every column of numbers on the clock; with a rule for all, those on other clocks too."""
    reference = next(item for item in clock.source.fields if item.name == clock.name)
    clocks = {(str(source.path), item.clock) for source in sources for item in source.fields if item.clock}
    notes: list[str] = []
    every = [(source, item) for source in sources for item in source.fields if item.name != clock.name]
    numeric = [(source, item) for source, item in every if item.numeric]
    words = [item.name for source, item in every if not item.numeric and _on(clock, reference, source, item)]
    if words:
        notes.append(f"columns that hold no numbers were left out: {_listed(words)}")
    # A clock is not a channel of its own.
    numeric = [(source, item) for source, item in numeric if (str(source.path), item.name) not in clocks]
    chosen = [
        (source, item) for source, item in numeric if _on(clock, reference, source, item) or _alignable(align, item)
    ]
    if rest := [item.name for pair in numeric if pair not in chosen for item in pair[1:]]:
        notes.append(f'columns on other clocks than "{clock.name}" were left out: {_listed(rest)}')
    if not chosen:
        raise LogError(
            f'{clock.path}: no column of numbers is on the clock "{clock.name}"; choose another time= (--time)'
        )
    units, unknown = _units(chosen)
    notes += unknown
    bare = [bare_name(item.name) if units[index] else item.name for index, (_, item) in enumerate(chosen)]
    columns: dict[str, Column] = {}
    found: dict[str, tuple[Source, Field]] = {}
    for name, unit, (source, item) in zip(bare, units, chosen, strict=True):
        key = name if bare.count(name) == 1 and name != "time" else item.name
        key = key if key not in columns else f"{source.path.name}:{item.name}"
        columns[key] = Column(column=item.name, unit=unit, file=source.path)
        found[key] = find([source], key, columns[key])
    return columns, found, notes


def _on(clock: Clock, reference: Field, source: Source, item: Field) -> bool:
    lengths = (item.length, reference.length)
    same = None in lengths or lengths[0] == lengths[1]
    return source is clock.source and item.clock == reference.clock and same


def _alignable(align: Rule | None, item: Field) -> bool:
    return align is not None and item.clock is not None


def _listed(names: list[str]) -> str:
    return ", ".join(names[:SHOWN]) + (f", ... ({len(names)} in all)" if len(names) > SHOWN else "")


def _units(chosen: list[tuple[Source, Field]]) -> tuple[list[str], list[str]]:
    """Return each column's unit, "" where none is known; brackets that hold no unit are part of the name."""
    given = [item.unit for _, item in chosen]
    text = [source.format == "CSV" for source, _ in chosen]
    for source, item in chosen:
        known = any(unit and is_unit(unit) for unit in given)
        if source.format == "CSV" and known and _meant(item) and not is_unit(item.unit or ""):
            unit_of(source, Column(column=item.name), item)
    if any(csv and unit is not None and not is_unit(unit) for csv, unit in zip(text, given, strict=True)):
        notes = ["brackets in the headers that are no units were taken as names; no unit is known"]
        return [""] * len(given), notes
    units = [unit if unit is not None and _scales(unit) else "" for unit in given]
    lost = [f"{item.name} [{old}]" for old, new, (_, item) in zip(given, units, chosen, strict=True) if old and not new]
    notes = [f"units that are not known were left out: {_listed(lost)}"] if lost else []
    return units, notes


def _meant(item: Field) -> bool:
    """Tell whether a header's brackets are meant as a unit: square ones without a number, which would be an index."""
    return item.unit is not None and item.name.endswith("]") and not item.unit.isdecimal()


def _scales(unit: str) -> bool:
    """Tell whether a unit comes to SI by a factor alone."""
    try:
        factor(unit, si_unit(unit))
    except SeaoptError:
        return False
    return True
