"""`structure = "mpc"` of a problem file as a user runs it: design, certificate, report, C code, and what is refused."""

from __future__ import annotations

import json
import pickle
import re
from dataclasses import replace

import control
import numpy as np
import pytest

import seaopt as so
from seaopt.control import Prefilter, export_mpc
from seaopt.control.mpc.stored import check_described, describe_mpc
from seaopt.files import to_json
from seaopt.problem.stages import certify_problem, check_mpc_file, design_mpc, read_sweep, tune_problem

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
    """Its sensors count, and those that it does not read are named."""
    (planned / "plan.toml").write_text(
        PLANNED + "current_step_A = 0.01\nsensors = { noise_std = { F1 = 1.0, F2 = 9.0 } }\n", encoding="utf-8"
    )
    out = seaopt("tune", "plan.toml", "-o", "out")
    assert out.returncode == 0 and "Predictive control: F1, 20 Hz, every limit met" in out.stdout
    assert seaopt("certify", "plan.toml", "-o", "out").returncode == 0
    robustness = json.loads((planned / "out" / "robustness.json").read_text(encoding="utf-8"))
    runs = robustness["constrained"]
    assert robustness["passed"] and runs["runs"] == 1 and runs["largest_ring"] > 0.0
    assert runs["sensors"]["noise_std"] == {"F1": 1.0} and runs["command_step"] == 0.01
    assert any("F2" in note and "no run" in note for note in robustness["remarks"])
    assert seaopt("export", "out", "--c", "code").returncode == 0
    problem = so.read_problem(planned / "plan.toml")
    export_mpc(design_mpc(problem, problem.parameters), planned / "python")
    for name in ("force_mpc_data.h", "force_mpc.c", "active_set.c"):
        assert (planned / "code" / name).read_bytes() == (planned / "python" / name).read_bytes()
    ringed = seaopt("export", "out", "--c", "code", "--precision", "float", "--log-rows", "64", "--tare", "2:50")
    assert ringed.returncode == 0 and (planned / "code" / "force_mpc_tare.c").is_file(), ringed.stderr
    assert "64UL /* a power of two */" in (planned / "code" / "force_mpc_log.h").read_text(encoding="utf-8")
    assert '"float32' in (planned / "code" / "force_mpc_log.c").read_text(encoding="utf-8").replace("\\", "")
    assert "--log-rows, --tare and those of --gate" in " ".join(
        seaopt("export", "out", "--c", "code", "--name", "knee").stderr.split()
    )
    narrower = PLANNED.replace("0.08]", "0.07]")
    (planned / "plan.toml").write_text(narrower, encoding="utf-8")
    assert "made from another problem file" in seaopt("certify", "plan.toml", "-o", "out").stderr
    content = json.loads((planned / "out" / "controller.json").read_text(encoding="utf-8"))
    with pytest.raises(so.SeaoptError, match="seaopt export"):
        so.export(content, planned / "law")


def test_a_measured_response_is_certified_on_in_the_linear_region(folder):
    chirp = """
[[experiment]]
name = "chirp"
plant = "stand"
virtual = { seed = 1, duration_s = 30, rate_hz = 1000, noise_std = { F1 = 1.0 }, excitation = { chirp = { amplitude = 2.0, f0_hz = 0.1, f1_hz = 200 } } }
"""  # noqa: E501
    text = PLANNED.replace("bandwidth_hz = 20", 'bandwidth_hz = 20\nrobust_to = ["frf:chirp"]')
    (folder / "measured.toml").write_text(text + chirp, encoding="utf-8")
    problem = so.read_problem(folder / "measured.toml")
    controller = tune_problem(problem, problem.parameters)
    certificate = certify_problem(problem, controller, problem.parameters)
    assert any(row.plant == "frf:chirp" and row.name == "max_sensitivity" for row in certificate.requirements)
    assert certificate.constrained.runs == 1


RENDERED = """
schema = 1
[plant.stand]
kind = "rotary"
link = "locked"
[plant.free]
kind = "rotary"
[controller]
plant = "stand"
measured = "tau_s"
structure = "mpc"
bandwidth_hz = 10
max_sensitivity = 2.0
max_complementary = 2.0
current_limit_A = 9.0
prefilter = { order = "first_order", corner_hz = 40 }
[impedance]
plant = "free"
stiffness = 20
damping = 2.0
velocity_filter_s = 0.005
[robustness]
samples = 3
constrained_runs = 1
"""


def test_a_plan_renders_an_impedance_that_is_certified_and_exported(folder):
    (folder / "rendered.toml").write_text(RENDERED, encoding="utf-8")
    problem = so.read_problem(folder / "rendered.toml")
    controller = tune_problem(problem, problem.parameters)
    assert controller.outer.stiffness == 20.0 and controller.outer.plant == "free"
    mpc = design_mpc(problem, problem.parameters)
    assert pickle.loads(pickle.dumps(mpc)).outer == mpc.outer == controller.outer
    assert mpc.spec.reference_filter == Prefilter(corner_hz=40.0)
    check_described(json.loads(to_json(describe_mpc(mpc))), mpc, source="", problem="", remedy="")
    rendering = so.certify(mpc, problem.certified_plants(), problem.parameters, samples=3, runs=1).impedance
    assert rendering.plant == "free" and rendering.rendering.impedance.damping == 2.0
    export_mpc(mpc, folder / "code")
    assert "OUTER_STIFFNESS" in (folder / "code" / "outer.h").read_text(encoding="utf-8")


WARMED = """
schema = 1
[parameters]
R = 0.7
R_wc = 1.3
R_ca = 3.1
C_w = 0.2
C_c = 1.5
[plant.stand]
kind = "rotary"
link = "locked"
parts = ["thermal"]
[controller]
plant = "stand"
measured = "tau_s"
structure = "mpc"
bandwidth_hz = 10
max_sensitivity = 2.0
max_complementary = 2.0
current_limit_A = 12.0
derate = true
"""


def test_a_plan_derates_as_its_file_and_its_options_say(folder, seaopt):
    (folder / "warm.toml").write_text(WARMED, encoding="utf-8")
    assert seaopt("tune", "warm.toml", "-o", "out").returncode == 0
    problem, stored = so.read_problem(folder / "warm.toml"), folder / "out" / "controller.json"
    mpc = design_mpc(problem, problem.parameters)
    check_mpc_file(problem, mpc, stored, "")
    with pytest.raises(so.SeaoptError, match=r"mpc\.code is not what"):
        check_mpc_file(problem, replace(mpc, heat=None), stored, "")
    export_mpc(mpc, folder / "python")
    for typed, there in (((), True), (("--no-derate",), False), (("--derate-margin", "20"), True)):
        out = seaopt("export", "out", "--c", "code", "--allow-infeasible", *typed)
        assert out.returncode in (0, 1) and ("code/heat.h" in out.stdout) == there
        data = (folder / "code" / "force_mpc_data.h").read_text(encoding="utf-8")
        assert f"#define FORCE_MPC_HEAT {int(there)}" in data
        if not typed:
            assert (folder / "code" / "heat.h").read_bytes() == (folder / "python" / "heat.h").read_bytes()
    assert (folder / "code" / "heat.h").read_bytes() != (folder / "python" / "heat.h").read_bytes()
    (folder / "cold.toml").write_text(WARMED.replace('parts = ["thermal"]', ""), encoding="utf-8")
    out = seaopt("tune", "cold.toml", "-o", "cold")
    assert out.returncode == 2 and "nothing is known of the motor's heat" in out.stderr


def test_a_sweep_says_what_the_linear_region_of_each_plan_does(planned, seaopt):
    """By the plan's first command while no limit is active, and the stand's response, both worked out here."""
    out = seaopt("tune", "plan.toml", "-o", "out", "--sweep", "15:25:10")
    assert out.returncode == 0, out.stderr
    content = json.loads((planned / "out" / "frontier.json").read_text(encoding="utf-8"))
    f, period = np.geomspace(0.1, 499.9, 40_000), 1e-3
    z, problem = np.exp(2j * np.pi * f * period), so.read_problem(planned / "plan.toml")
    plant = so.plants.high_impedance(drive="unlumped").linearize(problem.parameters)
    sampled = control.sample_system(plant["F1", "I"], period, "zoh")
    again = read_sweep(problem, problem.parameters, content)
    assert [row.met for row in again.rows] == [law.met for law in again.controllers]
    for row, stored, asked in zip(content["rows"], content["controllers"], (15.0, 25.0), strict=True):
        mpc = design_mpc(replace(problem, mpc=replace(problem.mpc, bandwidth_hz=asked)), problem.parameters)
        check_described(stored["mpc"], mpc, source="frontier.json", problem="plan.toml", remedy="")
        law = mpc.unlimited()
        states = np.linalg.solve(z[:, None, None] * np.eye(len(law.a)) - law.a, np.tile(law.b, (f.size, 1, 1)))
        c_r, c_y = (states.transpose(0, 2, 1) @ law.c + law.d).T
        force = sampled(z) / z  # a sample of computing
        sensitivity = 1.0 / (1.0 - force * c_y)
        tracking = np.abs(force * c_r * sensitivity)
        largest = np.abs(1.0 - sensitivity).max()  # Mt, which alone is over its limit at 25 Hz
        assert row["bandwidth_hz"] == asked and row["met"] == (largest <= 1.3)
        assert bool(row["blocked_by"]) == (not row["met"])
        assert row["ms"] == pytest.approx(np.abs(sensitivity).max(), rel=1e-4)
        below = f <= asked
        integral = np.trapezoid(np.abs(sensitivity[below]), np.log(f[below]))
        assert row["disturbance"] == pytest.approx(integral, rel=1e-3)
        at_band = np.interp(asked, f, np.abs(c_r * sensitivity))
        assert row["force_limit_N"] == pytest.approx(9.0 / at_band, rel=1e-4)
        assert np.interp(asked, f, tracking) == pytest.approx(tracking[0] / np.sqrt(2.0), rel=0.02)
    refused = seaopt("tune", "plan.toml", "-o", "out", "--sweep", "15:25:10", "--free-law")
    assert refused.returncode == 2 and "leave --free-law out" in refused.stderr


def test_what_blocks_a_plan_is_said_of_the_bandwidth_that_is_asked(planned, seaopt):
    strict = PLANNED.replace("current_limit_A = 9.0", "current_limit_A = 9.0\nmax_sensitivity = 1.05")
    (planned / "plan.toml").write_text(strict, encoding="utf-8")
    out = seaopt("tune", "plan.toml", "-o", "out", "-v")
    assert out.returncode == 1 and "asked 20 Hz" in out.stdout and out.stdout.count("20 Hz is blocked by") == 2
    spec = json.loads((planned / "out" / "controller.json").read_text(encoding="utf-8"))["spec"]
    assert (spec["bandwidth_hz"], spec["bandwidth_tolerance"]) == (20.0, 0.02)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('structure = "mpc"', 'structure = "pid"', '[controller] is not predictive; write structure = "mpc"'),
        ("bandwidth_hz = 20", 'bandwidth_hz = 20\nrobust_to = ["stand"]', "controller.robust_to shapes gains"),
        ("samples = 20", "retune = 2", "robustness.retune tunes gains"),
        ("qd =", "qqd =", 'bounds of "qqd": not an output or state'),
        ('plant = "stand"', 'plant = "stand"\nmeasured = ["F1", "qd"]', 'write measured = "F1"'),
    ],
)  # fmt: skip
def test_what_cannot_be_is_refused(planned, seaopt, old, new, said):
    assert PLANNED.count(old) == 1
    (planned / "plan.toml").write_text(PLANNED.replace(old, new), encoding="utf-8")
    out = seaopt("tune", "plan.toml", "-o", "out")
    assert out.returncode == 2 and said in out.stderr


def test_its_own_controller_is_certified_as_that_plan(planned, seaopt):
    assert seaopt("tune", "plan.toml", "-o", "out").returncode == 0
    kept = planned / "kept.json"
    (planned / "out" / "controller.json").rename(kept)
    out = seaopt("certify", "plan.toml", "-o", "other", "--controller", "kept.json")
    assert out.returncode == 0, out.stderr
    robustness = json.loads((planned / "other" / "robustness.json").read_text(encoding="utf-8"))
    assert robustness["passed"] and robustness["constrained"]["runs"] == 1
    own = json.loads(kept.read_text(encoding="utf-8"))
    written = json.loads((planned / "other" / "controller.json").read_text(encoding="utf-8"))
    assert all(written[name] == own[name] for name in ("law", "spec", "mpc"))


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("bandwidth_hz = 20", "bandwidth_hz = 25", "kept.json: mpc.spec.bandwidth_hz is 20.0, and plan.toml asks for"),
        ("[plant.stand]", "[parameters]\nk = 500000\n[plant.stand]", "mpc.code is not what plan.toml makes"),
        ('structure = "mpc"', 'structure = "pid"', "kept.json: is of predictive control"),
    ],
)  # fmt: skip
def test_a_controller_of_another_plan_is_refused(planned, seaopt, old, new, said):
    problem = so.read_problem(planned / "plan.toml")
    content = {"mpc": describe_mpc(design_mpc(problem, problem.parameters))}
    (planned / "kept.json").write_text(to_json(content), encoding="utf-8")
    text = PLANNED.replace(old, new)
    if "pid" in new:
        text = re.sub(r"\[mpc\].*\n(?=\[robustness\])", "", text, flags=re.DOTALL).replace("constrained_runs = 1", "")
    (planned / "plan.toml").write_text(text, encoding="utf-8")
    out = seaopt("certify", "plan.toml", "-o", "out", "--controller", "kept.json")
    assert out.returncode == 2 and said in " ".join(out.stderr.split())


def test_a_law_of_ones_own_is_no_plan(planned, seaopt):
    out = seaopt("certify", "plan.toml", "--controller", "law.toml")
    assert out.returncode == 2 and "is no plan" in out.stderr
