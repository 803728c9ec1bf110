"""Raw files to logs: CSV with a header, units in brackets or given (polars reads)."""

from __future__ import annotations

import hashlib
import io
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from seaopt.errors import LogError, SeaoptError, suggestion
from seaopt.files import write_text
from seaopt.logs.log import Log
from seaopt.logs.table import Table
from seaopt.signals import Origin, Signal
from seaopt.units import factor, si_unit

if TYPE_CHECKING:
    import polars as pl

_BRACKETS = re.compile(r"^(?P<name>.*?)\s*[\[(](?P<unit>[^\])]*)[\])]\s*$")


@dataclass(frozen=True, slots=True, kw_only=True)
class Column:
    """A column of a file and the unit of its numbers; without `unit`, the header's brackets say it."""

    column: str
    unit: str | None = None


def header_unit(header: str) -> str | None:
    """Return the unit in a header's brackets, None where there is none.

    Examples
    --------
    >>> header_unit("F1 [N]"), header_unit("Time(usec)"), header_unit("cur")
    ('N', 'usec', None)

    """
    found = _BRACKETS.match(header)
    return found["unit"].strip() if found else None


def read_table(
    path: str | Path, *, time: str | Column | None = None, channels: Mapping[str, str | Column] | None = None
) -> Table:
    r"""Read a file as it is: time may repeat or run backwards, and a channel may be empty.

    Parameters
    ----------
    path : path
        The file; the delimiter (comma, semicolon, tab) is the one its header uses.
    time : str or Column, optional
        Header of the time column; where it is left out, the one column that is named like a time.
    channels : mapping of channel name to str or Column, optional
        Which column is which channel; where it is left out, every column of numbers, named by its header without the
        unit's brackets.

    Raises
    ------
    LogError
        The file is missing, empty or not text, a column is missing or doubled, or a cell is not a number.
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

    """
    source = Path(path)
    text = _read_text(source)
    digest = hashlib.sha256(source.read_bytes()).hexdigest()
    first, _, rows = text.partition("\n")
    if not rows.strip():
        raise LogError(f"{source}: 0 rows below the header; record the log again")
    headers, delimiter = _headers(first.rstrip("\r"))
    if channels is not None and "time" in channels:
        raise LogError(f'{source}: a channel is named "time"; rename it, time is the clock')
    clock = _as_column(time) if time is not None else Column(column=_time_column(source, headers))
    notes: list[str] = []
    if channels is None:
        given = _every_column(source, headers, delimiter, rows, clock.column, notes)
    else:
        given = {name: _as_column(item) for name, item in channels.items()}
    wanted = {"time": clock} | given
    for name, column in wanted.items():
        _check_column(source, name, column.column, headers)
    units = {name: _unit_of(source, column) for name, column in wanted.items()}
    if factor_error := _wrong_time_unit(source, units["time"]):
        raise factor_error
    table = _parse(source, text, headers, delimiter, {column.column for column in wanted.values()})
    if table.height < 2:
        raise LogError(f"{source}: too few rows ({table.height}) below the header; a log needs at least 2")
    arrays = {name: _numbers(source, table, column.column) for name, column in wanted.items()}
    signals = {
        name: _signal(name, arrays[name], units[name], str(path), digest, column) for name, column in given.items()
    }
    seconds = arrays["time"] * factor(units["time"], "s")
    return Table(time=seconds, signals=signals, source=str(path), notes=tuple(notes))


def read_log(
    path: str | Path, *, time: str | Column | None = None, channels: Mapping[str, str | Column] | None = None
) -> Log:
    r"""Read a file, and check that it is a log.

    Parameters
    ----------
    path, time, channels
        As in `read_table`; channels are named as the plant's inputs and outputs, as a rule.

    Returns
    -------
    Log
        In SI. Empty cells and NaN are missing samples (NaN); the fit gives them no weight.

    Raises
    ------
    LogError
        What `read_table` raises, a channel holds no number, or time does not increase.
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
    table = read_table(path, time=time, channels=channels)
    for signal in table.signals.values():
        if not np.any(np.isfinite(signal.values)):
            raise LogError(f'{table.source}: column "{signal.origin.column}" holds no number; choose another column')
    return Log(time=table.time, signals=table.signals, source=table.source)


def write_log(log: Log, path: str | Path) -> Path:
    """Write a log as CSV, units in the header's brackets, numbers with all their digits."""
    import polars as pl

    columns = {"time [s]": log.time}
    for name, signal in log.signals.items():
        columns[f"{name} [{signal.unit}]" if signal.unit else name] = signal.values
    return write_text(path, pl.DataFrame(columns).write_csv())


_TIME_NAMES = frozenset({"time", "t", "timestamp", "timestamps", "zeit"})


def _time_column(source: Path, headers: list[str]) -> str:
    """Return the one header that is named like a time."""
    found = [header for header in headers if _bare(header).casefold() in _TIME_NAMES]
    if len(found) != 1:
        why = "no column is" if not found else f"{len(found)} columns are"
        raise LogError(f"{source}: {why} named like a time; give time=, one of the columns: {', '.join(headers)}")
    return found[0]


def _bare(header: str) -> str:
    found = _BRACKETS.match(header)
    return found["name"].strip() if found else header


def _every_column(
    source: Path, headers: list[str], delimiter: str, rows: str, clock: str, notes: list[str]
) -> dict[str, Column]:
    """Return a channel for every column whose first filled cell is a number; brackets that hold no unit are a name."""
    table = _parse(source, "\n" + "\n".join(rows.splitlines()[:1000]), headers, delimiter, set(headers) - {clock})
    numeric = [header for header in headers if header != clock and _is_numeric(table[header])]
    skipped = [header for header in headers if header != clock and header not in numeric]
    if skipped:
        notes.append(f"columns that hold no numbers were left out: {', '.join(skipped)}")
    if not all(_is_unit(header_unit(header)) for header in numeric):
        notes.append("brackets in the headers that are no units were taken as names; no unit is known")
        return {header: Column(column=header, unit="") for header in numeric}
    bare = [_bare(header) for header in numeric]
    return {
        name if bare.count(name) == 1 else header: Column(column=header, unit=header_unit(header) or "")
        for name, header in zip(bare, numeric, strict=True)
    }


def _is_numeric(cells: pl.Series) -> bool:
    filled = [cell.strip() for cell in cells.drop_nulls() if cell.strip()]
    try:
        float(filled[0] if filled else "x")
    except ValueError:
        return False
    return True


def _is_unit(unit: str | None) -> bool:
    if unit is None:
        return True
    try:
        si_unit(unit)
    except SeaoptError:
        return False
    return True


def _signal(name: str, values: Float[np.ndarray, " n"], unit: str, path: str, digest: str, column: Column) -> Signal:
    to = si_unit(unit)
    origin = Origin(file=path, sha256=digest, column=column.column, conversion=f"{unit} to {to}" if unit != to else "")
    return Signal(name=name, values=values * factor(unit, to), unit=to, origin=origin)


def _as_column(given: str | Column) -> Column:
    return given if isinstance(given, Column) else Column(column=given)


def _read_text(source: Path) -> str:
    if source.is_dir():
        raise LogError(f"{source}: is a folder; give a CSV file")
    try:
        raw = source.read_bytes()
    except FileNotFoundError as error:
        raise LogError(f"{source}: no such file; check the path") from error
    except OSError as error:
        raise LogError(f"{source}: cannot be read ({error.strerror}); check the path") from error
    if not raw.strip():
        raise LogError(f"{source}: the file is empty; record the log again")
    if b"\x00" in raw[:4096]:
        raise LogError(f"{source}: is not a text file; save the log as CSV")
    try:
        return raw.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise LogError(f"{source}: is not UTF-8 text (byte {error.start}); save the log as UTF-8 CSV") from error


def _headers(line: str) -> tuple[list[str], str]:
    delimiter = max(",;\t", key=line.count)
    return [cell.strip().strip('"') for cell in line.split(delimiter)], delimiter


def _check_column(source: Path, name: str, column: str, headers: list[str]) -> None:
    count = headers.count(column)
    if count == 0:
        raise LogError(f'{source}: no column "{column}" for {name}; {suggestion(column, headers)}')
    if count > 1:
        raise LogError(f'{source}: {count} columns are named "{column}"; rename all but one')


def _unit_of(source: Path, column: Column) -> str:
    unit = column.unit if column.unit is not None else header_unit(column.column)
    if unit is None:
        raise LogError(
            f'{source}: column "{column.column}" has no unit; write it in the header\'s brackets, '
            f'"{column.column} [unit]", or give it with the column'
        )
    return unit


def _wrong_time_unit(source: Path, unit: str) -> SeaoptError | None:
    try:
        factor(unit, "s")
    except SeaoptError as error:
        return type(error)(f"{source}: time: {error}")
    return None


def _parse(source: Path, text: str, headers: list[str], delimiter: str, wanted: set[str]) -> pl.DataFrame:
    """Return the wanted columns as text; what cannot be parsed is found cell by cell, to name it."""
    import polars as pl

    try:
        return pl.read_csv(
            io.StringIO(text),
            has_header=False,
            skip_rows=1,
            separator=delimiter,
            new_columns=[f"{index}:{name}" for index, name in enumerate(headers)],
            columns=[index for index, name in enumerate(headers) if name in wanted],
            schema_overrides=[pl.String] * len(headers),
            truncate_ragged_lines=False,
            raise_if_empty=False,
        ).rename(lambda name: name.split(":", 1)[1])
    except (pl.exceptions.PolarsError, ValueError) as error:
        reason = str(error).splitlines()[0]
        raise LogError(
            f"{source}: cannot be read as CSV ({reason}); check that every row has the header's columns"
        ) from error


def _numbers(source: Path, table: pl.DataFrame, column: str) -> Float[np.ndarray, " n"]:
    import polars as pl

    text = table[column].str.strip_chars()
    values = text.cast(pl.Float64, strict=False)
    blank = text.is_null() | text.str.to_lowercase().is_in(["", "nan", "na"])
    bad = (values.is_null() & ~blank).arg_true()
    if len(bad):
        row = int(bad[0])
        comma = re.fullmatch(r"[-+]?\d+,\d+", str(text[row])) is not None
        hint = ", or save the log with decimal points" if comma else ""
        raise LogError(
            f'{source}: line {row + 2}: "{text[row]}" in column "{column}" is not a number; correct it{hint}'
        )
    infinite = values.is_infinite().fill_null(value=False).arg_true()
    if len(infinite):
        row = int(infinite[0])
        raise LogError(
            f'{source}: line {row + 2}: "{text[row]}" in column "{column}" is not finite; leave the cell empty'
        )
    return values.fill_null(float("nan")).to_numpy().astype(float)
