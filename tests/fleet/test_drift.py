"""Drift over time: run lengths against published ones and simulation, and alarms against what was put in."""

from __future__ import annotations

from typing import Any

import numpy as np
import polars as pl
import pytest

from seaopt.errors import SeaoptError
from seaopt.fleet import Fleet, find_drift
from seaopt.fleet.cusum import alarm_probabilities, chart_runs, choose_threshold

NAMES = ("J", "b_r")
RUNS = 101


def make_fleet(actuators: int, seed: int, change: Any = 0.0, **columns: Any) -> Fleet:
    """Return a fleet whose values scatter by 1 between runs and by 0.5 to 1.5 in fits; J of unit 0 changes."""
    rng = np.random.default_rng(seed)
    shape = (actuators, RUNS, 2)
    stds = rng.uniform(0.5, 1.5, shape)
    values = 100.0 + 20.0 * rng.normal(size=(actuators, 1, 2)) + rng.normal(size=shape) + stds * rng.normal(size=shape)
    values[0, :, 0] += change
    unit, run = np.divmod(np.arange(actuators * RUNS), RUNS)
    rows: dict[str, Any] = {"log": [f"{u}/{r}.csv" for u, r in zip(unit, run, strict=True)], "status": "met"}
    rows |= {"unit": unit.astype(str), "run": (run + 1).astype(str)}
    for k, name in enumerate(NAMES):
        rows |= {name: values[:, :, k].ravel(), f"{name}_std": stds[:, :, k].ravel()}
    table = pl.DataFrame(rows).with_columns(**columns).sample(fraction=1.0, shuffle=True, seed=seed)
    return Fleet(rows=table, units={"J": "kg m^2", "b_r": "N m s"}, identity=("unit", "run"), fitted=NAMES)


@pytest.mark.parametrize(("threshold", "length"), [(4.0, 168.0), (5.0, 465.0)])
def test_average_run_lengths_are_the_published_ones(threshold: float, length: float) -> None:
    # Two-sided, k = 0.5: Montgomery, Introduction to Statistical Quality Control, table of ARL of the tabular CUSUM.
    quiet = 1.0 - alarm_probabilities(threshold, 20_000)  # the mean of a count is the sum of what it exceeds
    assert np.sum(quiet) / 2 == pytest.approx(length, rel=2e-3)


def test_alarms_of_charts_are_as_frequent_as_the_chain_says() -> None:
    values = np.random.default_rng(3).normal(size=(20000, RUNS))
    stds = np.random.default_rng(4).uniform(0.2, 3.0, size=values.shape)
    threshold = choose_threshold(0.1, RUNS - 1, 1)
    assert 2 * alarm_probabilities(threshold, RUNS - 1)[-1] == pytest.approx(0.1, rel=1e-3)
    share = float(np.mean(chart_runs(7.0 + stds * values, stds**2, threshold).alarm >= 0))
    assert 0.085 < share < 0.105  # the two sides exclude each other a little: 0.1 is the most


def test_innovations_are_recursive_residuals() -> None:
    rng = np.random.default_rng(1)
    values, variances = 3.0 + rng.normal(size=(1, 12)), rng.uniform(0.5, 2.0, size=(1, 12))
    innovations = chart_runs(values, variances, 50.0).innovations[0]
    for run in range(1, 12):
        mean = np.average(values[0, :run], weights=1 / variances[0, :run])
        spread = np.sqrt(variances[0, run] + 1 / np.sum(1 / variances[0, :run]))
        assert innovations[run] == pytest.approx((values[0, run] - mean) / spread, rel=1e-12)
    assert np.isnan(innovations[0])


def test_one_percent_of_healthy_actuators_have_an_alarm() -> None:
    drift = find_drift(make_fleet(300, 5))  # of 1,000: benchmarks/bench_fleet_drift.py
    assert len({one.actuator for one in drift.alarms}) < 9  # 3 expected, at most: once in 250 seeds there are more
    assert drift.expected == pytest.approx(3.0, rel=1e-3)
    assert drift.between["J"].std == pytest.approx(1.0, rel=0.03)


def test_what_drifts_is_told_with_since_when_and_how_much() -> None:
    run = np.arange(RUNS)
    change = 0.3 * np.maximum(run - 39, 0)
    drift = find_drift(make_fleet(30, 2, change))
    alarm = drift.alarms[0]
    assert (alarm.actuator, alarm.parameter) == ("0", "J")
    raised = int(alarm.raised_time.removeprefix("run "))
    assert 41 < raised < 58 and int(alarm.since_time.removeprefix("run ")) in range(35, raised)
    assert alarm.after - alarm.before > 5.0 and "rose" in alarm.describe()
    row = drift.table.filter((pl.col("actuator") == "0") & (pl.col("parameter") == "J")).row(0, named=True)
    assert row["alarm"] and row["change"] > 10 * row["change_std"]
    assert row["slope"] == pytest.approx(np.polyfit(run, change, 1)[0], abs=4 * row["slope_std"])


def test_trends_of_what_does_not_drift_are_within_their_stds() -> None:
    table = find_drift(make_fleet(200, 9)).table
    ratios = (table["slope"] / table["slope_std"]).to_numpy()
    assert np.std(ratios) == pytest.approx(1.0, abs=0.1) and abs(np.mean(ratios)) < 0.2


def test_one_wild_run_raises_no_alarm_two_do() -> None:
    wild = np.zeros(RUNS)
    wild[50] = 100.0
    assert not [one for one in find_drift(make_fleet(20, 4, wild)).alarms if one.actuator == "0"]
    wild[51:53] = 100.0
    assert [one for one in find_drift(make_fleet(20, 4, wild)).alarms if one.actuator == "0"]


def test_logs_that_are_not_met_are_left_out_and_counted() -> None:
    bad = pl.col("run").cast(int) % 10 == 0
    fleet = make_fleet(
        20, 4, status=pl.when(bad).then(pl.lit("not met")).otherwise(pl.lit("met")),
        J=pl.when(bad).then(1e9).otherwise(pl.col("J")),
    )  # fmt: skip
    drift = find_drift(fleet, since=11)
    assert drift.left_out == {"not met": 200, "before 11": 180}
    assert (drift.table["mean"] < 200.0).all()
    assert drift.table["runs"].unique().to_list() == [82]


def test_a_fleet_without_histories_says_so() -> None:
    fleet = make_fleet(5, 1)
    drift = find_drift(Fleet(rows=fleet.rows, units=fleet.units))
    assert "--identity" in drift.verdict and not drift.alarms and drift.table.is_empty()
    single = find_drift(Fleet(rows=fleet.rows.filter(pl.col("run") == "1"), units=fleet.units, identity=fleet.identity))
    assert single.verdict.startswith("not looked for: no actuator has two logs")


@pytest.mark.parametrize(
    "options", [{"parameters": ["k"]}, {"false_alarms": 0.0}, {"since": "soon"}, {"time": ["day"]}]
)
def test_what_is_refused(options: Any) -> None:
    with pytest.raises(SeaoptError):
        find_drift(make_fleet(2, 1), **options)


def test_what_has_come_back_further_than_it_was_is_told_as_it_was_at_the_alarm() -> None:
    run = np.arange(RUNS)
    alarm = find_drift(make_fleet(20, 4, 20.0 * (run >= 50) - 60.0 * (run >= 60))).alarms[0]
    assert (alarm.actuator, alarm.since_time) == ("0", "run 51") and "rose" in alarm.describe()
    assert alarm.after - alarm.before == pytest.approx(20.0, abs=4.0) and alarm.runs < 6


def test_what_is_too_rare_is_refused_whatever_the_number_of_charts() -> None:
    for charts in (1, 50):
        with pytest.raises(SeaoptError, match="1e-06 or more"):
            choose_threshold(1e-9, 100, charts)
    threshold = choose_threshold(1e-6, 100, 50)
    assert 2 * 50 * alarm_probabilities(threshold, 100)[-1] == pytest.approx(1e-6, rel=1e-2)
