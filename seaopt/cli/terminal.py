"""What reaches a terminal: texts of logs and problem files without what a terminal would obey."""

from __future__ import annotations

import io
import os
import sys
import textwrap
from collections.abc import Iterable, Sequence
from contextlib import suppress
from itertools import zip_longest
from pathlib import Path
from typing import Any, Literal

from rich.console import Console
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

from seaopt.formatting import format_table, printable
from seaopt.reporting.sections.text import Line

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

    def label(self, word: str, text: str, *, style: str, indent: int) -> None:
        """Print a word in a colour and a text beside it, whose further lines begin below the first one."""
        first, *rest = self.break_lines(text, indent=indent)
        self.say(word, style=style, end=" " * (indent - len(word)))
        self.say("\n".join([first, *(" " * indent + line for line in rest)]), soft_wrap=True)

    def write(self, lines: Iterable[Line]) -> None:
        """Print lines of sections as they are, in their colours."""
        for line in lines:
            self.print(Text.assemble(*line), soft_wrap=True)

    def list_files(self, paths: Iterable[object]) -> None:
        """Print which files were written; a path is never broken, to be copied whole."""
        names = [printable(str(path)) for path in paths]
        words = ["wrote", *(f"{name}," for name in names[:-1]), *names[-1:]]
        lines = [words[0]]
        for word in words[1:]:
            if len(lines[-1]) + 1 + len(word) <= self.width or lines[-1] == words[0]:
                lines[-1] += f" {word}"
            else:
                lines.append(word)
        self.say("\n".join(lines), soft_wrap=True)

    def break_lines(self, text: str, *, indent: int = 0) -> list[str]:
        """Return a text as the lines that fit the terminal behind an indent; at least one."""
        width = max(self.width - indent, LEAST_WIDTH)
        return textwrap.wrap(printable(text), width, break_long_words=False, break_on_hyphens=False) or [""]

    def tabulate(
        self, rows: Iterable[Sequence[str]], head: Sequence[str] = (), align: str = "", *, indent: int = 2, gap: int = 2
    ) -> None:
        """Print rows in aligned columns: "<" or ">" for each; what is too wide is broken in its cell."""
        cells = [[printable(cell) for cell in row] for row in rows]
        lines = [*([list(head)] if head else []), *cells]
        widths = [max(map(len, column)) for column in zip_longest(*lines, fillvalue="")]
        whole = [align[at : at + 1] == ">" or width <= NARROW for at, width in enumerate(widths)]
        least = sum(width if kept else NARROW for width, kept in zip(widths, whole, strict=True))
        if least + gap * (len(widths) - 1) + indent > self.width:  # nothing is cut: the terminal breaks the lines
            for line in format_table(cells, head or None, align):
                self.say(" " * indent + line, soft_wrap=True)
            return
        table = Table(box=None, show_header=bool(head), pad_edge=False, padding=(0, gap, 0, 0), header_style="dim")
        for at, kept in enumerate(whole):
            # Figures stay whole; words are broken.
            side = "right" if align[at : at + 1] == ">" else "left"
            table.add_column(Text(head[at]) if head else "", justify=side, no_wrap=kept, overflow="fold")
        for row in cells:
            table.add_row(*map(Text, row))
        self.print(Padding(table, (0, 0, 0, indent)))


def prepare_streams() -> None:
    """Let stdout and stderr write a character that their encoding lacks as its escape; open what a shell has closed.

    The next file that is opened would have the number of a closed stream, and get what libraries print.
    """
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        if getattr(sys, name) is None:
            mode = "w" if number else "r"
            nowhere = Path(os.devnull).open(mode, encoding="utf-8")  # noqa: SIM115 - as long as the process
            with suppress(OSError):
                if nowhere.fileno() != number and not _is_open(number):
                    os.dup2(nowhere.fileno(), number)
            setattr(sys, name, nowhere)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def _is_open(number: int) -> bool:
    try:
        os.fstat(number)
    except OSError:
        return False
    return True
