"""The test of stability with friction against a fine lifted discretisation and eigenvalues."""

from __future__ import annotations

import re
from dataclasses import replace

import control
import numpy as np
import pytest
from scipy.linalg import expm

import seaopt as so
from seaopt.control import MPCSpec, force_mpc
from seaopt.control.laws.friction import find_friction_margin, find_friction_margins
from seaopt.control.loops import absolute_stability as proof
from seaopt.control.loops.friction_loop import FrictionLoop
from seaopt.control.loops.sampled_plant import DigitalPlant
from seaopt.errors import ControlError
from tests.laws import law_of, measurement_matrices

STIFFNESS, MASS, DAMPING, PERIOD, DELAY = 120e3, 18.9, 395.0, 1e-3, 2
A = np.array([[0.0, 1.0], [-STIFFNESS / MASS, -DAMPING / MASS]])
B = np.array([0.0, 1.0 / MASS])
C = np.array([STIFFNESS, 0.0])


@pytest.fixture(scope="module")
def controller(stand, thor):
    """Return a law for the stand with friction, and for the swing."""
    spec, others = so.ControllerSpec(bandwidth_hz=15, max_sensitivity=1.6), {"swing": so.plants.moving_output()}
    return so.tune(stand, thor.update(f_c=50.0, v_s=4e-3), spec, others)


def discretise(period):
    block = expm(np.block([[A, B[:, None]], [np.zeros((1, 3))]]) * period)
    return block[:2, :2], block[:2, 2]


def pid(k_p, k_d, k_i=0.6, T_f=1.3e-3):
    alpha = T_f / (T_f + PERIOD)
    lag, difference = np.array([1.0, -alpha]), np.array([1.0, -1.0])
    den = np.convolve(difference, lag)
    num = k_p * den + k_d / (T_f + PERIOD) * np.convolve(difference, difference)
    return law_of(num + k_i * PERIOD / 2 * np.convolve([1.0, 1.0], lag), den, sample_time_s=PERIOD)


def loop_of(law, slope=1.0):
    a, b = discretise(PERIOD)
    plant = DigitalPlant(a=a, b=b, c=C[None], d=np.zeros(1), sample_time_s=PERIOD, delay_samples=DELAY, static_gain=1.0)
    return FrictionLoop(
        a=A, motor=B, friction=B[:, None], velocity=np.array([[0.0, 1.0]]), sensed=C[None], through=np.zeros((1, 1)),
        slopes=np.array([slope]), plant=plant, law=law,
    )  # fmt: skip


def closed_loop_matrices(law, substeps):
    """Return the loop over one period, from friction effort in each substep to the velocity's mean in each.

    Written for this test: states are the plant's, the two commands under way, and the law's own; the effort is
    constant within a substep.
    """
    h = PERIOD / substeps
    a, b = discretise(h)
    # Mean of the state over a substep, for a velocity whose power is that of the effort.
    mean = expm(np.block([[A, np.eye(2)], [np.zeros((2, 4))]]) * h)[:2, 2:] / h
    whole = expm(np.block([[A, B[:, None], np.zeros((2, 1))], [np.zeros((1, 3)), 1.0], [np.zeros((1, 4))]]) * h)
    mean_effort = whole[:2, 3] / h
    law_a, law_b, law_c, law_d = measurement_matrices(law)
    n, waiting = law_a.shape[0], DELAY
    size = 2 + waiting + n
    first = np.zeros((size, size))  # what happens at the sample: u_k = -C_y y_k joins the queue
    first[:2, :2] = np.eye(2)
    for i in range(1, waiting):
        first[2 + i - 1, 2 + i] = 1.0
    first[2 + waiting - 1, :2], first[2 + waiting - 1, 2 + waiting :] = -law_d * C, -law_c
    first[2 + waiting :, :2], first[2 + waiting :, 2 + waiting :] = np.outer(law_b, C), law_a
    applied = np.zeros(size)
    applied[2] = 1.0  # the oldest command is applied over this period
    transition, efforts = np.eye(size), np.zeros((size, substeps))
    out_state, out_effort = np.zeros((substeps, size)), np.zeros((substeps, substeps))
    for i in range(substeps):
        motion, drive = transition[:2], efforts[:2]
        out_state[i] = (mean @ motion)[1] + mean_effort[1] * applied
        out_effort[i] = (mean @ drive)[1]
        out_effort[i, i] += mean_effort[1]
        transition = np.vstack([a @ motion + np.outer(b, applied), transition[2:]])
        efforts = np.vstack([a @ drive, efforts[2:]])
        efforts[:2, i] += b
    return first @ transition, first @ efforts, out_state, out_effort, h


@pytest.mark.parametrize(
    "gains",
    [(0.53, 0.018), (3.0, 0.018), *(pytest.param(g, marks=pytest.mark.slow) for g in ((1.2, 0.03), (0.1, 0.002)))],
)
def test_the_test_agrees_with_a_fine_lifted_discretisation(gains):
    """At every angle the sign is that of the Hermitian part of a matrix with 120 substeps."""
    law = pid(*gains)
    loop = loop_of(law)
    theta = np.array([0.02, 0.1, 0.3, 0.8, 1.5, 2.5, 3.1])
    responses = proof.find_responses(loop, theta)
    transition, effort, state, direct, _ = closed_loop_matrices(law, 120)
    compared = 0
    for i, angle in enumerate(theta):
        z = np.exp(1j * angle)
        lifted = direct + state @ np.linalg.solve(z * np.eye(len(transition)) - transition, effort)
        for inverse in (1e-3, 1.6e-4, 5e-5, 2e-5, 1e-5, 3e-6):
            least = np.linalg.eigvalsh(0.5 * (lifted + lifted.conj().T) + inverse * np.eye(120))[0]
            value = proof._weigh(responses, np.ones_like)(inverse, proof.EVERY)[i]
            assert value <= 0.0 or least > 0.0, (angle, inverse, least, value)  # what is shown is true
            if least > 0.1 * inverse and inverse > 1e-5:  # and, where substeps and aliases resolve it, shown
                assert value > 0.0, (angle, inverse, least, value)
            compared += least < 0.0
    assert compared or gains[0] < 1.0  # the others meet matrices that are not definite


@pytest.mark.parametrize("seed", range(4))
def test_every_viscous_friction_within_the_margin_is_stable(seed):
    """Viscous friction is in the sector: eigenvalues of the loop with it must agree with what was shown."""
    rng = np.random.default_rng(seed)
    law = pid(rng.uniform(0.1, 4.0), rng.uniform(0.0, 0.04), k_i=rng.uniform(0.3, 200.0))
    loop = loop_of(law, slope=6250.0)
    margin = proof.friction_margin(loop)
    if np.max(np.abs(so.control.Loop(plant=loop.plant, law=law).eigenvalues())) >= 1.0:
        return  # the test is for loops that are stable without friction
    assert margin.factor > 0.0
    for share in np.linspace(0.0, 0.999, 25):
        slope = share * min(margin.slopes[0], 1e9)
        block = expm(np.block([[A - slope * np.outer(B, [0, 1]), B[:, None]], [np.zeros((1, 3))]]) * PERIOD)
        plant = DigitalPlant(
            a=block[:2, :2],
            b=block[:2, 2],
            c=C[None],
            d=np.zeros(1),
            sample_time_s=PERIOD,
            delay_samples=DELAY,
            static_gain=1.0,
        )
        closed = so.control.Loop(plant=plant, law=law)
        assert np.max(np.abs(closed.eigenvalues())) < 1.0 + 1e-9, share


def test_a_tuned_controller_is_shown_stable_on_the_stand():
    """On the stand a tuned pid is shown stable at THOR's friction; a plant without friction needs no test."""
    stand, rubbing = so.plants.high_impedance(), so.plants.thor().update(f_c=50.0, v_s=4e-3)
    controller = so.tune(stand, rubbing, so.ControllerSpec(bandwidth_hz=20, max_sensitivity=1.6))
    margin = find_friction_margin(controller, stand, rubbing)
    assert margin.shown
    assert margin.slopes[0] == pytest.approx(margin.factor * 50.0 / 4e-3)
    assert find_friction_margin(controller, stand, so.plants.thor()) is None


def test_nothing_is_shown_where_friction_acts_on_the_measured_output():
    """A lumped drive's F2 is F_m - friction: sampled, it has no bounded gain, and the sum over aliases diverges."""
    lumped, rubbing = so.plants.high_impedance(drive="lumped"), so.plants.thor().update(f_c=5.0, v_s=1.0)
    spec = so.ControllerSpec(bandwidth_hz=20, max_sensitivity=1.6)
    controller = so.tune(lumped, rubbing, spec)
    assert find_friction_margin(controller, lumped, rubbing).shown
    margin = find_friction_margin(replace(controller, spec=replace(spec, measured="F2")), lumped, rubbing)
    assert not margin.shown and margin.slopes == (0.0,)


def test_a_loop_that_needs_friction_is_not_shown_stable():
    actuator = so.plants.thor().update(
        k=120e3, m_l=0.9, l=0.005, N_p=1, K_tau=0.075, J=1.2e-5, b_r=2.5e-4, eta=0.86, f_c=25, v_s=0.004
    )
    spec = so.ControllerSpec(bandwidth_hz=25, max_sensitivity=1.6, max_noise_gain=25, compute_delay_samples=2)
    controller = so.tune(so.plants.high_impedance(), actuator.update(f_c=0.0), spec)
    swing = so.plants.moving_output()
    margin = find_friction_margin(controller, swing, actuator)
    eigenvalues = controller.close(swing, actuator.update(f_c=0.0)).eigenvalues()
    assert margin.shown <= bool(np.max(np.abs(eigenvalues)) < 1.0)


def test_one_friction_is_tested_as_many_are():
    """The scalar test against the matrix test: a second friction that acts on nothing changes neither."""
    law = pid(0.53, 0.018)
    loop = loop_of(law, slope=6250.0)
    theta = np.array([0.02, 0.3, 1.5, 3.0])
    one = proof.find_responses(loop, theta)
    wide = np.zeros((*one.s.shape, 2, 2), dtype=complex)
    wide[..., :1, :1] = one.mobility
    wide[..., 1, 1] = 1.0  # moves itself alone
    still = np.zeros((*one.s.shape, 1))
    two = proof.LoopResponses(
        theta=theta, s=one.s, mobility=wide, command=np.concatenate([one.command, still], axis=-1),
        sensed=np.concatenate([one.sensed, still], axis=-1), tail=one.tail, order=one.order,
    )  # fmt: skip
    for inverse in (1e-3, 0.1, 1.0):
        found, expected = (proof._weigh(at, lambda s: 1.0 + 1e-3 * s)(inverse, proof.EVERY) for at in (one, two))
        np.testing.assert_allclose(found, expected, rtol=1e-9)


def test_a_multiplier_tried_first_proves_no_more_than_all_of_them():
    loop = loop_of(pid(0.53, 0.018), slope=6250.0)
    best = proof.friction_margin(loop)
    again = proof.friction_margin(loop, best.multiplier)
    assert again.multiplier == best.multiplier
    assert again.factor == pytest.approx(best.factor, rel=0.02)
    assert proof.friction_margin(loop, least=2.0 * best.factor).factor == 0.0


def evaluate_circle(c_y, multiplier, slope, theta, plant=(MASS, DAMPING, STIFFNESS), delay_s=DELAY * PERIOD, most=1500):
    """Return 1 + (Re gamma - sqrt(alpha beta - (Im gamma)^2))/2 of a mass on a spring, -1 where not all D_k > 0.

    Written for this test, in the plant's own equations, over 2 most + 1 aliases, the sampled plant included.
    """
    mass, damping, stiffness = plant
    s = 1j * (theta[:, None] + 2 * np.pi * np.arange(-most, most + 1)) / PERIOD
    inner, weight = mass * s**2 + damping * s + stiffness, multiplier(s)
    held = (1 - np.exp(-s * PERIOD)) / s * np.exp(-s * delay_s)
    sampled = np.sum(stiffness / inner * held, axis=1) / PERIOD
    motor = -weight * s / inner * held * (c_y / (1 + sampled * c_y))[:, None]
    sensed = np.conj(stiffness / inner) / PERIOD
    real = np.real(weight * (s / inner + 1 / slope))
    alpha, beta = (np.sum(np.abs(one) ** 2 / real, axis=1) for one in (motor, sensed))
    gamma = np.sum(np.conj(sensed) * motor / real, axis=1)
    value = 1 + (np.real(gamma) - np.sqrt(np.maximum(alpha * beta - np.imag(gamma) ** 2, 0.0))) / 2
    return np.where(np.all(real > 0.0, axis=1), value, -1.0)


def read_multiplier(name):
    """Return the multiplier that a margin names, to its three digits."""
    numbers = [float(number) for number in re.findall(r"-?\d[\d.]*(?:e[-+]\d+)?", name)]
    if name.startswith("Popov"):
        return lambda s: 1.0 + numbers[0] * s
    if name.startswith("Zames-Falb"):
        share, rate = numbers[0], 2 * np.pi * numbers[1]
        return lambda s: 1.0 - share * rate / (rate + s)
    return np.ones_like


@pytest.mark.parametrize("factor", [0.1, 10.0, *(pytest.param(f, marks=pytest.mark.slow) for f in (1.0, 100.0))])
def test_what_a_multiplier_asks_of_the_feedback_is_the_circle_criterion(factor):
    """|weight C_y| below |1 + plant C_y| at an angle, for laws and multipliers of every kind."""
    rng, theta = np.random.default_rng(1), np.linspace(0.01, 3.1, 20)
    agreed = []
    for _ in range(5):
        law = pid(rng.uniform(0.1, 4.0), rng.uniform(0.0, 0.04), k_i=rng.uniform(0.3, 200.0))
        loop, c_y = loop_of(law, slope=6250.0), law.measurement_response(theta / (2 * np.pi * PERIOD))
        for name, multiplier in list(proof.list_multipliers(loop))[::7]:
            limit = proof.limit_feedback(loop, theta, name, factor)
            kept = np.abs(limit.weights[0, 0] * c_y) < np.abs(1.0 + limit.plants[0] * c_y)
            value = evaluate_circle(c_y, multiplier, factor * 6250.0, theta)
            assert np.all(value[kept] > 0.0), name
            assert np.all(kept[value > 0.05]), name
            agreed += [kept]
    assert 0.0 < np.mean(agreed) < 1.0


def test_what_is_not_a_number_shows_nothing():
    assert proof._least_inverse(lambda inverse, angles: np.full(5, np.nan)[angles], 1.0) is None


def test_of_many_sets_of_parameters_each_has_its_own_margin(controller, stand, thor):
    """With masses, frictions and delays of their own: that of the equations above on a dense grid, and none without."""
    radius, most = thor["l"].value / (2 * np.pi * thor["N_p"].value), 100
    cases = ((2e-6, 50.0, 0.0), (4e-6, 20.0, 3e-4), (3e-6, 0.0, 0.0), (3e-6, 80.0, 1.2e-3))
    sets = [
        thor.update(J=J, f_c=f_c, v_s=4e-3).with_parameters(so.Parameter(name="delay_s", value=delay, unit="s"))
        for J, f_c, delay in cases
    ]
    theta = np.concatenate([np.geomspace(1e-3, 0.1, 200), np.linspace(0.1, np.pi, 600)])
    c_y = controller.law.measurement_response(theta / (2 * np.pi * PERIOD))
    for margin, (J, f_c, delay) in zip(find_friction_margins(controller, stand, sets), cases, strict=True):
        if not f_c:
            assert margin is None
            continue
        multiplier, late = read_multiplier(margin.multiplier), controller.compute_delay_samples * PERIOD + delay
        plant = tuple(float(v) for v in (J / radius**2, thor["b_r"].value / radius**2, thor["k"].value))
        least = {
            share: np.min(evaluate_circle(c_y, multiplier, share * margin.slopes[0], theta, plant, late, most))
            for share in (0.97, 1.03)
        }
        assert least[0.97] > 0.0 > least[1.03], (margin, least)
        assert margin.slopes[0] == pytest.approx(margin.factor * f_c / 4e-3)


def test_with_a_link_that_turns_the_margin_is_that_of_the_plant_linearised_at_rest(controller, stand, thor):
    """With every viscous friction up to the margin python-control's loop of the plant is stable."""
    rubbing, swing = thor.update(f_c=50.0, v_s=4e-3), so.plants.moving_output()
    margin = find_friction_margin(controller, swing, rubbing)
    assert margin.factor > 1.0 and margin.linearised and "linearised" in str(margin)
    assert not find_friction_margin(controller, stand, rubbing).linearised
    law, radius = controller.law, rubbing["l"].value / (2 * np.pi * rubbing["N_p"].value)
    back = control.ss(law.a, -law.b[:, 1:], law.c[None], -law.d[1], PERIOD)
    late = control.ss(control.tf([1.0], [1.0, *[0.0] * controller.compute_delay_samples], PERIOD))
    for slope in np.geomspace(1.0, margin.slopes[0], 20):
        viscous = thor.update(b_r=thor["b_r"].value + slope * radius**2)
        plant = control.c2d(swing.linearize(viscous)[0, 0] * controller.command.per_effort, PERIOD)
        assert np.max(np.abs(control.feedback(plant * late * back, 1).poles())) < 1.0, slope


@pytest.mark.parametrize(("part", "values"), [("hardening", {"k_3": 1e10}), ("backlash", {})])
def test_nothing_is_shown_of_a_plant_that_is_not_linear_besides_its_friction(controller, stand, part, values):
    """Whatever the law; with a cubic part of nothing it is the stand."""
    plant, (_, rubbing) = so.plants.high_impedance(parts=[part]), controller.design
    bent = plant.complete(rubbing).update(**values)
    planned = force_mpc(plant, bent, MPCSpec(bandwidth_hz=15, current_limit_A=9.0)).friction
    for margin in (find_friction_margin(controller, plant, bent), planned):
        assert margin.factor == 0.0 and not margin.shown and "not linear" in margin.multiplier
    with pytest.raises(ControlError, match="not linear"):
        so.tune(stand, rubbing, replace(controller.spec, min_friction_margin=1e4), {"bent": (plant, bent)})
    if "k_3" in values:
        straight = find_friction_margin(controller, plant, bent.update(k_3=0.0))
        assert straight.factor == pytest.approx(find_friction_margin(controller, stand, rubbing).factor)
