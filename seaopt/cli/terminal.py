"""What reaches a terminal: texts of logs and problem files without what a terminal would obey."""

from __future__ import annotations

import io
import sys
import textwrap
from collections.abc import Iterable, Sequence
from typing import Any, Literal

from rich.console import Console
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

from seaopt.formatting import printable

Amount = Literal["quiet", "usual", "verbose"]  # of what is printed

LEAST_WIDTH = 20  # of a wrapped text, in characters
NARROW = 16  # characters of a cell that is never broken


class Terminal(Console):
    """Rich's console; control characters in the texts that it prints are shown, not sent."""

    def print(self, *objects: Any, **options: Any) -> None:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Print as Rich does."""
        super().print(*(printable(one) if isinstance(one, str) else one for one in objects), **options)

    def say(self, text: str, **options: Any) -> None:
        """Print a text as it is: no markup, no colours of Rich's own, lines broken at blanks."""
        self.print(text, highlight=False, markup=False, **options)

    def wrap(self, text: str, *, indent: int = 0, **options: Any) -> None:
        """Print a text with its lines broken at blanks, all of them indented; commands in it stay whole words."""
        for line in self.break_lines(text, indent=indent):
            self.say(" " * indent + line, soft_wrap=True, **options)

    def break_lines(self, text: str, *, indent: int = 0) -> list[str]:
        """Return a text as the lines that fit the terminal behind an indent; at least one."""
        width = max(self.width - indent, LEAST_WIDTH)
        return textwrap.wrap(printable(text), width, break_long_words=False, break_on_hyphens=False) or [""]

    def tabulate(
        self, rows: Iterable[Sequence[str]], head: Sequence[str] = (), align: str = "", *, indent: int = 2, gap: int = 2
    ) -> None:
        """Print rows in aligned columns: "<" or ">" for each; what is too wide is broken in its cell."""
        table = Table(box=None, show_header=bool(head), pad_edge=False, padding=(0, gap, 0, 0), header_style="dim")
        cells = [[printable(cell) for cell in row] for row in rows]
        for at in range(max(map(len, [head, *cells]))):
            right = align[at : at + 1] == ">"
            # Figures stay whole; words are broken.
            whole = right or max((len(row[at]) for row in cells), default=0) <= NARROW
            table.add_column(
                Text(head[at]) if head else "", justify="right" if right else "left", no_wrap=whole, overflow="fold"
            )
        for row in cells:
            table.add_row(*map(Text, row))
        self.print(Padding(table, (0, 0, 0, indent)))


def prepare_streams() -> None:
    """Let stdout and stderr write a character that their encoding lacks as its escape."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
