"""`seaopt bringup` and `seaopt accept --stage` of schedules and predictive control: a stage's own C on a machine."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from typer.testing import CliRunner

import seaopt as so
from seaopt.cli.main import app
from seaopt.control import ScheduledController
from seaopt.files import to_json
from seaopt.problem import certify_problem
from seaopt.problem.stages import design_mpc
from tests.machine.simulator import Bench, Machine

SCHEDULED = """
schema = 1
title = "Stand over its spring"
plant = { stand = { kind = "high_impedance" } }
robustness = { parameters = { eta = [0.98, 1.0] }, samples = 5 }

[controller]
plant = "stand"
measured = "F1"
bandwidth_hz = 25
max_sensitivity = 1.6
current_limit_A = 9.0
reserve = 0.05
schedule = { over = "k", points = [5e5, 8e5], min_rate = 5e5 }
"""
PLANNED = """
schema = 1
title = "Planned"
plant = { stand = { kind = "high_impedance" } }
robustness = { parameters = { eta = [0.98, 1.0] }, samples = 5, constrained_runs = 2 }

[controller]
plant = "stand"
structure = "mpc"
bandwidth_hz = 20
current_limit_A = 9.0
"""


@pytest.fixture
def seaopt(tmp_path):
    def run(command, *arguments):
        stated = [command, str(tmp_path / "stand.toml"), *map(str, arguments), "-o", str(tmp_path / "out")]
        return CliRunner().invoke(app, stated)

    return run


@pytest.fixture
def play(compiler, tmp_path):
    """Return what flashes a stage's C on a machine, plays the stage's reference, and returns the log's path."""

    def run(stage, law, machine, **options):
        folder = tmp_path / "out" / "bringup"
        reference = so.read_log(folder / stage / "reference.csv")["reference"]
        if "place" in options:
            options["places"] = np.full(reference.size, options.pop("place"))
        log = Bench(compiler, folder, law, stage, exported=True).log(machine, reference, decimals=3, **options)
        return so.write_log(log, tmp_path / f"{stage}.csv")

    return run


def read_stages(tmp_path):
    return json.loads((tmp_path / "out" / "bringup" / "bringup.json").read_text())["stages"]


@pytest.mark.slow
def test_a_schedule_is_brought_up_from_a_quarter_of_its_bandwidth_and_each_stage_accepted(tmp_path, seaopt, play):
    (tmp_path / "stand.toml").write_text(SCHEDULED)
    assert seaopt("tune").exit_code == 0
    done = seaopt("bringup", "--limit", "F1=900")
    assert done.exit_code == 0 and "4 of 4 stages with a certified law" in " ".join(done.output.split()), done.output
    rows = [(stage["name"], stage["bandwidth_hz"], stage["place"], stage["note"]) for stage in read_stages(tmp_path)]
    slow, half, whole = 6.25, 12.5, 25
    assert rows == [
        ("stage_1", slow, 5e5, ""),
        ("stage_2", half, 5e5, ""),
        ("full_1", whole, 5e5, ""),
        ("full_2", whole, 8e5, ""),
    ]

    problem = so.read_problem(tmp_path / "stand.toml")
    content = json.loads((tmp_path / "out" / "bringup" / "stage_1" / "controller.json").read_text())
    law = ScheduledController.from_dict(content, problem.design_plant, problem.values(problem.parameters))
    assert law.spec.bandwidth_hz == slow
    soft, stiff = (replace(Machine(), stiffness=stiffness) for stiffness in (5e5, 8e5))
    first = play("stage_1", law, soft, place=5e5)
    done = seaopt("accept", first, "--stage", "stage_1")
    assert done.exit_code == 0, done.output
    assert json.loads((tmp_path / "out" / "acceptance.json").read_text())["place"]["value"] == 5e5
    assert seaopt("accept", first).exit_code == 1  # it is not the full law
    content = json.loads((tmp_path / "out" / "controller.json").read_text())
    law = ScheduledController.from_dict(content, problem.design_plant, problem.values(problem.parameters))
    assert seaopt("accept", play("full_2", law, stiff, place=8e5)).exit_code == 0
    missing = seaopt("accept", first, "--stage", "stage_9")
    assert missing.exit_code != 0 and "there are full_1, full_2, stage_1, stage_2" in str(missing.exception)


@pytest.mark.slow
def test_predictive_control_is_brought_up_slower_and_its_stage_accepted(tmp_path, seaopt, play):
    (tmp_path / "stand.toml").write_text(PLANNED)
    assert seaopt("tune").exit_code == 0
    assert seaopt("certify").exit_code == 0
    done = seaopt("bringup", "--limit", "F1=900")
    assert done.exit_code == 0, done.output
    assert "certifying the law itself" not in done.output  # the folder's certificate is taken
    first, second, full = read_stages(tmp_path)
    assert (first["bandwidth_hz"], first["command_limit"]) == (20.0, 2.25) and "25 % of its effort" in first["note"]
    assert (second["bandwidth_hz"], second["command_limit"], second["note"]) == (10.0, 9.0, "")
    assert first["met"] and second["met"] and (full["bandwidth_hz"], full["command_limit"]) == (20.0, 9.0)

    problem = so.read_problem(tmp_path / "stand.toml")
    for stage, change in (("stage_1", {"current_limit_A": 2.25}), ("stage_2", {"bandwidth_hz": 10.0})):
        law = design_mpc(replace(problem, mpc=replace(problem.mpc, **change)), problem.parameters)
        log = play(stage, law, Machine())
        seaopt("accept", log, "--stage", stage)
        content = json.loads((tmp_path / "out" / "acceptance.json").read_text())
        assert content["replay"]["met"] and content["response"] is not None, content["replay"]
    seaopt("accept", log)  # of the slower stage, under the full law
    assert not json.loads((tmp_path / "out" / "acceptance.json").read_text())["replay"]["met"]


def test_a_full_law_without_a_certificate_is_certified_as_the_command_does_it(tmp_path, seaopt, monkeypatch):
    made = []

    def record(*arguments, **options):
        made.append(certify_problem(*arguments, **options))
        return made[-1]

    monkeypatch.setattr("seaopt.cli.machine.certify_problem", record)
    (tmp_path / "stand.toml").write_text(SCHEDULED[: SCHEDULED.index("schedule =")])
    assert seaopt("tune").exit_code == 0 and seaopt("bringup", "--limit", "F1=900").exit_code == 0
    assert seaopt("certify").exit_code == 0
    certified = json.loads((tmp_path / "out" / "robustness.json").read_text())
    full = json.loads(to_json(made[-1].to_dict()))
    assert full["simulation"]["large_signal"]
    assert all(full[part] == certified[part] for part in ("requirements", "plants", "simulation"))
    (tmp_path / "stand.toml").write_text(SCHEDULED[: SCHEDULED.index("schedule =")].replace("25", "20"))
    assert seaopt("tune").exit_code == 0
    refused, count = seaopt("bringup", "--limit", "F1=900"), len(made)
    assert isinstance(refused.exception, so.SeaoptError)
    assert "robustness.json: is not of controller.json beside it; run seaopt certify" in str(refused.exception)
    assert len(made) == count  # nothing was certified in its place
