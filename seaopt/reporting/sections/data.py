"""The parts that describe a result, however it is rendered: sections of tables and sentences, and verdicts."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import field, replace
from typing import Literal

from seaopt.formatting import MISSING, format_number, format_percent
from seaopt.records import record

LEAST_GRACE = 0.005  # that is said

Style = Literal["good", "bad", "error", "warning", "note"]


@record
class Mark:
    """A word that stands out: a verdict, or how severe a finding is."""

    text: str
    style: Style


Cell = str | Mark


def mark_met(met: bool, yes: str = "met", no: str = "not met") -> Mark:
    """Return a verdict as a cell."""
    return Mark(text=yes, style="good") if met else Mark(text=no, style="bad")


def show_limit(sense: str, limit: float | None, grace: float) -> str:
    """Return a limit as a cell, with the share by which it may be missed where that shows in its figure."""
    return f"{sense} {format_number(limit)}" + (f" ({format_percent(grace, 6)} grace)" if grace > LEAST_GRACE else "")


@record
class Table:
    """Rows under their heads; `align` has "<" or ">" for each column.

    Where the width lacks, `optional` columns are left out, the last first; a column without any entry always is.
    """

    head: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]
    align: str = ""
    label: str = ""  # what a screen reader says of it; the section's title, where left out
    optional: tuple[str, ...] = ()

    def drop_empty(self) -> Table:
        """Return the table without columns that have no entry."""
        empty = [
            head
            for at, head in enumerate(self.head)
            if self.rows and all(row[at] in ("", MISSING) for row in self.rows)
        ]
        return self.drop(*empty)

    def drop(self, *heads: str) -> Table:
        """Return the table without these columns."""
        kept = [at for at, head in enumerate(self.head) if head not in heads]
        return replace(
            self,
            head=tuple(self.head[at] for at in kept),
            rows=tuple(tuple(row[at] for at in kept) for row in self.rows),
            align="".join(self.align[at : at + 1] or "<" for at in kept),
        )


@record
class Item:
    """A line of a list, with how severe it is."""

    severity: Style
    text: str


@record
class Section:
    """One subject of a result: a title, key figures beside it, sentences, tables, remarks on them, a list, figures."""

    title: str
    aside: str = ""
    sentences: tuple[str, ...] = ()
    tables: tuple[Table, ...] = ()
    remarks: tuple[str, ...] = ()  # what the columns mean, below the tables
    items: tuple[Item, ...] = ()
    part: str = ""  # of the page
    screen: bool = True  # whether it stands on one screen of a terminal, or with --verbose
    folded: bool = False  # detail: on a terminal with --verbose, on a page when opened


def list_notes(of: str, notes: Iterable[str], items: Iterable[Item] = ()) -> list[Section]:
    """Return the section of the findings of a result; none where there are none."""
    items = (*items, *(Item(severity="note", text=note) for note in notes))
    return [Section(title=f"Findings of {of}", part="findings", items=items)] if items else []


@record
class Reason:
    """One thing that is not met; of `count` places it is in, `where` is the worst."""

    what: str
    where: str = ""
    count: int = 1

    def __str__(self) -> str:
        more = f" (and {self.count - 1} more)" if self.count > 1 else ""
        return f"{self.what}{more}" + (f": {self.where}" if self.where else "")


@record
class Step:
    """What to do next, and what to copy for it as it is: a command, or lines of a problem file."""

    text: str
    copied: tuple[str, ...] = ()

    @classmethod
    def typed(cls, text: str, command: str) -> Step:
        """Return what to do with a command at its end, which is typed."""
        return cls(text=f"{text} type" if text else "type", copied=(command,))


@record
class Verdict:
    """Whether a result is met, in one line; why not; and what comes next."""

    met: bool
    text: str
    reasons: tuple[Reason, ...] = ()
    next: tuple[Step, ...] = ()
    words: tuple[str, str] = field(default=("met", "not met"))


@record
class KeyFigure:
    """A number to see first, with its unit, and what it is compared with."""

    name: str
    value: str
    against: str = ""


@record
class Commands:
    """Commands to type next, for a result of the command line; empty elsewhere."""

    fit: str = ""
    tune: str = ""
    certify: str = ""
    plants: Mapping[str, tuple[str, ...]] = field(default_factory=dict)  # of those that are fitted: table to parts

    @property
    def sweep(self) -> str:
        """The command that tunes at a range of bandwidths, but for the range."""
        return f"{self.tune} --sweep" if self.tune else ""
