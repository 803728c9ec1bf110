"""Scenarios of a law with the outer loop around it, against the equations of motor and link written here."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import expm

import seaopt as so
from seaopt.control import Impedance, add_impedance, tune_schedule
from seaopt.robustness.verification.linear import linearise_last_phase
from seaopt.robustness.verification.playback import Rig, play
from seaopt.robustness.verification.scenarios import Phase, Scenario, default_scenarios
from seaopt.robustness.verification.schedule_sweep import RestStart
from seaopt.robustness.verification.verification import verify

HELD, FREE, PENDULUM = so.plants.rotary("locked"), so.plants.rotary(), so.plants.rotary("pendulum")
VALUES = FREE.defaults.update(N=100.0, K_tau=0.0369, eta=0.7, J_m=2.4e-5, b_r=1e-4, k_s=300.0, J_l=0.25, d_l=0.3)
TS, ASKED = 1e-3, Impedance(stiffness=40.0, damping=2.0, velocity_filter_s=5e-3)
STEP = Scenario(name="step", phases=(Phase(duration_s=0.2), Phase(duration_s=1.0, force_N=4.0)))


@pytest.fixture(scope="module")
def force():
    return so.tune(HELD, VALUES, so.ControllerSpec(measured="tau_s", bandwidth_hz=15, reserve=0.05))


@pytest.fixture(scope="module")
def knee(force):
    return add_impedance(force, FREE, VALUES, ASKED, name="free")


@pytest.fixture(scope="module")
def damped(force):
    """Return a law with an outer loop of damping alone."""
    return add_impedance(force, FREE, VALUES, replace(ASKED, stiffness=0.0), name="free")


def sample_joint():
    """Return the sampled motor and link, from command to their next state."""
    v = {name: VALUES[name].value for name in VALUES}
    n, k, c = v["N"], v["k_s"], v["c_s"]
    a = np.array([
        [0, 1, 0, 0], [-k / n**2 / v["J_m"], -(v["b_r"] + c / n**2) / v["J_m"], k / n / v["J_m"], c / n / v["J_m"]],
        [0, 0, 0, 1], [k / n / v["J_l"], c / n / v["J_l"], -k / v["J_l"], -(v["d_l"] + c) / v["J_l"]],
    ])  # fmt: skip
    b = np.array([0.0, v["eta"] * v["K_tau"] / v["J_m"], 0.0, 0.0])
    whole = expm(np.block([[a, b[:, None]], [np.zeros((1, 5))]]) * TS)
    return whole[:4, :4], whole[:4, 4], np.array([k / n, c / n, -k, -c])


def simulate(controller, wanted, added=None):
    """Return torque, its reference and the link's position under references of the link's position. `added`: torques
    asked for beside damping alone.
    """
    stiffness, added = (40.0, np.zeros(wanted.size)) if added is None else (0.0, added)
    (a, b, spring), law, per_effort = sample_joint(), controller.law, controller.command.per_effort
    x, z, waiting, before, speed, rows = np.zeros(4), np.zeros(law.c.size), 0.0, 0.0, 0.0, []
    for x_0, push in zip(wanted, added, strict=True):
        torque, place = spring @ x, x[2]
        speed, before = (5e-3 * speed + place - before) / (5e-3 + TS), place
        asked = push + stiffness * (x_0 - place) - 2.0 * speed
        rows.append((torque, asked, place))
        effort, z = law.c @ z + law.d @ [asked, torque], law.a @ z + law.b @ [asked, torque]
        x, waiting = a @ x + b * waiting, effort * per_effort
    return np.array(rows).T


def close_by_hand(controller, stiffness=40.0):
    """Return the matrix of joint, waiting command, law and filter of the speed."""
    (a, b, spring), law, n = sample_joint(), controller.law, controller.law.c.size
    pole, rate = 5.0 / 6.0, 1.0 / 6e-3
    asked = np.concatenate([-(stiffness + 2.0 * rate) * np.eye(4)[2], [0.0], np.zeros(n), [-2.0]])
    read = np.concatenate([spring, np.zeros(n + 2)])
    effort = np.concatenate([np.zeros(5), law.c, [0.0]]) + law.d[0] * asked + law.d[1] * read
    rows = np.zeros((n + 6, n + 6))
    rows[:4, :4], rows[:4, 4], rows[4] = a, b, controller.command.per_effort * effort
    rows[5 : 5 + n, 5 : 5 + n] = law.a
    rows[5 : 5 + n] += np.outer(law.b[:, 0], asked) + np.outer(law.b[:, 1], read)
    rows[-1, 2], rows[-1, -1] = (pole - 1.0) * rate, pole
    return rows


def test_a_step_moves_the_link_as_the_equations_say(knee):
    played = play(Rig(controller=knee, plant=FREE), STEP, [VALUES])
    torque, asked, place = simulate(knee, np.repeat([0.0, 0.1], [200, 1000]))  # 4 N m over 40 N m/rad
    assert place[-1] > 0.08 and np.max(torque) > 1.0
    for found, expected in ((played.outputs["tau_s"], torque), (played.reference, asked)):
        np.testing.assert_allclose(found[0], expected, atol=1e-5 * np.ptp(expected))
    np.testing.assert_allclose(played.outputs["theta_l"][0], place, atol=1e-6)


def test_damping_alone_is_added_to_the_torque_that_is_asked_for(damped, force):
    played = play(Rig(controller=damped, plant=FREE), STEP, [VALUES])
    push = np.repeat([0.0, 4.0], [200, 1000])
    torque, asked, place = simulate(damped, np.zeros(1200), push)
    assert np.min(asked[220:]) < 0.6 * 4.0  # it is damped
    for found, expected in ((played.outputs["tau_s"], torque), (played.reference, asked)):
        np.testing.assert_allclose(found[0], expected, atol=1e-5 * np.ptp(expected))
    np.testing.assert_allclose(played.outputs["theta_l"][0], place, atol=1e-6)
    held, plain = (play(Rig(controller=each, plant=HELD), STEP, [VALUES]) for each in (damped, force))
    np.testing.assert_allclose(held.outputs["tau_s"], plain.outputs["tau_s"], atol=1e-9)


def test_a_link_that_is_held_or_gripped_has_the_force_asked_for(knee, force):
    held, plain = (play(Rig(controller=each, plant=HELD), STEP, [VALUES]) for each in (knee, force))
    np.testing.assert_allclose(held.outputs["tau_s"], plain.outputs["tau_s"], atol=1e-9)
    push, grip = Phase(duration_s=0.3, force_N=4.0), Phase(duration_s=0.3, force_N=4.0, held=True)
    played = play(Rig(controller=knee, plant=FREE, partner=HELD), Scenario(name="grip", phases=(push, grip)), [VALUES])
    place = played.outputs["theta_l"][0, 299]
    assert place > 0.02
    assert played.reference[0, -1] == pytest.approx(40.0 * (0.1 - place), abs=0.05)  # a sample later
    assert played.outputs["tau_s"][0, -1] == pytest.approx(played.reference[0, -1], abs=0.02)


def test_a_pendulum_rests_at_an_angle_where_its_stiffness_carries_it(force):
    placed = so.Parameter(name="theta_l", value=0.4, unit="rad")
    values = PENDULUM.defaults.with_parameters(*VALUES.values()).update(m=1.0, L=0.3).with_parameters(placed)
    stiff = add_impedance(force, PENDULUM, values, ASKED, name="leg")
    played = play(Rig(controller=stiff, plant=PENDULUM), STEP, [values])
    weight = 1.0 * 9.81 * 0.3 * np.sin(0.4)
    np.testing.assert_allclose(played.outputs["theta_l"][0, :200], 0.4, atol=1e-9)
    np.testing.assert_allclose(played.reference[0, :200], weight, atol=1e-6)
    assert played.outputs["theta_l"][0, -1] > 0.45


@pytest.mark.parametrize("stiffness", [40.0, 0.0])
def test_the_linear_loop_of_the_judgement_has_the_outer_loop(knee, damped, stiffness):
    law = knee if stiffness else damped
    view = linearise_last_phase(Rig(controller=law, plant=FREE), STEP, VALUES)
    found, expected = view.loop.eigenvalues(), np.linalg.eigvals(close_by_hand(law, stiffness))
    np.testing.assert_allclose(*(np.sort(np.abs(each))[::-1][:6] for each in (found, expected)), rtol=1e-7)


@pytest.mark.parametrize("stiffness", [40.0, 0.0])
def test_an_outer_loop_that_makes_the_link_swing_fails_its_scenarios(force, knee, damped, stiffness):
    knee = knee if stiffness else damped
    asked = replace(ASKED, stiffness=stiffness, damping=-1.0)
    pushing = add_impedance(force, FREE, VALUES, asked, name="free")
    runs = {name: verify(each, {"free": FREE}, VALUES) for name, each in (("kept", knee), ("pushed", pushing))}
    assert runs["kept"].met
    assert {"unstable", "growth"} <= {kind for row in runs["pushed"].rows for kind in row.kinds}
    assert not any(row.met for row in runs["pushed"].rows)


def test_noise_of_the_position_is_in_the_runs(knee):
    seen = [
        play(Rig(controller=knee, plant=FREE, sensors=so.Sensors(noise_std=std)), STEP, [VALUES])
        for std in ({}, {"theta_l": 1e-4})
    ]
    assert np.std(seen[1].outputs["tau_s"] - seen[0].outputs["tau_s"]) > 0.001
    assert verify(knee, {"free": FREE}, VALUES, scenarios=[STEP], sensors=so.Sensors(noise_std={"theta_l": 1e-5})).met


def test_a_lever_that_is_pulled_on_is_not_let_fall():
    stand, swing, thor = so.plants.high_impedance(), so.plants.moving_output(), so.plants.thor()
    plain = so.tune(stand, thor, so.ControllerSpec(bandwidth_hz=30, max_sensitivity=1.6))
    stiff = add_impedance(plain, swing, thor, Impedance(stiffness=5e3, damping=500.0), name="swing")
    names = [{scenario.name for scenario in default_scenarios(each, swing)} for each in (plain, stiff)]
    assert names[0] - names[1] == {"fall through 90 deg"}


@pytest.mark.parametrize("stiffness", [40.0, 0.0])
def test_a_schedule_is_pushed_with_its_outer_loop(force, stiffness):
    schedule, asked = (
        tune_schedule(HELD, VALUES, force.spec, "k_s", [280.0, 320.0]),
        replace(ASKED, stiffness=stiffness),
    )
    laws = tuple(add_impedance(each, FREE, VALUES, asked, name="free") for each in schedule.controllers)
    schedule = replace(schedule, controllers=laws)
    start = RestStart.at_rest(schedule, FREE, VALUES, 300.0)
    pulses = np.repeat([0.0, 1.0], [50, 450])
    run = start.run(FREE, start.params, 4.0 * pulses[None], np.full(500, 300.0))
    torque, asked, place = simulate(schedule.at(300.0), 0.1 * pulses, None if stiffness else 4.0 * pulses)
    np.testing.assert_allclose(run.outputs["theta_l"][0], place, atol=1e-6)
    np.testing.assert_allclose(start.find_errors(run, np.full(500, 300.0))[0], torque - asked, atol=1e-4)
