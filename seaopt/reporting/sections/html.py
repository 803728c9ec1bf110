"""Sections as HTML, for notebooks and for the page of the report, whose style sheet knows the classes."""

from __future__ import annotations

import html
from collections.abc import Iterable

from seaopt.formatting import printable
from seaopt.reporting.sections.data import Cell, Item, Section, Table, Verdict, mark_met
from seaopt.reporting.sections.glossary import explain_terms


def render_section(section: Section, *, title: bool = True) -> str:
    """Return a section; details are behind their title."""
    body = "".join(
        [
            *(f"<p>{_escape(text)}</p>" for text in section.sentences),
            *(
                _render_table(table.drop_empty(), table.label or section.title)
                for table in section.tables
                if table.rows
            ),
            *(f'<p class="note">{_escape(text)}</p>' for text in section.remarks),
            _render_items(section.items),
        ]
    )
    head = _escape(section.title)
    if section.folded:
        return f"<details><summary>{head}</summary>{body}</details>"
    aside = f' <span class="aside">{_escape(section.aside)}</span>' if section.aside else ""
    return (f"<h3>{head}{aside}</h3>" if title else "") + body


def render_verdict(verdict: Verdict) -> str:
    """Return a verdict with its reasons and what comes next."""
    mark = mark_met(verdict.met, *verdict.words)
    lines = [
        *(_escape(str(reason)) for reason in verdict.reasons),
        *(
            f"next: {_escape(step.text)}" + (f"<pre>{_escape(chr(10).join(step.copied))}</pre>" if step.copied else "")
            for step in verdict.next
        ),
    ]
    reasons = "".join(f"<li>{line}</li>" for line in lines)
    return f"<p>{_render_cell(mark)} {_escape(verdict.text)}</p>" + (f"<ul>{reasons}</ul>" if reasons else "")


def _render_items(items: Iterable[Item]) -> str:
    lines = "".join(f'<li><b class="{item.severity}">{item.severity}</b> {_escape(item.text)}</li>' for item in items)
    return f'<ul class="findings">{lines}</ul>' if lines else ""


def _render_table(table: Table, label: str) -> str:
    sides = [' class="n"' if side == ">" else "" for side in table.align.ljust(len(table.head), "<")]
    heads = zip(map(_escape, table.head), sides, strict=True)
    head = "".join(f'<th scope="col"{side}>{explain_terms(text)}</th>' for text, side in heads)
    rows = "".join(
        "<tr>"
        + "".join(f"<td{side}>{_render_cell(cell)}</td>" for cell, side in zip(row, sides, strict=True))
        + "</tr>"
        for row in table.rows
    )
    top = f"<thead><tr>{head}</tr></thead>" if any(table.head) else ""
    opening = f'<div class="wide" role="region" aria-label="{_escape(label)}" tabindex="0">'
    return f"{opening}<table>{top}<tbody>{rows}</tbody></table></div>"


def _render_cell(cell: Cell) -> str:
    return (
        f'<b class="{cell.style}">{_escape(cell.text)}</b>'
        if not isinstance(cell, str)
        else explain_terms(_escape(cell))
    )


def _escape(text: str) -> str:
    return html.escape(printable(text))
