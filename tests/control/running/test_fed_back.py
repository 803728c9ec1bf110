"""Loops closed with what terms feed back, against matrices from sample to sample written here, and python-control."""

from __future__ import annotations

from dataclasses import replace

import control
import numpy as np
import pytest
from scipy.linalg import expm

import seaopt as so
from seaopt.control import (
    CompensateFriction,
    CompensateGravity,
    Impedance,
    add_compensation,
    add_impedance,
    compensate_schedule,
    tune_schedule,
)
from seaopt.control.running.fed_back import close_terms, close_whole, split_states
from seaopt.errors import ControlError
from seaopt.robustness.certificate.cases import pose
from seaopt.robustness.uncertainty.batch import batch_figures
from tests.hand_loops import find_peaks

HELD, KNEE, FREE = (so.plants.rotary(link) for link in ("locked", "pendulum", "free"))
VALUES = KNEE.defaults.update(
    N=100.0, K_tau=0.0369, eta=0.7, J_m=2.4e-5, b_r=1e-4, k_s=300.0, J_l=0.25, d_l=0.3, m=3.0, L=0.25, f_c=0.0, v_s=1.0
)
RUBBING = VALUES.update(f_c=0.004)
TS, ASKED = 1e-3, Impedance(stiffness=40.0, damping=2.0, velocity_filter_s=5e-3)


@pytest.fixture(scope="module")
def force():
    return so.tune(HELD, VALUES, so.ControllerSpec(measured="tau_s", bandwidth_hz=15, reserve=0.05))


@pytest.fixture(scope="module")
def rubbing():
    plain = so.tune(HELD, RUBBING, so.ControllerSpec(measured="tau_s", bandwidth_hz=15, reserve=0.05))
    return add_compensation(plain, friction=CompensateFriction(fraction=0.5, source="speed"))


def weigh(controller, fraction=0.9):
    return add_compensation(controller, gravity=CompensateGravity(fraction=fraction), link=(KNEE, VALUES))


def sample_joint(v, angle, rubs):
    """Return the sampled motor and link at an angle, friction with a slope, and what is read of them."""
    n, k, c, weight = v["N"], v["k_s"], v["c_s"], v["m"] * v["g"] * v["L"] * np.cos(angle)
    a = np.array([
        [0, 1, 0, 0],
        [-k / n**2 / v["J_m"], -(v["b_r"] + rubs + c / n**2) / v["J_m"], k / n / v["J_m"], c / n / v["J_m"]],
        [0, 0, 0, 1],
        [k / n / v["J_l"], c / n / v["J_l"], -(k + weight) / v["J_l"], -(v["d_l"] + c) / v["J_l"]],
    ])  # fmt: skip
    b = np.array([0.0, v["eta"] * v["K_tau"] / v["J_m"], 0.0, 0.0])
    whole = expm(np.block([[a, b[:, None]], [np.zeros((1, 5))]]) * TS)
    return whole[:4, :4], whole[:4, 4], np.array([k / n, c / n, -k, -c])


def close_by_hand(controller, angle=0.0, *, rubs=0.0, around=None, against=0.0, share=0.9, **changed):
    """Return the loop from disturbance of the command and reference to command and torque: of joint, waiting command,
    law, filter of the link's speed and last angle of the motor. `against`: effort by the motor's step.
    """
    v = {name: VALUES[name].value for name in VALUES} | changed
    (a, b, spring), law, gain = sample_joint(v, angle, rubs), controller.law, controller.command.per_effort
    m, nominal = law.c.size, 3.0 * 9.81 * 0.25 * np.cos(angle)
    size, link, motor = m + 7, np.eye(m + 7)[2], np.eye(m + 7)[0]
    pole, rate = 5.0 / 6.0, 1.0 / 6e-3
    stiffness, damping = (0.0, 0.0) if around is None else (around.stiffness, around.damping)
    asked = share * nominal * link - (stiffness + damping * rate) * link
    asked[-2] -= damping
    read = np.concatenate([spring, np.zeros(m + 3)])
    effort = law.d[0] * asked + law.d[1] * read + against * (motor - np.eye(size)[-1])
    effort[5 : 5 + m] += law.c
    rows, into = np.zeros((size, size)), np.zeros((size, 2))
    rows[:4, :4], rows[:4, 4], rows[4] = a, b, gain * effort
    rows[5 : 5 + m, 5 : 5 + m] = law.a
    rows[5 : 5 + m] += np.outer(law.b[:, 0], asked) + np.outer(law.b[:, 1], read)
    rows[-2, 2], rows[-2, -2], rows[-1, 0] = (pole - 1.0) * rate, pole, 1.0
    into[4], into[5 : 5 + m, 1] = [gain, gain * law.d[0]], law.b[:, 0]
    out = np.array([effort, read])
    return control.ss(rows, into, out, np.array([[1.0, law.d[0]], [0.0, 0.0]]), TS)


def check_figures(found, loop, *, tracking_too=True):
    assert found.spectral_radius == pytest.approx(np.max(np.abs(loop.poles())), abs=2e-8)  # the series
    ms, tracking_peak = find_peaks(loop, lambda response: response[0, 0], lambda response: response[1, 1])
    assert found.ms == pytest.approx(ms, rel=1e-4)
    if not tracking_too:  # its static value is that of the series' last digits where nothing of a weight is left
        return
    still = abs(loop(1.0)[1, 1])
    assert found.reference_peak == pytest.approx(max(tracking_peak / still, 1.0), rel=1e-3)
    edge = np.abs(loop(np.exp(2j * np.pi * found.bandwidth_hz * TS)))[1, 1]
    assert edge == pytest.approx(still / np.sqrt(2.0), rel=1e-5)


@pytest.mark.parametrize("angle", [0.0, 0.7])
@pytest.mark.parametrize("around", [None, ASKED, replace(ASKED, stiffness=0.0)])
def test_a_weight_is_fed_back_with_the_outer_loop_around_it(force, around, angle):
    controller = weigh(force)
    if around is not None:
        controller = add_impedance(controller, KNEE, VALUES, around)
    at = VALUES.with_parameters(so.Parameter(name="theta_l", value=angle, unit="rad"))
    plants = split_states(controller, {"knee": KNEE, "stand": HELD}, VALUES)
    assert plants["stand"] is HELD and close_terms(controller, HELD) is controller
    found = close_terms(controller, plants["knee"]).close(plants["knee"], at).figures()
    check_figures(found, close_by_hand(controller, angle, around=around))
    assert abs(found.bandwidth_hz - controller.close(KNEE, at).figures().bandwidth_hz) > 0.1


@pytest.mark.parametrize("around", [ASKED, replace(ASKED, stiffness=0.0)])
def test_an_outer_loop_is_closed_without_a_weight_too(force, around):
    """At the nominal parameters and at draws; a link that is held has the force loop alone."""
    controller = add_impedance(force, KNEE, VALUES, around)
    plants = split_states(controller, {"knee": KNEE, "stand": HELD}, VALUES)
    assert plants == {"knee": KNEE, "stand": HELD} and close_terms(controller, HELD) is controller
    loop = close_by_hand(controller, around=around, share=0.0)
    check_figures(close_whole(controller, KNEE, VALUES).figures(), loop)
    assert close_whole(controller, KNEE, VALUES).figures().ms != pytest.approx(force.close(KNEE, VALUES).figures().ms)
    masses = np.array([1.0, 3.0, 6.0])
    found = batch_figures(controller, KNEE, VALUES, {"m": masses})
    by_hand = [close_by_hand(controller, around=around, share=0.0, m=mass) for mass in masses]
    radii = [np.max(np.abs(loop.poles())) for loop in by_hand]
    np.testing.assert_allclose(found.spectral_radius, radii, atol=2e-8)


def test_draws_have_the_slope_where_they_rest(force):
    controller = weigh(force, 1.1)
    (plant,) = split_states(controller, {"knee": KNEE}, VALUES).values()
    masses, angles = np.array([2.6, 3.0, 3.2, 3.5]), np.array([0.0, 0.5, 0.5, -0.9])
    found = batch_figures(controller, plant, VALUES, {"m": masses, "theta_l": angles})
    loops = [close_by_hand(controller, angle, share=1.1, m=mass) for mass, angle in zip(masses, angles, strict=True)]
    radii = [np.max(np.abs(loop.poles())) for loop in loops]
    np.testing.assert_allclose(found.spectral_radius, radii, atol=2e-8)
    assert list(found.spectral_radius < 1.0) == [False, False, False, True]
    check_figures(
        close_terms(controller, plant).close(plant, VALUES.update(m=3.5)).figures(),
        close_by_hand(controller, share=1.1, m=3.5),
    )


def test_all_of_a_weight_leaves_a_loop_that_stands(force):
    controller = weigh(force, 1.0)
    (plant,) = split_states(controller, {"knee": KNEE}, VALUES).values()
    found = close_terms(controller, plant).close(plant, VALUES).figures()
    check_figures(found, close_by_hand(controller, share=1.0 - 1e-4), tracking_too=False)
    assert found.stable


def test_friction_is_compensated_in_full_where_it_sticks(rubbing):
    term, whole = rubbing.compensation.friction, close_terms
    plants = split_states(rubbing, {"stand": KNEE}, RUBBING)
    sliding, stuck = plants.values()
    assert list(plants) == ["stand sliding", "stand stuck"] and whole(rubbing, sliding) is rubbing
    per_step = term.effort / term.speed * term.velocity_per_rate / TS
    hand = close_by_hand(rubbing, rubs=0.004, against=per_step, share=0.0)
    found = whole(rubbing, stuck).close(stuck, RUBBING).figures()
    check_figures(found, hand)
    without = rubbing.close(stuck, RUBBING).figures()
    assert found.ms != pytest.approx(without.ms, rel=1e-3)


def test_friction_is_compensated_where_nothing_holds_a_link_too(rubbing):
    """The motor's place drifts, an eigenvalue of 1 by hand, and is left out."""
    term = rubbing.compensation.friction
    _, stuck = split_states(rubbing, {"free": FREE}, RUBBING).values()
    per_step = term.effort / term.speed * term.velocity_per_rate / TS
    hand = close_by_hand(rubbing, rubs=0.004, against=per_step, share=0.0, m=0.0)
    found = close_terms(rubbing, stuck).close(stuck, RUBBING).figures()
    radii = np.sort(np.abs(hand.poles()))
    assert radii[-1] == pytest.approx(1.0, abs=1e-9)
    assert found.spectral_radius == pytest.approx(radii[-2], abs=1e-8) and found.stable
    f = np.concatenate([np.geomspace(0.01, 2.0, 2000), np.linspace(2.0, 499.0, 10_000)])
    size = np.abs(hand(np.exp(2j * np.pi * f * TS))[0, 0])
    np.testing.assert_allclose(found.ms, np.max(size), rtol=2e-5)
    drawn = batch_figures(rubbing, stuck, RUBBING, {"k_s": np.array([300.0])})
    np.testing.assert_allclose((drawn.ms[0], drawn.spectral_radius[0]), (found.ms, found.spectral_radius), rtol=1e-6)
    assert abs(rubbing.close(stuck, RUBBING).figures().ms - found.ms) > 0.03


def test_a_schedule_is_closed_so_at_each_of_its_places(force):
    schedule = tune_schedule(HELD, VALUES, force.spec, "k_s", [280.0, 320.0])
    schedule = compensate_schedule(schedule, gravity=CompensateGravity(fraction=0.9), link=(KNEE, VALUES))
    for value, cases in pose(schedule, {"knee": KNEE}, VALUES, {}, so.ParameterSet()).items():
        plant = cases.plants["knee"]
        found = close_terms(cases.controller, plant).close(plant, cases.unknown.nominal).figures()
        check_figures(found, close_by_hand(cases.controller, k_s=value))


def test_a_certificate_is_of_the_loop_with_its_weight(force):
    controller = weigh(force, 1.1)
    certificate = so.certify(controller, {"knee": KNEE}, VALUES, samples=5, simulations=False)
    radius = np.max(np.abs(close_by_hand(controller, share=1.1).poles()))
    assert certificate.plants["knee"].spectral_radius == pytest.approx(radius, abs=2e-8)
    assert {row.name for row in certificate.requirements if not row.met} >= {"spectral_radius", "gravity_compensation"}
    read = so.Certificate.from_dict(certificate.to_dict(), controller, {"knee": KNEE}, VALUES)
    assert read.plants["knee"] == certificate.plants["knee"] and read.worst["knee"].verify(controller)


def test_a_plant_without_what_is_regulated_is_named(force):
    def h(t, x, u, p):
        return {name: value for name, value in KNEE.h(t, x, u, p).items() if name != "tau_s"}

    outputs = {name: unit for name, unit in KNEE.outputs.items() if name != "tau_s"}
    bare = replace(KNEE, name="bare", h=h, outputs=outputs, sensing=None)
    for controller in (force, weigh(force)):
        with pytest.raises(ControlError, match='measured = "tau_s" is not an output of bare'):
            so.certify(controller, {"bare": bare}, VALUES, samples=5, simulations=False)
