"""The table of a fleet: a folder of Parquet files, a row a log, each file whole or absent.

Rows are written in parts as they come, into a folder of work beside, and moved into place: what was done when a client
is killed is there. Parts are merged now and then, and where a row replaces an older one of the same log. The merged
file is whole before the parts go, and moved into place when they are gone, so that no row is ever seen twice; what a
killed merge left behind is finished when the table is opened again. One client at a time has a table.
"""

from __future__ import annotations

import io
import json
import os
import secrets
import time
from collections.abc import Mapping, Sequence
from itertools import combinations
from pathlib import Path
from typing import Any

import polars as pl

from seaopt.errors import FileError
from seaopt.files import describe_os_error, write_bytes
from seaopt.fleet.logs import FleetLog
from seaopt.fleet.plan import Columns, Plan, name_correlation
from seaopt.fleet.worker import FAILED, Row

PART_S, PART_ROWS = 2.0, 5000  # a part is written after so long, or so many rows
WRITING = 0.1  # of the time, at most, goes into writing
MOST_PARTS = 64  # until they are merged
WORK = ".fleet"  # the folder of work: readers of a folder of Parquet files want no others in it
MERGED = "merged-"  # begins the name of a file there that is whole; of its parts, some may be gone

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
        "findings": pl.List(_FINDING), "fit_status": pl.String, "samples": pl.Int64, "iterations": pl.Int64,
        "fit_s": pl.Float64, "total_s": pl.Float64, "log_sha256": pl.String, "problem_sha256": pl.String,
        "version": pl.String,
    }  # fmt: skip


def make_frame(rows: Sequence[Row], schema: Mapping[str, Any], plan: Plan) -> pl.DataFrame:
    """Return rows as a table of a schema; what a row does not have is null."""
    same = {"problem_sha256": plan.digest, "version": plan.version}
    content = [dict.fromkeys(schema) | row | same | {"met": row["status"] == "met"} for row in rows]
    return pl.DataFrame(
        {name: pl.Series(name, [row[name] for row in content], dtype=kind) for name, kind in schema.items()}
    )


class Table:
    """A table that rows are added to.

    Parameters
    ----------
    folder : Path
        Of the results: the table is the folder ``fleet`` in it.
    schema : mapping of name to type
    plan : Plan
        Which problem its rows are of.

    Raises
    ------
    FileError
        The folder cannot be made, another client has it, or a file of it is damaged.

    """

    def __init__(self, folder: Path, schema: Mapping[str, Any], plan: Plan) -> None:
        self.folder = folder / "fleet"
        self.work = folder / WORK
        self.schema = schema
        self.plan = plan
        self.rows: list[Row] = []
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
        """Write the rows that are kept, each in place of an older one of its log."""
        started = time.monotonic()
        if self.rows:
            new = make_frame(self.rows, self.schema, self.plan)
            if self.present.isdisjoint(new["log"]):
                name = f"part-{secrets.token_hex(8)}.parquet"
                self._write(new, name).rename(self.folder / name)
                if len(self.parts()) >= MOST_PARTS:
                    self.merge()
            else:
                self.merge(new)
            self.present.update(new["log"])
            self.rows = []
        took = time.monotonic() - started
        self.due = time.monotonic() + max(PART_S, took / WRITING)

    def read(self) -> pl.DataFrame:
        """Return all rows that are written, in order of their logs, in columns of the schema, then others there are."""
        frames = [_read(path) for path in self.parts()]
        missing = pl.DataFrame(schema=dict(self.schema))
        return pl.concat([missing, *frames], how="diagonal_relaxed").sort("log")

    def merge(self, new: pl.DataFrame | None = None) -> None:
        """Put all rows into one file, in order of their logs, with new ones in place of older ones of the same logs."""
        parts, rows = self.parts(), self.read()
        if new is not None:
            rows = rows.join(new.select("log"), on="log", how="anti")
            rows = pl.concat([rows, new], how="diagonal_relaxed").sort("log")
        names = json.dumps([path.name for path in parts])
        self._replace(self._write(rows, f"{MERGED}part-{secrets.token_hex(8)}.parquet", {"replaces": names}))

    def relabel(self, names: Sequence[str], logs: Sequence[FleetLog]) -> None:
        """Give the rows of logs the identities that these have now."""
        rows = self.read()
        if not names or not len(rows):
            return
        now = pl.DataFrame({"log": [log.path for log in logs], **{n: [log.identity[n] for log in logs] for n in names}})
        labelled = rows.drop(names).join(now, on="log").select(rows.columns)
        before = rows.join(now.select("log"), on="log", how="semi")
        if not labelled.select("log", *names).equals(before.select("log", *names)):
            self.merge(labelled)

    def _replace(self, merged: Path) -> None:
        """Delete the parts that a merged file replaces, then show it."""
        for name in json.loads(pl.read_parquet_metadata(merged)["replaces"]):
            (self.folder / name).unlink(missing_ok=True)
        merged.rename(self.folder / merged.name.removeprefix(MERGED))

    def _recover(self) -> None:
        """Finish what a client that was killed had begun."""
        for path in self.work.glob(f"{MERGED}*"):
            self._replace(path)
        for path in self.work.glob("*.parquet"):
            path.rename(self.folder / path.name)  # whole, too
        for path in self.work.glob(".seaopt-*"):
            path.unlink()

    def _write(self, frame: pl.DataFrame, name: str, metadata: dict[str, str] | None = None) -> Path:
        content = io.BytesIO()
        frame.write_parquet(content, metadata=metadata)
        return write_bytes(self.work / name, content.getvalue())


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
    """Return the open lock of a table, which ends with the process.

    Raises
    ------
    FileError
        Another process has it.

    """
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
