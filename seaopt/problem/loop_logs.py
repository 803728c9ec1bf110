"""Logs taken under a law, read by the columns that a problem file gives them."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np

from seaopt.errors import LogError
from seaopt.logs import Column, Log, contents, read_log, read_table
from seaopt.logs.formats import Field
from seaopt.logs.quality.clock import JITTER_LIMIT, assess_clock, shorten_rate, split_at_gaps
from seaopt.logs.reading.selection import ClockError
from seaopt.problem.bench_tables import AcceptanceTable, ExperimentTable
from seaopt.problem.columns import make_column
from seaopt.problem.problem import Problem
from seaopt.signals import REFERENCE, REFERENCES, STATUS, RawLog, VectorN
from seaopt.units import bare_name

NUMBERS = ("float", "int", "uint")  # kinds of a column, before their bits
MOST_NAMES = 20  # in a message
SAME_STAMP = 1e-6  # of a period, by which rows of one stamp are set apart
OFF_RATE = 5e-3  # of the rows: as far as a clock is off
LONG_STEP = 3.0  # periods of a step that no jitter makes of one, of ticks that are stamped late


def read_loop_log(
    problem: Problem,
    path: Path,
    units: Mapping[str, str],
    reference: str | None = None,
    *,
    beside: Mapping[str, str] | None = None,
    at_rest: Collection[str] = (),
) -> Log:
    """Return a log taken under a law, with the channels that the law has and its reference.

    A column is that of [acceptance], else of the experiment of the controller's plant, else of the channel's own name;
    a log that the exported C wrote has the channels' own names and its own clock, and [acceptance] is of others.
    One that states no unit has the law's. `units`: of each channel, that of the reference by the name "reference".
    `reference`: its column, by the header, with its unit or without. `beside`: channels that are read, too, with their
    units, where the log has the column that the experiment or [acceptance] gives them. `at_rest`: channels that may be
    constant, besides these, and are not noted then. Raises LogError: a column is
    missing, or the log cannot be read.
    """
    file = contents(path)
    table = AcceptanceTable() if file.law else problem.table.acceptance
    fields = {field.name: field for field in file.fields}
    template = _find_template(problem)
    columns = {} if template is None else {**template.inputs, **template.outputs}
    columns = {**columns, **table.columns} | ({} if table.reference is None else {REFERENCE: table.reference})
    columns = columns if reference is None else {**columns, REFERENCE: reference}
    beside = {name: unit for name, unit in (beside or {}).items() if name not in units}
    wanted = {**units, **beside}
    stated = {name: make_column(column, problem.folder) for name, column in columns.items() if name in wanted}
    optional = stated.keys() - table.columns.keys() - {REFERENCE}  # of another log, which may have more
    stated = {name: column for name, column in stated.items() if name not in optional or _has(column, fields)}
    channels: dict[str, Column] = {}
    for name, unit in wanted.items():
        column = stated.get(name) if name in beside else _choose_column(name, stated.get(name), fields)
        if column is None:
            continue  # who judges the log says what it is for
        field = fields.get(column.column) if isinstance(column.column, str) else None
        if name == STATUS and (field is None or field.kind.rstrip("0123456789") not in NUMBERS):
            continue  # words of another kind
        has_none = column.unit is None and field is not None and field.unit is None
        column = replace(column, at_rest=name in beside or name in at_rest)
        channels[name] = replace(column, unit=unit or "-") if has_none else column
    if not channels:
        raise LogError(
            f"{path}: has none of {', '.join(units)}; its columns are {', '.join(list(fields)[:MOST_NAMES])}: name "
            "them in [acceptance] of the problem file: columns = { ... }"
        )
    clock = table.time if table.time is not None or template is None else template.time
    time = None if clock is None else make_column(clock, problem.folder)
    if time is not None and table.time is None and isinstance(time.column, str) and time.column not in fields:
        time = None  # another log's
    return _read_ticks(path, time, channels, table.rate_hz)


def _read_ticks(path: Path, time: Column | None, channels: Mapping[str, Column], rate_hz: float | None) -> Log:
    """Return a log whose rows are the ticks of a law. `rate_hz`: of the ticks, where the log has no clock, or one that
    stamps them unevenly.
    """
    try:
        if rate_hz is not None:
            return _number_rows(read_table(path, time=time, channels=channels), rate_hz)
        log = read_log(path, time=time, channels=channels)
    except ClockError as error:
        if rate_hz is not None and time is None:
            return read_log(path, channels=channels, rate_hz=rate_hz)
        raise LogError(f"{error}; in the problem file: [acceptance] time = COLUMN, or rate_hz = RATE") from error
    clock = assess_clock(log.time, log.source)
    if clock.jitter_max > JITTER_LIMIT * clock.period:
        raise LogError(
            f"{log.source}: a step of time differs by {clock.jitter_max / clock.period:.0%} from the period "
            f"{clock.period:.4g} s ({JITTER_LIMIT:.0%} is allowed), though each row is a tick of the law; "
            f"{_advise_rate(log)}"
        )
    return log


def _number_rows(table: RawLog, rate_hz: float) -> Log:
    """Return a log whose rows are ticks in the order in which they were written, whenever each was stamped, with gaps
    where the stamps tell them. Raises LogError: the stamps are of another rate.
    """
    rows, signals = np.arange(table.time.size), dict(table.signals)
    stamps = np.sort(table.time[np.isfinite(table.time)])

    def make_log(time: VectorN, *notes: str) -> Log:
        return Log(time=time, signals=signals, source=table.source, notes=(*table.notes, *notes), law=table.law)

    if stamps.size == rows.size:
        with suppress(LogError):
            return make_log(stamps + SAME_STAMP / rate_hz * rows).restamp(rate_hz=rate_hz)
    lasts = float(stamps[-1] - stamps[0]) if stamps.size > 1 else 0.0
    if abs(lasts * rate_hz - (rows.size - 1)) > OFF_RATE * rows.size:
        mean = f", {(rows.size - 1) / lasts:.6g} Hz on average" if lasts else ""
        raise LogError(
            f"{table.source}: rate_hz = {rate_hz:g} is not the rate of its rows, {rows.size} in {lasts:.6g} s{mean}; "
            "correct it, or where no row is missing leave the time column out: each row is a tick then"
        )
    return make_log(
        rows / rate_hz,
        f"each row is a tick of {rate_hz:g} Hz, in the order in which they were written; by such stamps a row that is "
        "missing cannot be told",
    )


def _advise_rate(log: Log) -> str:
    """Return what to do about uneven stamps of ticks: their mean rate, where it explains them."""
    parts = split_at_gaps(log.time, LONG_STEP * log.period) or [slice(None)]
    stamps = max((log.time[part] for part in parts), key=len)
    rate_hz = shorten_rate((stamps.size - 1) / float(stamps[-1] - stamps[0]))
    try:
        log.restamp(rate_hz=rate_hz)
    except LogError:
        return f"their mean rate, {rate_hz:g} Hz, does not explain the stamps either: log the target's own time"
    return f"state the rate of the ticks in the problem file: [acceptance] rate_hz = {rate_hz:g}"


def _find_template(problem: Problem) -> ExperimentTable | None:
    """Return the first experiment of the controller's plant that has a log."""
    of_plant = [each for each in problem.table.experiment if problem.plants[each.plant] is problem.design_plant]
    return next((each for each in of_plant if each.virtual is None), None)


def _has(column: Column, fields: Mapping[str, Field]) -> bool:
    return not isinstance(column.column, str) or column.column in fields


def _choose_column(name: str, stated: Column | None, fields: Mapping[str, Field]) -> Column | None:
    """Return the column that is stated, where the log has it, else one of the channel's name."""
    if stated is not None and _has(stated, fields):
        return stated
    called = REFERENCES if name == REFERENCE else (name,)
    if stated is not None and name == REFERENCE:  # another one than was named is none
        called = (stated.column,)
    header = next((field for field in fields if field in called or bare_name(field) in called), None)
    return stated if header is None else Column(column=header)
