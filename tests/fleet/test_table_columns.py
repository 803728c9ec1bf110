"""What a fleet's table says beside values and stds: how errors are correlated, and what a fit rests on."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

import seaopt as so
from seaopt.fleet.result import count_reasons
from tests.fleet.conftest import PROBLEM


def test_correlations_of_errors_are_those_of_the_fit_alone_and_guesses_are_named(stand: Path) -> None:
    file = stand / "stand.toml"
    file.write_text(PROBLEM.replace("schema = 1", 'schema = 1\nguessed = ["k"]'), encoding="utf-8")
    with ThreadPoolExecutor(1) as executor:
        fleet = so.fit_fleet(file, [stand / "logs/r1_j2.csv"], executor=executor)
    problem = so.read_problem(file)
    alone = so.fit([problem.experiment_like(stand / "logs/r1_j2.csv", keep_slice=True)], problem.parameters)
    matrix = alone.covariance.matrix
    correlation = matrix[0, 1] / (matrix[0, 0] * matrix[1, 1]) ** 0.5
    assert fleet.rows["J:b_r_corr"][0] == pytest.approx(correlation, abs=1e-6) and abs(correlation) > 1e-4
    assert [one["kind"] for one in fleet.rows["findings"][0]] == ["guess"]
    assert fleet.verdict == "1 log, all met, on 1 guess: k" and fleet.to_dict()["guesses"] == "on 1 guess: k"


def test_findings_name_the_log_s_own_experiment(stand: Path) -> None:
    lines = (stand / "logs/r1_j2.csv").read_text(encoding="utf-8").splitlines()
    mirrored = [f"{head},{-float(force)}" for head, _, force in (line.rpartition(",") for line in lines[1:])]
    (stand / "logs/7 left.csv").write_text("\n".join([lines[0], *mirrored]), encoding="utf-8")
    with ThreadPoolExecutor(1) as executor:
        fleet = so.fit_fleet(stand / "stand.toml", [stand / "logs/7 left.csv"], executor=executor)
    row = fleet.rows.row(0, named=True)
    assert row["status"] == "not met"
    assert "log_7_left.F1" in {one["where"] for one in row["findings"]}
    assert all("test" not in one["where"] for one in row["findings"])


def test_reasons_that_differ_in_the_log_s_name_are_one() -> None:
    kinds = {"severity": "error", "kind": "explained"}
    rows = [(f"/logs/{n}.csv", "why", [kinds | {"where": f"log_{n}.F1"}]) for n in (7, 8)]
    rows += [(f"/logs/{n}.csv", f"stand.toml: experiment log_{n}: no column", None) for n in (1, 2, 3)]
    assert [count for _, count, _ in count_reasons(rows)] == [3, 2]
