"""CSV and other delimited text, parsed by polars in blocks of whole lines.

A block is parsed to floats at once; only where that fails is it parsed as text, and only where a cell is not a number
is it walked line by line, to name that cell. Memory holds the wanted columns and one block.
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

BLOCK_BYTES = 4 << 20
BLOCKS_AHEAD = 2  # blocks that are parsed while the next one is read and the last one is stored
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
        load=lambda names, _: _load_blocks(layout, names, {}),  # without an index a window reads it whole
        notes=layout.notes,
        constants=layout.constants,
        load_where=partial(_load_blocks, layout),
    )


def _load_blocks(layout: TextLayout, names: Sequence[str], where: Where) -> dict[str, VectorN]:
    """Return columns of the rows in which others have given values; of all rows without any."""
    places = {field.name: (field.position or 1) - 1 for field in layout.fields}
    index, values = {name: places[name] for name in names}, {places[name]: value for name, value in where.items()}
    columns = _GrowingColumns(names)
    size = layout.path.stat().st_size
    pending: deque[tuple[float, Future[dict[str, Any]]]] = deque()
    try:
        with closing(_read_blocks(layout)) as blocks, ThreadPoolExecutor(BLOCKS_AHEAD) as pool:
            for number, block in enumerate(blocks):
                if not block.isspace():
                    parsed = pool.submit(_parse, layout, block, number, index, values)
                    pending.append((size / len(block), parsed))
                if len(pending) > BLOCKS_AHEAD:
                    columns.add(*pending.popleft())
            while pending:
                columns.add(*pending.popleft())
    except UnicodeError as error:
        raise encoding_error(layout.path, layout.encoding, error) from error
    return columns.finish()


class _GrowingColumns:
    """Arrays that grow block by block, sized by the first block so that they are rarely moved."""

    def __init__(self, names: Sequence[str]) -> None:
        self.rows = 0
        self.arrays: dict[str, np.ndarray] = {name: np.empty(0) for name in names}

    def add(self, blocks: float, future: Future[dict[str, Any]]) -> None:
        parsed = future.result()
        count = next(iter(parsed.values())).size
        stop = self.rows + count
        for name, values in parsed.items():
            array = self.arrays[name]
            if not self.rows:  # not filled, so that memory is taken as it is written
                array = self.arrays[name] = np.empty(int(count * max(blocks, 1.0) * 1.02) + 1)
            elif stop > array.size:
                array.resize(int(stop * 1.25), refcheck=False)
            array[self.rows : stop] = values
        self.rows = stop

    def finish(self) -> dict[str, VectorN]:
        for array in self.arrays.values():
            array.resize(self.rows, refcheck=False)
        return self.arrays


def _read_blocks(layout: TextLayout) -> Generator[bytes]:
    """Return blocks of whole lines as UTF-8."""
    wide = layout.encoding == "utf-16"
    with layout.path.open(encoding=layout.encoding, newline="\n") if wide else layout.path.open("rb") as stream:
        for _ in range(layout.first):
            stream.readline()
        number = 0
        while block := _read_block(stream, layout.encoding):
            _check_lines(layout, block, number)
            if not number:
                block = block.removeprefix(codecs.BOM_UTF8)
            if len(block) < BLOCK_BYTES:  # the last one may end in blank lines, and in the end-of-file mark of DOS
                block = block.rstrip(b"\x1a \t\r\n") + b"\n"
            yield block
            number += 1


def _read_block(stream: IO[Any], encoding: str) -> bytes:
    """Return the next block, up to the end of a line."""
    if encoding == "utf-16":
        return (stream.read(BLOCK_BYTES) + stream.readline(MAX_LINE + 1)).encode()
    start = stream.tell()
    stream.seek(start + BLOCK_BYTES)
    stream.readline(MAX_LINE + 1)
    end = stream.tell()
    stream.seek(start)
    block = stream.read(end - start)
    return block.decode(WINDOWS).encode() if encoding == WINDOWS else block


def _find_first_line(layout: TextLayout, number: int) -> int:
    """Return the line on which a block begins; counted only to name a line, as it takes a while."""
    with closing(_read_blocks(layout)) as blocks:
        return layout.first + 1 + sum(block.count(b"\n") for block in islice(blocks, number))


def _check_lines(layout: TextLayout, block: bytes, number: int) -> None:
    start = 0
    while len(block) - start > MAX_LINE:
        end = block.rfind(b"\n", start, start + MAX_LINE)
        if end < start:
            raise line_length_error(layout.path, _find_first_line(layout, number) + block.count(b"\n", 0, start))
        start = end + 1


def _parse(
    layout: TextLayout, block: bytes, number: int, index: Mapping[str, int], where: Mapping[int, str | float]
) -> dict[str, Any]:
    """Return the columns of a block, by name; with `where` of the rows in which columns have these values. Texts are
    parsed where floats alone are not there, or blank lines are; what other rows hold is not looked at.
    """
    import polars as pl

    def error_at(reason: str) -> LogError:
        return _cell_error(layout, block, number, {} if where else index, reason)

    parsed: dict[str, Any] = {}
    try:
        frame = None if where else _parse_frame(layout, block, index.values(), pl.Float64)
    except (pl.exceptions.PolarsError, ValueError):
        frame = None
    if frame is not None and not (frame.to_series(0).null_count() and _BLANK_LINES.search(block)):
        parsed = {name: frame[f"column_{at}"].to_numpy() for name, at in index.items()}
        if any(np.isinf(values).any() for values in parsed.values()):
            raise error_at("a cell is infinite")
        return parsed
    try:
        frame = _parse_frame(layout, _BLANK_LINES.sub(b"", block), {*index.values(), *where}, pl.String)
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


def _parse_frame(layout: TextLayout, block: bytes, columns: Collection[int], kind: Any) -> pl.DataFrame:
    import polars as pl

    delimiter, wanted = layout.delimiter, set(columns)
    if delimiter == " ":
        delimiter, block = "\t", re.sub(rb"(?m)^\t|\t(?=\r?$)", b"", _RUNS.sub(b"\t", block))
    return pl.read_csv(
        block,
        has_header=False,
        separator=delimiter,
        schema={f"column_{at}": kind if at in wanted else pl.String for at in range(layout.width)},
        columns=[f"column_{at}" for at in sorted(wanted)],
        decimal_comma=layout.comma,
        missing_columns="insert",
        extra_columns="raise",
        null_values=["NA", "na", "N/A", "n/a"],
    )


def _cell_error(layout: TextLayout, block: bytes, number: int, index: Mapping[str, int], reason: str) -> LogError:
    """Return the error that names the first cell, or row, that cannot be read."""
    lines = block.decode().rstrip().split("\n")
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
