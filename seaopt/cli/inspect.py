"""`seaopt inspect`: read a log as it is, print its quality report, write it where asked."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

from seaopt.cli.progress import show_progress
from seaopt.cli.terminal import Amount, Terminal
from seaopt.errors import LogError, SeaoptError
from seaopt.files import check_folder, to_json, write_json
from seaopt.logs import Column, Counter, Hold, Linear, Quality, assess_quality, contents, read_table
from seaopt.logs.formats import open_source
from seaopt.logs.log.alignment import Rule
from seaopt.logs.reading.clock_samples import guess_time_unit, runs_on
from seaopt.logs.reading.selection import ClockError, is_time_name
from seaopt.logs.reading.vocabulary import find_unit_in_name, read_header
from seaopt.progress import divide
from seaopt.reporting.sections import describe
from seaopt.reporting.sections.data import Section
from seaopt.reporting.sections.text import Most, render_sections
from seaopt.signals import RawLog
from seaopt.units import is_unit, same_dimension, si_unit

RULES: dict[str, Rule] = {"hold": Hold(), "linear": Linear()}
MAX_DIGITS = 9  # of a count
MOST_LINES = 200  # of channels, and of findings


def inspect_log(
    path: Path,
    *,
    time: str | None = None,
    channels: Sequence[str] = (),
    inputs: Sequence[str] = (),
    units: Sequence[str] = (),
    align: str | None = None,
    counter: str | None = None,
    rate_hz: float | None = None,
    folder: Path | None = None,
    json: bool = False,
    amount: Amount = "usual",
) -> bool:
    """Read a log as it is, print what is wrong with it, and write quality.json and the figure if asked. Returns whether
    it has no error, with which a fit refuses it or is wrong. Raises SeaoptError: the log cannot be read, or an option
    is malformed.
    """
    if folder is not None:
        check_folder(folder)
    headers, unit_of = parse_pairs("--channel", channels), parse_pairs("--unit", units)
    for name in unit_of:
        if name != "time" and name not in headers:
            unit = f"{name}={unit_of[name]}"
            command = _spell_command(path, shlex.join(["--channel", f"{name}=COLUMN", "--unit", unit]))
            raise SeaoptError(f"--unit {unit}: name its column too: {command}")
    if align is not None and align not in RULES:
        raise SeaoptError(f'--align "{align}" is not known; give {" or ".join(RULES)}')
    columns = {name: Column(column=header, unit=unit_of.get(name)) for name, header in headers.items()}
    read = partial(
        read_table,
        path,
        channels=columns or None,
        align=None if align is None else RULES[align],
        counter=_parse_counter(counter),
        rate_hz=rate_hz,
    )
    written: list[Path] = []
    console = Terminal(stderr=True)
    with show_progress(console, "inspecting the log", console.say, brief=True) as tell:
        reading, looking, drawing = divide(tell, 1.0, 1.0, float(folder is not None))  # for a long log
        reading("reading", 0.0)
        table = _take_units_of_names(_read_on_clock(path, read, time, unit_of.get("time")))
        quality = assess_quality(table, inputs=list(inputs) or None, progress=looking)
        if folder is not None:
            from seaopt.reporting import write_quality_figure

            drawing("drawing", 0.0)
            written = [write_json(folder / "quality.json", quality.to_dict())]
            written += write_quality_figure(table, quality, folder / "quality")
    if json:
        sys.stdout.write(to_json(quality.to_dict()))
    else:
        _print_report(quality, written, amount)
    return not any(finding.severity == "error" for finding in quality.findings)


def _read_on_clock(path: Path, read: Callable[..., RawLog], time: str | None, unit: str | None) -> RawLog:
    """Read a table; where its clock is not clear the error is the command to type, and its unit may be assumed. Raises
    LogError: no column, or more than one, is named like a time, or it has another unit.
    """
    if time is None and unit is not None:
        named = [field.name for field in contents(path).fields if field.numeric and is_time_name(field.name)]
        if len(named) != 1:
            raise LogError(f"--unit time={unit}: name its column too: {_spell_clock(path, 'COLUMN', unit)}")
        time = named[0]
    clock = Column(column=time, unit=unit) if time is not None else None
    try:
        return read(time=clock)
    except ClockError as error:
        if error.column is None or not is_time_name(error.column):
            named = (error.column, error.unit) if error.column is not None else _choose_clock(path, error.candidates)
            command = (
                _spell_clock(path, *named) if named else _spell_command(path, "--rate-hz 1000, if that is its rate")
            )
            raise LogError(f"{error}; type {command}") from error
        table = read(time=Column(column=error.column, unit=error.unit))
        unit, word = {"s": ("ms", "milliseconds")}.get(error.unit, ("s", "seconds"))
        note = (
            f'column "{error.column}" has no unit: {error.unit} was assumed, by the size of its steps; for {word} '
            f"type {_spell_clock(path, error.column, unit)}"
        )
        return replace(table, notes=(note, *table.notes))


def _take_units_of_names(table: RawLog) -> RawLog:
    """Return the table with the units that the names of channels without one end in, and a note of them."""
    units = {name: find_unit_in_name(name) for name, signal in table.signals.items() if not signal.unit}
    signals, taken = dict(table.signals), {name: unit for name, unit in units.items() if unit is not None}
    for name, unit in taken.items():
        values = Column(column=name).to_si(signals[name].values.copy(), unit, table.source)
        signals[name] = replace(signals[name], values=values, unit=si_unit(unit))
    listed = ", ".join(f"{unit} of {name}" for name, unit in taken.items())
    notes = (f"units were taken from names: {listed}",) if taken else ()
    return replace(table, signals=signals, notes=(*table.notes, *notes))


def _choose_clock(path: Path, candidates: Sequence[str]) -> tuple[str, str] | None:
    """Return the likely clock and its unit: the column whose header states a unit of time, or that runs on, or else is
    named like a time; None where there is none.
    """
    stated = {field.name: field.unit for field in contents(path).fields}
    units = {name: read_header(name, stated.get(name)).unit for name in candidates}
    for name, unit in units.items():
        if is_unit(unit) and same_dimension(unit, "s"):
            return name, unit
    source = open_source(path)
    for name in candidates:
        values = source.read([name])[name]
        if runs_on(values):
            return name, guess_time_unit(values)
    return next(((name, "s") for name in candidates if is_time_name(name)), None)


def _spell_clock(path: Path, column: str, unit: str) -> str:
    return _spell_command(path, f"--time {shlex.quote(column)} --unit time={unit}")


def _spell_command(path: Path, options: str) -> str:
    return f"seaopt inspect {shlex.quote(str(path))} {options}"


def _parse_counter(option: str | None) -> Counter | None:
    if option is None:
        return None
    ((column, count),) = parse_pairs("--counter", [option]).items()
    if not count.isdecimal() or len(count) > MAX_DIGITS:
        raise SeaoptError(f'--counter "{option}": "{count}" is not how many samples a count stands for; give 1 or more')
    return Counter(column=column, samples_per_count=int(count))


def parse_pairs(option: str, texts: Sequence[str]) -> dict[str, str]:
    """Return the values of NAME=VALUE by name. Raises SeaoptError: a text is none, or a name occurs twice."""
    pairs: dict[str, str] = {}
    for text in texts:
        name, sign, value = (part.strip() for part in text.partition("="))
        if not sign or not name or not value:
            raise SeaoptError(f'{option} "{text}" is not a valid pair; write {option} NAME=VALUE')
        if name in pairs:
            raise SeaoptError(f'{option} names "{name}" twice; keep one')
        pairs[name] = value
    return pairs


def _print_report(quality: Quality, written: list[Path], amount: Amount) -> None:
    """Print the verdict, and with it findings and channels unless asked for little."""
    console, first, *further = Terminal(), *describe(quality)
    if amount == "quiet":
        console.write(render_sections([Section(title=first.title)], console.width)[1:])
        return
    most = Most() if amount == "verbose" else Most(rows=MOST_LINES, items=MOST_LINES)
    console.write(render_sections([first, *further], console.width, most)[1:])
    if written:
        console.list_files(written)
