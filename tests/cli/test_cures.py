"""What a fit says to write into its problem file, written there: the file is read, and its fit is met."""

from __future__ import annotations

import re
import tomllib
from dataclasses import replace
from types import SimpleNamespace

import pytest

import seaopt as so
from seaopt.estimation.result.findings import FitFinding
from seaopt.estimation.result.trials import HypothesisTrial
from seaopt.problem.stages import fit_problem
from seaopt.reporting.sections import judge
from seaopt.reporting.sections.data import Commands
from seaopt.reporting.sections.kinds.fit import _list_cures, spell_cure
from tests.actuator_logs import write_csv
from tests.estimation.judgement.test_late_or_damped import DAMPER, record

PROBLEM = """\
schema = 1

[parameters]
N = 100
K_tau = 0.037
J_m = { value = 3e-5, free = true }
b_r = { value = 1.5e-4, free = true }
f_c = { value = 0.004, free = true }
v_s = 1.0
k_s = { value = 240, free = true }
c_s = 0

[plant.held]
kind = "rotary"
link = "locked"

[[experiment]]
name = "chirp"
plant = "held"
log = "chirp.csv"
[experiment.inputs]
I = "I [A]"
[experiment.outputs]
tau_s = "tau_s [N m]"
theta_m = "theta_m [rad]"
"""


def write_under(text, advice):
    """Return a file with lines where an advice says, in place of lines of the same name."""
    said, lines = advice.text, advice.copied
    (header,) = re.findall(r"write under (\[\S+\])", said)
    anchor = f'log = "{said.split()[3].rstrip(",")}.csv"' if header == "[[experiment]]" else header
    assert text.count(anchor) == 1
    for line in lines:
        ((name, _),) = tomllib.loads(line).items()
        text = re.sub(rf"(?m)^{name}\s*=.*\n", "", text)
        text = text.replace(anchor, f"{anchor}\n{line}")
    return text


@pytest.mark.parametrize(("damper", "delay"), [(DAMPER, 1)])
def test_what_comes_next_is_written_as_it_stands(tmp_path, damper, delay):
    log, path = record(damper=damper, delay=delay), tmp_path / "held.toml"
    columns = {"time [s]": log.time, "I [A]": log["I"], "tau_s [N m]": log["tau_s"], "theta_m [rad]": log["theta_m"]}
    write_csv(tmp_path / "chirp.csv", columns)
    text = PROBLEM
    path.write_text(text, encoding="utf-8")
    problem = so.read_problem(path)
    fit = fit_problem(problem)
    assert not fit.met
    for advice in judge(fit, Commands(plants=dict.fromkeys(problem.plants, ()))).next:
        text = write_under(text, advice)
    path.write_text(text, encoding="utf-8")
    mended = so.read_problem(path)
    fit = fit_problem(mended)
    assert fit.met
    assert fit.parameters["c_s"].value == pytest.approx(damper, rel=0.01)


def test_each_plant_keeps_its_own_parts():
    """A held joint with a current loop and a link that cogs, which both take a damper in the spring."""
    trial = HypothesisTrial(
        effect="a damper", parts=("spring_damping",), outcome="adopted", excess_before=3.0, excess=1.0,
        frees={"c_k": 600.0}, fixed={}, parameters={}, evaluations=9,
    )  # fmt: skip
    cause = FitFinding(
        severity="error", kind="cause", where="tau_s", text="", preferred={"c_k": (600.0, 1.0)}, together=("c_k",)
    )
    fit = SimpleNamespace(findings=(cause,), hypotheses=(trial,), parameters={}, experiments=())
    held, swing, values = _list_cures(fit, {"held": ("current_loop",), "swing": ("cogging",)})
    assert held.copied == ('parts = ["current_loop", "spring_damping"]',) and "[plant.held]" in held.text
    assert swing.copied == ('parts = ["cogging", "spring_damping"]',) and "[plant.swing]" in swing.text
    assert values.copied == ("c_k = { value = 600, free = true }",)


def test_a_cure_keeps_the_bounds_and_the_prior_that_a_parameter_has():
    """The line takes the place of the parameter's own, with which its bound would go: the next fit went beyond it."""
    plant = so.plants.rotary(link="locked")
    params = plant.complete(so.ParameterSet())
    bounded = replace(params["eta"], value=0.8, max=1.0, prior_std=0.05)
    cause = FitFinding(
        severity="error", kind="cause", where="tau_s", text="", preferred={"eta": (0.9, 0.01), "J_m": (2e-4, 1e-6)},
        together=("eta", "J_m"),
    )  # fmt: skip
    fit = SimpleNamespace(
        findings=(cause,), hypotheses=(), parameters=params.with_parameters(bounded),
        experiments=(SimpleNamespace(plant=plant),),
    )  # fmt: skip
    (advice,) = _list_cures(fit, {"held": ()})
    assert advice.copied == (
        "eta = { value = 0.9, free = true, max = 1, prior_std = 0.05 }",
        "J_m = { value = 0.0002, free = true }",
    )


@pytest.mark.parametrize(
    "kept",
    [{"max": 0.123456}, {"max": 0.1234560789}, {"min": 0.123456}, {"min": 0.1, "max": 0.2, "prior_std": 0.0123456789}],
)
def test_a_cure_is_read_back_within_the_bounds_that_it_keeps(kept, tmp_path):
    """0.1235 with a bound of 0.123456 was refused, and a bound of more digits was rounded."""
    _, line = spell_cure("eta", 0.123456, kept)
    path = tmp_path / "p.toml"
    machine = '[plant.stand]\nkind = "high_impedance"\n[controller]\nplant = "stand"\nbandwidth_hz = 30\n'
    path.write_text(f'schema = 1\ntitle = "x"\n[parameters]\n{line}\n{machine}')
    eta = so.read_problem(path).parameters["eta"]
    assert eta.value == pytest.approx(0.123456, rel=1e-3) and eta.free
    assert {name: getattr(eta, name) for name in kept} == kept
