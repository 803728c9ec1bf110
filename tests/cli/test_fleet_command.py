"""`seaopt fleet` on the command line: verdict, JSON, exit codes."""

from __future__ import annotations

import json

import pytest

from tests.fleet.conftest import PROBLEM, write_log


@pytest.fixture
def fleet(folder, seaopt, monkeypatch):
    """Return what runs the command on two good logs, in this process."""
    from concurrent.futures import ThreadPoolExecutor

    monkeypatch.setattr("seaopt.executors.Processes", lambda workers: ThreadPoolExecutor(workers or 1))
    (folder / "stand.toml").write_text(PROBLEM, encoding="utf-8")
    for k in range(2):
        write_log(folder / f"r0_j{k}.csv", k)
    return lambda *arguments: seaopt("fleet", "stand.toml", *arguments)


def test_the_verdict_comes_first_and_a_second_run_has_nothing_to_do(fleet, folder):
    done = fleet("r0_j?.csv", "-o", "out", "--identity", "{robot}_{joint}.csv")
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("met      Fleet: 2 logs, all met")
    again = fleet("r0_j?.csv", "-o", "out", "--json")
    content = json.loads(again.stdout)
    assert content["counts"] == {"met": 2, "not met": 0, "failed": 0} and content["units"]["J"] == "kg m^2"
    assert content == {
        name: value for name, value in json.loads((folder / "out/fleet.json").read_text()).items() if name in content
    }


def test_a_log_with_a_gap_is_named(fleet, folder):
    lines = (folder / "r0_j0.csv").read_text().splitlines()
    (folder / "r0_j0.csv").write_text("\n".join(lines[:401] + lines[520:]))
    done = fleet("r0_j?.csv", "-o", "out")
    said = " ".join(done.stdout.split())
    assert done.returncode == 0 and "with gaps: 1 log (" in said and "r0_j0.csv: 1 gap, 119 samples lost" in said


def test_a_log_that_is_not_met_exits_1_with_its_reason(fleet, folder):
    (folder / "bad.csv").write_text("junk\n", encoding="utf-8")
    (folder / "list.csv").write_text("log,unit\nbad.csv,a\nr0_j0.csv,b\n", encoding="utf-8")
    done = fleet("--manifest", "list.csv", "-o", "out")
    assert done.returncode == 1
    assert done.stdout.startswith("not met  Fleet: 1 of 2 logs not met: 1 failed\n")
    assert "bad.csv" in done.stdout


@pytest.mark.parametrize(
    "arguments", [(), ("r0_j0.csv", "--manifest", "list.csv"), ("none*.csv",), ("r0_j0.csv", "--like", "other")]
)
def test_bad_input_is_one_line_and_exits_2(fleet, arguments):
    done = fleet(*arguments)
    assert done.returncode == 2 and len(done.stderr.strip().splitlines()) <= 2
