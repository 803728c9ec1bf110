"""Which columns of which files become the channels, and which clock each is on; what is not clear is an error."""

from __future__ import annotations

import re
import shlex
from collections import Counter as Counts
from collections.abc import Mapping, Sequence
from dataclasses import field as record_field
from dataclasses import replace
from difflib import get_close_matches
from pathlib import Path

from seaopt.errors import LogError, SeaoptError, UnitError, suggestion
from seaopt.logs.formats import Field, Source, keep_rows
from seaopt.logs.log.alignment import Rule
from seaopt.logs.reading.clock_samples import guess_time_unit
from seaopt.logs.reading.column import Column, spell_column
from seaopt.logs.reading.counter import Counter
from seaopt.logs.reading.vocabulary import QUANTITY_WORDS, find_unit_in_name, split_unit
from seaopt.records import record
from seaopt.signals import check_distinct
from seaopt.units import bare_name, factor, is_unit, same_dimension, si_unit

# Names of a time where nothing else has one, and of ticks beside it.
COUNTERS = ("clock", "stamp", "uptime", "elapsed", "millis", "micros")
MAX_NAMES = 20  # in a message
HOW_TO_ALIGN = "align it by Hold(), Linear(), Nearest(tolerance_s=...) or Readings()"
ALIGNED = ({"align": {"hold": {}}}, {"align": {"linear": {}}})  # the same as keys


class ClockError(LogError):
    """The log's clock is not clear: its unit if `column` is named, else which of the `candidates` it is.

    `unit` is the likely one of that column, by the size of its steps.
    """

    def __init__(self, text: str, column: str | None = None, unit: str = "s", candidates: Sequence[str] = ()) -> None:
        super().__init__(text)
        self.column, self.unit, self.candidates = column, unit, tuple(candidates)


@record
class ClockColumn:
    """A column of times, or without one a rate: two are the same clock if all of this is the same."""

    source: Source = record_field(compare=False)
    path: Path
    name: str
    unit: str
    offset_s: float = 0.0
    rows: str = ""
    rate_hz: float | None = None

    @property
    def field(self) -> Field | None:
        """Its field in the file; None where it is a rate."""
        return next((field for field in self.source.fields if field.name == self.name), None)

    def shift(self, column: Column) -> ClockColumn:
        """Return the clock of a column whose samples are late or early by a stated time."""
        return replace(self, offset_s=self.offset_s + column.clock_offset_s)


@record
class FileColumn:
    """A column as it is declared, the file that has it, and its field there."""

    column: Column
    source: Source
    field: Field

    @property
    def stated_unit(self) -> str | None:
        """Its unit, before it is checked; None where nothing says it."""
        stated = (self.column.unit, self.field.unit)
        return next((unit for unit in stated if unit is not None), find_unit_in_name(self.field.name))

    @property
    def unit(self) -> str:
        """Its unit: as given, else as the file says, else as its name ends in."""
        unit = self.stated_unit
        where = f'{self.source.path}: column "{self.field.name}"'
        if unit is None:
            named = f'write it in the header\'s brackets, "{self.field.name} [unit]", or '
            spelt = spell_column(column=self.column.column, unit="...")
            raise LogError(f"{where} has no unit; {named * (self.source.format == 'CSV')}give it: {spelt} (--unit)")
        try:
            factor(unit, si_unit(unit))
        except SeaoptError as error:
            raise type(error)(f"{where}: {error}") from error
        return unit


@record
class SelectedChannel:
    """A channel before it is read; `unit` is its column's, `constant` its value where that stands in a header."""

    file_column: FileColumn
    unit: str
    clock: ClockColumn
    rule: Rule | None = None
    constant: float | None = None


@record
class Selection:
    """The log's clock, its channels before they are read, and notes on both."""

    clock: ClockColumn
    channels: Mapping[str, SelectedChannel]
    notes: tuple[str, ...]


def select(
    sources: Sequence[Source],
    time: str | int | Column | None,
    channels: Mapping[str, str | int | Column] | None,
    align: Rule | None,
    counter: Counter | None,
    rate_hz: float | None = None,
) -> Selection:
    """Return the log's clock and channels. Raises LogError: a column is missing, doubled or without a unit, the clock
    is not clear, or a channel's other clock has no rule. Raises UnitError: a unit is unknown or of the wrong dimension.
    """
    if channels is not None and "time" in channels:
        raise LogError(f'{sources[0].path}: a channel is named "time"; rename it, time is the clock')
    declared = {name: as_column(column) for name, column in (channels or {}).items()}
    columns = None if channels is None else _find_columns(sources, declared)
    clock = _find_log_clock(sources, time, None if columns is None else list(columns.values()), rate_hz)
    notes = [note for source in sources for note in source.notes]
    if columns is None:
        columns, more = _select_every_channel(sources, clock, align)
        notes += more
    if counter is not None:
        find_column([clock.source], "the counter", Column(column=counter.column))
    selected = {name: _select_channel(clock, file_column, align) for name, file_column in columns.items()}
    origins = {
        name: (str(file_column.source.path), f"{file_column.field.name} {file_column.source.rows}".strip())
        for name, file_column in columns.items()
        if not file_column.column.shared
    }
    notes += check_distinct({name: (origin, si_unit(selected[name].unit)) for name, origin in origins.items()})
    for name, column in declared.items():
        if column.from_header:
            selected[name] = _select_constant(sources, clock, name, column)
    ordered = {name: selected[name] for name in declared or selected}
    return Selection(clock=clock, channels=ordered, notes=tuple(notes))


def _select_channel(clock: ClockColumn, file_column: FileColumn, align: Rule | None) -> SelectedChannel:
    """Return a channel with its clock, and the rule that brings it to the log's."""
    channel_clock = _find_channel_clock(clock, file_column)
    if channel_clock == clock:
        return SelectedChannel(file_column=file_column, unit=file_column.unit, clock=clock)
    rule, source = file_column.column.align or align, file_column.source
    # Rows of one table may be at the same instants; whether they are is seen on reading.
    if rule is None and not (source.rows and clock.rows and source.path == clock.path):
        raise LogError(
            f'{source.path}: "{file_column.field.name}" is on the clock "{channel_clock.name}", the log on '
            f'"{clock.name}" of {clock.path.name}; {HOW_TO_ALIGN}',
            keys=ALIGNED,
        )
    return SelectedChannel(file_column=file_column, unit=file_column.unit, clock=channel_clock, rule=rule)


def _find_columns(sources: Sequence[Source], columns: Mapping[str, Column]) -> dict[str, FileColumn]:
    """Return the columns that are no constants; those of the same rows share a source, and so a clock."""
    read = [(name, column) for name, column in columns.items() if not column.from_header]
    file_columns = {name: find_column(sources, name, column) for name, column in read}
    kept: dict[tuple[str, str], Source] = {}
    for name, column in read:
        if column.where:
            rows = keep_rows(file_columns[name].source, column.where)
            file_columns[name] = replace(file_columns[name], source=kept.setdefault((str(rows.path), rows.rows), rows))
    return file_columns


def _select_constant(sources: Sequence[Source], clock: ClockColumn, name: str, column: Column) -> SelectedChannel:
    """Return a channel that has the value that a header states."""
    files = [source for source in sources if column.file is None or source.path == Path(column.file)]
    constant = str(column.column)
    stated = {other: source for source in files for other in source.constants}
    if column.column not in stated:
        raise LogError(
            f'{_list_paths(files)}: the header states no constant "{constant}" for {name}; '
            f"{suggestion(constant, stated)}"
        )
    value, unit = stated[constant].constants[constant]
    field = Field(name=constant, kind="float64", length=None, unit=unit)
    file_column = FileColumn(column=column, source=stated[constant], field=field)
    return SelectedChannel(file_column=file_column, unit=file_column.unit, clock=clock, constant=value)


def as_column(column: str | int | Column) -> Column:
    """Return a column, of which the header alone may be given."""
    return column if isinstance(column, Column) else Column(column=column)


def find_column(sources: Sequence[Source], name: str, column: Column) -> FileColumn:
    """Return where a column is."""
    places = [source for source in sources if column.file is None or source.path == Path(column.file)]
    if not places:
        paths = ", ".join(str(source.path) for source in sources)
        raise LogError(f'{name}: file = "{column.file}" is none of those read; give one of {paths}')
    hits = [(source, field) for source in places for field in _match_fields(source, column.column)]
    if not hits:
        raise LogError(f"{_list_paths(places)}: {_explain_missing(places, name, column)}")
    if len(hits) > 1 and hits[0][0] is hits[1][0]:
        raise LogError(f'{hits[0][0].path}: {len(hits)} columns are named "{column.column}"; rename all but one')
    if len(hits) > 1:
        raise LogError(
            f'"{column.column}" for {name} is in {_list_paths([source for source, _ in hits])}; say which with '
            f"{spell_column(column=column.column, file='...')}"
        )
    source, field = hits[0]
    if not field.numeric and source.format != "CSV":  # a text file names the cell, on reading
        raise LogError(f'{source.path}: "{field.name}" holds {field.kind}, not numbers; {field.remedy}')
    return FileColumn(column=column, source=source, field=field)


def _match_fields(source: Source, column: str | int) -> list[Field]:
    """Return the fields of a name, or of a number counted from 1."""
    if isinstance(column, str):
        return [field for field in source.fields if field.name == column]
    numbered = ((at if field.position is None else field.position, field) for at, field in enumerate(source.fields, 1))
    return [field for number, field in numbered if number == column]


def _explain_missing(places: Sequence[Source], name: str, wanted: Column) -> str:
    """Return what to do about a column that is not there, or about a header that several columns have."""
    column = wanted.column
    fields = [field for source in places for field in source.fields]
    if isinstance(column, int):
        return f"no column {column} for {name}; the file has {len(fields)}: {_list_names([f.name for f in fields])}"
    repeated = [field.position for field in fields if field.header == column]
    if repeated:
        numbers = ", ".join(map(str, repeated[:MAX_NAMES]))
        how = spell_column(column=repeated[0] or 1)
        return f'{len(repeated)} columns are named "{column}"; give the number of the one for {name}, {numbers}: {how}'
    names, listed = [field.name for field in fields], f"seaopt inspect {shlex.quote(str(places[0].path))} --list"
    near = _find_near(column, names)
    key = name if wanted == Column(column=column) else "column"  # its unit and scale stay
    how = (
        f'did you mean "{near}"? write {key} = "{near}"'
        if near
        else f"known: {_list_names(names)}; list them: {listed}"
    )
    return f'no column "{column}" for {name}; {how}'


def _find_near(name: str, names: Sequence[str]) -> str | None:
    """Return the header nearest to one by what stands before its unit: a unit that is the same makes none alike."""
    bare = {bare_name(each): each for each in reversed(names)}
    near = get_close_matches(bare_name(name), bare, n=1, cutoff=0.6)
    return bare[near[0]] if near else None


def _list_paths(sources: Sequence[Source]) -> str:
    return ", ".join(str(source.path) for source in sources)


def _make_clock(file_column: FileColumn) -> ClockColumn:
    column, source, name = file_column.column, file_column.source, file_column.field.name
    if file_column.stated_unit is None:
        unit = guess_time_unit(source.read([name])[name]) if file_column.field.numeric else "s"
        raise ClockError(
            f'{source.path}: column "{name}" has no unit, and is the time; give it, {unit} by the size of its steps: '
            f"time with {spell_column(column=column.column, unit=unit)} (--unit time={unit})",
            column=name,
            unit=unit,
        )
    if not same_dimension(file_column.unit, "s"):
        raise UnitError(
            f'{source.path}: column "{name}" is in {file_column.unit}, not a unit of time; {advise_time(source)}'
        )
    clock = ClockColumn(source=source, path=source.path, name=name, unit=file_column.unit, rows=source.rows)
    return clock.shift(column)


def _find_log_clock(
    sources: Sequence[Source], time: str | int | Column | None, channels: list[FileColumn] | None, rate_hz: float | None
) -> ClockColumn:
    """Return the log's clock: as given, else the one that all channels share."""
    if rate_hz is not None:
        return _make_rate_clock(sources, time, channels, rate_hz)
    if time is not None:
        column = as_column(time)
        first = channels[0].source if channels else None
        # A header that several files have, or rows, is the clock of the first channel's.
        if first and not column.where and ((len(sources) > 1 and column.file is None) or first.rows):
            sources = [first] if _match_fields(first, column.column) else sources
        file_column = find_column(sources, "time", column)
        return _make_clock(
            replace(file_column, source=keep_rows(file_column.source, column.where)) if column.where else file_column
        )
    if channels is None:
        places = [(source, field) for source in sources for field in source.fields if field.numeric]
    else:
        places = [(file_column.source, file_column.field) for file_column in channels]
    files = list(dict.fromkeys(str(source.path) for source, _ in places))
    if len(files) > 1:
        raise LogError(f"{', '.join(files)}: several files have several clocks; name the log's with time= (--time)")
    if not places:
        raise LogError(
            f"{_list_paths(sources)}: holds no column of numbers; list it with contents(path) (seaopt inspect --list)"
        )
    if all(field.length == 0 for _, field in places):
        raise LogError(f"{_list_paths(sources)}: holds no sample; record the log again")
    source = places[0][0]
    clocks = list(dict.fromkeys(field.clock for _, field in places))
    if len(clocks) > 1:
        lengths = {field.name: field.length or 0 for field in source.fields}
        names = sorted((clock for clock in clocks if clock is not None), key=lambda name: -lengths.get(name, 0))
        raise ClockError(
            f"{source.path}: holds several clocks ({_list_names(names)}); name the log's with time= (--time)",
            candidates=names,
        )
    column = Column(column=clocks[0]) if clocks[0] is not None else _find_time_column(source)
    return _make_clock(find_column([source], "time", column))


def _make_rate_clock(
    sources: Sequence[Source], time: object, channels: list[FileColumn] | None, rate_hz: float
) -> ClockColumn:
    """Return a clock of a stated rate, for a file that has none."""
    if time is not None:
        raise LogError(f"{_list_paths(sources)}: time and rate_hz are both given; keep one of them")
    if isinstance(rate_hz, bool) or not isinstance(rate_hz, int | float) or not 0.0 < rate_hz < 1e12:
        raise LogError(f"rate_hz = {rate_hz!r} is not a sample rate; give samples per second")
    source = channels[0].source if channels else sources[0]
    if len(sources) > 1 or any(file_column.source is not source for file_column in channels or []):
        raise LogError(f"{_list_paths(sources)}: rate_hz is the clock of one table; read one file, without where")
    return ClockColumn(source=source, path=source.path, name=f"{rate_hz:g} Hz", unit="s", rate_hz=float(rate_hz))


def _find_time_column(source: Source) -> Column:
    """Return the one column that is named like a time."""
    names = [field.name for field in source.fields if field.numeric]
    lengths = {field.name: field.length for field in source.fields}
    ranks = [(field, _rank_time_name(field.header or field.name)) for field in source.fields if field.numeric]
    first = min((rank for _, rank in ranks if rank is not None), default=0)
    named = [field for field, rank in ranks if rank == first]
    # T in degrees is a temperature; of several, one with another unit is no time.
    times = [
        field.name
        for field in named
        if not field.unit
        or not is_unit(field.unit)
        or same_dimension(field.unit, "s")
        or (len(named) == 1 and si_unit(field.unit) != "degC")
    ]
    if len(times) == 1:
        return Column(column=times[0])
    why = "no column is" if not times else f"{len(times)} columns are"
    raise ClockError(
        f"{source.path}: {why} named like a time; {advise_time(source)}; or rate_hz= where there is none",
        candidates=times or sorted(names, key=lambda name: -(lengths[name] or 0)),
    )


def advise_time(source: Source) -> str:
    """Return how to name the time, and the columns that may be it."""
    return f"give time= (--time), one of the columns: {_list_names([f.name for f in source.fields if f.numeric])}"


def is_time_name(name: str) -> bool:
    """Tell whether a column is named like a time, with a unit behind it or without."""
    return _rank_time_name(name) is not None


def _rank_time_name(name: str) -> int | None:
    """Return how clearly a column is named like a time: 0 as in "Zeit [ms]", 1 where the name ends in the unit, as
    "Zeit/ms" or "t_ms", 2 of ticks beside a time; None of what is no time.
    """
    bare = bare_name(name)
    unit, stem = split_unit(bare)
    for rank, each in enumerate((bare, stem if unit and same_dimension(unit, "s") else "")):
        last = re.split(r"[./]", each)[-1].casefold()
        if last in QUANTITY_WORDS["time"]:
            return 2 if last in COUNTERS and rank == 0 else rank
    return None


def _find_channel_clock(clock: ClockColumn, file_column: FileColumn) -> ClockColumn:
    """Return the clock a channel is on: its own, the log's, the format's, or in another file one of the same name."""
    column, source, field = file_column.column, file_column.source, file_column.field
    reference = clock.field
    if column.time is not None:
        time = as_column(column.time)
    elif source is clock.source and (reference is None or field.clock == reference.clock):
        if reference is not None and not _is_as_long(field, reference):
            raise LogError(
                f'{source.path}: "{field.name}" has {field.length} samples and the clock "{clock.name}" '
                f"{reference.length}; give it its own with {spell_column(column=field.name, time='...')}"
            )
        return clock.shift(column)
    elif field.clock is not None:
        time = Column(column=field.clock)
    elif source is not clock.source:
        named = any(other.name == clock.name for other in source.fields)
        time = Column(column=clock.name, unit=clock.unit) if named else _find_time_column(source)
    else:
        how = spell_column(column=field.name, time="...")
        raise LogError(f'{source.path}: "{field.name}" has no clock of its own; give it one: {how}')
    return _make_clock(find_column([source], f'time of "{field.name}"', time)).shift(column)


def _is_as_long(field: Field, other: Field) -> bool:
    """Tell whether two columns have as many samples, as far as the format tells."""
    return None in (field.length, other.length) or field.length == other.length


def _select_every_channel(
    sources: Sequence[Source], clock: ClockColumn, align: Rule | None
) -> tuple[dict[str, FileColumn], list[str]]:
    """Return every column of numbers on the clock; with a rule for all, those on other clocks too."""
    reference = clock.field

    def is_on_clock(source: Source, field: Field) -> bool:
        if source is not clock.source or field.clock != (reference.clock if reference else None):
            return False
        return reference is None or _is_as_long(field, reference)

    clock_names = {(str(source.path), field.clock) for source in sources for field in source.fields if field.clock}
    chosen: list[tuple[Source, Field]] = []
    words: list[str] = []
    elsewhere: list[str] = []
    longer_or_shorter: list[str] = []
    every = [(source, field) for source in sources for field in source.fields if field.name != clock.name]
    for source, field in every:
        on_clock = is_on_clock(source, field)
        if not field.numeric:
            words += [field.name] * on_clock
        elif (str(source.path), field.name) in clock_names:
            continue  # a clock is not a channel too
        elif on_clock or (align is not None and field.clock is not None):
            chosen.append((source, field))
        elif field.clock is not None:
            elsewhere.append(field.name)
        else:
            longer_or_shorter.append(field.name)
    notes = [f"columns that hold no numbers were left out: {_list_names(words)}"] if words else []
    if elsewhere:
        notes.append(
            f'columns on other clocks than "{clock.name}" were left out: {_list_names(elsewhere)}; to have them too, '
            "align them: align=Linear() (--align linear)"
        )
    if longer_or_shorter:
        notes.append(f'columns that are not as long as "{clock.name}" were left out: {_list_names(longer_or_shorter)}')
    if not chosen:
        raise LogError(
            f'{clock.path}: no column of numbers is on the clock "{clock.name}"; choose another time= (--time)'
        )
    units, remarks = _find_units(chosen)
    bare = [bare_name(field.name) if unit else field.name for unit, (_, field) in zip(units, chosen, strict=True)]
    counts = Counts(bare)
    columns: dict[str, FileColumn] = {}
    for name, unit, (source, field) in zip(bare, units, chosen, strict=True):
        key = name if counts[name] == 1 and name != "time" else field.name
        key = key if key not in columns else f"{source.path.name}:{field.name}"
        column = Column(column=field.name, unit=unit, file=source.path)
        columns[key] = FileColumn(column=column, source=source, field=field)
    return columns, notes + remarks


def _list_names(names: Sequence[str]) -> str:
    return (", ".join(names[:MAX_NAMES]) or "none") + (f", ... ({len(names)} in all)" if len(names) > MAX_NAMES else "")


def _find_units(chosen: list[tuple[Source, Field]]) -> tuple[list[str], list[str]]:
    """Return each column's unit, "" where none is known; brackets that hold no unit are part of the name."""
    some_known = any(field.unit and is_unit(field.unit) for _, field in chosen)
    odd = [(source, field) for source, field in chosen if source.format == "CSV" and not is_unit(field.unit or "")]
    for source, field in odd:
        # Square brackets without a number, which would be an index, are meant as a unit.
        if some_known and field.name.endswith("]") and not str(field.unit).isdecimal():
            _check_bracket(source, field)
    if odd:
        return [""] * len(chosen), ["brackets in the headers that are not units were taken as names; no unit is known"]
    units: list[str] = []
    lost: list[str] = []
    for _, field in chosen:
        try:  # a unit comes to SI by a factor alone
            factor(field.unit or "", si_unit(field.unit or ""))
            units.append(field.unit or "")
        except SeaoptError:
            units.append("")
            lost.append(f"{field.name} [{field.unit}]")
    return units, [f"units that are not known were left out: {_list_names(lost)}"] if lost else []


def _check_bracket(source: Source, field: Field) -> None:
    """Refuse brackets that hold no unit, with the command that gives one."""
    try:
        si_unit(FileColumn(column=Column(column=field.name), source=source, field=field).unit)
    except SeaoptError as error:
        bare = bare_name(field.name)
        name = bare if bare.isidentifier() else "F1"
        options = ["--channel", f"{name}={field.name}", "--unit", f"{name}=N"]
        command = shlex.join(["seaopt", "inspect", str(source.path), *options])
        raise UnitError(f"{error}; or name the column, and give its own unit, as in {command}") from error
