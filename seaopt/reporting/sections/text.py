"""Sections as lines of text that fit a width: for `repr`, for the terminal, which colours them, and for comments in C.

Nothing is cut. A table that is too wide breaks its heads, leaves out what is optional, breaks its texts, and at last
continues below with its first column repeated.
"""

from __future__ import annotations

import textwrap
from collections.abc import Iterable, Iterator, Sequence
from itertools import zip_longest

from seaopt.formatting import printable
from seaopt.records import record
from seaopt.reporting.sections.data import Cell, Mark, Section, Table, Verdict, mark_met

WIDTH = 80
INDENT = 2
LEAST = 20  # characters of a wrapped text
NARROW = 16  # characters of a text in a table that is never broken
GAP = 2
LABEL = 9  # characters before the text of a verdict, a reason and a finding
COLOURS = {"good": "green", "bad": "red", "error": "bold red", "warning": "yellow", "note": "dim"}

Line = tuple[tuple[str, str], ...]  # texts with their styles, as Rich names them


@record
class Most:
    """How much of a result is shown; None is all of it."""

    rows: int | None = None
    reasons: int | None = None
    items: int | None = None
    folded: bool = False  # whether details are shown
    screen: bool = False  # whether only sections of one screen are shown


def join(lines: Iterable[Line]) -> str:
    """Return lines as one text, without colours."""
    return "\n".join("".join(text for text, _ in line).rstrip() for line in lines)


def render_sections(sections: Iterable[Section], width: int = WIDTH, most: Most | None = None) -> list[Line]:
    """Return the lines of sections, a blank one before each."""
    most = most or Most()
    lines: list[Line] = []
    for section in sections:
        if (section.folded and not most.folded) or (most.screen and not section.screen):
            continue
        lines += [(), *_wrap_title(section, width)]
        for sentence in section.sentences:
            lines += wrap(sentence, width, indent=INDENT)
        for table in section.tables:
            lines += render_table(table, width, most=most.rows)
        for remark in section.remarks:
            lines += wrap(remark, width, indent=INDENT, style="dim")
        for item in section.items[: most.items]:
            lines += _wrap_label(Mark(text=item.severity, style=item.severity), item.text, width, indent=INDENT)
        lines += _count_hidden(len(section.items), most.items)
    return lines


def render_verdict(verdict: Verdict, width: int = WIDTH, most: Most | None = None) -> list[Line]:
    """Return the lines of a verdict: what it is, each reason once, and what comes next."""
    most = most or Most()
    lines = _wrap_label(mark_met(verdict.met, *verdict.words), verdict.text, width)
    for reason in verdict.reasons[: most.reasons]:
        lines += wrap(str(reason), width, indent=LABEL)
    lines += _count_hidden(len(verdict.reasons), most.reasons, LABEL)
    for step in verdict.next:
        lines += wrap(f"next: {step.text}", width, indent=LABEL)
        lines += [((f"{' ' * (LABEL + 2)}{line}", ""),) for line in step.copied]
    return lines


def render_table(table: Table, width: int = WIDTH, *, most: int | None = None) -> list[Line]:
    """Return the lines of a table, none of them wider than `width` where its words and numbers allow it."""
    if not table.rows:
        return []
    table, room = table.drop_empty(), width - INDENT
    widths = _choose_widths(table, room)
    for optional in reversed(table.optional):
        if _measure(widths) <= room:
            break
        table = table.drop(optional)
        widths = _choose_widths(table, room)
    blocks = [table]
    if _measure(widths) > room:
        widths = _choose_widths(table, room, broken=True)
        blocks = list(_split(table, widths, room))
    lines: list[Line] = []
    for block in blocks:
        widths = _choose_widths(block, room, broken=True)
        lines += _lay_out(block, widths, most)
    return lines + _count_hidden(len(table.rows), most)


def wrap(text: str, width: int = WIDTH, *, indent: int = 0, style: str = "") -> list[Line]:
    """Return a text as lines broken at blanks, all of them indented."""
    return [((" " * indent + line, style),) for line in break_text(text, width - indent)]


def break_text(text: str, width: int) -> list[str]:
    """Return a text as lines broken at blanks; words stay whole, to be copied."""
    return _break(printable(text), max(width, LEAST))


def _break(text: str, width: int) -> list[str]:
    return textwrap.wrap(text, max(width, 1), break_long_words=False, break_on_hyphens=False) or [""]


def _wrap_title(section: Section, width: int) -> list[Line]:
    title = (printable(section.title), "bold")
    if not section.aside:
        return [(title,)]
    first, *more = break_text(section.aside, width - len(section.title) - 2)
    return [(title, ("  ", ""), (first, "dim")), *(((f"  {line}", "dim"),) for line in more)]


def _wrap_label(mark: Mark, text: str, width: int, *, indent: int = 0) -> list[Line]:
    """Return a mark and a text beside it, whose further lines begin below the first."""
    left = indent + max(LABEL, len(mark.text) + 1)
    first, *more = break_text(text, width - left)
    head = ((" " * indent, ""), (mark.text, COLOURS[mark.style]), (" " * (left - indent - len(mark.text)) + first, ""))
    return [head, *(((" " * left + line, ""),) for line in more)]


def _count_hidden(count: int, most: int | None, indent: int = INDENT) -> list[Line]:
    hidden = 0 if most is None else count - most
    return wrap(f"and {hidden} more: --verbose prints them", indent=indent) if hidden > 0 else []


def _choose_widths(table: Table, room: int, *, broken: bool = False) -> list[int]:
    """Return the widths of the columns: as they are if that fits, else with broken heads, else with broken texts."""
    columns = [[_text(row[at]) for row in table.rows] for at in range(len(table.head))]
    bodies = [max(map(len, column)) for column in columns]
    natural = [max(body, len(head)) for body, head in zip(bodies, table.head, strict=True)]
    if _measure(natural) <= room:
        return natural
    words = [max(map(len, head.split()), default=0) for head in table.head]
    narrow = [max(body, word) for body, word in zip(bodies, words, strict=True)]
    if _measure(narrow) <= room or not broken:
        return narrow
    texts = [at for at, body in enumerate(bodies) if _align(table, at) == "<" and body > NARROW]
    rigid = _measure(narrow) - sum(narrow[at] for at in texts)
    for k, at in enumerate(sorted(texts, key=lambda at: narrow[at])):  # short texts leave their share to long ones
        share = max((room - rigid) // (len(texts) - k), NARROW)
        longest = max((len(word) for cell in columns[at] for word in cell.split()), default=0)
        narrow[at] = max(min(narrow[at], share), min(longest, share), words[at])
        rigid += narrow[at]
    return narrow


def _split(table: Table, widths: Sequence[int], room: int) -> Iterator[Table]:
    """Yield parts of a table that fit, each with the first column."""
    start, heads = 1, list(range(len(table.head)))
    while start < len(heads):
        stop = start + 1
        while stop < len(heads) and _measure([widths[0], *widths[start : stop + 1]]) <= room:
            stop += 1
        kept = (0, *heads[start:stop])
        yield Table(
            head=tuple(table.head[at] for at in kept),
            rows=tuple(tuple(row[at] for at in kept) for row in table.rows),
            align="".join(_align(table, at) for at in kept),
        )
        start = stop


def _lay_out(table: Table, widths: Sequence[int], most: int | None) -> Iterator[Line]:
    rows: list[tuple[tuple[Cell, ...], str]] = [(row, "") for row in table.rows[:most]]
    if any(table.head):
        rows.insert(0, (table.head, "dim"))
    for row, style in rows:
        cells = [_break(_text(cell), width) for cell, width in zip(row, widths, strict=True)]
        styles = [COLOURS[cell.style] if isinstance(cell, Mark) else style for cell in row]
        for line in zip_longest(*cells, fillvalue=""):
            spans: list[tuple[str, str]] = [(" " * INDENT, "")]
            for at, (part, width, shade) in enumerate(zip(line, widths, styles, strict=True)):
                last = at == len(widths) - 1
                side = part.rjust(width) if _align(table, at) == ">" else part if last else part.ljust(width)
                spans += [(side, shade), ("" if last else " " * GAP, "")]
            yield tuple(spans)


def _measure(widths: Sequence[int]) -> int:
    return sum(widths) + GAP * (len(widths) - 1)


def _align(table: Table, at: int) -> str:
    return table.align[at : at + 1] or "<"


def _text(cell: Cell) -> str:
    return printable(cell.text if isinstance(cell, Mark) else cell)
