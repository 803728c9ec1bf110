"""The reading keys of a problem file to columns, rules and paths."""

from __future__ import annotations

from pathlib import Path, PurePosixPath, PureWindowsPath

from seaopt.errors import ProblemError
from seaopt.logs import Column, Hold, Linear, Nearest
from seaopt.problem.schema import AlignTable, ClockTable, ColumnTable, ExperimentTable


def log_files(table: ExperimentTable) -> list[str]:
    """Return the files of an experiment: its log or logs, then those that columns name."""
    logs = [table.log] if isinstance(table.log, str) else list(table.log or [])
    tables = [item for item in (table.time, *table.inputs.values(), *table.outputs.values()) if item is not None]
    named = [item.file for item in tables if not isinstance(item, str) and item.file is not None]
    return list(dict.fromkeys([*logs, *named]))


def check_inside(place: str, table: ExperimentTable) -> None:
    """Refuse a file outside the problem file's folder.

    Raises
    ------
    ProblemError
        A path is absolute, or climbs out.

    """
    for name in log_files(table):
        for kind in (PurePosixPath, PureWindowsPath):  # a problem file reads the same on every system
            if kind(name).anchor or ".." in kind(name).parts:
                raise ProblemError(f'{place}.log = "{name}" leaves the problem file\'s folder; put the log beside it')


def column_of(item: str | ClockTable | ColumnTable, folder: Path) -> Column:
    """Return a column as the reader takes it."""
    if isinstance(item, str):
        return Column(column=item)
    file = None if item.file is None else folder / item.file
    if isinstance(item, ClockTable):
        return Column(column=item.column, unit=item.unit, file=file, clock_offset_s=item.clock_offset_s)
    own = item.time if item.time is None or isinstance(item.time, str) else column_of(item.time, folder)
    return Column(
        column=item.column, unit=item.unit, scale=item.scale, offset=item.offset, wrap_bits=item.wrap_bits, file=file,
        time=own, clock_offset_s=item.clock_offset_s, align=rule_of(item.align),
    )  # fmt: skip


def rule_of(table: AlignTable | None) -> Hold | Linear | Nearest | None:
    """Return an alignment rule."""
    if table is None:
        return None
    if table.hold is not None:
        return Hold(**table.hold.model_dump(exclude_none=True))
    if table.linear is not None:
        return Linear(**table.linear.model_dump(exclude_none=True))
    assert table.nearest is not None
    return Nearest(tolerance_s=table.nearest.tolerance_s)
