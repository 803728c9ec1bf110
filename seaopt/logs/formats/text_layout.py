"""How a text file is laid out: encoding, delimiter, decimal sign, banner, headers, units row, first line of data.

Everything is read off the first lines: the delimiter is the one that cuts most cells into numbers, the data start at
the first line of that width which is mostly numbers, and what stands above it is banner or header.
"""

from __future__ import annotations

import codecs
import csv
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path

from seaopt.errors import LogError
from seaopt.formatting import format_count
from seaopt.logs.formats.source import Field
from seaopt.records import record
from seaopt.units import bare_name, header_unit, is_unit

MAX_LINE = 1 << 20
HEAD_BYTES = 2 * MAX_LINE  # bytes in which the data must begin
TAIL_BYTES, MAX_SHOWN = 4096, 40  # of the end of a file that are looked at, and characters of it that are shown
HEAD_LINES = 2000  # lines in which the data must begin
SAMPLE_LINES = 200  # lines that decide on delimiter and decimal sign
COMMENTS = ("#", "%", "//")
BLANK = frozenset({"", "nan", "na", "n/a"})
_NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?|[-+]?inf(inity)?", re.IGNORECASE | re.ASCII)
_CONSTANT = re.compile(
    r"(?P<name>[^=:;,\t|]{1,80}?)\s*[=:;,\t|]\s*\"?(?P<value>[-+]?[\d.,]+(?:[eE][-+]?\d+)?)\"?\s*[;,\t|]?\s*"
    r"(?P<unit>[^\d=:;,\t|][^=:;,\t|]{0,19})?"
)
# Delimiters, each with a decimal point and a decimal comma.
_CHOICES = [(delimiter, comma) for delimiter in ("\t", ";", "|", ",", " ") for comma in (False, True)]
_CHOICES.remove((",", True))
WINDOWS = "cp1252"  # of which Latin-1's signs and letters are a part
_BOMS = ((codecs.BOM_UTF8, "utf-8-sig"), (codecs.BOM_UTF16_LE, "utf-16"), (codecs.BOM_UTF16_BE, "utf-16"))


@record
class TextLayout:
    """How a text file is laid out."""

    path: Path
    encoding: str
    delimiter: str  # a space stands for any run of blanks
    comma: bool  # whether the decimal sign is a comma
    width: int  # cells in a row
    first: int  # lines above the data
    fields: tuple[Field, ...]  # the columns that have a header
    notes: tuple[str, ...]
    constants: Mapping[str, tuple[float, str | None]]  # lines above the data such as "kp = 200" or "mass [kg]; 0.5"


def find_layout(path: Path) -> TextLayout:
    """Return a text file's layout. Raises LogError: it is empty, not text, has a line beyond 1 MiB, or no data."""
    encoding, lines = _read_head(path)
    filled = [(at, line) for at, line in enumerate(lines) if line.strip() and not _is_comment(line)]
    if not filled:
        raise LogError(f"{path}: the file holds no data, only comments or blank lines; record the log again")
    sample = [line for _, line in filled[-SAMPLE_LINES:]]
    delimiter, comma = _find_delimiter(sample, filled[0][1])
    # The usual number of cells is the number of columns; a short row lacks its last cells.
    width = Counter(len(split_cells(line, delimiter)) for line in sample).most_common(1)[0][0]
    first = next((at for at, line in filled if _is_data(line, delimiter, comma, width)), None)
    if first is None:  # the header is the first line, and text stands in every row below it
        first = filled[1][0] if len(filled) > 1 else len(lines)
    if first >= len(lines):
        raise LogError(f"{path}: 0 rows below the header; record the log again")
    data = [line for at, line in filled if at >= first]
    if encoding == WINDOWS and (odd := next((line for line in data if not line.isascii()), None)) is not None:
        # Among the data such bytes may be damage, and not a header's µ or °.
        raise LogError(
            f'{path}: is not UTF-8 text ("{odd[:40]}"); save the log as UTF-8 CSV, or convert it: '
            f"iconv -f WINDOWS-1252 -t UTF-8 {path.name} > utf8_{path.name}"
        )
    rows = [split_cells(line, delimiter) for line in data]
    headers, units, notes = _find_headers(path, lines[:first], delimiter, width, rows)
    counts = Counter(headers)
    fields = tuple(
        Field(
            name=_number_header(header, at + 1) if counts[header] > 1 else header,
            kind="float64" if _is_numeric(rows, at, comma) else "text",
            length=None,
            unit=unit,
            position=at + 1,
            header=header if counts[header] > 1 else None,
        )
        for at, (header, unit) in enumerate(zip(headers, units, strict=True))
        if header
    )
    if comma:
        notes.append("the decimal sign is a comma")
    if (unended := _read_unended(path, encoding)) is not None:
        notes.append(
            f'its last line does not end: "{unended}"; where the file was cut, its last number lacks digits: record it '
            "again, or complete that line"
        )
    if encoding == WINDOWS:
        signs = sorted({sign for line in lines[:first] for sign in line if not sign.isascii()})
        notes.append(f"its header is no UTF-8 text and was read as Windows-1252: {' '.join(signs)}")
    if repeated := [field.name for field in fields if field.header]:
        named = ", ".join(repeated[:4]) + (", ..." if len(repeated) > 4 else "")
        notes.append(f"headers that several columns have were numbered: {named}")
    return TextLayout(
        path=path,
        encoding=encoding,
        delimiter=delimiter,
        comma=comma,
        width=len(headers),
        first=first,
        fields=fields,
        notes=tuple(notes),
        constants=_find_constants(lines[:first], delimiter, comma),
    )


def _number_header(header: str, number: int) -> str:
    """Return the header of a column that others have, too, with its number before the brackets."""
    bare = bare_name(header)
    return f"{bare}#{number}{header[len(bare) :]}"


def _read_unended(path: Path, encoding: str) -> str | None:
    """Return the end of the last line where nothing ends it: it may have been cut anywhere, a number too."""
    with path.open("rb") as stream:
        order = "be" if stream.read(2) == codecs.BOM_UTF16_BE else "le"
        stream.seek(max(stream.seek(0, 2) - TAIL_BYTES, 0))
        tail = stream.read().decode(f"utf-16-{order}" if encoding == "utf-16" else encoding, errors="replace")
    lines = re.split(r"[\r\n]", tail.rstrip("\x1a\x00 \t"))
    return lines[-1].strip()[-MAX_SHOWN:] or None


def _find_constants(above: list[str], delimiter: str, comma: bool) -> dict[str, tuple[float, str | None]]:
    """Return the constants above the data: a name, a sign or delimiter, a number, and a unit where there is one."""
    constants: dict[str, tuple[float, str | None]] = {}
    for line in above:
        match = _CONSTANT.fullmatch(line.lstrip("#%/; \t").rstrip(f";, {delimiter}"))
        if match is None or not is_number(match["value"], comma):
            continue
        number = match["value"].replace(",", ".", 1) if comma else match["value"]
        name, bracket = bare_name(match["name"].strip()), header_unit(match["name"].strip())
        unit = (match["unit"] or "").strip("[]() ") or bracket
        constants.setdefault(name, (float(number), unit if unit is None or is_unit(unit) else None))
    return constants


def split_cells(line: str, delimiter: str) -> list[str]:
    """Return the cells of a line, stripped."""
    if delimiter == " ":
        return line.split()
    if '"' in line:
        line_cells = next(csv.reader([line], delimiter=delimiter, skipinitialspace=True), [])
        return [cell.strip() for cell in line_cells]
    return [cell.strip() for cell in line.split(delimiter)]


def is_number(cell: str, comma: bool) -> bool:
    """Return whether a cell is a number, or infinite."""
    return _NUMBER.fullmatch(cell.replace(",", ".", 1) if comma else cell) is not None


def _read_head(path: Path) -> tuple[str, list[str]]:
    """Return the encoding and the first lines, the last one only if it is whole."""
    with path.open("rb") as stream:
        raw = stream.read(HEAD_BYTES)
    if not raw.strip(b" \t\r\n\x1a\x00"):
        raise LogError(f"{path}: the file is empty; record the log again")
    encoding = next((name for bom, name in _BOMS if raw.startswith(bom)), "utf-8")
    if encoding != "utf-16" and b"\x00" in raw[:4096]:
        line = raw.count(b"\n", 0, raw.index(0)) + 1
        raise LogError(f"{path}: line {line} holds a zero byte, it is not a text file; save the log as CSV")
    encoding, text = _decode(path, encoding, raw)
    whole = len(raw) < HEAD_BYTES
    lines = text.rstrip("\x1a" if whole else "").split("\n", HEAD_LINES)
    more = len(lines) > HEAD_LINES  # the last item is all that is left
    for number, line in enumerate(lines[:HEAD_LINES], start=1):
        if len(line) > MAX_LINE:
            raise line_length_error(path, number)
    if not whole or more:
        lines.pop()
    if len(lines) <= 1 and "\r" in text.rstrip("\r\n"):
        raise LogError(f"{path}: its lines end in CR alone; save it with LF line ends")
    return encoding, [line.rstrip("\r") for line in lines]


def _decode(path: Path, encoding: str, raw: bytes) -> tuple[str, str]:
    """Return the encoding of a file's first bytes, and their text: Windows-1252 where they are no UTF-8."""

    def decode(name: str) -> str:
        return codecs.getincrementaldecoder(name)().decode(raw, final=len(raw) < HEAD_BYTES)

    try:
        return encoding, decode(encoding)
    except UnicodeError as error:
        refused = encoding_error(path, encoding, error)
        if encoding != "utf-8":
            raise refused from error
        try:
            return WINDOWS, decode(WINDOWS)
        except UnicodeError:
            raise refused from error


def encoding_error(path: Path, encoding: str, error: UnicodeError) -> LogError:
    """Return the error of a byte that is not text."""
    name = {"utf-16": "UTF-16", WINDOWS: "Windows-1252"}.get(encoding, "UTF-8")
    at = f"byte {error.start}" if isinstance(error, UnicodeDecodeError) else "no text"
    return LogError(f"{path}: is not {name} text ({at}); save the log as UTF-8 CSV")


def line_length_error(path: Path, line: int) -> LogError:
    """Return the error of a line that no log has."""
    return LogError(f"{path}: line {line} is longer than {MAX_LINE >> 20} MiB; is it a log? save one row per line")


def _is_comment(line: str) -> bool:
    return line.lstrip().startswith(COMMENTS)


def _find_delimiter(sample: list[str], header: str) -> tuple[str, bool]:
    """Return the delimiter and decimal sign that make most cells numbers."""
    scores = {choice: _score(sample, *choice) for choice in _CHOICES}
    best = max(_CHOICES, key=scores.__getitem__)
    return best if scores[best] > 0 else (max(",;\t|", key=header.count), False)


def _score(sample: list[str], delimiter: str, comma: bool) -> float:
    rows = [split_cells(line, delimiter) for line in sample]
    width, count = Counter(map(len, rows)).most_common(1)[0]
    if width < 2:
        return 0.0
    filled = [cell for row in rows for cell in row if cell.casefold() not in BLANK]
    numbers = sum(is_number(cell, comma) for cell in filled)
    # A point is read either way; a comma only where it occurs.
    bonus = 1e-6 if comma == any("," in cell for cell in filled if is_number(cell, comma)) else 0.0
    return (count / len(rows)) * numbers / max(len(filled), 1) + (bonus if numbers else 0.0)


def _is_data(line: str, delimiter: str, comma: bool, width: int) -> bool:
    row = split_cells(line, delimiter)
    filled = [cell for cell in row if cell.casefold() not in BLANK]
    numbers = sum(is_number(cell, comma) for cell in filled)
    return len(row) == width and numbers > 0 and 2 * numbers >= len(filled)


def _is_numeric(rows: list[list[str]], index: int, comma: bool) -> bool:
    """Return whether a column's first filled cell is a number; a column that starts empty may still hold some."""
    for row in rows:
        if index < len(row) and row[index].casefold() not in BLANK:
            return is_number(row[index], comma)
    return True


def _find_headers(
    path: Path, above: list[str], delimiter: str, width: int, rows: list[list[str]]
) -> tuple[list[str], list[str | None], list[str]]:
    """Return header and unit of each column, and what was found above the data."""
    notes: list[str] = []
    above = _join_quoted_lines(above)
    candidates = [(at, _split_header(line, delimiter)) for at, line in enumerate(above) if line.strip()]
    table = [(at, row) for at, row in candidates if not _is_comment(above[at])]
    fitting = [(at, row) for at, row in table if _fits(row, width, rows) and sum(map(bool, row)) > min(1, width - 1)]
    header_rows = [(at, row) for at, row in fitting if not _CONSTANT.fullmatch(above[at].strip())] or fitting
    if not header_rows and table:  # a lone line above the data is the header, whatever its width
        at, row = table[-1]
        raise LogError(
            f"{path}: cannot be read as CSV (line {at + 1} has {len(row)} columns and the rows below have {width}); "
            "check that every row has the header's columns, and that a decimal comma is not the delimiter as well"
        )
    if not header_rows:
        header_rows = [(at, row) for at, row in candidates if len(row) == width][-1:]
    skipped = len(candidates) - len(header_rows)
    if skipped:
        notes.append(f"{format_count(skipped, 'line')} above the header passed over")
    if not header_rows:
        notes.append("no header was found; columns are numbered from 1")
        return [f"column {index + 1}" for index in range(width)], [None] * width, notes
    units: list[str | None] = [None] * width
    if len(header_rows) > 1 and _is_units_row(header_rows[-1][1]):
        notes.append(f"line {header_rows[-1][0] + 1} was read as the units")
        units = [_strip_brackets(cell) for cell in _pad(header_rows.pop()[1], width)]
    if len(header_rows) > 1:
        notes.append(f"{len(header_rows)} header lines were joined")
    names = zip(*(_pad(row, width) for _, row in header_rows), strict=True)
    headers = [" ".join(cell for cell in column if cell) for column in names]
    return headers, [unit or header_unit(name) for unit, name in zip(units, headers, strict=True)], notes


def _join_quoted_lines(lines: Sequence[str]) -> list[str]:
    """Return lines of which one that a quoted cell breaks (RFC 4180) is whole, with empty ones for the rest of it."""
    joined = list(lines)
    start: int | None = None
    for at, line in enumerate(lines):
        broken = line.count('"') % 2 == 1
        if start is None:
            start = at if broken else None
        elif broken:
            joined[start : at + 1] = [" ".join(lines[start : at + 1]), *[""] * (at - start)]
            start = None
    return joined


def _split_header(line: str, delimiter: str) -> list[str]:
    if _is_comment(line):
        line = line.lstrip().lstrip("#%/").strip()
    if delimiter != " ":
        return split_cells(line, delimiter)
    joined: list[str] = []  # "time [s]" is one header
    for token in line.split():
        if joined and token[0] in "[(":
            joined[-1] += f" {token}"
        else:
            joined.append(token)
    return joined


def _fits(row: list[str], width: int, rows: list[list[str]]) -> bool:
    """Return whether a line can be the header: as wide as the data, but for cells that are empty in every row."""
    if len(row) >= width:
        return not any(row[width:]) or all(len(data) <= len(row) for data in rows)
    return len(row) > 0 and not any(cell for data in rows for cell in data[len(row) :])


def _pad(row: list[str], width: int) -> list[str]:
    return (row + [""] * width)[:width]


def _strip_brackets(cell: str) -> str | None:
    return cell.strip("[]() ") or None


def _is_units_row(row: list[str]) -> bool:
    filled = [unit for cell in row if (unit := _strip_brackets(cell))]
    return bool(filled) and all(is_unit(unit) for unit in filled)
