"""Raw files to logs: CSV with a header, units in brackets or given (polars reads)."""

from __future__ import annotations

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
from seaopt.signals import Signal
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


def read_log(path: str | Path, *, time: str | Column, channels: Mapping[str, str | Column]) -> Log:
    r"""Read a CSV file with a header line.

    Parameters
    ----------
    path : path
        The file; the delimiter (comma, semicolon, tab) is the one its header uses.
    time : str or Column
        Header of the time column.
    channels : mapping of channel name to str or Column
        Which column is which channel: names of the plant's inputs and outputs, as a rule.

    Returns
    -------
    Log
        In SI. Empty cells and NaN are missing samples (NaN); the fit gives them no weight.

    Raises
    ------
    LogError
        The file is missing, empty or not text, a column is missing or doubled, a cell is not a number, or time
        does not increase.
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
    source = Path(path)
    text = _read_text(source)
    first, _, rows = text.partition("\n")
    if not rows.strip():
        raise LogError(f"{source}: 0 rows below the header; record the log again")
    headers, delimiter = _headers(first.rstrip("\r"))
    wanted = {"time": _as_column(time)} | {name: _as_column(given) for name, given in channels.items()}
    if "time" in channels:
        raise LogError(f'{source}: a channel is named "time"; rename it, time is the clock')
    for name, column in wanted.items():
        _check_column(source, name, column.column, headers)
    units = {name: _unit_of(source, column) for name, column in wanted.items()}
    if factor_error := _wrong_time_unit(source, units["time"]):
        raise factor_error
    table = _parse(source, text, headers, delimiter, {column.column for column in wanted.values()})
    if table.height < 2:
        raise LogError(f"{source}: too few rows ({table.height}) below the header; a log needs at least 2")
    arrays = {name: _numbers(source, table, column.column) for name, column in wanted.items()}
    clock = arrays.pop("time") * factor(units.pop("time"), "s")
    signals = {
        name: Signal(name=name, values=values * factor(units[name], si_unit(units[name])), unit=si_unit(units[name]))
        for name, values in arrays.items()
    }
    for name, signal in signals.items():
        if not np.any(np.isfinite(signal.values)):
            raise LogError(f'{source}: column "{wanted[name].column}" holds no number; choose another column')
    return Log(time=clock, signals=signals, source=str(path))


def write_log(log: Log, path: str | Path) -> Path:
    """Write a log as CSV, units in the header's brackets, numbers with all their digits."""
    import polars as pl

    columns = {"time [s]": log.time}
    for name, signal in log.signals.items():
        columns[f"{name} [{signal.unit}]" if signal.unit else name] = signal.values
    return write_text(path, pl.DataFrame(columns).write_csv())


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
