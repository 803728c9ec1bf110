"""`seaopt fleet` over time: alarms, the page and the table of actuators, and what is refused before any fit."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from subprocess import CompletedProcess

import polars as pl
import pytest

from tests.fleet.conftest import PROBLEM, write_log

IDENTITY = ("--identity", "{unit}_{date}.csv")
Run = Callable[..., "CompletedProcess[str]"]


@pytest.fixture
def fleet(folder: Path, seaopt: Run, monkeypatch: pytest.MonkeyPatch) -> Run:
    """Return what runs the command, in this process, on five actuators of which one changes."""
    from concurrent.futures import ThreadPoolExecutor

    monkeypatch.setattr("seaopt.executors.Processes", lambda workers: ThreadPoolExecutor(workers or 1))
    (folder / "stand.toml").write_text(PROBLEM, encoding="utf-8")
    for unit in range(5):
        for day in range(1, 6):
            changed = 1.2 if unit == 2 and day > 3 else 1.0
            J = 3.31e-6 * (1.0 + 0.02 * unit + 1e-3 * ((7 * day + 3 * unit) % 5)) * changed
            write_log(folder / f"u{unit}_2026-01-0{day}.csv", 10 * unit + day, J=J, n=200)
    return lambda *arguments: seaopt("fleet", "stand.toml", "u*.csv", *arguments)


def test_an_alarm_is_told_and_stands_on_the_page(fleet: Run, folder: Path) -> None:
    done = fleet("-o", "out", *IDENTITY, "--false-alarms", "0.3")
    assert done.returncode == 0, done.stderr  # every log is met
    assert "alarm    Drift: 1 of 5 actuators with an alarm" in done.stdout and "u2: J rose" in done.stdout
    assert "since 2026-01-04" in done.stdout
    content = json.loads((folder / "out/fleet.json").read_text())
    (alarm,) = (one for one in content["drift"]["alarms"] if one["parameter"] == "J")
    assert alarm["actuator"] == "u2" and alarm["since"].endswith("u2_2026-01-04.csv")
    assert sorted(content["population"]["names"]) == ["J", "b_r"]
    assert content["problem_sha256"]
    actuators = pl.read_parquet(folder / "out/actuators.parquet")
    assert actuators["label"][0] == "u2" and len(actuators) == 5
    page = (folder / "out/fleet.html").read_text()
    assert "J rose" in page and "stand.toml" in page
    healthy = json.loads(fleet("-o", "out", *IDENTITY, "--since", "2026-01-04", "--json").stdout)
    assert (
        "left out of drift, of 25 logs: 15 before 2026-01-04"
        in fleet("-o", "out", *IDENTITY, "--since", "2026-01-04").stdout
    )
    assert healthy["drift"]["left_out"] == {"before 2026-01-04": 15} and not healthy["drift"]["alarms"]


def test_bad_options_are_refused_before_any_fit(folder: Path, seaopt: Run) -> None:
    (folder / "stand.toml").write_text(PROBLEM, encoding="utf-8")
    write_log(folder / "u0_2026-01-01.csv", 1, n=50)
    for arguments, words in (
        ((*IDENTITY, "--time", "day"), 'time = "day"'),
        ((*IDENTITY, "--actuator", "robot"), 'actuator = "robot"'),
        ((*IDENTITY, "--since", "yesterday"), "2026-01-31"),
        ((*IDENTITY, "--false-alarms", "2"), "false_alarms = 2"),
        (("--time", "date"), "--identity"),
    ):
        done = seaopt("fleet", "stand.toml", "u0_2026-01-01.csv", "-o", "out", *arguments)
        assert done.returncode == 2 and words in done.stderr and not (folder / "out").exists(), done.stderr
