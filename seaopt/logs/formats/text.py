"""CSV and other delimited text, parsed by polars in blocks of whole lines.

A block is parsed to floats at once; only where that fails is it parsed as text, and only where a cell is not a number
is it walked line by line, to name that cell. Memory holds the wanted columns and one block.
"""

from __future__ import annotations

import codecs
import re
from collections import Counter, deque
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing
from functools import partial
from itertools import islice
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from seaopt.errors import LogError
from seaopt.logs.formats.source import Field, Source, Where, summarise_error
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
from seaopt.units import bare_name

if TYPE_CHECKING:
    import polars as pl

BLOCK_BYTES = 4 << 20
BLOCKS_AHEAD = 2  # blocks that are parsed while the next one is read and the last one is stored
_RUNS = re.compile(rb"[ \t]+")
_BLANK_LINES = re.compile(rb"(?m)^[ \t]*\r?\n")


def open_text(path: Path) -> Source:
    """List a text file's columns."""
    form = find_layout(path)
    names = _name_columns(form.headers)
    fields = tuple(
        Field(
            name=name,
            kind="float64" if numeric else "text",
            length=None,
            unit=unit,
            position=at,
            header=header if header != name else None,
        )
        for at, (name, header, unit, numeric) in enumerate(
            zip(names, form.headers, form.units, form.numeric, strict=True), start=1
        )
        if name
    )
    repeated = [field.name for field in fields if field.header is not None]
    notes = form.notes
    if repeated:
        named = ", ".join(repeated[:4]) + (", ..." if len(repeated) > 4 else "")
        notes = (*notes, f"headers that several columns have were numbered: {named}")
    return Source(
        path=path,
        format="CSV",
        fields=fields,
        load=lambda names, _: _load_blocks(path, form, names, _parse),  # without an index a window reads it whole
        notes=notes,
        constants=form.constants,
        load_where=partial(_load_where, path, form),
    )


def _name_columns(headers: Sequence[str]) -> list[str]:
    """Return the columns' names: a header that several have, with each one's number before its brackets.

    Examples
    --------
    >>> _name_columns(["X [s]", "Y", "X [s]", ""])
    ['X#1 [s]', 'Y', 'X#3 [s]', '']

    """
    names: list[str] = []
    counts = Counter(headers)
    for at, header in enumerate(headers, start=1):
        bare = bare_name(header)
        repeated = bool(header) and counts[header] > 1
        names.append(f"{bare}#{at}{header[len(bare) :]}" if repeated else header)
    return names


def _place_columns(form: TextLayout) -> dict[str, int]:
    return {name: at for at, name in enumerate(_name_columns(form.headers)) if name}


def _load_where(path: Path, form: TextLayout, names: Sequence[str], where: Where) -> dict[str, Float[np.ndarray, " n"]]:
    """Return columns of the rows in which others have given values."""
    places = _place_columns(form)
    return _load_blocks(path, form, names, partial(_parse_where, {places[name]: at for name, at in where.items()}))


def _load_blocks(
    path: Path, form: TextLayout, names: Sequence[str], parse: Callable[..., dict[str, Any]]
) -> dict[str, Float[np.ndarray, " n"]]:
    places = _place_columns(form)
    index = {name: places[name] for name in names}
    columns = _GrowingColumns(names)
    size = path.stat().st_size
    pending: deque[tuple[float, Future[dict[str, Any]]]] = deque()
    try:
        with closing(_read_blocks(path, form)) as blocks, ThreadPoolExecutor(BLOCKS_AHEAD) as pool:
            for number, block in enumerate(blocks):
                if not block.isspace():
                    pending.append((size / len(block), pool.submit(parse, path, form, block, index, number)))
                if len(pending) > BLOCKS_AHEAD:
                    columns.add(*pending.popleft())
            while pending:
                columns.add(*pending.popleft())
    except UnicodeError as error:
        raise encoding_error(path, form.encoding, error) from error
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

    def finish(self) -> dict[str, Float[np.ndarray, " n"]]:
        for array in self.arrays.values():
            array.resize(self.rows, refcheck=False)
        return self.arrays


def _read_blocks(path: Path, form: TextLayout) -> Generator[bytes]:
    """Return blocks of whole lines as UTF-8."""
    wide = form.encoding == "utf-16"
    with path.open(encoding=form.encoding, newline="\n") if wide else path.open("rb") as stream:
        for _ in range(form.first):
            stream.readline()
        number = 0
        while block := _read_block(stream, form):
            _check_lines(path, form, block, number)
            if not number:
                block = block.removeprefix(codecs.BOM_UTF8)
            if len(block) < BLOCK_BYTES:  # the last one may end in blank lines, and in the end-of-file mark of DOS
                block = block.rstrip(b"\x1a \t\r\n") + b"\n"
            yield block
            number += 1


def _read_block(stream: IO[Any], form: TextLayout) -> bytes:
    """Return the next block, up to the end of a line."""
    if form.encoding == "utf-16":
        return (stream.read(BLOCK_BYTES) + stream.readline(MAX_LINE + 1)).encode()
    start = stream.tell()
    stream.seek(start + BLOCK_BYTES)
    stream.readline(MAX_LINE + 1)
    end = stream.tell()
    stream.seek(start)
    block = stream.read(end - start)
    return block.decode(WINDOWS).encode() if form.encoding == WINDOWS else block


def _find_first_line(path: Path, form: TextLayout, number: int) -> int:
    """Return the line on which a block begins; counted only to name a line, as it takes a while."""
    with closing(_read_blocks(path, form)) as blocks:
        return form.first + 1 + sum(block.count(b"\n") for block in islice(blocks, number))


def _check_lines(path: Path, form: TextLayout, block: bytes, number: int) -> None:
    start = 0
    while len(block) - start > MAX_LINE:
        end = block.rfind(b"\n", start, start + MAX_LINE)
        if end < start:
            raise line_length_error(path, _find_first_line(path, form, number) + block.count(b"\n", 0, start))
        start = end + 1


def _parse(path: Path, form: TextLayout, block: bytes, index: dict[str, int], number: int) -> dict[str, Any]:
    import polars as pl

    def error_at(reason: str) -> LogError:
        return _cell_error(path, form, block, index, _find_first_line(path, form, number), reason)

    try:
        frame = _parse_frame(_replace_blanks(block, form), form, index, pl.Float64)
    except (pl.exceptions.PolarsError, ValueError):
        return _parse_text(form, block, index, error_at)
    if frame.to_series(0).null_count() and _BLANK_LINES.search(block):
        return _parse_text(form, block, index, error_at)
    parsed = {name: frame[f"column_{at}"].to_numpy() for name, at in index.items()}
    if any(np.isinf(values).any() for values in parsed.values()):
        raise error_at("a cell is infinite")
    return parsed


def _parse_where(
    ids: dict[int, str | float], path: Path, form: TextLayout, block: bytes, index: dict[str, int], number: int
) -> dict[str, Any]:
    """Parse the rows of a block in which the columns `ids` have their values; what the others hold is not looked at."""
    import polars as pl

    wanted = {**index, **{f"id {at}": at for at in ids}}
    try:
        frame = _parse_frame(_replace_blanks(_BLANK_LINES.sub(b"", block), form), form, wanted, pl.String)
    except (pl.exceptions.PolarsError, ValueError) as error:
        line = _find_first_line(path, form, number)
        raise _cell_error(path, form, block, {}, line, summarise_error(error)) from error
    for at, value in ids.items():
        text = frame[f"column_{at}"].str.strip_chars()
        alike = text == str(value)
        if isinstance(value, int | float):
            alike |= text.cast(pl.Float64, strict=False).fill_null(float("nan")) == float(value)
        frame = frame.filter(alike.fill_null(False))
    parsed: dict[str, Any] = {}
    for name, at in index.items():
        parsed[name], wrong = _parse_numbers(frame[f"column_{at}"], form)
        if len(wrong):
            raise LogError(
                f'{path}: "{str(wrong[0])[:60]}" in column "{name}" is not a finite number, in a row that where keeps; '
                "correct it"
            )
    return parsed


def _parse_numbers(column: pl.Series, form: TextLayout) -> tuple[Float[np.ndarray, " n"], pl.Series]:
    """Return a column of texts as numbers, nan where it is blank, and the cells that are no finite number."""
    import polars as pl

    text = column.str.strip_chars()
    values = (text.str.replace(",", ".", literal=True) if form.comma else text).cast(pl.Float64, strict=False)
    wrong = (values.is_null() & ~text.str.to_lowercase().is_in(list(BLANK)).fill_null(True)) | values.is_infinite()
    return values.to_numpy(), text.filter(wrong.fill_null(False))


def _replace_blanks(block: bytes, form: TextLayout) -> bytes:
    """Return a block whose delimiter is one byte."""
    return re.sub(rb"(?m)^\t|\t(?=\r?$)", b"", _RUNS.sub(b"\t", block)) if form.delimiter == " " else block


def _parse_frame(block: bytes, form: TextLayout, index: dict[str, int], kind: Any) -> pl.DataFrame:
    import polars as pl

    wanted = set(index.values())
    schema = {f"column_{at}": kind if at in wanted else pl.String for at in range(len(form.headers))}
    return pl.read_csv(
        block,
        has_header=False,
        separator="\t" if form.delimiter == " " else form.delimiter,
        schema=schema,
        columns=[f"column_{at}" for at in sorted(wanted)],
        decimal_comma=form.comma,
        missing_columns="insert",
        extra_columns="raise",
        null_values=["NA", "na", "N/A", "n/a"],
    )


def _parse_text(
    form: TextLayout, block: bytes, index: dict[str, int], error_at: Callable[[str], LogError]
) -> dict[str, Any]:
    """Parse a block with blank lines, or with blanks around its numbers; what is still no number is named."""
    import polars as pl

    try:
        frame = _parse_frame(_replace_blanks(_BLANK_LINES.sub(b"", block), form), form, index, pl.String)
    except (pl.exceptions.PolarsError, ValueError) as error:
        raise error_at(summarise_error(error)) from error
    parsed: dict[str, Any] = {}
    for name, at in index.items():
        parsed[name], wrong = _parse_numbers(frame[f"column_{at}"], form)
        if len(wrong):
            raise error_at("a cell is not a number")
    return parsed


def _cell_error(path: Path, form: TextLayout, block: bytes, index: dict[str, int], line: int, reason: str) -> LogError:
    """Return the error that names the first cell, or row, that cannot be read."""
    for number, text in enumerate(block.decode().split("\n"), start=line):
        row = split_cells(text.rstrip("\r"), form.delimiter) if text.strip() else []
        if len(row) > len(form.headers):
            return LogError(
                f"{path}: cannot be read as CSV (line {number} has {len(row)} columns and the header "
                f"{len(form.headers)}); check that every row has the header's columns"
            )
        for name, at in index.items():
            cell = row[at] if at < len(row) else ""
            if cell.casefold() in BLANK:
                continue
            where = f'{path}: line {number}: "{cell[:60]}" in column "{name}"'
            if "inf" in cell.casefold() and is_number(cell, form.comma):
                return LogError(f"{where} is not finite; leave the cell empty")
            if not is_number(cell, form.comma):
                decimal = re.fullmatch(r"[-+]?\d+,\d+", cell) is not None
                return LogError(
                    f"{where} is not a number; correct it{', or save the log with decimal points' if decimal else ''}"
                )
    return LogError(f"{path}: cannot be read as CSV ({reason}); check that every row has the header's columns")
