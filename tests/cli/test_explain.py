"""`seaopt fit --explain` on a log whose spring hardens: the lines it writes make the fit that it goes on with."""

from __future__ import annotations

import json
import math
import tomllib
from dataclasses import replace

import numpy as np
import pytest

from seaopt.errors import ProblemError
from seaopt.estimation.problem.fit_problem import count_evaluations
from seaopt.estimation.result.trials import HypothesisTrial
from seaopt.problem import fit_problem, read_problem
from seaopt.problem.explained import adopt, say_adopted, say_unexplained
from tests.actuator_logs import write_csv
from tests.estimation.judgement.test_hypotheses import TRUTH, record

START = {"J_m": 3e-5, "b_r": 2e-4, "k_s": 250.0, "f_c": 0.015, "eta": 1.0}
FILE = """
schema = 1
[parameters]
{parameters}
[plant.stand]
kind = "rotary"
link = "locked"
[[experiment]]
name = "log"
plant = "stand"
log = "log.csv"
time = "time [s]"
inputs = {{ I = "I [A]" }}
outputs = {{ tau_s = "tau_s [N m]", theta_m = "theta_m [rad]" }}
initial_state = "rest"
"""


@pytest.fixture
def problem(tmp_path):
    log = record(harder=8.0)
    columns = {"time [s]": log.time, "I [A]": log["I"], "tau_s [N m]": log["tau_s"], "theta_m [rad]": log["theta_m"]}
    write_csv(tmp_path / "log.csv", columns)
    rows = [f"{name} = {{ value = {value}, free = true }}" for name, value in START.items()]
    rows += [f"{name} = {TRUTH[name]}" for name in TRUTH if name not in START]
    path = tmp_path / "problem.toml"
    path.write_text(FILE.format(parameters="\n".join(rows)), encoding="utf-8")
    return path


def test_bristles_are_added_to_a_plant_that_sticks(problem):
    """They hold it by themselves, so that the file's sticks = true has to go."""
    text = problem.read_text(encoding="utf-8").replace('link = "locked"', 'link = "locked"\nsticks = true')
    problem.write_text(text, encoding="utf-8")
    trial = HypothesisTrial(
        effect="the joint gives way before it slips", parts=("lugre",), outcome="adopted", excess_before=9.0,
        excess=1.0, frees={"sigma_0": 0.1, "sigma_1": 1e-4}, fixed={}, parameters={"k_s": 299.0}, evaluations=9,
    )  # fmt: skip
    found, lines = adopt(read_problem(problem), trial)
    assert not found.plants["stand"].sticks
    assert found.parameters["k_s"].value == 299.0
    assert tomllib.loads(lines)["plant"]["stand"] == {"parts": ["lugre"], "sticks": False}


def test_a_start_with_which_free_a_cause_was_found_is_freed_with_it(problem):
    trial = HypothesisTrial(
        effect="the spring hardens", parts=("hardening",), outcome="adopted", excess_before=9.0, excess=1.0,
        frees={"k_3": 8.0}, fixed={}, parameters={}, evaluations=9,
    )  # fmt: skip
    same, lines = adopt(read_problem(problem), trial)
    assert same.table.experiment[0].initial_state == "rest" and "experiment" not in tomllib.loads(lines)
    found, lines = adopt(read_problem(problem), trial, ["log"])
    assert found.table.experiment[0].initial_state == "estimate"
    assert tomllib.loads(lines)["experiment"] == [{"name": "log", "initial_state": "estimate"}]


def test_a_command_that_is_held_changes_its_log_alone(problem):
    trial = HypothesisTrial(
        effect="the command is taken only every few rows of the log", parts=(), outcome="adopted", excess_before=9.0,
        excess=1.0, frees={}, fixed={}, parameters={}, evaluations=9, holds={"log": (5, 3)},
    )  # fmt: skip
    before = read_problem(problem)
    found, lines = adopt(before, trial)
    assert tomllib.loads(lines) == {"experiment": [{"name": "log", "held": {"samples": 5, "first": 3}}]}
    (was,), (held,) = before.experiments(), found.experiments()
    assert np.array_equal(held.log["I"][3:], np.repeat(was.log["I"][3::5], 5)[: len(was.log) - 3])
    with pytest.raises(ProblemError, match="held of log is of its log alone"):
        found.experiment_like(problem.parent / "log.csv")


def test_a_fit_may_leave_the_search_for_causes_out(problem, seaopt):
    """The spring hardens, which the search finds after some hundred simulations."""
    before = count_evaluations()
    out = problem.parent / "out"
    result = seaopt("fit", problem, "-o", out, "--no-causes")
    assert count_evaluations() - before < 100
    assert result.returncode == 1
    said = " ".join(result.stdout.split())
    assert said.count("may lack was not looked for") == 1 and "causes were not looked for" not in said
    assert "next: look for causes, without --no-causes and causes = false: type seaopt fit" in said
    assert "correct the file" not in said  # nothing in it is wrong
    fit = json.loads((out / "fit.json").read_text(encoding="utf-8"))
    kinds = {finding["kind"] for finding in fit["findings"]}
    assert "unsearched" in kinds and "excess" in kinds and not kinds & {"cause", "fixed", "budget"}

    refused = seaopt("fit", problem, "-o", out, "--no-causes", "--explain")
    assert refused.returncode == 2 and "leave out --no-causes" in refused.stderr
    problem.write_text(problem.read_text(encoding="utf-8") + "[fit]\ncauses = false\n", encoding="utf-8")
    refused = seaopt("fit", problem, "-o", out, "--explain")
    assert refused.returncode == 2 and "causes = false" in refused.stderr


def test_a_file_may_leave_the_search_for_causes_out(problem):
    problem.write_text(problem.read_text(encoding="utf-8") + "[fit]\ncauses = false\n", encoding="utf-8")
    fit = fit_problem(read_problem(problem))
    assert not fit.hypotheses and any(each.kind == "unsearched" for each in fit.findings)
    assert "may lack was not looked for" in " ".join(repr(fit).split())


def test_what_nothing_explains_is_said():
    trial = HypothesisTrial(
        effect="the spring hardens", parts=("hardening",), outcome="tried", excess_before=30.0, excess=20.0,
        frees={"k_3": 1.0}, fixed={}, parameters={}, evaluations=9,
    )  # fmt: skip
    trials = (trial, replace(trial, effect="the motor cogs", excess=12.0))
    assert "three effects" not in say_unexplained(trials[:1]) and "look for what is not" in say_unexplained(trials[:1])
    assert "these may be some of them: add the parts" in say_unexplained(trials)
    assert 'to parts = ["hardening"], and fit again; or look for what is not' in say_unexplained(trials)
    assert "nothing was tried" in say_unexplained(())
    assert "the best, the motor cogs, leaves 12 times the sensor's noise of 30" in say_unexplained(trials)
    tied = tuple(replace(each, outcome="tied") for each in trials)
    assert "the spring hardens (hardening); or the motor cogs" in say_unexplained(tied)
    left = replace(trials[0], outcome="undecided", excess=math.inf)
    said = say_unexplained((trials[1], left))
    assert (
        "of 1 causes" in said
        and f"not decided, as it takes too many integration steps, is whether {left.effect}" in said
    )
    assert say_unexplained((left,)).startswith("nothing explains the logs; not decided")


def test_what_leaves_a_large_residual_is_not_called_explained():
    trial = HypothesisTrial(
        effect="the current lags its command", parts=("current_loop",), outcome="adopted", excess_before=443.0,
        excess=37.8, frees={}, fixed={}, parameters={}, evaluations=9,
    )  # fmt: skip
    assert "explained" not in say_adopted(trial)
    assert "falls from 443 to 37.8 times its sensor's noise, so that more is missing" in say_adopted(trial)
    assert say_adopted(replace(trial, excess=1.1)).startswith("explained: the current lags its command")


def test_what_is_found_is_added_and_fitted(problem, seaopt):
    out = problem.parent / "out"
    assert seaopt("fit", problem, "-o", out).returncode == 1
    first = json.loads((out / "fit.json").read_text(encoding="utf-8"))
    assert first["hypotheses"][0]["parts"] == ["hardening"]
    explained = seaopt("fit", problem, "-o", out, "--explain")
    assert explained.returncode == 0
    assert "explained: the spring hardens" in explained.stderr
    again = json.loads((out / "fit.json").read_text(encoding="utf-8"))
    assert again["met"]
    assert again["parameters"]["k_3"]["value"] == pytest.approx(2400.0, rel=0.05)
    assert again["hypotheses"][0]["excess"] < 1.5 < again["hypotheses"][0]["excess_before"]
    lines = tomllib.loads((out / "explained.toml").read_text(encoding="utf-8"))
    assert lines["plant"]["stand"]["parts"] == ["hardening"]
    assert lines["parameters"]["k_3"]["free"]
    other = seaopt("validate", problem, problem.parent / "log.csv", "-o", out)
    assert other.returncode == 2
    assert f"put the lines of {out / 'explained.toml'} into {problem}" in other.stderr
    # A file with these lines is the problem that the folder's fit is of.
    text = problem.read_text(encoding="utf-8").replace('link = "locked"', 'link = "locked"\nparts = ["hardening"]')
    value = lines["parameters"]["k_3"]["value"]
    problem.write_text(text.replace("[plant", f"k_3 = {{ value = {value}, free = true }}\n[plant", 1), encoding="utf-8")
    assert seaopt("validate", problem, problem.parent / "log.csv", "-o", out).returncode == 0
