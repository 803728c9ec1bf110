"""What a problem file says about reading a log, as columns, alignment rules and paths."""

from __future__ import annotations

from pathlib import Path, PurePosixPath, PureWindowsPath

from seaopt.errors import ProblemError
from seaopt.logs import Column, Hold, Linear, Nearest
from seaopt.problem.bench_tables import AlignTable, ClockTable, ColumnTable, ExperimentTable


def list_log_files(table: ExperimentTable) -> list[str]:
    """Return the files of an experiment: its log or logs, then those that columns name."""
    logs = [table.log] if isinstance(table.log, str) else list(table.log or [])
    columns = [column for column in (table.time, *table.inputs.values(), *table.outputs.values()) if column is not None]
    named = [column.file for column in columns if not isinstance(column, str | int) and column.file is not None]
    return list(dict.fromkeys([*logs, *named]))


def check_inside(place: str, table: ExperimentTable) -> None:
    """Refuse a file outside the problem file's folder.

    Raises ProblemError: a path is absolute, or climbs out.
    """
    for name in list_log_files(table):
        for kind in (PurePosixPath, PureWindowsPath):  # a problem file reads the same on every system
            if kind(name).anchor or ".." in kind(name).parts:
                raise ProblemError(f'{place}.log = "{name}" leaves the problem file\'s folder; put the log beside it')


def check_links(folder: Path, names: list[str]) -> None:
    """Refuse a log that a symbolic link puts outside the problem file's folder.

    Raises ProblemError: the file that is meant lies elsewhere.
    """
    for name in names:
        try:
            inside = (folder / name).resolve().is_relative_to(folder.resolve())
        except (OSError, ValueError, RuntimeError):  # no path, or links in a circle: the reader says so
            continue
        if not inside:
            raise ProblemError(f'log = "{name}" is a link out of the problem file\'s folder; put the log beside it')


def make_column(table: str | int | ClockTable | ColumnTable, folder: Path) -> Column:
    """Return a column as the reader takes it."""
    if isinstance(table, str | int):
        return Column(column=table)
    file = None if table.file is None else folder / table.file
    if isinstance(table, ClockTable):
        return Column(
            column=table.column, unit=table.unit, file=file, clock_offset_s=table.clock_offset_s, where=table.where
        )
    time = table.time if table.time is None or isinstance(table.time, str | int) else make_column(table.time, folder)
    return Column(
        column=table.column,
        unit=table.unit,
        scale=table.scale,
        offset=table.offset,
        wrap_bits=table.wrap_bits,
        file=file,
        time=time,
        clock_offset_s=table.clock_offset_s,
        align=make_rule(table.align),
        where=table.where,
        from_header=table.source == "header",
        shared=table.shared,
    )


def make_rule(table: AlignTable | None) -> Hold | Linear | Nearest | None:
    """Return an alignment rule."""
    if table is None:
        return None
    if table.hold is not None:
        return Hold(**table.hold.model_dump(exclude_none=True))
    if table.linear is not None:
        return Linear(**table.linear.model_dump(exclude_none=True))
    assert table.nearest is not None
    return Nearest(tolerance_s=table.nearest.tolerance_s)
