"""The page and the table of a fleet's actuators: worst first, whole in one file, thinned where there are many."""

from __future__ import annotations

import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import polars as pl
import pytest

from seaopt.fleet import Fleet, estimate_population, find_drift, page, tabulate_actuators, write_fleet_page
from seaopt.reporting.page.fleet import MOST_POINTS, draw_trend
from tests.fleet.test_drift import RUNS, make_fleet


@pytest.fixture(scope="module")
def fleet() -> Fleet:
    """Return twelve actuators: unit 0 drifts, unit 3 has logs that failed, unit 4 is called like markup."""
    made = make_fleet(12, 2, 0.3 * np.maximum(np.arange(RUNS) - 39, 0))
    failed = (pl.col("unit") == "3") & (pl.col("run") == "5")
    rows = made.rows.with_columns(
        pl.when(failed).then(pl.lit("failed")).otherwise("status").alias("status"),
        pl.when(failed).then(pl.lit("LOG: is empty")).alias("reason"),
        pl.lit(None).alias("findings"),
        pl.lit(0.3).alias("J:b_r_corr"),
        pl.col("unit").replace({"4": "<script>alert(1)</script>\x07"}),
    )
    return replace(made, rows=rows, free=("J", "b_r"))


class _Page(HTMLParser):
    """Collects ids, addresses, and the rows' heads of the table that sorts."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.ids: list[str] = []
        self.addresses: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        for name, value in attrs:
            if name == "id":
                self.ids.append(str(value))
            if name in ("src", "href") and not str(value).startswith("#"):
                self.addresses.append(str(value))


def test_the_worst_comes_first_and_nothing_is_fetched(fleet: Fleet, tmp_path: Path) -> None:
    drift = find_drift(fleet)
    text = write_fleet_page(fleet, drift, tmp_path / "fleet.html", population=estimate_population(fleet)).read_text()
    parsed = _Page(text)
    assert not parsed.addresses and len(parsed.ids) == len(set(parsed.ids)) and "url(" not in text
    names = re.findall(r'<th scope="row">([^<]*)</th>', text)
    assert names[0] == "0" and len(names) == 12 and names.index("3") < names.index("7")
    assert "<script>alert" not in text and "\x07" not in text and r"alert(1)&lt;/script&gt;\x07" in text
    assert text.count('class="trend"') == 24 and text.count('class="changed"') == len(drift.alarms)
    assert drift.alarms[0].describe() in text and "LOG: is empty" in text


def test_the_table_of_actuators_has_values_trends_and_alarms(fleet: Fleet) -> None:
    drift, population = find_drift(fleet), estimate_population(fleet)
    table = tabulate_actuators(fleet, drift, population)
    first = table.row(0, named=True)
    assert (first["label"], first["alarm"], first["logs"], first["last"]) == ("0", True, RUNS, "run 101")
    assert "J rose" in first["alarms"] and first["level"] > 1.0 and first["J_change"] > 10.0
    assert first["J"] == population.table.filter(pl.col("actuator") == "0")["J"][0]
    assert table.filter(pl.col("label") == "3").select("met", "failed").row(0) == (RUNS - 1, 1)
    plain = tabulate_actuators(fleet, drift).filter(pl.col("label") == "7").row(0, named=True)
    own = fleet.rows.filter(pl.col("unit") == "7")
    weights = 1.0 / (own["J_std"].to_numpy() ** 2 + drift.between["J"].std ** 2)
    assert plain["J"] == pytest.approx(np.average(own["J"], weights=weights), rel=1e-9)


def test_stds_of_means_allow_for_what_differs_from_run_to_run() -> None:
    rng, (units, runs) = np.random.default_rng(5), (300, 6)
    truth = rng.normal(50.0, 5.0, units)
    stds = rng.uniform(0.05, 0.2, units * runs)  # of fits; runs differ by 1
    values = np.repeat(truth, runs) + rng.normal(size=units * runs) * np.hypot(1.0, stds)
    unit, run = np.divmod(np.arange(units * runs), runs)
    columns = {"log": [f"{u}_{r}" for u, r in zip(unit, run, strict=True)], "status": "met"}
    columns |= {"unit": unit.astype(str), "run": run.astype(str), "J": values, "J_std": stds}
    fleet = Fleet(rows=pl.DataFrame(columns), units={"J": "kg m^2"}, identity=("unit", "run"), fitted=("J",))
    table = tabulate_actuators(fleet, find_drift(fleet))
    off = (table["J"].to_numpy() - truth[table["label"].cast(pl.Int64).to_numpy()]) / table["J_std"].to_numpy()
    assert 0.9 < np.std(off) < 1.1


def test_of_many_actuators_only_the_worst_have_drawings(
    fleet: Fleet, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(page, "MOST_DRAWN", 3)
    monkeypatch.setattr(page, "MOST_ROWS", 5)
    text = write_fleet_page(fleet, find_drift(fleet), tmp_path / "fleet.html").read_text()
    assert text.count('class="trend"') == 6 and text.count('<th scope="row">') >= 5
    assert "The 3 worst of 12 actuators have drawings." in text and "The 5 worst of 12 actuators are listed" in text


def test_a_drawing_has_forty_points_at_most_and_keeps_its_ends() -> None:
    run = np.arange(1000.0)
    drawing = str(draw_trend(run, 5.0 + run, np.ones(1000), label="J", since=500.0))
    line = re.search(r'class="line" d="M([^"]*)"', drawing)
    assert line is not None
    points = np.array([part.split() for part in line[1].split("L")], dtype=float)
    assert len(points) == MOST_POINTS and np.all(np.diff(points[:, 1]) < 0)  # a rise goes up on the page
    assert points[0, 0] < 5.0 and points[-1, 0] > 127.0 and 'class="changed" x="66' in drawing
    flat = str(draw_trend(run[:3], np.full(3, 2.0), np.zeros(3), label="J"))
    assert "nan" not in flat and "changed" not in flat
