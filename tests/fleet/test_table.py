"""The table of a fleet: what it costs to add to a long one, and that each log is there once, whatever was killed."""

from __future__ import annotations

import polars as pl
import pytest

from seaopt.fleet import table
from seaopt.fleet.plan import make_plan
from seaopt.fleet.table import FleetTable
from seaopt.problem import read_problem

SCHEMA = {"log": pl.String, "status": pl.String, "J": pl.Float64}


class Counting(FleetTable):
    """Counts the rows that it writes."""

    written = 0

    def _write(self, frame, name, metadata=None):
        self.written += len(frame)
        return super()._write(frame, name, metadata)


@pytest.fixture
def plan(made):
    return make_plan(read_problem(made / "stand.toml"), None, None, "client")


@pytest.fixture(autouse=True)
def small(monkeypatch):
    """Let 100 rows be a large file, and four parts many."""
    monkeypatch.setattr(table, "LARGE", 100)
    monkeypatch.setattr(table, "MOST_PARTS", 4)


def fill(one, numbers, J, at_a_time=10):
    """Add a row for each number, and check now and then that a reader sees each log once."""
    numbers = list(numbers)
    for start in range(0, len(numbers), at_a_time):
        one.add([{"log": f"{k:06d}", "status": "met", "J": J} for k in numbers[start : start + at_a_time]])
        one.flush()
        if start % 70 == 0:
            assert pl.read_parquet(one.folder)["log"].is_unique().all()


def write(folder, plan, count):
    """Return how many rows were written for a table of so many, made anew and then replaced whole, in another order."""
    one = Counting(folder, SCHEMA, plan)
    fill(one, range(count), 1.0)
    one.finish()
    first, one.written = one.written, 0
    fill(one, reversed(range(count)), 2.0)
    one.finish()
    rows = pl.read_parquet(one.folder).sort("log")
    assert rows["log"].to_list() == [f"{k:06d}" for k in range(count)] and (rows["J"] == 2.0).all()
    assert len(one.parts()) <= count / table.LARGE + 1
    one.close()
    return first / count, one.written / count


@pytest.mark.slow
def test_a_row_costs_the_same_in_a_longer_table(tmp_path, plan):
    short, long = (write(tmp_path / str(count), plan, count) for count in (200, 1600))
    assert long[0] == pytest.approx(short[0], rel=0.1) and long[0] < 5.0
    assert long[1] < 2.0 / table.SHARE and long[1] < 1.2 * short[1] + 1.0


def test_newer_rows_of_a_killed_client_are_found(tmp_path, plan):
    one = FleetTable(tmp_path, SCHEMA, plan)
    fill(one, range(100), 1.0)
    fill(one, [7, 300, 8], 2.0)
    assert pl.read_parquet(one.folder).filter(pl.col("log") == "000007")["J"].to_list() == [1.0]  # whole, and older
    assert one.read().filter(pl.col("J") == 2.0)["log"].to_list() == ["000007", "000008", "000300"]
    one.close()  # as the end of its process does
    again = FleetTable(tmp_path, SCHEMA, plan)
    rows = pl.read_parquet(again.folder)
    assert rows.filter(pl.col("J") == 2.0)["log"].sort().to_list() == ["000007", "000008", "000300"]
    assert len(rows) == 101 and [path.name for path in again.work.iterdir()] == ["lock"]
    again.close()


def test_newer_rows_are_put_in_again_where_that_was_killed(tmp_path, plan, monkeypatch):
    one = FleetTable(tmp_path, SCHEMA, plan)
    fill(one, range(300), 1.0, at_a_time=100)
    merged = FleetTable._write_merged

    def die(self, rows, parts):
        if len(one.parts()) and (pl.read_parquet(one.folder)["J"] == 2.0).any():
            raise KeyboardInterrupt
        merged(self, rows, parts)

    monkeypatch.setattr(FleetTable, "_write_merged", die)
    with pytest.raises(KeyboardInterrupt):
        fill(one, range(0, 300, 3), 2.0, at_a_time=100)
    assert pl.read_parquet(one.folder)["log"].is_unique().all()
    one.close()
    monkeypatch.undo()
    again = FleetTable(tmp_path, SCHEMA, plan)
    rows = pl.read_parquet(again.folder)
    assert len(rows) == 300 and (rows["J"] == 2.0).sum() == 100
    again.close()
