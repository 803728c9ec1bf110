"""What reaches a terminal: texts of logs and problem files without what a terminal would obey."""

from __future__ import annotations

import io
import sys
from typing import Any

from rich.console import Console

from seaopt.formatting import printable


class Terminal(Console):
    """Rich's console; control characters in the texts that it prints are shown, not sent."""

    def print(self, *objects: Any, **options: Any) -> None:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Print as Rich does."""
        super().print(*(printable(one) if isinstance(one, str) else one for one in objects), **options)


def prepare_streams() -> None:
    """Let stdout and stderr write a character that their encoding lacks as its escape."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
