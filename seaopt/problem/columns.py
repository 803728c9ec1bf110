"""How a problem file has a log read: columns, alignment rules and paths."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any

from seaopt.errors import ProblemError
from seaopt.logs import Column, Hold, Linear, Nearest, Readings
from seaopt.logs.log.alignment import Rule
from seaopt.problem.bench_tables import AlignTable, ClockTable, ColumnTable, ExperimentTable


def list_log_files(table: ExperimentTable) -> list[str]:
    """Return the files of an experiment: its log or logs, then those that columns name."""
    logs = [table.log] if isinstance(table.log, str) else list(table.log or [])
    columns = [column for column in (table.time, *table.inputs.values(), *table.outputs.values()) if column is not None]
    named = [column.file for column in columns if not isinstance(column, str | int) and column.file is not None]
    return list(dict.fromkeys([*logs, *named]))


def check_inside(key: str, table: ExperimentTable) -> None:
    """Refuse a file outside the problem file's folder. Raises ProblemError: a path is absolute, or climbs out."""
    for name in list_log_files(table):
        for kind in (PurePosixPath, PureWindowsPath):  # a problem file reads the same on every system
            if kind(name).anchor or ".." in kind(name).parts:
                raise ProblemError(f'{key}.log = "{name}" leaves the problem file\'s folder; put the log beside it')


def check_links(folder: Path, names: list[str]) -> None:
    """Refuse a log that a symbolic link puts outside the problem file's folder (ProblemError)."""
    for name in names:
        try:
            inside = (folder / name).resolve().is_relative_to(folder.resolve())
        except (OSError, ValueError, RuntimeError):  # no path, or links in a circle: the reader says so
            continue
        if not inside:
            raise ProblemError(f'log = "{name}" is a link out of the problem file\'s folder; put the log beside it')


def make_column(table: str | int | ClockTable, folder: Path) -> Column:
    """Return a column as the reader takes it."""
    if isinstance(table, str | int):
        return Column(column=table)
    stated: dict[str, Any] = {name: getattr(table, name) for name in table.model_fields_set - {"source", "sigma"}}
    if table.file is not None:
        stated["file"] = folder / table.file
    if isinstance(table, ColumnTable):
        if isinstance(table.time, ClockTable):
            stated["time"] = make_column(table.time, folder)
        stated |= {"align": make_rule(table.align), "from_header": table.source == "header"}
    return Column(**stated)


def make_rule(table: AlignTable | None) -> Rule | None:
    """Return an alignment rule."""
    if table is None:
        return None
    kinds: dict[str, Callable[..., Rule]] = {"hold": Hold, "linear": Linear, "nearest": Nearest, "readings": Readings}
    (name,) = (name for name in kinds if getattr(table, name) is not None)
    return kinds[name](**getattr(table, name).model_dump(exclude_none=True))
