"""HTML for notebooks: what `_repr_html_` of results is made of, every text escaped."""

from __future__ import annotations

import html
from collections.abc import Iterable, Sequence


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table of texts, its first row as head.

    Examples
    --------
    >>> table(["name"], [["Ms < 1.6"]])
    '<table><thead><tr><th>name</th></tr></thead><tbody><tr><td>Ms &lt; 1.6</td></tr></tbody></table>'

    """
    top = "".join(f"<th>{html.escape(cell)}</th>" for cell in head)
    body = "".join("<tr>" + "".join(f"<td>{html.escape(cell)}</td>" for cell in row) + "</tr>" for row in rows)
    return f"<table><thead><tr>{top}</tr></thead><tbody>{body}</tbody></table>"


def paragraph(text: str) -> str:
    """Return a paragraph.

    Examples
    --------
    >>> paragraph("a & b")
    '<p>a &amp; b</p>'

    """
    return f"<p>{html.escape(text)}</p>"


def items(texts: Iterable[str]) -> str:
    """Return a list, or nothing where there is nothing to list.

    Examples
    --------
    >>> items(["a"]), items([])
    ('<ul><li>a</li></ul>', '')

    """
    lines = "".join(f"<li>{html.escape(text)}</li>" for text in texts)
    return f"<ul>{lines}</ul>" if lines else ""


def figure(value: float | None, unit: str = "") -> str:
    """Return a number in four digits with its unit, or a dash.

    Examples
    --------
    >>> figure(1.23456, "Hz"), figure(None), figure(7)
    ('1.235 Hz', '–', '7')

    """
    return "–" if value is None else f"{value:.4g} {unit}".rstrip()
