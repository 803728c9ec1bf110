"""What a certificate requires of an impedance, and what a problem file asks for."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import expm

import seaopt as so
from seaopt.control import Impedance, add_impedance, critical_impedance, render
from seaopt.control.laws.realisation import runnable
from seaopt.files import to_json
from seaopt.problem.stages import tune_problem
from seaopt.robustness import Certificate
from tests.words import flatten

HELD, FREE = so.plants.rotary("locked"), so.plants.rotary()
VALUES = FREE.defaults.update(N=100.0, K_tau=0.0369, eta=0.7, J_m=2.4e-5, b_r=1e-4, k_s=300.0, J_l=0.25, d_l=0.3)
PROBLEM = """
schema = 1
[parameters]
N = 100
K_tau = 0.0369
eta = 0.7
J_m = 2.4e-5
b_r = 1e-4
k_s = 300
J_l = 0.25
d_l = 0.3
[plant.stand]
kind = "rotary"
link = "locked"
[plant.free]
kind = "rotary"
[controller]
plant = "stand"
measured = "tau_s"
bandwidth_hz = 15
[impedance]
plant = "PLANT"
stiffness = 40
damping = DAMPING
velocity_filter_s = 0.005
"""


@pytest.fixture(scope="module")
def force():
    return so.tune(HELD, VALUES, so.ControllerSpec(measured="tau_s", bandwidth_hz=15, reserve=0.05))


def certify(force, damping, ranges=None, values=VALUES, limit_A=None, thorough=True):
    asked = Impedance(stiffness=40.0, damping=damping, velocity_filter_s=5e-3)
    limited = replace(force, spec=replace(force.spec, current_limit_A=limit_A))
    controller = add_impedance(limited, FREE, values, asked, name="free")
    options = {"samples": 5, "ranges": ranges, "simulations": False, "thorough": thorough}
    return so.certify(controller, {"free": FREE}, values, **options)


@pytest.fixture(scope="module")
def certificate(force):
    return certify(force, 2.0, ranges={"J_l": (0.2, 0.3)}, limit_A=100.0)


def find(certificate, name):
    (row,) = [row for row in certificate.requirements if row.name == name]
    return row


def test_a_passive_impedance_is_certified(certificate):
    assert find(certificate, "impedance_stable").met
    row = find(certificate, "impedance_damper")
    assert row.met and row.value < row.limit == pytest.approx(0.3)
    assert "40 N m/rad and 2 N m s/rad at the link of free" in flatten(repr(certificate))


def test_one_that_is_not_fails_and_names_what_breaks_it(force):
    certificate = certify(force, 12.0)
    assert not certificate.passed
    row = find(certificate, "impedance_damper")
    assert not row.met and row.value > 0.3
    assert "makes it oscillate" in row.where


def test_it_is_in_the_json_and_read_again(certificate):
    content = json.loads(to_json(certificate.to_dict()))
    assert content["impedance"]["plant"] == "free"
    assert content["impedance"]["region"]["stiffest"]["stiffness"] > 40.0
    read = Certificate.from_dict(content, certificate.controller, {"free": FREE}, VALUES)
    assert read.impedance is not None
    assert read.impedance.rendering.needed_damper == pytest.approx(content["impedance"]["needed_damper"])
    assert read.impedance.draws == certificate.impedance.draws and read.impedance.draws.passive == 5
    assert read.impedance.steps == certificate.impedance.steps


def test_scenarios_of_damping_alone_are_of_the_law_with_it(force):
    def certify_damping(damping):
        damped = add_impedance(force, FREE, VALUES, Impedance(stiffness=0.0, damping=damping), name="free")
        return so.certify(damped, {"free": FREE}, VALUES, samples=5, simulations=False)

    assert certify_damping(1.0).steps.met
    pushed = certify_damping(-1.0)  # a link without a damper of its own: it runs away
    assert not pushed.steps.met and {row.plant for row in pushed.steps.failures} == {"free"}


@pytest.mark.slow
def test_draws_that_are_not_passive_fail(force):
    # A spring of 80 N m/rad passively carries no stiffness of 40 under this law: the nominal one, of 300, does.
    values = VALUES.update(d_l=0.05)
    certificate = certify(force, 2.0, ranges={"k_s": (60.0, 100.0)}, values=values)
    row = find(certificate, "impedance_draws")
    worst = render(
        certificate.controller, FREE, values.update(**certificate.impedance.draws.parameters),
        Impedance(stiffness=40.0, damping=2.0, velocity_filter_s=5e-3),
    )  # fmt: skip
    assert not row.met and not certificate.passed and not worst.passive
    assert find(certificate, "impedance_damper").met  # at the nominal parameters


@pytest.mark.slow
def test_friction_counts_sliding_and_stuck(force):
    certificate = certify(force, 2.0, values=VALUES.update(f_c=0.005, v_s=1.0))
    assert certificate.impedance.stuck is not None
    rows = [row for row in certificate.requirements if row.name == "impedance_damper"]
    assert len(rows) == 2 and "stuck" in rows[1].where and rows[1].value < rows[0].value


def test_friction_margins_that_nobody_asks_for_are_left_out_and_the_impedance_is_judged_at_the_same_draws(force):
    rubbing, ranges = VALUES.update(f_c=1e-4, v_s=1.0), {"J_l": (0.2, 0.3)}
    loose = replace(force, spec=replace(force.spec, max_sensitivity=2.0, max_complementary=2.0))
    whole, brief = (certify(loose, 2.0, ranges, rubbing, 100.0, thorough) for thorough in (True, False))
    assert whole.met and whole.friction_draws and not brief.friction_draws and "free" in brief.friction
    assert brief.requirements == whole.requirements and brief.impedance.draws == whole.impedance.draws


def test_a_simulated_step_is_that_of_the_equations(certificate):
    """The two inertias by their equations, sampled by SciPy, under the stored law and the outer loop's formula."""
    small = certificate.impedance.steps[0]
    v = {name: VALUES[name].value for name in VALUES}
    n, ts = v["N"], 1e-3
    k, c = v["k_s"], v["c_s"]
    a = np.array([
        [0, 1, 0, 0], [-k / n**2 / v["J_m"], -(v["b_r"] + c / n**2) / v["J_m"], k / n / v["J_m"], c / n / v["J_m"]],
        [0, 0, 0, 1], [k / n / v["J_l"], c / n / v["J_l"], -k / v["J_l"], -(v["d_l"] + c) / v["J_l"]],
    ])  # fmt: skip
    b = np.array([0.0, v["eta"] * v["K_tau"] / v["J_m"], 0.0, 0.0])
    whole = expm(np.block([[a, b[:, None]], [np.zeros((1, 5))]]) * ts)
    law, per_effort = certificate.controller.law, certificate.controller.command.per_effort
    x, z, waiting, before, speed, path = np.zeros(4), np.zeros(law.c.size), 0.0, 0.0, 0.0, []
    for _ in range(15000):
        torque, place = k * (x[0] / n - x[2]) + c * (x[1] / n - x[3]), x[2]
        speed = (5e-3 * speed + place - before) / (5e-3 + ts)
        before = place
        inputs = np.array([40.0 * (small.size - place) - 2.0 * speed, torque])
        effort, z = law.c @ z + law.d @ inputs, law.a @ z + law.b @ inputs
        path.append(place)
        x, waiting = whole[:4, :4] @ x + whole[:4, 4] * waiting, effort * per_effort
    assert not small.saturated and small.rests
    assert small.end == pytest.approx(1.0, abs=1e-6) == path[-1] / small.size
    assert small.overshoot == pytest.approx(max(path) / small.size - 1.0, rel=1e-6)


def test_one_law_runs_as_force_law_and_outer_loop_do(force):
    controller = add_impedance(force, FREE, VALUES, Impedance(stiffness=40.0, damping=2.0), name="free")
    law, whole = (runnable(controller, command_limit=2.0, outer=outer) for outer in (False, True))
    rng = np.random.default_rng(3)
    wanted, torque, place = rng.normal(size=(3, 200)) * np.array([[0.02], [0.5], [0.001]])
    together, _ = whole.run(wanted, torque, whole.reset(0.0, readings=[0.0]), place[:, None])
    state, filtered, apart = law.reset(), controller.outer.reset(place[0]), []
    for k in range(200):
        reference, filtered = controller.outer.step(filtered, wanted[k], place[k])
        current, state = law.step(state, reference, torque[k])
        apart.append(current)
    assert np.max(np.abs(apart)) == 2.0 and np.min(np.abs(apart)) < 1.0
    assert together == pytest.approx(np.array(apart), rel=1e-12, abs=1e-12)


def write(folder, plant="free", damping="2.0"):
    path = folder / "knee.toml"
    path.write_text(PROBLEM.replace("PLANT", plant).replace("DAMPING", damping))
    return path


def test_a_problem_file_asks_for_it(tmp_path):
    problem = so.read_problem(write(tmp_path, damping='"critical"'))
    controller = tune_problem(problem, problem.parameters)
    expected = critical_impedance(controller, FREE, problem.parameters, 40.0, velocity_filter_s=5e-3)
    assert controller.outer.impedance == expected
    assert controller.outer.plant == "free"
    assert list(problem.certified_plants()) == ["stand", "free"]


def test_a_held_link_or_a_missing_controller_is_refused(tmp_path):
    with pytest.raises(so.SeaoptError, match=r'impedance.plant = "stand" holds its link'):
        so.read_problem(write(tmp_path, plant="stand"))
    path = write(tmp_path)
    text = path.read_text()
    start, end = text.index("[controller]"), text.index("[impedance]")
    path.write_text(text[:start] + text[end:])
    with pytest.raises(so.SeaoptError, match=r"no \[controller\]"):
        so.read_problem(path)
