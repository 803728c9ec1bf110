"""What [expect] asks, held against figures a hair better and a hair worse than those of one problem's results."""

from __future__ import annotations

import json
import sys
from types import SimpleNamespace

import pytest

import seaopt as so
from seaopt.cli import main
from seaopt.problem import Stages, json_schema, tune_problem
from seaopt.robustness.certificate.simulated import SIMULATIONS
from tests.checks import leave_out

DESIGN = """
schema = 1
[plant.stand]
kind = "high_impedance"
[plant.swing]
kind = "moving_output"
[controller]
plant = "stand"
bandwidth_hz = 30
[robustness]
plants = ["stand"]
parameters = { eta = [0.95, 1.0] }
samples = 30
"""
FRICTION = """
[parameters]
f_c = 10.0
v_s = 0.01
"""
DOWNWARDS = {"ms", "mt", "reference_peak", "droop_db", "noise_gain"}  # good where small
FIGURES = (
    "bandwidth_hz", "crossover_hz", "sensitivity_bandwidth_hz", "ms", "mt", "reference_peak", "droop_db",
    "gain_margin_db", "phase_margin_deg", "delay_margin_s", "disk_margin", "noise_gain",
)  # fmt: skip


def read(path, expect, friction=FRICTION):
    file = path / "design.toml"
    file.write_text(DESIGN + friction + expect, encoding="utf-8")
    return so.read_problem(file)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Return the problem's results, with the figures in them that are read here."""
    problem = read(tmp_path_factory.mktemp("design"), "")
    values, plants = problem.parameters, problem.certified_plants()
    controller = tune_problem(problem, values)
    certificate = so.certify(controller, plants, values, ranges=problem.ranges, samples=30, simulations=False)
    stages = Stages(problem, fit=None, controller=controller, certificate=certificate)
    return SimpleNamespace(stages=stages, achieved=controller.achieved, certificate=certificate)


@pytest.fixture
def check(tmp_path, made):
    """Return a function that gives what came of each expectation, by name."""

    def judge(expect):
        problem = read(tmp_path, expect)
        return {one.name: one.check(made.stages) for one in so.testing.list_expectations(problem)}

    return judge


@pytest.mark.parametrize("figure", FIGURES)
def test_a_number_is_the_limit_on_the_bad_side(figure, check, made):
    value = getattr(made.achieved, figure)
    hair = 0.02 * (abs(value) or 1.0)
    better, worse = (value - hair, value + hair) if figure in DOWNWARDS else (value + hair, value - hair)
    for asked, met in ((better, False), (worse, True)):
        found = check(f"[expect.controller]\n{figure} = {asked!r}\n")
        assert found["controller.met"][0] and found[f"controller.{figure}"][0] is met
        text = found[f"controller.{figure}"][1]
        assert float(text.split("found ")[1].split()[0].rstrip(",")) == pytest.approx(value, rel=1e-3)
        assert ("; " in text) is not met


def test_a_range_has_two_ends(check, made):
    ms = made.achieved.ms
    for ends, met in (((ms - 0.1, ms + 0.1), True), ((ms + 0.1, ms + 0.2), False), ((1.0, ms - 0.1), False)):
        assert check(f"[expect.controller]\nms = {list(ends)}\n")["controller.ms"][0] is met


def test_a_tracking_band_contains_the_one_that_is_asked(check, made):
    low, high = made.achieved.tracking_band_hz
    for ends, met in (([low, high], True), ([low + 1, high - 1], True), ([low, high * 1.01], False)):
        assert check(f"[expect.controller]\ntracking_band_hz = {ends}\n")["controller.tracking_band_hz"][0] is met


def test_a_plant_with_friction_is_judged_sliding_and_stuck(check, made):
    """The worse of the two decides: its Ms is asked, and less than it."""
    sizes = {name: loop.ms for name, loop in made.certificate.plants.items()}
    assert set(sizes) == {"stand sliding", "stand stuck"}
    for asked, met in ((max(sizes.values()), True), (0.5 * sum(sizes.values()), False)):
        found, text = check(f"[expect.certificate.plants.stand]\nms = {asked!r}\n")["certificate.plants.stand.ms"]
        assert found is met and "stand sliding" in text and "stand stuck" in text
    worst = max(made.certificate.worst[name].ms for name in sizes)
    for asked, met in ((worst * 1.001, True), (worst * 0.99, False)):
        name = "certificate.plants.stand.worst_ms"
        assert check(f"[expect.certificate.plants.stand]\nworst_ms = {asked!r}\n")[name][0] is met


def test_the_certificate_and_its_bound_are_expected(check, made):
    bound = made.certificate.monte_carlo.failure_probability_bound
    for asked, met in ((bound * 1.01, True), (bound * 0.99, False)):
        found = check(f"[expect.certificate]\nfailure_probability = {asked!r}\n")
        assert found["certificate.failure_probability"][0] is met
        assert found["certificate.met"][0] is made.certificate.met
    turned = check(f"[expect.certificate]\nmet = {str(not made.certificate.met).lower()}\n")
    assert turned["certificate.met"][0] is False


@pytest.mark.parametrize(("stage", "older"), [("controller", "feasible"), ("certificate", "passed")])
def test_the_older_word_for_met_is_still_read(stage, older, check):
    for word in (older, "met"):
        found = check(f"[expect.{stage}]\n{word} = true\n"), check(f"[expect.{stage}]\n{word} = false\n")
        assert {each[f"{stage}.met"][0] for each in found} == {True, False}


def test_a_plant_that_is_not_certified_says_where_to_name_it(check):
    met, words = check("[expect.certificate.plants.swing]\nms = 2\n")["certificate.plants.swing.ms"]
    assert not met and 'put "swing" into plants in [robustness]' in words


def test_a_result_that_was_not_made_is_said(check, made):
    expected = so.testing.Expectation(name="controller.ms", stage="controller", judge=lambda _: None)
    met, words = expected.check(Stages(made.stages.problem, fit=None, controller=None))
    assert not met and "there is no controller" in words


@pytest.mark.parametrize(("ms", "code"), [pytest.param(1.9, 0, marks=pytest.mark.slow), (1.05, 1)])
def test_seaopt_run_checks_them_and_its_exit_code_says_so(tmp_path, monkeypatch, capsys, without_drawing, ms, code):
    read(tmp_path, f"[expect.controller]\nms = {ms}\n", friction="")
    monkeypatch.chdir(tmp_path)
    options = ["--json"] if code == 0 else []
    monkeypatch.setattr(sys, "argv", ["seaopt", "run", "design.toml", *options])
    leave_out(monkeypatch, SIMULATIONS)
    with pytest.raises(SystemExit) as end:
        main()
    out = capsys.readouterr().out
    assert int(end.value.code or 0) == code
    if options:
        assert [one["met"] for one in json.loads(out)["expect"]["outcomes"]] == [True, True]
    else:
        assert "1 of 2 met" in out and "expect.controller.ms: found" in " ".join(out.split())


def test_the_schema_of_problem_files_has_every_expectation():
    schema = json_schema()
    table = schema["$defs"]["ExpectTable"]["properties"]
    assert set(table) == {"fit_met", "parameters", "fit_percent", "controller", "certificate"}
    assert set(FIGURES) < set(schema["$defs"]["ExpectedControllerTable"]["properties"])
    for name in ("ExpectTable", "ExpectedControllerTable", "ExpectedPlantTable", "ExpectedCertificateTable"):
        assert all(one.get("description") for one in schema["$defs"][name]["properties"].values())
        assert schema["$defs"][name]["additionalProperties"] is False
