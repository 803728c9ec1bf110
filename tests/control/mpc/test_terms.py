"""What is compensated beside predictive control: formulas of a pendulum, matrices written here, compiled C."""

from __future__ import annotations

import ctypes
import json
import pickle
import subprocess
from dataclasses import replace

import numpy as np
import pytest
from numpy.polynomial.chebyshev import chebval
from scipy.linalg import expm

import seaopt as so
from seaopt.control import CompensateRipple, add_compensation, export_mpc
from seaopt.control.loops.compensation.terms import Compensation
from seaopt.control.mpc.export import collect_code
from seaopt.control.mpc.stored import read_code
from seaopt.files import to_json
from seaopt.problem.stages import design_mpc, tune_problem
from seaopt.robustness import linear_controller
from seaopt.robustness.verification import playback
from tests.c_code import STRICT

TS, WEIGHT, LIMIT_A, COULOMB = 1e-3, 4.0 * 9.81 * 0.2, 9.0, 50.0 * 0.002
FILE = """
schema = 1
[parameters]
N = 50
K_tau = 0.0369
eta = 0.7
J_m = 2.4e-5
b_r = 4e-4
f_c = 0.002
v_s = 1.0
k_s = 300
J_l = 0.3
d_l = 0.5
m = 4.0
L = 0.2
[plant.stand]
kind = "rotary"
link = "locked"
[plant.swing]
kind = "rotary"
link = "pendulum"
[controller]
plant = "stand"
measured = "tau_s"
structure = "mpc"
bandwidth_hz = 15
max_sensitivity = 2.0
max_complementary = 2.0
sample_rate_hz = 1000
compute_delay_samples = 1
current_limit_A = 9.0
compensate = { TERMS }
OPTIONS
[robustness]
plants = ["swing"]
samples = 4
constrained_runs = 1
"""
GRAVITY = 'gravity = { plant = "swing", fraction = 0.8 }'
FROM_SPEED = 'friction = { fraction = 0.5, from = "speed", speed = 20.0 }'
FROM_REFERENCE = "friction = { fraction = 0.5 }"
IMPEDANCE = '[impedance]\nplant = "swing"\nstiffness = 30\ndamping = 2.0\nvelocity_filter_s = 0.005'
GATE = "[controller.gate]\nrange_N = [-300, 300]\n"
DRIVER = """
#include <stddef.h>
#include "force_mpc.h"
void run(const double *in, size_t n, double *out) {
  static force_mpc s;
  force_mpc_reset(&s);
  for (size_t i = 0; i < n; i++, in += 4) {
    const force_mpc_real asked = (force_mpc_real)(ASKED), places[2] = {(force_mpc_real)in[1], (force_mpc_real)in[2]};
    force_mpc_terms(&s, asked, places + FIRST - 1);
    out[i] = force_mpc_step(&s, asked, (force_mpc_real)in[3]);
  }
}
"""


def read(folder, terms=GRAVITY, options="", **changes):
    text = FILE.replace("TERMS", terms).replace("OPTIONS", options)
    for name, value in changes.items():
        text = text.replace(f"\n{name} = ", f"\n{name} = {value} #")
    (folder / "plan.toml").write_text(text, encoding="utf-8")
    return so.read_problem(folder / "plan.toml")


def plan(folder, terms=GRAVITY, options=""):
    problem = read(folder, terms, options)
    return design_mpc(problem, problem.parameters)


def find_weight(term, positions):
    """Return what a term adds, by NumPy's series; constant beyond its range."""
    scaled = (2.0 * positions - term.low - term.high) / (term.high - term.low)
    return chebval(np.clip(scaled, -1.0, 1.0), term.coefficients)


def run_c(compiler, folder, mpc, rows, asked="in[0]", first=1, *, single=False):
    """Return the commands of rows of what is asked, motor, link, torque."""
    export_mpc(mpc, folder, single_precision=single)
    driver = DRIVER.replace("ASKED", asked).replace("FIRST", f"{first}")
    (folder / "example.c").write_text(driver, encoding="utf-8")
    files = [str(path) for path in folder.glob("*.c")]
    flags = [*STRICT, "-Wundef", "-ffp-contract=off", "-shared", "-fPIC"]
    subprocess.run([*compiler, *flags, *files, "-o", str(folder / "plan.so")], check=True)
    found, pointer = np.zeros(len(rows)), ctypes.POINTER(ctypes.c_double)
    given, made = (array.ctypes.data_as(pointer) for array in (np.ascontiguousarray(rows), found))
    ctypes.CDLL(str(folder / "plan.so")).run(given, ctypes.c_size_t(len(rows)), made)
    return found


def draw_rows(seed, n=1500):
    """Return what is asked, where motor and link are, and the torque: steps, and wanderings with what is no number."""
    rng = np.random.default_rng(seed)
    rows = np.cumsum(rng.normal(size=(n, 4)), axis=0) * [0.05, 0.03, 0.15, 0.05]
    rows[:, 0] += np.repeat(rng.uniform(-30.0, 30.0, n // 100), 100)
    rows[:2, 1:] = 0.0
    rows[rng.integers(5, n, 40), rng.integers(1, 4, 40)] = rng.choice([np.nan, np.inf, -3e15], 40)
    return rows


def rub(values, share):
    """Return the effort against friction of values as they were used, from one number to the next."""
    steps = np.diff(values, prepend=values[0])
    return 0.5 * COULOMB * np.clip(share * steps, -1.0, 1.0)


@pytest.mark.parametrize("rendered", [False, True])
def test_in_c_the_plan_gets_what_carries_the_link(rendered, compiler, tmp_path):
    """A share of m g L sin, by NumPy's series to the last digits; positions that are no numbers leave the last."""
    mpc = plan(tmp_path, options=f"{GATE}{IMPEDANCE if rendered else ''}")
    rows = draw_rows(8)
    assert np.max(np.abs(rows[:, 2][np.abs(rows[:, 2]) < 9e9])) > 3.3  # beyond the range
    asking = "force_mpc_outer(&s, in[0], in[2])" if rendered else "in[0]"
    found = run_c(compiler, tmp_path / "code", mpc, rows, asking, 2)
    term, angles = mpc.compensation.gravity, np.linspace(-3.1, 3.1, 60)
    np.testing.assert_allclose(find_weight(term, angles), 0.8 * WEIGHT * np.sin(angles), atol=1e-5 * WEIGHT)
    bare, state = replace(mpc, compensation=None), mpc.start
    asked, weight, speed, last, commands = 0.0, 0.0, 0.0, rows[0, 2], []
    for wanted, _, position, reading in rows.tolist():
        if abs(position) <= 1e15:
            speed, last = (0.005 * speed + position - last) / 0.006, position
            asked, weight = 30.0 * (wanted - position) - 2.0 * speed, find_weight(term, position)
        command, state = bare.command(state, (asked if rendered else wanted) + weight, reading)
        commands.append(command)
    np.testing.assert_allclose(found, commands, rtol=0.0, atol=1e-11 * LIMIT_A)
    assert np.ptp(commands) > 0.3 * LIMIT_A


@pytest.mark.parametrize("slew", ["", "\n[mpc]\ncurrent_slew_A_per_s = 800"])
@pytest.mark.parametrize("preview", [0, 4])
def test_in_c_and_python_the_sum_of_plan_and_terms_is_within_limits(slew, preview, compiler, tmp_path):
    mpc = plan(
        tmp_path, f"{GRAVITY}, {FROM_SPEED}", GATE + slew + ("\npreview_samples = 4" if preview and slew else "")
    )
    ripple = CompensateRipple(cycles=(2, 5), cos=(1.4, 0.8), sin=(0.4, -1.2))
    terms = add_compensation(linear_controller(mpc), ripple=ripple).compensation
    friction = replace(mpc.compensation.friction, effort=2.0)
    mpc = replace(mpc, compensation=replace(mpc.compensation, ripple=terms.ripple, friction=friction))
    rows, state, commands = draw_rows(3), mpc.start, []
    assert mpc.compensation.reads == ("theta_m", "theta_l")
    assert all(getattr(mpc.compensation, name) for name in Compensation.json_keys)  # a new one is to be here, too
    found = run_c(compiler, tmp_path / "code", mpc, rows)
    for wanted, motor, link, reading in rows.tolist():
        command, state = mpc.command(state, wanted, reading, (motor, link))
        commands.append(command)
    np.testing.assert_allclose(found, commands, rtol=0.0, atol=1e-10 * LIMIT_A)
    assert 0.02 < np.mean(np.abs(commands) > LIMIT_A * (1 - 1e-9)) < 0.9 and np.max(np.abs(commands)) <= LIMIT_A
    steps = np.abs(np.diff(commands, prepend=0.0))
    assert (not slew and np.max(steps) > 1.0) or (np.max(steps) < 0.8 + 1e-12 and np.mean(steps > 0.8 - 1e-9) > 0.05)


@pytest.mark.parametrize("source", ["speed", "reference"])
def test_within_limits_the_plan_is_the_one_without_terms_and_friction_is_beside_it(source, compiler, tmp_path):
    """So the loop while no limit is active is that of the law with its terms, as it is certified."""
    mpc = plan(tmp_path, FROM_SPEED if source == "speed" else FROM_REFERENCE)
    rows = draw_rows(5)
    rows = rows[np.all(np.abs(rows) < 9e9, axis=1)] * [0.1, 2.0, 0.1, 0.1]
    term, per_effort = mpc.compensation.friction, 1.0 / (50.0 * 0.7 * 0.0369)
    found = run_c(compiler, tmp_path / "code", mpc, rows)
    bare, state, planned = replace(mpc, compensation=None), mpc.start, []
    for wanted, _, _, reading in rows.tolist():
        command, state = bare.command(state, wanted, reading)
        planned.append(command)
    per_step = 1.0 / (TS * 20.0) if source == "speed" else term.velocity_per_rate / (TS * term.speed)
    against = per_effort * rub(rows[:, 1] if source == "speed" else rows[:, 0], per_step)
    assert np.max(np.abs(found)) < 0.9 * LIMIT_A and np.ptp(against) > 0.9 * COULOMB * per_effort
    np.testing.assert_allclose(found, planned + against, rtol=0.0, atol=1e-9)


def find_radius(mpc, angle, fraction):
    """Return the largest eigenvalue on the pendulum at an angle, of matrices written here: motor, link, the command on
    its way, and the plan while no limit is active, whose reference is a share of the weight's slope times the link.
    """
    mass, damping, slope = 50.0**2 * 2.4e-5, 50.0**2 * 4e-4, WEIGHT * np.cos(angle)
    rates = np.zeros((5, 5))  # motor at the output, its speed, link, its speed; the command
    rates[0, 1] = rates[2, 3] = 1.0
    rates[1] = np.array([-300.0, -damping, 300.0, 0.0, 50.0 * 0.7 * 0.0369]) / mass
    rates[3] = np.array([300.0, 0.0, -300.0 - slope, -0.5, 0.0]) / 0.3
    law, moved = mpc.unlimited(), expm(rates * TS)
    n = law.c.size
    whole, read = np.zeros((5 + n, 5 + n)), np.zeros((2, 5))
    read[0, 2], read[1, [0, 2]] = fraction * slope, (300.0, -300.0)
    whole[:4, :5] = moved[:4]
    whole[4] = np.concatenate([law.d @ read, law.c])
    whole[5:] = np.column_stack([law.b @ read, law.a])
    return np.max(np.abs(np.linalg.eigvals(whole)))


@pytest.mark.parametrize("fraction", [0.8, 1.3])
def test_the_loop_that_a_weight_closes_is_certified_and_played(fraction, tmp_path, monkeypatch):
    """Its largest eigenvalue over angles at which the link does not fall by itself; more than all lets it rise."""
    problem, runs, play = read(tmp_path, GRAVITY.replace("0.8", f"{fraction}"), f_c=0), [], playback.close_loop
    mpc = design_mpc(problem, problem.parameters)
    monkeypatch.setattr(playback, "close_loop", lambda *a, **k: runs.append(play(*a, **k)) or runs[-1])
    certificate = so.certify(mpc, problem.certified_plants(), problem.parameters, samples=3, runs=1)
    angles = [angle for angle in 0.95 * np.pi * np.linspace(-1.0, 1.0, 9) if find_radius(mpc, angle, 0.0) <= 1.0]
    assert len(angles) == 5
    (row,) = (row for row in certificate.requirements if row.name == "gravity_compensation")
    assert row.value == pytest.approx(max(find_radius(mpc, angle, fraction) for angle in angles), abs=1e-6)
    assert row.met == (fraction < 1.0) and row.plant == "swing"
    run = next(run for run in runs if "theta_l" in run.outputs and np.ptp(run.outputs["theta_l"]) > 0.1)
    bare, state, places = replace(mpc, compensation=None), mpc.start, run.outputs["theta_l"]
    for wanted, place, torque, current in zip(run.reference, places, run.force, run.current, strict=True):
        command, state = bare.command(state, wanted + find_weight(mpc.compensation.gravity, place), torque)
        assert command == pytest.approx(current, abs=1e-9)


def test_friction_beside_a_plan_is_certified_as_beside_gains(tmp_path):
    """From the measured speed stability is shown up to a slope that half of the friction keeps, and more does not."""
    rows = {}
    for fraction, speed in ((0.5, 20.0), (1.5, 0.05)):
        terms = f'friction = {{ fraction = {fraction}, from = "speed", speed = {speed} }}'
        problem = read(tmp_path, terms)
        mpc = design_mpc(problem, problem.parameters)
        certificate = so.certify(mpc, problem.certified_plants(), problem.parameters, samples=3, runs=1)
        rows[fraction] = [row for row in certificate.requirements if row.name == "friction_compensation"]
    assert {row.plant for row in rows[0.5]} == {"design", "swing"} or {row.plant for row in rows[0.5]} == {
        "stand",
        "swing",
    }
    assert all(row.met for row in rows[0.5]) and not all(row.met for row in rows[1.5])


def test_files_and_pickles_keep_it(tmp_path):
    problem = read(tmp_path, f"{GRAVITY}, {FROM_SPEED}", IMPEDANCE)
    mpc, law = design_mpc(problem, problem.parameters), tune_problem(problem, problem.parameters)
    code, again = collect_code(mpc), pickle.loads(pickle.dumps(mpc))
    assert again.compensation == mpc.compensation == law.compensation and again.outer == mpc.outer == law.outer
    assert read_code(json.loads(to_json(code.to_dict()))).to_dict() == code.to_dict()
    assert "80 % of the link's weight, by theta_l" in repr(law)
    assert code.parts.keys() == {"terms.h", "outer.h"}
    assert not collect_code(replace(mpc, compensation=None, outer=None)).parts


@pytest.mark.parametrize(("added", "needed", "aimed"), [(-3.0, 10.5, 10.5), (3.0, 8.0, 6.0), (-3.0, 13.0, 12.0)])
def test_at_rest_the_sum_of_plan_and_terms_is_what_the_limit_is_of(added, needed, aimed, tmp_path, monkeypatch):
    """Of 9 A, beside -3 A a plan may rest at 12 A, and beside 3 A at 6 A."""
    mpc = plan(tmp_path, FROM_REFERENCE)
    monkeypatch.setattr(
        "seaopt.control.mpc.mpc.add_terms",
        lambda terms, link, last, references, readings: (0.0, added / mpc.per_effort, *last[2:]),
    )
    step = mpc.step(mpc.start, needed * mpc.static_gain, 0.0, ())
    assert step.target_N == pytest.approx(aimed * mpc.static_gain)
