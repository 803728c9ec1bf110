"""`seaopt export --gate` and [controller.gate]: the exported C is the law with its gate in Python, sample by sample."""

from __future__ import annotations

import json

import numpy as np
import pytest

import seaopt as so
from seaopt.cli.export import choose_gate
from seaopt.control import MPCSpec, PlausibilityGate, force_mpc, runnable
from seaopt.control.laws.stored import read_controller
from seaopt.control.mpc.export import collect_code
from seaopt.errors import FileError, ProblemError
from seaopt.files import seal
from seaopt.problem.stages import design_mpc, tune_problem
from tests.c_code import LoadedLaw, LoadedMPC

PROBLEM = """
schema = 1
title = "gated"
[plant.stand]
kind = "high_impedance"
drive = "unlumped"
[controller]
plant = "stand"
bandwidth_hz = 30
max_sensitivity = 1.6
current_limit_A = 9.0
"""
GATE = """
[controller.gate]
range_N = [-3000, 3500]
max_held = 8
ramp_s = 0.2
"""
STATUS = ("ok", "held", "fault")


def readings():
    """Return 400 of them: a step, spikes outside and inside the range, short outages, and at the end a long one."""
    y = 500.0 * (1.0 - np.exp(-np.arange(400) / 20.0))
    y[[60, 61, 90]] = [4000.0, -3500.0, np.nan]
    y[[120, 121]] = [-2500.0, np.inf]
    y[150:158] = np.nan
    y[200:] += 200.0  # as far as it can have moved
    y[300:320] = 1e308
    return y


@pytest.fixture
def tuned(folder, seaopt):
    """Return a call that tunes a problem and exports it, and what it wrote."""

    def call(text, *options):
        (folder / "gated.toml").write_text(text, encoding="utf-8")
        assert seaopt("tune", "gated.toml", "-o", "out").returncode == 0
        return seaopt("export", "out", "--c", "code", *options), folder / "code"

    return call


def compare(compiled, law):
    """Play readings, a reset, and a few more through both; commands and statuses agree."""
    said, state = [], law.reset()
    for k, reading in enumerate(readings()):
        if k == 380:
            compiled.reset(100.0, 120.0, 0.5)
            state = law.reset(100.0, 120.0, 0.5)
        wanted, state = law.step(state, 500.0, float(reading))
        assert compiled.step(500.0, reading) == pytest.approx(wanted, rel=0, abs=1e-10)
        assert STATUS[compiled.law.status] == state.status
        assert (compiled.law.held, compiled.law.refused) == (state.held, state.gate.held)
        said.append(state.status)
    return said


def test_the_gate_of_the_problem_file_is_in_the_exported_code(tuned, folder, compiler):
    out, code = tuned(PROBLEM + GATE)
    assert out.returncode == 1 and "not certified" in out.stdout, out.stderr
    problem = so.read_problem(folder / "gated.toml")
    controller = tune_problem(problem, problem.parameters)
    expected = PlausibilityGate.of_controller(controller, range_N=(-3000.0, 3500.0), max_held=8, ramp_s=0.2)
    assert controller.gate == expected
    content = json.loads((folder / "out" / "controller.json").read_text(encoding="utf-8"))
    assert read_controller(content)["gate"] == expected
    assert so.Controller.from_dict(content, *controller.design).gate == expected
    said = compare(LoadedLaw(compiler, code, "force_law", 2, gated=True), runnable(controller, gate=controller.gate))
    held = 2 + 1 + 2 + 8 + 8 + 1  # the last after the reset, 580 N from the measurement given there
    assert [said.count(status) for status in STATUS] == [400 - held - 72, held, 72]
    assert "Readings from -3000 to 3500 N" in repr(controller)


def test_a_gate_that_is_typed_is_in_the_exported_code(tuned, folder, compiler, seaopt):
    typed = ("--gate", "-4000:4000", "--gate-max-step", "300", "--gate-max-held", "3", "--gate-ramp", "0.05")
    out, code = tuned(PROBLEM, *typed)
    assert out.returncode == 1 and "not certified" in out.stdout, out.stderr
    problem = so.read_problem(folder / "gated.toml")
    gate = PlausibilityGate(range_N=(-4000.0, 4000.0), max_step_N=300.0, max_held=3, ramp_per_s=180.0)
    law = runnable(tune_problem(problem, problem.parameters), gate=gate)
    assert "fault" in compare(LoadedLaw(compiler, code, "force_law", 2, gated=True), law)
    for option in ((), ("--no-gate",)):
        assert seaopt("export", "out", "--c", "bare", *option).returncode == 1
        assert "unsigned long refused" not in (folder / "bare" / "force_law.h").read_text(encoding="utf-8")


def test_a_range_that_is_typed_takes_the_step_of_the_problem_file(tuned, folder, seaopt):
    _, code = tuned(PROBLEM + GATE, "--gate", "-100:200")
    text = (code / "force_law.c").read_text(encoding="utf-8")
    gate = json.loads((folder / "out" / "controller.json").read_text(encoding="utf-8"))["guards"]["gate"]
    assert "LOWEST = -100.0;" in text and f"MOST_STEP = {gate['max_step_N']!r};" in text and "MAX_HELD 5UL" in text
    assert seaopt("export", "out", "--c", "bare", "--no-gate").returncode == 1
    assert "LOWEST" not in (folder / "bare" / "force_law.c").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--gate", "-4000:4000"), "write [controller.gate] with range_N = [-4000, 4000] in the problem file"),
        (("--gate", "4000"), "type --gate LOW:HIGH, such as -4000:4000"),
        (("--gate", "5:1", "--gate-max-step", "3"), "range_N = (5, 1) is not a range"),
        (("--gate", "-9:9", "--gate-max-step", "-3"), "max_step_N = -3 is not above 0"),
        (("--gate", "-9:9", "--gate-max-step", "0"), "max_step_N = 0 is not above 0"),
        (("--gate", "-9:9", "--gate-max-step", "3", "--gate-max-held", "-1"), "max_held = -1"),
        (("--gate", "-9:9", "--gate-max-step", "3", "--gate-ramp", "0"), "ramp_s = 0 is not above 0"),
        (("--gate", "-9:9", "--gate-max-step", "3", "--current-limit", "inf"), "type --current-limit"),
        (("--gate", "-9:9", "--no-gate"), "type one of them"),
        (("--gate-max-held", "3"), "add --gate LOW:HIGH"),
    ],
)
def test_what_is_no_gate_is_one_line(done, seaopt, tmp_path, options, words):
    out = seaopt("export", done.results, "--c", tmp_path / "code", *options)
    assert out.returncode == 2 and len(out.stderr.strip().splitlines()) == 1
    assert words in out.stderr
    assert not (tmp_path / "code").exists()


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("range_N = [-3000, 3500]", "range_N = [3500, -3000]", "controller.gate: range_N = (3500, -3000)"),
        ("max_held = 8", "max_held = -8", "controller.gate.max_held"),
        ("ramp_s = 0.2", "ramp = 0.2", "controller.gate"),
        ("current_limit_A = 9.0", "", "controller.gate: the controller has no current limit"),
    ],
)
def test_a_table_that_is_no_gate_is_named(folder, seaopt, old, new, words):
    (folder / "gated.toml").write_text((PROBLEM + GATE).replace(old, new), encoding="utf-8")
    out = seaopt("tune", "gated.toml", "-o", "out")
    assert out.returncode == 2 and words in out.stderr


def test_an_edited_gate_is_refused(tuned, folder):
    tuned(PROBLEM + GATE)
    content = json.loads((folder / "out" / "controller.json").read_text(encoding="utf-8"))
    content["guards"]["gate"]["range_N"] = [10.0, -10.0]
    content = seal(content)
    del content["made_from"]  # whose digest tells any edit
    with pytest.raises(FileError, match=r"controller\.json: guards\.gate: range_N"):
        read_controller(content)


def test_a_plans_own_step_is_that_of_its_code(stand, thor):
    gate = PlausibilityGate(range_N=(-3000.0, 3500.0), max_step_N=300.0, max_held=8, ramp_per_s=45.0)
    plans = [force_mpc(stand, thor, MPCSpec(current_limit_A=9.0), gate=one) for one in (gate, None)]
    gated, bare = ({"mpc": {"code": collect_code(plan).to_dict()}, "guards": {"gate": None}} for plan in plans)
    chosen = choose_gate(gated, {"range_N": "-100:200", "ramp_s": 0.2}, {})
    assert chosen == PlausibilityGate(range_N=(-100.0, 200.0), max_step_N=300.0, max_held=5, ramp_per_s=45.0)
    with pytest.raises(ProblemError, match=r"type --gate-max-step, or write \[controller.gate\]"):
        choose_gate(bare, {"range_N": "-100:200"}, {})


@pytest.mark.slow
def test_predictive_control_takes_both(tuned, folder, compiler, seaopt):
    planned = PROBLEM.replace("max_sensitivity = 1.6", 'structure = "mpc"').replace("= 30", "= 20")
    out, code = tuned(planned + GATE)
    assert out.returncode == 1 and "not certified" in out.stdout, out.stderr
    problem = so.read_problem(folder / "gated.toml")
    mpc = design_mpc(problem, problem.parameters)
    assert mpc.gate.max_held == 8
    compare_plans(LoadedMPC(compiler, code), mpc)
    assert "/* NOT CERTIFIED: seaopt certify was not run" in (code / "force_mpc_data.h").read_text(encoding="utf-8")
    bare = force_mpc(*mpc.design, mpc.spec)
    typed = ("--gate", "-4000:4000", "--gate-max-step", "300", "--gate-max-held", "3")
    assert seaopt("export", "out", "--c", "typed", *typed).returncode == 1
    gate = PlausibilityGate(range_N=(-4000.0, 4000.0), max_step_N=300.0, max_held=3, ramp_per_s=90.0)
    compare_plans(LoadedMPC(compiler, folder / "typed"), force_mpc(*bare.design, bare.spec, gate=gate))
    assert seaopt("export", "out", "--c", "ranged", "--gate", "-100:200").returncode == 1  # with the problem's step
    assert f"mpc_step = (force_mpc_real){mpc.gate.max_step_N:.17g};" in (
        folder / "ranged" / "force_mpc_data.h"
    ).read_text(encoding="utf-8")
    assert seaopt("export", "out", "--c", "bare", "--no-gate").returncode == 1
    assert "FORCE_MPC_GATE 0" in (folder / "bare" / "force_mpc_data.h").read_text(encoding="utf-8")
    assert isinstance(mpc.spec, MPCSpec)


def compare_plans(compiled, mpc):
    rows, state, said = compiled.run(np.full(380, 500.0), readings()[:380]), mpc.start, []
    for row, reading in zip(rows, readings(), strict=False):
        result = mpc.step(state, 500.0, float(reading))
        state = result.state
        assert row[0] == pytest.approx(result.command, abs=1e-7)
        said.append(state.gate.status)
    assert [STATUS[int(value)] for value in rows[:, 4]] == said and "fault" in said
