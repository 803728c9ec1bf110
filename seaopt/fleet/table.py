"""The table of a fleet: a folder of Parquet files, a row per log, each file whole or absent.

Rows are written in parts as they come, into a folder of work beside, and moved into place: what was done when a client
is killed is there. Two rules keep the cost of a row the same however long the table is:

- Parts are merged when there are many of them, but only small ones; a file of `LARGE` rows is not merged again. A row
  is so written a bounded number of times, and a table of n rows has about n/LARGE files.
- Rows that replace older ones of the same logs wait in the folder of work until they are a fixed share of the table,
  or the run ends. Then each file that has one of these logs is written anew. A table of n rows that is replaced whole
  is rewritten 1/`SHARE` times, however many flushes that took.

A merged file is whole before the parts that it replaces go, and moved into place when they are gone, so that no row is
ever seen twice; what a killed client left behind is finished when the table is opened again. One client at a time has
a table.
"""

from __future__ import annotations

import io
import json
import os
import secrets
import time
from collections.abc import Iterable, Mapping, Sequence
from itertools import combinations
from pathlib import Path
from typing import Any

import polars as pl

from seaopt.errors import FileError
from seaopt.files import describe_os_error, write_bytes
from seaopt.fleet.logs import FleetLog
from seaopt.fleet.plan import Columns, Plan, name_correlation
from seaopt.fleet.result import SHORT
from seaopt.fleet.worker import FAILED, Row

PART_S, PART_ROWS = 2.0, 5000  # a part is written after so long, or so many rows
WRITING = 0.1  # of the time, at most, goes into writing
MOST_PARTS = 64  # new ones, until the small ones are merged
LARGE = 50_000  # rows of a file that is merged no more
SHORT_SHARE = 0.25  # of the median's samples, under which a log has a finding
SHARE = 0.25  # of the table's rows, that newer ones are when they replace them
WORK = ".fleet"  # the folder of work: readers of a folder of Parquet files want no others in it
MERGED = "merged-"  # begins the name of a file there that is whole; of its parts, some may be gone
NEWER = "newer-"  # begins the name of a file there with rows that replace others in the table

_FINDING = pl.Struct({"severity": pl.String, "kind": pl.String, "where": pl.String, "text": pl.String})


def make_schema(columns: Columns, identity: Sequence[str]) -> dict[str, Any]:
    """Return the columns of a table and their types, in order."""
    schema: dict[str, Any] = {"log": pl.String, **dict.fromkeys(identity, pl.String)}
    schema |= {"status": pl.String, "reason": pl.String, "met": pl.Boolean}
    for name in columns.units:
        schema |= {name: pl.Float64, f"{name}_std": pl.Float64}
    schema |= {name_correlation(*pair): pl.Float64 for pair in combinations(columns.free, 2)}
    for output in columns.outputs:
        schema |= {f"fit_percent_{output}": pl.Float64, f"rms_residual_{output}": pl.Float64}
    return schema | {
        "findings": pl.List(_FINDING),
        "fit_status": pl.String,
        "samples": pl.Int64,
        "iterations": pl.Int64,
        "fit_s": pl.Float64,
        "total_s": pl.Float64,
        "log_sha256": pl.String,
        "problem_sha256": pl.String,
        "version": pl.String,
    }


def make_frame(rows: Sequence[Row], schema: Mapping[str, Any], plan: Plan) -> pl.DataFrame:
    """Return rows as a table of a schema; what a row does not have is null."""
    same = {"problem_sha256": plan.digest, "version": plan.version}
    content = [dict.fromkeys(schema) | row | same | {"met": row["status"] == "met"} for row in rows]
    return pl.DataFrame(
        {name: pl.Series(name, [row[name] for row in content], dtype=kind) for name, kind in schema.items()}
    )


class FleetTable:
    """A table that rows are added to: the folder ``fleet`` in that of the results, for the problem of a plan. Raises
    FileError: the folder cannot be made, another client has it, or a file of it is damaged.
    """

    def __init__(self, folder: Path, schema: Mapping[str, Any], plan: Plan) -> None:
        self.folder = folder / "fleet"
        self.work = folder / WORK
        self.schema = schema
        self.plan = plan
        self.rows: list[Row] = []
        self.waiting = 0  # rows in the folder of work that replace others
        self.fresh = 0  # parts since the small ones were merged
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            self.work.mkdir(exist_ok=True)
        except OSError as error:
            raise FileError(f"{folder}: cannot be made ({describe_os_error(error)}); choose another folder") from error
        self.lock = _lock(self.work / "lock")
        try:
            self._recover()
            self.present = set(self.read()["log"])
        except BaseException:
            self.close()
            raise
        self.due = time.monotonic() + PART_S

    def close(self) -> None:
        """Let go of the folder."""
        os.close(self.lock)

    def parts(self) -> list[Path]:
        """Return the files, by name."""
        return sorted(self.folder.glob("part-*.parquet"))

    def add(self, rows: Sequence[Row]) -> None:
        """Keep rows; write them when it is time."""
        self.rows += rows
        if len(self.rows) >= PART_ROWS or time.monotonic() >= self.due:
            self.flush()

    def flush(self) -> None:
        """Write the rows that are kept; those of logs that have a row already wait until they replace it."""
        started = time.monotonic()
        if self.rows:
            frame = make_frame(self.rows, self.schema, self.plan)
            older = pl.Series([log in self.present for log in frame["log"]], dtype=pl.Boolean)
            fresh, newer = frame.filter(~older), frame.filter(older)
            if len(fresh):
                name = _name_part()
                self._write(fresh, name).rename(self.folder / name)
                self.present.update(fresh["log"])
                self.fresh += 1
            if len(newer):
                self._write(newer, f"{NEWER}{_name_part()}")
                self.waiting += len(newer)
            self.rows = []
            if self.fresh >= MOST_PARTS:
                self._merge_small()
            if self.waiting >= SHARE * len(self.present):
                self._replace_older()
        took = time.monotonic() - started
        self.due = time.monotonic() + max(PART_S, took / WRITING)

    def finish(self) -> None:
        """Write what is kept, replace what is older, and merge small parts."""
        self.flush()
        self._replace_older()
        self._merge_small()

    def read(self) -> pl.DataFrame:
        """Return all rows that are written, in order of their logs, in columns of the schema, then others there are."""
        frames = [_read(path) for path in self.parts()]
        missing = pl.DataFrame(schema=dict(self.schema))
        rows, newer = pl.concat([missing, *frames], how="diagonal_relaxed"), self._read_newer()
        return _put(rows, newer).sort("log")

    def relabel(self, names: Sequence[str], logs: Sequence[FleetLog]) -> None:
        """Give the rows of logs the identities that these have now."""
        rows = self.read()
        if not names or not len(rows):
            return
        now = tabulate_logs(logs, names)
        labelled = rows.drop(names).join(now, on="log").select(rows.columns)
        before = rows.join(now.select("log"), on="log", how="semi")
        if not labelled.select("log", *names).equals(before.select("log", *names)):
            self.put(labelled)

    def put(self, rows: pl.DataFrame) -> None:
        """Write rows in the place of those of the same logs, at once."""
        if len(rows):
            self._write(rows, f"{NEWER}{_name_part()}")
            self._replace_older()

    def _merge_small(self) -> None:
        """Put the rows of all small parts into one, in order of their logs."""
        small = [path for path in self.parts() if pl.scan_parquet(path).select(pl.len()).collect().item() < LARGE]
        if len(small) > 1:
            rows = pl.concat([_read(path) for path in small], how="diagonal_relaxed")
            self._write_merged(rows, small)
        self.fresh = 0

    def _replace_older(self) -> None:
        """Put the rows that wait in the place of older ones of the same logs, file by file."""
        waiting = self._list_newer()
        if not waiting:
            return
        newer, replaced = self._read_newer(), pl.DataFrame(schema={"log": pl.String})
        for path in self.parts():
            rows = _read(path)
            logs = rows.select("log")
            if len(mine := newer.join(logs, on="log", how="semi")):
                self._write_merged(_put(rows, mine), [path])
                replaced = pl.concat([replaced, mine.select("log")])
        orphans = newer.join(replaced, on="log", how="anti")
        if len(orphans):  # somebody has deleted the file with the older ones
            self._write_merged(orphans, [])
        for path in waiting:
            path.unlink()
        self.waiting = 0

    def _list_newer(self) -> list[Path]:
        return sorted(self.work.glob(f"{NEWER}*.parquet"))

    def _read_newer(self) -> pl.DataFrame:
        """Return the rows that wait; a run has one per log."""
        frames = [_read(path) for path in self._list_newer()]
        return pl.concat([pl.DataFrame(schema={"log": pl.String}), *frames], how="diagonal_relaxed")

    def _write_merged(self, rows: pl.DataFrame, parts: Sequence[Path]) -> None:
        """Write rows in order of their logs as a part that replaces others."""
        names = json.dumps([path.name for path in parts])
        self._replace(self._write(rows.sort("log"), f"{MERGED}{_name_part()}", {"replaces": names}))

    def _replace(self, merged: Path) -> None:
        """Delete the parts that a merged file replaces, then show it."""
        for name in json.loads(pl.read_parquet_metadata(merged)["replaces"]):
            (self.folder / name).unlink(missing_ok=True)
        merged.rename(self.folder / merged.name.removeprefix(MERGED))

    def _recover(self) -> None:
        """Finish what a client that was killed had begun."""
        for path in self.work.glob(f"{MERGED}*"):
            self._replace(path)
        for path in self.work.glob("part-*.parquet"):
            path.rename(self.folder / path.name)  # whole, too
        for path in self.work.glob(".seaopt-*"):
            path.unlink()
        self._replace_older()

    def _write(self, frame: pl.DataFrame, name: str, metadata: dict[str, str] | None = None) -> Path:
        content = io.BytesIO()
        frame.write_parquet(content, metadata=metadata)
        return write_bytes(self.work / name, content.getvalue())


def _name_part() -> str:
    return f"part-{secrets.token_hex(8)}.parquet"


def _put(rows: pl.DataFrame, newer: pl.DataFrame) -> pl.DataFrame:
    """Return rows with newer ones in place of those of the same logs."""
    kept = rows.join(newer.select("log"), on="log", how="anti")
    return pl.concat([kept, newer], how="diagonal_relaxed")


def read_rows(folder: Path) -> pl.DataFrame:
    """Return the rows of a table that nobody writes, ordered by log. Raises FileError: none, or a damaged one."""
    parts = [_read(path) for path in sorted((folder / "fleet").glob("part-*.parquet"))]
    if not parts:
        raise FileError(f"{folder / 'fleet'}: has no table; type the command of the fleet again")
    return pl.concat(parts, how="diagonal_relaxed").sort("log")


def note_short_logs(rows: pl.DataFrame) -> pl.DataFrame:
    """Return those rows whose finding "short" comes, goes or changes: of logs much shorter than their siblings."""
    median = pl.Series(rows["samples"].drop_nulls()).cast(pl.Float64).median() or 0.0
    short = (pl.col("samples") < SHORT_SHARE * float(str(median))).fill_null(value=False)
    kinds = pl.col("findings").list.eval(pl.element().struct.field("kind"))
    picked = rows.filter(short | kinds.list.contains(SHORT).fill_null(value=False))
    findings: list[list[dict[str, Any]]] = []
    for row, is_short in zip(picked.iter_rows(named=True), picked.select(short).to_series(), strict=True):
        text = f"{row['samples']} samples, where half the logs have {median:g} or more: cut off, or another test?"
        note = {"severity": "warning", "kind": SHORT, "where": "", "text": text}
        kept = [finding for finding in row["findings"] or [] if finding["kind"] != SHORT]
        findings.append([*kept, note] if is_short else kept)
    changed = [now != before for now, before in zip(findings, picked["findings"].to_list(), strict=True)]
    noted = picked.with_columns(pl.Series("findings", findings, dtype=pl.List(_FINDING)))
    return noted.filter(pl.Series(changed, dtype=pl.Boolean))


def find_done(rows: pl.DataFrame, plan: Plan) -> dict[str, str]:
    """Return the contents of the logs that need no new fit, by path: done with this problem and version, not failed."""
    done = rows.filter(
        (pl.col("problem_sha256") == plan.digest)
        & (pl.col("version") == plan.version)
        & (pl.col("status") != FAILED)
        & pl.col("log_sha256").is_not_null()
    )
    return dict(zip(done["log"], done["log_sha256"], strict=True))


def _read(path: Path) -> pl.DataFrame:
    try:
        return pl.read_parquet(path)
    except (OSError, pl.exceptions.PolarsError) as error:
        reason = str(error).splitlines()[0]
        raise FileError(f"{path}: cannot be read ({reason}); delete it, and its logs are fitted again") from error


def _lock(path: Path) -> int:
    """Return the open lock of a table, which ends with the process. Raises FileError: another process has it."""
    handle = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
    try:
        if os.name == "nt":
            import msvcrt

            msvcrt.locking(handle, msvcrt.LK_NBLCK, 1)
        else:
            import fcntl

            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        os.close(handle)
        raise FileError(f"{path.parents[1]}: another fleet writes it; wait, or give another folder") from error
    return handle


def tabulate_logs(logs: Sequence[FleetLog], names: Iterable[str]) -> pl.DataFrame:
    """Return a row per log with these of its identity beside it."""
    return pl.DataFrame({"log": [log.path for log in logs], **{n: [log.identity[n] for log in logs] for n in names}})
