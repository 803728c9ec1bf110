"""`structure = "mpc"` of a problem file as a user runs it: design, certificate, report, C code, and what is refused."""

from __future__ import annotations

import json

import pytest

import seaopt as so
from seaopt.control import export_mpc
from seaopt.problem.stages import design_mpc

PLANNED = """
schema = 1
title = "planned"
[plant.stand]
kind = "high_impedance"
drive = "unlumped"
[controller]
plant = "stand"
structure = "mpc"
bandwidth_hz = 20
current_limit_A = 9.0
[mpc]
current_slew_A_per_s = 2000
bounds = { qd = [-0.08, 0.08] }
preview_samples = 4
[robustness]
parameters = { J = [3.2e-6, 3.4e-6] }
samples = 20
constrained_runs = 1
"""


@pytest.fixture
def planned(folder):
    (folder / "plan.toml").write_text(PLANNED, encoding="utf-8")
    return folder


@pytest.mark.slow
def test_the_report_has_plan_and_certificate(planned, seaopt):
    assert seaopt("run", "plan.toml", "-o", "out").returncode == 0
    page = (planned / "out" / "report.html").read_text(encoding="utf-8")
    assert "Predictive control" in page and "with limits active: 0 failures" in page
    assert seaopt("report", "plan.toml", "-o", "out").returncode == 0


def test_it_is_designed_certified_and_exported(planned, seaopt):
    out = seaopt("tune", "plan.toml", "-o", "out")
    assert out.returncode == 0 and "Predictive control: F1, 20 Hz, every limit met" in out.stdout
    assert seaopt("certify", "plan.toml", "-o", "out").returncode == 0
    robustness = json.loads((planned / "out" / "robustness.json").read_text(encoding="utf-8"))
    assert robustness["passed"] and robustness["constrained"]["runs"] == 1
    assert seaopt("export", "out", "--c", "code").returncode == 0
    problem = so.read_problem(planned / "plan.toml")
    export_mpc(design_mpc(problem, problem.parameters), planned / "python")
    for name in ("force_mpc_data.h", "force_mpc.c", "active_set.c"):
        assert (planned / "code" / name).read_bytes() == (planned / "python" / name).read_bytes()
    narrower = PLANNED.replace("0.08]", "0.07]")
    (planned / "plan.toml").write_text(narrower, encoding="utf-8")
    assert "made from another problem file" in seaopt("certify", "plan.toml", "-o", "out").stderr
    content = json.loads((planned / "out" / "controller.json").read_text(encoding="utf-8"))
    with pytest.raises(so.SeaoptError, match="seaopt export"):
        so.export(content, planned / "law")


def test_what_blocks_a_plan_is_said_of_the_bandwidth_that_is_asked(planned, seaopt):
    strict = PLANNED.replace("current_limit_A = 9.0", "current_limit_A = 9.0\nmax_sensitivity = 1.05")
    (planned / "plan.toml").write_text(strict, encoding="utf-8")
    out = seaopt("tune", "plan.toml", "-o", "out", "-v")
    assert out.returncode == 1 and "(asked 20)" in out.stdout and out.stdout.count("20 Hz is blocked by") == 2
    spec = json.loads((planned / "out" / "controller.json").read_text(encoding="utf-8"))["spec"]
    assert (spec["bandwidth_hz"], spec["bandwidth_tolerance"]) == (20.0, 0.02)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('structure = "mpc"', 'structure = "pid"', '[controller] asks for no plan; write structure = "mpc"'),
        ("bandwidth_hz = 20", 'bandwidth_hz = 20\nrobust_to = ["stand"]', "controller.robust_to is of gains"),
        ("samples = 20", "retune = 2", "robustness.retune is of gains"),
        ("qd =", "qqd =", 'bounds of "qqd": not an output or state'),
        ('plant = "stand"', 'plant = "stand"\nmeasured = ["F1", "qd"]', 'write measured = "F1"'),
    ],
)  # fmt: skip
def test_what_cannot_be_is_refused(planned, seaopt, old, new, said):
    assert PLANNED.count(old) == 1
    (planned / "plan.toml").write_text(PLANNED.replace(old, new), encoding="utf-8")
    out = seaopt("tune", "plan.toml", "-o", "out")
    assert out.returncode == 2 and said in out.stderr


@pytest.mark.parametrize(
    ("arguments", "said"),
    [(("tune", "plan.toml", "--sweep", "10:20:5"), "a sweep tunes gains"),
     (("certify", "plan.toml", "--controller", "law.toml"), "is no plan")],
)  # fmt: skip
def test_what_is_of_gains_is_refused(planned, seaopt, arguments, said):
    out = seaopt(*arguments)
    assert out.returncode == 2 and said in out.stderr
