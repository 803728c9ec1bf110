"""`compensate` in a problem file: through tuning to controller.json and back."""

from __future__ import annotations

import json

import pytest

import seaopt as so
from seaopt.control import Controller
from seaopt.files import to_json
from seaopt.problem.stages import tune_problem

TEXT = """
schema = 1
[parameters]
f_c = 100.0
[plant.stand]
kind = "high_impedance"
[controller]
plant = "stand"
bandwidth_hz = 20
max_sensitivity = 1.6
compensate = %s
"""


@pytest.mark.parametrize(
    ("asked", "fraction", "source"),
    [
        ('["friction"]', 0.8, "reference"),
        ('{ friction = { fraction = 0.5, from = "speed", speed = 0.05 } }', 0.5, "speed"),
    ],
)
def test_what_the_file_asks_is_what_runs(tmp_path, asked, fraction, source):
    path = tmp_path / "problem.toml"
    path.write_text(TEXT % asked, encoding="utf-8")
    problem = so.read_problem(path)
    controller = tune_problem(problem, problem.parameters)
    term = controller.compensation.friction
    assert (term.fraction, term.source) == (fraction, source)
    assert term.effort == pytest.approx(fraction * 100.0)
    content = json.loads(to_json(controller.to_dict()))
    assert (
        Controller.from_dict(content, problem.design_plant, problem.parameters).compensation == controller.compensation
    )
    content["terms"]["friction"]["reads"] = "" if source == "speed" else "q"
    with pytest.raises(so.SeaoptError, match="reads"):
        Controller.from_dict(content, problem.design_plant, problem.parameters)


def test_retune_certifies_what_is_compensated(tmp_path):
    path = tmp_path / "problem.toml"
    asked = '{ friction = { from = "speed", speed = 0.05 } }\n[robustness]\nplants = []\nsamples = 10\nretune = 1'
    path.write_text(TEXT % asked, encoding="utf-8")
    problem = so.read_problem(path)
    joint = tune_problem(problem, problem.parameters)
    (one,) = joint.rounds
    assert one.certificate.controller.compensation is not None
    assert "friction_compensation" in [row.name for row in joint.certificate.requirements]
    assert joint.controller is joint.certificate.controller


@pytest.mark.parametrize(
    ("asked", "named"),
    [
        (
            '["frictoin"]',
            r"controller\.compensate\.1 = 'frictoin': should be 'friction' or 'gravity'; correct",
        ),
        ('"friction"', r"controller\.compensate = 'friction': should be a valid list; correct it: compensate = \["),
        ("{ friction = 3 }", r"controller\.compensate\.friction = 3: should be a table; correct it: friction = \{"),
        ("{ frictoin = {} }", r"unknown key controller\.compensate\.frictoin; did you mean"),
        ("{ friction = { fraction = 2.0 } }", "fraction"),
        ('{ friction = { from = "encoder" } }', "speed"),
        ("{ friction = { speed = 0.0 } }", "speed"),
    ],
)
def test_what_is_not_there_to_be_asked_is_named(tmp_path, asked, named):
    path = tmp_path / "problem.toml"
    path.write_text(TEXT % asked, encoding="utf-8")
    with pytest.raises(so.SeaoptError, match=named):
        so.read_problem(path)


def test_without_friction_there_is_nothing_to_compensate(tmp_path):
    path = tmp_path / "problem.toml"
    path.write_text((TEXT % '["friction"]').replace("f_c = 100.0", ""), encoding="utf-8")
    problem = so.read_problem(path)
    with pytest.raises(so.SeaoptError, match="no Coulomb friction at the motor"):
        tune_problem(problem, problem.parameters)


def test_gravity_of_another_plant_is_compensated(tmp_path):
    path = tmp_path / "problem.toml"
    text = TEXT.replace("[controller]", '[plant.swing]\nkind = "moving_output"\n[controller]')
    path.write_text(text % '{ gravity = { fraction = 0.9, plant = "swing" } }', encoding="utf-8")
    problem = so.read_problem(path)
    term = tune_problem(problem, problem.parameters).compensation.gravity
    assert (term.reads, term.fraction) == ("x_2", 0.9)
    path.write_text(text % '{ gravity = { plant = "swnig" } }', encoding="utf-8")
    with pytest.raises(so.SeaoptError, match="swing"):
        so.read_problem(path)
    path.write_text(text % '["gravity"]', encoding="utf-8")
    problem = so.read_problem(path)
    with pytest.raises(so.SeaoptError, match=r"holds its link; name the plant"):
        tune_problem(problem, problem.parameters)


def test_ripple_of_the_file_is_added(tmp_path):
    path = tmp_path / "problem.toml"
    asked = "{ ripple = { cycles = [6, 12], cos = [0.1, 0.0], sin = [0.0, 0.02], fraction = 0.8, period = 0.002 } }"
    path.write_text(TEXT % asked, encoding="utf-8")
    problem = so.read_problem(path)
    controller = tune_problem(problem, problem.parameters)
    term = controller.compensation.ripple
    assert (term.reads, term.cycles, term.period) == ("q", (6, 12), 0.002)
    assert controller.command.per_effort * term.effort(0.0) == pytest.approx(0.08)
    content = json.loads(to_json(controller.to_dict()))
    content["terms"]["ripple"]["cos"] = [0.1]
    with pytest.raises(so.SeaoptError, match="one cos and one sin"):
        Controller.from_dict(content, problem.design_plant, problem.parameters)
    path.write_text(TEXT % asked.replace("[0.1, 0.0]", "[0.1]"), encoding="utf-8")
    with pytest.raises(so.SeaoptError, match="one cos and one sin"):
        so.read_problem(path)
