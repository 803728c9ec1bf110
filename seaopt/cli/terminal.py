"""What reaches a terminal: texts of logs and problem files without what a terminal would obey."""

from __future__ import annotations

import io
import os
import re
import shlex
import sys
from collections.abc import Collection, Iterable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Literal, NoReturn

from rich.console import Console
from rich.text import Text

from seaopt.errors import FileError, LogError, SeaoptError, UnitError
from seaopt.formatting import printable
from seaopt.reporting.sections.data import Table
from seaopt.reporting.sections.text import Line, render_table, wrap

Amount = Literal["quiet", "usual", "verbose"]  # how much is printed
# A command, a line of TOML, an option or the word that was meant stands in it.
TYPED = re.compile(r"\bseaopt [a-z]|\w = |(?<!\w)--?[a-z]|did you mean \"")
PIPE_CLOSED = 141  # exit code, as a shell's


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


def leave_pipe() -> NoReturn:
    """Leave without a word, as what reads stdout has; the exit code is that of no verdict."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # Python flushes it once more
    raise SystemExit(PIPE_CLOSED) from None


def list_notes(error: BaseException | None) -> list[str]:
    """Return the notes of an error and of those that it was raised from, line by line."""
    notes: list[str] = []
    while error is not None:
        notes += [line for note in getattr(error, "__notes__", ()) for line in note.splitlines()]
        error = error.__cause__
    return notes


def end(text: str, notes: Iterable[str] = (), exit_code: int = 2) -> NoReturn:
    """Write one line on stderr, as a terminal may see it, with notes below; leave, with the exit code of bad input."""
    with suppress(OSError):  # the exit code tells it where stderr cannot be written
        for line in (f"seaopt: {' '.join(text.split())}", *notes):
            sys.stderr.write(f"{printable(line)}\n")
    raise SystemExit(exit_code)


def add_remedy(error: SeaoptError, commands: Collection[str]) -> str:
    """Return an error's text, with where to look at its end where it names nothing to type itself."""
    text, command = str(error), next((word for word in sys.argv[1:] if word in commands), "")
    if TYPED.search(text):
        return text
    if isinstance(error, LogError) and command != "inspect":
        return f"{text}; to see what is in the log type seaopt inspect LOG"
    if isinstance(error, LogError | FileError | UnitError) or command in ("", "inspect", "new", "export", "schema"):
        return f"{text}; for what may be given type seaopt {f'{command} ' if command else ''}--help"
    return f"{text}; for every key and what it means type seaopt schema problem"


def spell_call() -> str:
    """Return the command that was typed, to be typed again."""
    return shlex.join(["seaopt", *sys.argv[1:]])
