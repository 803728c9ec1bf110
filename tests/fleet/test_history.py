"""Whose logs are, and when they were taken: by columns of the identity."""

from __future__ import annotations

import polars as pl
import pytest

from seaopt.errors import SeaoptError
from seaopt.fleet import Fleet, order_runs
from seaopt.fleet.history import LABEL, TIME, format_time


def make_fleet(**columns: list[str]) -> Fleet:
    (count,) = {len(column) for column in columns.values()}
    rows = pl.DataFrame({"log": [f"{k}.csv" for k in range(count)], **columns})
    return Fleet(rows=rows, units={}, identity=tuple(columns))


@pytest.mark.parametrize(
    ("columns", "times", "unit"),
    [
        ({"date": ["2026-02-01", "2026-01-31"]}, [1.0, 0.0], "day"),
        ({"date": ["20260201", "20260131"], "time": ["0600", "1800"]}, [1.25, 0.75], "day"),
        ({"when": ["2026-01-31T00:00:00Z", "2026-01-31T12:00:00Z"]}, [0.0, 0.5], "day"),
        ({"timestamp": ["1769817600", "1769904000"]}, [0.0, 1.0], "day"),
        ({"hours": ["110.5", "9"]}, [110.5, 9.0], "hours"),
        ({"run": ["run10", "run9"]}, [2.0, 1.0], "run"),
        ({"joint": ["knee", "knee"]}, [1.0, 2.0], "run"),
    ],
)
def test_times_are_read(columns: dict[str, list[str]], times: list[float], unit: str) -> None:
    history = order_runs(make_fleet(**columns))
    rows = history.rows.sort("log")
    start = 20484.0 if unit == "day" else 0.0  # 2026-01-31
    assert (rows[TIME] - start).to_list() == times and history.unit == unit
    assert history.rows[TIME].is_sorted()
    assert bool(history.warning) == ("joint" in columns)


def test_what_is_no_time_names_the_actuator_and_a_log_without_one_has_none() -> None:
    fleet = make_fleet(
        robot=["r1", "r1", "r2"],
        joint=["hip", "hip", "hip"],
        date=["2026-01-02", "", "2026-01-01"],
        run=["1", "2", "1"],
    )
    history = order_runs(fleet)
    assert history.actuator == ("robot", "joint")
    assert history.rows[LABEL].to_list() == ["r1 / hip", "r1 / hip", "r2 / hip"]
    assert history.rows[TIME].null_count() == 1
    by_robot = order_runs(fleet, actuator=["robot"], time=["run"])
    assert by_robot.actuator == ("robot",) and by_robot.rows[TIME].to_list() == [1.0, 2.0, 1.0]


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"time": ["dat"]}, 'did you mean "date"'),
        ({"actuator": ["unit"]}, "known: joint, date"),
        ({}, "2026-01-31"),
    ],
)
def test_what_is_refused(options: dict[str, list[str]], words: str) -> None:
    with pytest.raises(SeaoptError, match=words):
        order_runs(make_fleet(joint=["a", "b"], date=["yesterday", "2026-01-01"]), **options)


def test_logs_that_name_no_actuator_are_not_taken_for_one() -> None:
    fleet = make_fleet(robot=["", "", "r1"], joint=["", "", ""], run=["1", "2", "3"])
    history = order_runs(fleet)
    assert sorted(history.rows[LABEL].to_list()) == sorted([*fleet.rows["log"].to_list()[:2], "r1 / "])


def test_the_one_date_that_is_none_is_named() -> None:
    dates = ["2026-01-01", "", "2026-01-02", "2026-13-03"]
    with pytest.raises(SeaoptError, match='"2026-13-03"'):
        order_runs(make_fleet(joint=["a"] * 4, date=dates))


def test_numbers_of_other_length_are_no_dates() -> None:
    history = order_runs(make_fleet(run=["123456", "234567"]))
    assert history.unit == "run" and history.rows[TIME].to_list() == [123456.0, 234567.0]
    assert format_time(123456.0, "run") == "run 123456"
