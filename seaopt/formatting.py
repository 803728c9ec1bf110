"""Numbers, units and tables as people read them, in text, in HTML and in notebooks.

Every `__repr__`, `_repr_html_`, the report and the command line write what they have in common with these, so that a
missing number, an infinite one and a range look the same everywhere.
"""

from __future__ import annotations

import html
import json
import re
from collections.abc import Container, Iterable, Mapping, Sequence
from itertools import chain, count
from typing import Any, Literal

import numpy as np

MISSING = "–"
# All control characters but tab and line feed, what turns the direction of text, and halves of characters.
_UNPRINTABLE = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u200e\u200f\u202a-\u202e\u2066-\u2069\ud800-\udfff]")


def format_number(value: Any, digits: int = 4, missing: str = MISSING) -> str:
    """Return a number in few digits, "yes" or "no" for a flag, and `missing` where there is none."""
    if value is None or np.isnan(value) or value == -np.inf:
        return missing
    if isinstance(value, (bool, np.bool_)):
        return "yes" if value else "no"
    return "∞" if value == np.inf else f"{value:.{digits}g}"


def format_figure(value: Any, unit: str = "", digits: int = 4, missing: str = MISSING) -> str:
    """Return a number with its unit."""
    number = format_number(value, digits, missing)
    return number if number == missing else f"{number} {unit}".rstrip()


def format_percent(share: float, digits: int = 3, sign: Literal["", "+"] = "") -> str:
    """Return a share in percent, rounded to so many digits and never as a power of ten: "100 %", not "1e+02 %"."""
    return f"{float(f'{100.0 * share:.{digits}g}'):{sign}.12g} %"


def printable(text: str) -> str:
    r"""Return a text that a terminal shows and does not obey: no control characters, nor bytes that are no text."""
    return _UNPRINTABLE.sub(lambda match: match.group().encode("unicode_escape").decode(), text)


def format_band(ends: tuple[float, float] | None, unit: str = "", missing: str = "none") -> str:
    """Return a range with its unit, three digits of its low end and four of its high end."""
    return missing if ends is None else f"{format_number(ends[0], 3)} to {format_figure(ends[1], unit)}"


def format_values(values: Mapping[str, float], digits: int = 4, missing: str = MISSING) -> str:
    """Return names and their values."""
    return ", ".join(f"{name} = {format_number(value, digits)}" for name, value in values.items()) or missing


def format_count(count: int, noun: str) -> str:
    """Return a count with its noun."""
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def format_toml(value: Any) -> str:
    """Return a value as a problem file writes it."""
    if isinstance(value, Mapping):
        return f"{{ {format_keys(value)} }}" if value else "{}"  # pyright: ignore[reportUnknownArgumentType]
    if isinstance(value, (list, tuple)):
        return f"[{', '.join(map(format_toml, value))}]"  # pyright: ignore[reportUnknownArgumentType]
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007F")
    return str(value).lower() if isinstance(value, bool) else f"{value:.10g}"


def format_keys(keys: Mapping[str, Any]) -> str:
    """Return keys with their values as a problem file writes them, on one line."""
    return ", ".join(f"{format_key(name)} = {format_toml(value)}" for name, value in keys.items())


def format_key(name: str) -> str:
    """Return a key as a problem file writes it."""
    return name if re.fullmatch(r"[A-Za-z0-9_-]+", name) else format_toml(name)


def format_remedies(text: str, remedies: Sequence[Mapping[str, Any]]) -> str:
    """Return a text with what to write in a problem file at its end: one remedy, or another."""
    ways = [" and ".join(format_keys({name: value}) for name, value in keys.items()) for keys in remedies]
    return f"{text}; in a problem file: {', or '.join(ways)}" if ways else text


def tell_apart(name: str, taken: Container[str], between: str = "") -> str:
    """Return a name that is not taken: itself, or with 2, 3, ... at its end, `between` before the number."""
    return next(each for each in chain([name], (f"{name}{between}{k}" for k in count(2))) if each not in taken)


def join_words(words: Sequence[str]) -> str:
    """Return an enumeration."""
    return " and ".join([", ".join(words[:-1]), words[-1]] if len(words) > 1 else words)


def format_table(rows: Iterable[Sequence[str]], head: Sequence[str] | None = None, align: str = "") -> list[str]:
    """Return the lines of a table in aligned columns. `rows`: all of the same length. `head`: titles of the columns.
    `align`: "<" or ">" for each column; those without one are left aligned.
    """
    cells = [*([head] if head is not None else []), *rows]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    sides = align.ljust(len(widths), "<")
    lines = (zip(row, sides, widths, strict=True) for row in cells)
    return [
        "  ".join(cell.rjust(width) if side == ">" else cell.ljust(width) for cell, side, width in line).rstrip()
        for line in lines
    ]


def html_table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table of texts, its first row as head."""
    top = "".join(f"<th>{html.escape(cell)}</th>" for cell in head)
    body = "".join("<tr>" + "".join(f"<td>{html.escape(cell)}</td>" for cell in row) + "</tr>" for row in rows)
    return f"<table><thead><tr>{top}</tr></thead><tbody>{body}</tbody></table>"


def html_paragraph(text: str) -> str:
    """Return a paragraph."""
    return f"<p>{html.escape(text)}</p>"


def html_list(texts: Iterable[str]) -> str:
    """Return a list, or nothing where there is nothing to list."""
    lines = "".join(f"<li>{html.escape(text)}</li>" for text in texts)
    return f"<ul>{lines}</ul>" if lines else ""


def html_text(result: object) -> str:
    """Return what a result prints, for notebooks; a class whose text is a table takes it as its `_repr_html_`."""
    return f"<pre>{html.escape(repr(result))}</pre>"
