"""What reaches a terminal: texts of logs and problem files without what a terminal would obey."""

from __future__ import annotations

import io
import os
import sys
from collections.abc import Iterable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Literal

from rich.console import Console
from rich.text import Text

from seaopt.formatting import printable
from seaopt.reporting.sections.data import Table
from seaopt.reporting.sections.text import Line, render_table, wrap

Amount = Literal["quiet", "usual", "verbose"]  # how much is printed


class Terminal(Console):
    """Rich's console; control characters in the texts that it prints are shown, not sent."""

    def print(self, *objects: Any, **options: Any) -> None:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Print as Rich does."""
        super().print(*(printable(text) if isinstance(text, str) else text for text in objects), **options)

    def say(self, text: str, **options: Any) -> None:
        """Print a text as it is: no markup, no colours of Rich's own, lines broken at blanks."""
        self.print(text, highlight=False, markup=False, **options)

    def wrap(self, text: str, *, indent: int = 0) -> None:
        """Print a text with its lines broken at blanks, all of them indented; commands in it stay whole words."""
        self.write(wrap(text, self.width, indent=indent))

    def tabulate(self, rows: Iterable[Sequence[str]], head: Sequence[str], align: str = "") -> None:
        """Print rows in aligned columns, "<" or ">" for each."""
        self.write(render_table(make_table(rows, head, align), self.width))

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


def make_table(rows: Iterable[Sequence[str]], head: Sequence[str], align: str = "") -> Table:
    """Return rows of texts as a table of sections."""
    return Table(head=tuple(head), rows=tuple(tuple(row) for row in rows), align=align)


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
