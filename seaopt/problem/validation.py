"""A problem file's table: TOML checked against the schema, with messages that name key, value and remedy."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

from seaopt.documents import check_table
from seaopt.errors import ProblemError
from seaopt.problem.schema import ProblemTable

MAX_BYTES = 4 << 20


def read_table(source: Path) -> ProblemTable:
    """Return a problem file's table.

    Raises
    ------
    ProblemError
        The file is missing or not TOML, a key is unknown or missing, or a value is out of range.

    """
    return check_table(ProblemTable, _read_toml(source), str(source), error=ProblemError)


def _read_toml(source: Path) -> dict[str, Any]:
    try:
        if source.is_dir():
            raise ProblemError(f"{source}: is a folder; give a problem file (TOML)")
        if source.stat().st_size > MAX_BYTES:
            raise ProblemError(f"{source}: is larger than {MAX_BYTES >> 20} MB; give a problem file (TOML)")
        return tomllib.loads(source.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise ProblemError(f"{source}: no such file; check the path") from error
    except OSError as error:
        raise ProblemError(f"{source}: cannot be read ({error.strerror})") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError) as error:
        raise ProblemError(f"{source}: is not valid TOML ({error}); correct that place") from error
