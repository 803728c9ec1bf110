"""A schedule as a user makes one: tune, certify, report, export; and what is refused."""

import json
from functools import partial
from pathlib import Path

import pytest

from seaopt.machine import bring_up
from tests.cli.test_schemas import validator

KNEE = Path(__file__).resolve().parents[2] / "problems" / "lever_knee.toml"
SHORTER = {
    "points = [0.0, 0.3, 0.55, 0.75, 0.9, 1.05, 1.15]": "points = [0.0, 0.35]",
    "min_rate = 2.0": "min_rate = 1.0",  # as far as the link swings there
    "[robustness]": "[robustness]\nsamples = 50",
    'structure = "pid"': 'structure = "pid"\nprefilter = "first_order"',
}


@pytest.fixture(scope="module")
def text():
    text = KNEE.read_text(encoding="utf-8")
    for long, short in SHORTER.items():
        assert long in text
        text = text.replace(long, short)
    return text


@pytest.fixture
def knee(folder, text):
    (folder / "knee.toml").write_text(text, encoding="utf-8")
    return folder


@pytest.mark.slow
def test_tune_writes_a_schedule_that_export_takes_with_the_gate_of_its_file_at_every_point(knee, seaopt, text):
    gated = text.replace("[controller.schedule]", "[controller.gate]\nrange_N = [-200, 200]\n\n[controller.schedule]")
    (knee / "knee.toml").write_text(gated, encoding="utf-8")
    out = seaopt("tune", "knee.toml")
    assert out.returncode == 0, out.stderr
    content = json.loads((knee / "out" / "controller.json").read_text(encoding="utf-8"))
    assert content["schema"] == "seaopt/controller/3" and content["schedule"]["points"] == [0.0, 0.35]
    assert content["guards"]["gate"]["range_N"] == [-200.0, 200.0]
    assert not list(validator("controller").iter_errors(content))
    written = seaopt("export", "out", "--c", "c", "--name", "knee")
    assert written.returncode == 1 and {path.name for path in (knee / "c").iterdir()} == {"knee.h", "knee.c"}
    assert "not certified" in written.stdout
    assert "A reading is believed" in (knee / "c" / "knee.h").read_text(encoding="utf-8")
    assert seaopt("export", "out", "--c", "d", "--name", "knee", "--no-gate").returncode == 1
    assert "A reading is believed" not in (knee / "d" / "knee.h").read_text(encoding="utf-8")


@pytest.mark.slow
def test_a_whole_run_is_met_and_its_report_has_the_schedule(knee, seaopt):
    out = seaopt("run", "knee.toml")
    assert out.returncode == 0, out.stdout
    assert "phi is assumed to move slowly" in out.stdout
    page = (knee / "out" / "report.html").read_text(encoding="utf-8")
    assert "Gains at the points" in page and "proved" in page
    assert seaopt("report", "knee.toml").returncode == 0
    for document, name in (("controller", "controller.json"), ("robustness", "robustness.json")):
        content = json.loads((knee / "out" / name).read_text(encoding="utf-8"))
        assert not list(validator(document).iter_errors(content))
    written = seaopt("export", "out", "--c", "c")
    assert written.returncode == 0 and "not certified" not in written.stdout


@pytest.mark.slow
def test_a_rate_that_the_link_does_not_reach_is_named_with_what_to_change(knee, seaopt, text):
    (knee / "knee.toml").write_text(text.replace("min_rate = 1.0", "min_rate = 2.0"), encoding="utf-8")
    out = seaopt("run", "knee.toml")
    assert out.returncode == 1 and "min_motion_rate" in out.stdout
    (advice,) = [line for line in out.stdout.splitlines() if "next:" in line]
    assert "min_rate" in advice and "reserve" not in advice


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('over = "phi"', 'over = "ph"', 'did you mean "phi"'),
        ("points = [0.0, 0.35]", "points = [0.35, 0.0]", "do not ascend"),
        ("min_rate = 1.0", "bandwidth_hz = [30.0]", "give one per point"),
        ("I_p = [0.3, 0.42]", "phi = [0.3, 0.42]", "robustness.parameters.phi"),
        ('plant = "stand"\nmeasured', 'plant = "frf:x"\nmeasured', "frf:x"),
        ("[robustness]", "[expect.controller]\n[robustness]", "expect.controller"),
    ],
)
def test_what_cannot_be_scheduled_is_one_line(knee, seaopt, text, old, new, words):
    assert old in text
    (knee / "knee.toml").write_text(text.replace(old, new), encoding="utf-8")
    out = seaopt("tune", "knee.toml")
    assert out.returncode == 2 and words in out.stderr and len(out.stderr.strip().splitlines()) == 1


def test_a_sweep_of_bandwidths_tunes_the_schedule_at_each(knee, seaopt):
    out = seaopt("tune", "knee.toml", "--sweep", "20:30:10")
    assert out.returncode in (0, 1) and "phi = " in out.stdout, out.stderr
    content = json.loads((knee / "out" / "frontier.json").read_text(encoding="utf-8"))
    assert content["over"] == "phi" and [row["bandwidth_hz"] for row in content["rows"]] == [20, 30]
    for row, schedule in zip(content["rows"], content["controllers"], strict=True):
        assert schedule["schedule"]["bandwidth_hz"] == [row["bandwidth_hz"]] * len(schedule["schedule"]["points"])
        assert row["met"] == schedule["met"]


STAND = """schema = 1
title = "Stand"
parameters = { I_p = { value = 0.36, unit = "kg m^2" } }
plant = { stand = { kind = "high_impedance" }, swing = { kind = "moving_output" } }
robustness = { plants = ["swing"], parameters = { I_p = [0.2, 0.6] }, samples = 50 }
[controller]
plant = "stand"
measured = "F1"
bandwidth_hz = 25
max_sensitivity = 1.6
current_limit_A = 9.0
"""
SCHEDULE = 'schedule = { over = "k", points = [5e5, 8e5] }\n'


def test_every_command_takes_what_was_tuned_with_more_of_a_reserve_than_is_asked(
    folder, seaopt, without_simulation, monkeypatch
):
    """What the draws of the certificate need is taken off the limits while it is tuned, and the file says so."""
    # The stages of the law itself: slower laws are tuned anew, in half of this test's time.
    monkeypatch.setattr("seaopt.cli.machine.bring_up", partial(bring_up, fractions=()))
    (folder / "stand.toml").write_text(STAND + SCHEDULE, encoding="utf-8")
    assert seaopt("tune", "stand.toml").returncode == 0
    path = folder / "out" / "controller.json"
    assert json.loads(path.read_text(encoding="utf-8"))["spec"]["reserve"] == pytest.approx(0.03)
    for command in (["certify", "stand.toml"], ["report", "stand.toml"], ["bringup", "stand.toml"], ["export", "out"]):
        done = seaopt(*command, *(["--c", "c"] if command[0] == "export" else []))
        assert done.returncode == 0, (command, done.stderr)
