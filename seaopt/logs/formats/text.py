"""CSV and other delimited text, parsed by polars in chunks of whole lines.

A chunk is parsed to floats at once; only where that fails is it parsed as text, and only where a cell is not a number
is it walked line by line, to name that cell. Memory holds the wanted columns and one chunk.
"""

from __future__ import annotations

import codecs
import re
from collections import deque
from collections.abc import Collection, Generator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing
from functools import partial
from itertools import islice
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import numpy as np

from seaopt.errors import LogError
from seaopt.logs.formats.source import Source, Where, summarise_error
from seaopt.logs.formats.text_layout import (
    BLANK,
    MAX_LINE,
    WINDOWS,
    TextLayout,
    encoding_error,
    find_layout,
    is_number,
    line_length_error,
    split_cells,
)
from seaopt.signals import VectorN

if TYPE_CHECKING:
    import polars as pl

CHUNK_BYTES = 4 << 20
CHUNKS_AHEAD = 2  # chunks that are parsed while the next one is read and the last one is stored
_RUNS = re.compile(rb"[ \t]+")
_BEGUN = re.compile(r"[-+]|[-+]?[\d.,]+[eE][-+]?")  # a number that is cut
_BLANK_LINES = re.compile(rb"(?m)^[ \t]*\r?\n")


def open_text(path: Path) -> Source:
    """List a text file's columns."""
    layout = find_layout(path)
    return Source(
        path=path,
        format="CSV",
        fields=layout.fields,
        load=lambda names, _: _load_chunks(layout, names, {}),  # without an index a window reads it whole
        notes=layout.notes,
        constants=layout.constants,
        load_where=partial(_load_chunks, layout),
    )


def _load_chunks(layout: TextLayout, names: Sequence[str], where: Where) -> dict[str, VectorN]:
    """Return columns of the rows in which others have given values; of all rows without any."""
    places = {field.name: (field.position or 1) - 1 for field in layout.fields}
    index, values = {name: places[name] for name in names}, {places[name]: value for name, value in where.items()}
    columns = _GrowingColumns(names)
    size = layout.path.stat().st_size
    pending: deque[tuple[float, Future[dict[str, Any]]]] = deque()
    try:
        with closing(_read_chunks(layout)) as chunks, ThreadPoolExecutor(CHUNKS_AHEAD) as pool:
            for number, chunk in enumerate(chunks):
                if not chunk.isspace():
                    parsed = pool.submit(_parse, layout, chunk, number, index, values)
                    pending.append((size / len(chunk), parsed))
                if len(pending) > CHUNKS_AHEAD:
                    columns.add(*pending.popleft())
            while pending:
                columns.add(*pending.popleft())
    except UnicodeError as error:
        raise encoding_error(layout.path, layout.encoding, error) from error
    return columns.finish()


class _GrowingColumns:
    """Arrays that grow chunk by chunk, sized by the first chunk so that they are rarely moved."""

    def __init__(self, names: Sequence[str]) -> None:
        self.rows = 0
        self.arrays: dict[str, np.ndarray] = {name: np.empty(0) for name in names}

    def add(self, chunks: float, future: Future[dict[str, Any]]) -> None:
        parsed = future.result()
        count = next(iter(parsed.values())).size
        stop = self.rows + count
        for name, values in parsed.items():
            array = self.arrays[name]
            if not self.rows:  # not filled, so that memory is taken as it is written
                array = self.arrays[name] = np.empty(int(count * max(chunks, 1.0) * 1.02) + 1)
            elif stop > array.size:
                array.resize(int(stop * 1.25), refcheck=False)
            array[self.rows : stop] = values
        self.rows = stop

    def finish(self) -> dict[str, VectorN]:
        for array in self.arrays.values():
            array.resize(self.rows, refcheck=False)
        return self.arrays


def _read_chunks(layout: TextLayout) -> Generator[bytes]:
    """Return chunks of whole lines as UTF-8."""
    wide = layout.encoding == "utf-16"
    with layout.path.open(encoding=layout.encoding, newline="\n") if wide else layout.path.open("rb") as stream:
        for _ in range(layout.first):
            stream.readline()
        number = 0
        while chunk := _read_chunk(stream, layout.encoding):
            _check_lines(layout, chunk, number)
            if not number:
                chunk = chunk.removeprefix(codecs.BOM_UTF8)
            if len(chunk) < CHUNK_BYTES:  # the last one may end in blank lines, and in the end-of-file mark of DOS
                chunk = chunk.rstrip(b"\x1a \t\r\n") + b"\n"
            yield chunk
            number += 1


def _read_chunk(stream: IO[Any], encoding: str) -> bytes:
    """Return the next chunk, up to the end of a line."""
    if encoding == "utf-16":
        return (stream.read(CHUNK_BYTES) + stream.readline(MAX_LINE + 1)).encode()
    start = stream.tell()
    stream.seek(start + CHUNK_BYTES)
    stream.readline(MAX_LINE + 1)
    end = stream.tell()
    stream.seek(start)
    chunk = stream.read(end - start)
    return chunk.decode(WINDOWS).encode() if encoding == WINDOWS else chunk


def _find_first_line(layout: TextLayout, number: int) -> int:
    """Return the line on which a chunk begins; counted only to name a line, as it takes a while."""
    with closing(_read_chunks(layout)) as chunks:
        return layout.first + 1 + sum(chunk.count(b"\n") for chunk in islice(chunks, number))


def _check_lines(layout: TextLayout, chunk: bytes, number: int) -> None:
    start = 0
    while len(chunk) - start > MAX_LINE:
        end = chunk.rfind(b"\n", start, start + MAX_LINE)
        if end < start:
            raise line_length_error(layout.path, _find_first_line(layout, number) + chunk.count(b"\n", 0, start))
        start = end + 1


def _parse(
    layout: TextLayout, chunk: bytes, number: int, index: Mapping[str, int], where: Mapping[int, str | float]
) -> dict[str, Any]:
    """Return the columns of a chunk, by name; with `where` of the rows in which columns have these values. Texts are
    parsed where floats alone are not there, or blank lines are; what other rows hold is not looked at.
    """
    import polars as pl

    def error_at(reason: str) -> LogError:
        return _cell_error(layout, chunk, number, {} if where else index, reason)

    parsed: dict[str, Any] = {}
    try:
        frame = None if where else _parse_frame(layout, chunk, index.values(), pl.Float64)
    except (pl.exceptions.PolarsError, ValueError):
        frame = None
    if frame is not None and not (frame.to_series(0).null_count() and _BLANK_LINES.search(chunk)):
        parsed = {name: frame[f"column_{at}"].to_numpy() for name, at in index.items()}
        if any(np.isinf(values).any() for values in parsed.values()):
            raise error_at("a cell is infinite")
        return parsed
    try:
        frame = _parse_frame(layout, _BLANK_LINES.sub(b"", chunk), {*index.values(), *where}, pl.String)
    except (pl.exceptions.PolarsError, ValueError) as error:
        raise error_at(summarise_error(error)) from error
    for at, value in where.items():
        text = frame[f"column_{at}"].str.strip_chars()
        alike = text == str(value)
        if isinstance(value, int | float):
            alike |= text.cast(pl.Float64, strict=False).fill_null(float("nan")) == float(value)
        frame = frame.filter(alike.fill_null(False))
    for name, at in index.items():
        text = frame[f"column_{at}"].str.strip_chars()
        values = (text.str.replace(",", ".", literal=True) if layout.comma else text).cast(pl.Float64, strict=False)
        blank = text.str.to_lowercase().is_in(list(BLANK)).fill_null(True)
        wrong = text.filter(((values.is_null() & ~blank) | values.is_infinite()).fill_null(False))
        if len(wrong) and where:
            raise LogError(
                f'{layout.path}: "{str(wrong[0])[:60]}" in column "{name}" is not a finite number, in a row that where '
                "keeps; correct it"
            )
        if len(wrong):
            raise error_at("a cell is not a number")
        parsed[name] = values.to_numpy()
    return parsed


def _parse_frame(layout: TextLayout, chunk: bytes, columns: Collection[int], kind: Any) -> pl.DataFrame:
    import polars as pl

    delimiter, wanted = layout.delimiter, set(columns)
    if delimiter == " ":
        delimiter, chunk = "\t", re.sub(rb"(?m)^\t|\t(?=\r?$)", b"", _RUNS.sub(b"\t", chunk))
    return pl.read_csv(
        chunk,
        has_header=False,
        separator=delimiter,
        schema={f"column_{at}": kind if at in wanted else pl.String for at in range(layout.width)},
        columns=[f"column_{at}" for at in sorted(wanted)],
        decimal_comma=layout.comma,
        missing_columns="insert",
        extra_columns="raise",
        null_values=["NA", "na", "N/A", "n/a"],
    )


def _cell_error(layout: TextLayout, chunk: bytes, number: int, index: Mapping[str, int], reason: str) -> LogError:
    """Return the error that names the first cell, or row, that cannot be read."""
    lines = chunk.decode().rstrip().split("\n")
    for line, text in enumerate(lines, start=_find_first_line(layout, number)):
        row = split_cells(text.rstrip("\r"), layout.delimiter) if text.strip() else []
        if len(row) > layout.width:
            return LogError(
                f"{layout.path}: cannot be read as CSV (line {line} has {len(row)} columns and the header "
                f"{layout.width}); check that every row has the header's columns"
            )
        for name, at in index.items():
            cell = row[at] if at < len(row) else ""
            if cell.casefold() in BLANK:
                continue
            where = f'{layout.path}: line {line}: "{cell[:60]}" in column "{name}"'
            if not is_number(cell, layout.comma):
                if text is lines[-1] and at == len(row) - 1 and _BEGUN.fullmatch(cell):
                    return LogError(f"{where} is not a number: the last line is unfinished; remove it")
                points = ", or save the log with decimal points" if re.fullmatch(r"[-+]?\d+,\d+", cell) else ""
                return LogError(f"{where} is not a number; correct it{points}")
            if "inf" in cell.casefold():
                return LogError(f"{where} is not finite; leave the cell empty")
    return LogError(f"{layout.path}: cannot be read as CSV ({reason}); check that every row has the header's columns")
