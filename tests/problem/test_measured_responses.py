"""Measured responses in problem files: frf:NAME, from the file to the verdict."""

from __future__ import annotations

import json

import pytest
from typer.testing import CliRunner

import seaopt as so
from seaopt.cli.main import app
from seaopt.errors import ProblemError
from seaopt.problem.stages import list_plants, tune_problem

FILE = """
schema = 1
title = "measured"
[plant.stand]
kind = "high_impedance"
[[experiment]]
name = "chirp"
plant = "stand"
delay_s = 0.001
virtual = { seed = 1, duration_s = 40, rate_hz = 1000, noise_std = { F1 = 1.0 }, excitation = { chirp = { amplitude = 4.0, f0_hz = 0.1, f1_hz = 150 }, noise = { std = 2.0, band_hz = 200 } } }
[controller]
plant = "PLANT"
bandwidth_hz = 30
max_sensitivity = 1.7
max_noise_gain = 80
robust_to = [OTHERS]
[robustness]
samples = 50
"""  # noqa: E501


@pytest.fixture
def write(tmp_path):
    def write(plant="stand", others='"frf:chirp"'):
        path = tmp_path / "problem.toml"
        path.write_text(FILE.replace("PLANT", plant).replace("OTHERS", others))
        return path

    return write


def test_a_response_is_read_with_the_delay_that_its_experiment_has(write):
    problem = so.read_problem(write())
    design, others = list_plants(problem, problem.parameters)
    assert design is problem.design_plant
    assert others["frf:chirp"].clock.delay_s == 0.001 and others["frf:chirp"].confidence == 0.95
    controller = tune_problem(problem, problem.parameters)
    assert controller.feasible and [one.name for one in controller.measured] == ["frf:chirp"]
    measured = problem.measure_responses(problem.parameters)
    certificate = so.certify(
        controller, problem.certified_plants(), problem.parameters, simulations=False, measured=measured
    )  # fmt: skip
    rows = [row for row in certificate.requirements if row.where.startswith("frf:chirp (on measured points, at 95 %)")]
    assert {row.name for row in rows} == {"spectral_radius", "max_sensitivity", "max_complementary"}
    assert certificate.passed


def test_without_a_model_no_fit_is_needed_and_none_is_certified(write, tmp_path):
    path = write("frf:chirp", "")
    result = CliRunner().invoke(app, ["tune", str(path), "-o", str(tmp_path / "out")])
    assert result.exit_code == 0 and "every limit met on measured points" in result.stdout
    stored = json.loads((tmp_path / "out" / "controller.json").read_text())
    assert stored["measured_responses"][0]["stable"] and stored["fit_met"]
    assert stored["achieved"]["bandwidth_hz"] == 30.0
    certified = CliRunner().invoke(app, ["certify", str(path), "-o", str(tmp_path / "out")])
    assert isinstance(certified.exception, ProblemError) and "takes a model" in str(certified.exception)


@pytest.mark.parametrize(
    ("plant", "others", "said"),
    [("stand", '"frf:chrip"', "chirp"), ("frf:other", "", "controller.plant"), ("stand", '"frf:"', "robust_to")],
)
def test_a_response_of_no_experiment_is_refused(write, plant, others, said):
    with pytest.raises(ProblemError, match=said):
        so.read_problem(write(plant, others))
