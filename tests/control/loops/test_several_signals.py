"""Laws that read several signals: against loops written out here, and against one signal told twice over.

A rotary drive's torque is its stiffness times its deflection: a law that takes part of its feedback from the one and
the rest from the other is the law of the torque alone, so that every figure must be the same.
"""

from __future__ import annotations

import json

import numpy as np
import pytest
from scipy.linalg import expm

import seaopt as so
from seaopt.control import Law, assess, cascade_pid, parallel_pid, passivity, read_law, realise, runnable
from seaopt.control.impedance.link import find_link
from seaopt.control.impedance.moving_loop import close_link
from seaopt.control.impedance.sampled_port import SampledPort
from seaopt.control.laws.controller import Controller
from seaopt.control.laws.friction import find_friction_margin, predict_limit_cycles
from seaopt.control.loops.sampled_plant import find_signals
from seaopt.control.running.closed_loop import SampledLoop, run_loop
from seaopt.errors import ControlError, FileError
from seaopt.robustness.bounds.bracket import Budget, bracket
from seaopt.robustness.uncertainty.batch import batch_figures
from seaopt.robustness.uncertainty.delay_margin import sampled_delay_margin
from seaopt.robustness.uncertainty.draws import combine_uncertainty
from seaopt.robustness.uncertainty.severity import severity_slopes
from seaopt.robustness.verification.amplitude_prediction import predict_gain
from seaopt.robustness.verification.linear import linearise_last_phase
from seaopt.robustness.verification.playback import Rig
from seaopt.robustness.verification.scenarios import default_scenarios
from tests.c_code import CompiledLaw

TS = 1e-3
STAND, SWING = so.plants.rotary(link="locked"), so.plants.rotary(link="pendulum")
VALUES = SWING.defaults.update(
    J_m=2.4e-5, b_r=4e-4, K_tau=0.0369, N=100.0, eta=0.7, k_s=300.0, f_c=0.004, J_l=0.25, d_l=0.3, m=4.0, L=0.2
)
SPEC = so.ControllerSpec(
    measured=("tau_s", "deflection"), bandwidth_hz=15, max_sensitivity=3.0, max_complementary=3.0, max_droop_db=False,
    max_reference_peak=False, min_sensitivity_bandwidth_hz=False, current_limit_A=9.0,
)  # fmt: skip
PID = parallel_pid(k_p=1.2, k_i=20.0, k_d=0.02, T_f=2e-3, sample_time_s=TS)
K_V = 0.3  # N m s/rad of the motor's speed


def share(law, part, stiffness):
    """Return the law that takes `part` of its feedback from the deflection."""
    b, d = (np.column_stack([m[:, 0], (1 - part) * m[:, 1], part * stiffness * m[:, 1]]) for m in (law.b, law.d[None]))
    return Law(a=law.a, b=b, c=law.c, d=d[0], sample_time_s=TS)


@pytest.fixture(scope="module")
def one():
    return assess(PID, STAND, VALUES, so.ControllerSpec(**{**SPEC.to_dict(), "measured": "tau_s"}), {"swing": SWING})


@pytest.fixture(scope="module")
def two():
    return assess(share(PID, 0.4, 300.0), STAND, VALUES, SPEC, {"swing": SWING})


@pytest.fixture(scope="module")
def speed():
    """The PID with the motor's speed fed back, computed from its encoder."""
    b = np.hstack([PID.b, np.zeros((PID.c.size, 1))])
    law = Law(a=PID.a, b=b, c=PID.c, d=np.append(PID.d, -K_V), sample_time_s=TS)
    return assess(law, STAND, VALUES, so.ControllerSpec(**{**SPEC.to_dict(), "measured": ("tau_s", "thetad_m")}))


def judge(link):
    """Return the sampled plant to (tau_s, theta_m), friction sliding, one command waiting: from the equations alone."""
    v = {name: VALUES[name].value for name in VALUES}
    k, n, inertia = v["k_s"], v["N"], v["J_m"]
    a = np.array([[0.0, 1.0], [-k / n**2 / inertia, -v["b_r"] / inertia]])
    b, c = np.array([0.0, 1.0 / n / inertia]), np.array([[k / n, 0.0], [1.0, 0.0]])
    if link == "pendulum":
        weight, load = v["m"] * 9.81 * v["L"], v["J_l"]
        more = np.array([[0.0, 0.0, 0.0, 1.0], [k / n / load, 0.0, -(k + weight) / load, -v["d_l"] / load]])
        a = np.vstack([np.hstack([a, [[0.0, 0.0], [k / n / inertia, 0.0]]]), more])
        b, c = np.append(b, [0.0, 0.0]), np.hstack([c, [[-k, 0.0], [0.0, 0.0]]])
    size = b.size
    block = expm(np.block([[a, b[:, None]], [np.zeros((1, size + 1))]]) * TS)
    whole = np.zeros((size + 1, size + 1))
    whole[:size, :size], whole[:size, size] = block[:size, :size], block[:size, size]
    return whole, np.eye(size + 1)[size], np.hstack([c, np.zeros((2, 1))])


@pytest.mark.parametrize(("plant", "link"), [(STAND, "locked"), (SWING, "pendulum")])
def test_figures_are_those_of_the_loop_written_out(speed, plant, link):
    assert speed.signals == ("tau_s", "theta_m")
    law, (a, b, c) = speed.law, judge(link)
    figures = speed.close(plant, VALUES).figures()
    closed = np.block([[a + np.outer(b, law.d[1:] @ c), np.outer(b, law.c)], [law.b[:, 1:] @ c, law.a]])
    assert figures.spectral_radius == pytest.approx(np.max(np.abs(np.linalg.eigvals(closed))), abs=1e-9)
    f = np.geomspace(0.01, 499.0, 40_000)
    z = np.exp(2j * np.pi * f * TS)
    p = np.array([c @ np.linalg.solve(point * np.eye(b.size) - a, b) for point in z]).T
    # PID and difference as their definitions, not as the state space.
    q, pole = 1.0 / z, 2e-3 / 3e-3
    pid = 1.2 + 20.0 * TS / 2 * (1 + q) / (1 - q) + 0.02 / 3e-3 * (1 - q) / (1 - pole * q)
    c_y = np.array([pid, K_V * (1 - q) / TS])
    s = 1.0 / (1.0 + np.sum(c_y * p, axis=0))
    assert figures.ms == pytest.approx(np.max(np.abs(s)), rel=1e-4)
    assert figures.mt == pytest.approx(np.max(np.abs(1 - s)), rel=1e-3)
    assert figures.noise_gain == pytest.approx(np.max(np.abs(c_y[0] * s)), rel=1e-4)
    assert figures.other_noise_gains == pytest.approx([np.max(np.abs(c_y[1] * s))], rel=1e-4)
    if link == "locked":
        track = np.abs(p[0] * pid * s)
        assert figures.bandwidth_hz == pytest.approx(f[np.argmax(track < np.sqrt(0.5))], rel=1e-3)


def test_feedback_told_twice_is_the_same_loop(one, two):
    for plant in (STAND, SWING):
        first, second = (controller.close(plant, VALUES).figures() for controller in (one, two))
        for name in ("spectral_radius", "ms", "mt", "disk_margin", "gain_margin_db", "delay_margin_s", "bandwidth_hz"):
            assert getattr(second, name) == pytest.approx(getattr(first, name), rel=1e-6), name
        assert second.noise_gain == pytest.approx(0.6 * first.noise_gain, rel=1e-6)
        assert sampled_delay_margin(two, plant, VALUES, 0.05) == pytest.approx(
            sampled_delay_margin(one, plant, VALUES, 0.05), rel=1e-6
        )


def test_draws_and_worst_cases_are_the_same(one, two):
    unknown = combine_uncertainty(
        VALUES, so.ParameterSet(), {"J_l": (0.15, 0.5), "b_r": (1e-4, 1e-3)}, {"swing": SWING}
    )
    points = np.random.default_rng(1).uniform(-1, 1, (20, unknown.size))
    sliding = so.plants.rotary(link="pendulum")
    first, second = (batch_figures(each, sliding, VALUES, unknown.values(points)) for each in (one, two))
    for name in ("spectral_radius", "ms", "mt"):
        np.testing.assert_allclose(getattr(second, name), getattr(first, name), rtol=1e-7)
    first, second = (severity_slopes(each, sliding, unknown, points) for each in (one, two))
    np.testing.assert_allclose(second, first, rtol=1e-5, atol=1e-7 * np.max(np.abs(first)))
    budget = Budget(tolerance=0.05, boxes=200)
    first, second = (bracket(each, STAND, unknown, budget=budget) for each in (one, two))
    assert (second.bounded_stable, second.ms_upper) == (first.bounded_stable, pytest.approx(first.ms_upper, rel=1e-2))


def test_friction_and_port_are_the_same(one, two):
    first, second = (find_friction_margin(each, STAND, VALUES) for each in (one, two))
    assert (second.factor, second.multiplier) == (pytest.approx(first.factor, rel=1e-6), first.multiplier)
    first, second = (predict_limit_cycles(each, STAND, VALUES) for each in (one, two))
    assert [cycle.frequency_hz for cycle in second] == pytest.approx([cycle.frequency_hz for cycle in first], rel=1e-5)
    first, second = (passivity(each, STAND, VALUES) for each in (one, two))
    assert second.least_damping_N_s_per_m == pytest.approx(first.least_damping_N_s_per_m, rel=1e-6)
    assert second.held_stable == first.held_stable
    np.testing.assert_allclose(second.bands_hz, first.bands_hz, rtol=1e-6)
    f, size = np.geomspace(1, 50, 7), np.array([0.3, 3.0])
    gains = [predict_gain(each, STAND, VALUES, f, size) for each in (one, two)]
    np.testing.assert_allclose(gains[1], gains[0], rtol=1e-6)


def test_an_impedance_around_them_is_the_same(one, two):
    theta, k, d = np.geomspace(1e-3, 3.1, 60), np.array([5.0, 60.0]), np.array([0.5, 3.0])
    links = [find_link(each, SWING, VALUES) for each in (one, two)]
    terms = [SampledPort(link=link, velocity_filter_s=2e-3).terms(theta, 0.2) for link in links]
    np.testing.assert_allclose(terms[1].margin(k, d), terms[0].margin(k, d), rtol=1e-6, atol=1e-9)
    radii = [close_link(link, 2e-3).radius(k, d) for link in links]
    np.testing.assert_allclose(radii[1], radii[0], rtol=1e-8)


def test_simulated_it_is_the_same(one, two):
    n, reference = 400, np.full(400, 2.0)
    runs = [
        run_loop(
            SampledLoop(plant=SWING, law=runnable(each), measured=each.signals, delay_samples=1), [VALUES], reference
        )
        for each in (one, two)
    ]
    np.testing.assert_allclose(runs[1].outputs["tau_s"], runs[0].outputs["tau_s"], atol=1e-6)
    # Noise and the encoder's steps reach each signal on its own.
    noisy = so.Sensors(noise_std={"deflection": 1e-4})
    loop = SampledLoop(plant=STAND, law=runnable(two), measured=two.signals, delay_samples=1, sensors=noisy)
    quiet = SampledLoop(plant=STAND, law=runnable(two), measured=two.signals, delay_samples=1)
    change = run_loop(loop, [VALUES], np.zeros(n)).current - run_loop(quiet, [VALUES], np.zeros(n)).current
    assert np.std(change) > 0.0
    with pytest.raises(so.SeaoptError, match="the law reads 2"):
        SampledLoop(plant=STAND, law=runnable(two), measured="tau_s", delay_samples=1)


def test_a_quantised_encoder_moves_the_command(speed):
    """The difference of a position in steps of 2 pi/8192 is a speed in steps of 0.77 rad/s."""
    step = 2 * np.pi / 8192
    loops = [
        SampledLoop(plant=STAND, law=runnable(speed), measured=speed.signals, delay_samples=1, sensors=sensors)
        for sensors in (so.Sensors(), so.Sensors(quantisation={"theta_m": step}))
    ]
    ideal, coarse = (run_loop(loop, [VALUES], np.full(500, 3.0)).current[0] for loop in loops)
    jump = K_V * step / TS * speed.command.per_effort
    assert 0.2 * jump < np.max(np.abs(coarse - ideal)) < 5.0 * jump


def test_it_is_stored_and_exported(speed, tmp_path, compiler):
    content = json.loads(json.dumps(speed.to_dict(), default=lambda value: np.asarray(value).tolist()))
    assert content["measured"] == ["tau_s", "theta_m"]
    assert len(content["measurement"]) == 2
    again = Controller.from_dict(content, STAND, VALUES)
    assert again.signals == speed.signals
    assert again.achieved.ms == pytest.approx(speed.achieved.ms)
    with pytest.raises(FileError, match="measured"):
        Controller.from_dict({**content, "measured": ["tau_s"]}, STAND, VALUES)
    path = tmp_path / "law.json"
    for keys in (("law",), ("reference", "measurement")):
        path.write_text(json.dumps({
            "sample_time_s": TS, "delay_samples": 1, "measured": content["measured"], **{k: content[k] for k in keys}
        }))  # fmt: skip
        f = np.geomspace(0.1, 480, 50)
        np.testing.assert_allclose(read_law(path).law.responses(f), speed.law.responses(f), rtol=1e-5)
    rng = np.random.default_rng(3)
    r, y = np.cumsum(rng.normal(size=200)), np.cumsum(rng.normal(size=(200, 2)), axis=0)
    wanted, _ = runnable(speed).run(r, y)
    found = CompiledLaw(compiler, tmp_path, speed, "double", allow_infeasible=True).run(r, y)
    assert "theta_m" in (tmp_path / "law_gains.m").read_text()
    np.testing.assert_allclose(found, wanted, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("T_v", [0.05, np.inf])
def test_a_cascade_is_its_difference_equation(T_v):
    k_v, k_p, k_i, k_d, T_f, b, c, ahead = 0.3, 5.0, 60.0, 0.05, 2e-3, 0.7, 0.4, 0.9
    law = cascade_pid(
        k_v=k_v, T_v=T_v, k_p=k_p, k_i=k_i, k_d=k_d, T_f=T_f, sample_time_s=TS, b=b, c=c, feedforward=ahead
    )
    rng = np.random.default_rng(5)
    r, y, v = np.cumsum(rng.normal(size=(3, 200)), axis=1)
    force = rate = speed = late = moved_before = miss_before = 0.0
    wanted, found, x = [], [], np.zeros(law.c.size)
    for sample in np.stack([r, y, v], axis=1):
        error, moved = sample[0] - sample[1], c * sample[0] - sample[1]
        force += k_i * TS / 2 * (error + late)
        rate = (T_f * rate + k_d * (moved - moved_before)) / (T_f + TS)
        miss = k_p * (b * sample[0] - sample[1]) + force + rate - sample[2]
        speed += TS / 2 * (miss + miss_before) / T_v
        wanted.append(k_v * (miss + speed) + ahead * sample[0])
        late, moved_before, miss_before = error, moved, miss
        found.append(law.c @ x + law.d @ sample)
        x = law.a @ x + law.b @ sample
    np.testing.assert_allclose(found, wanted, atol=1e-8 * np.max(np.abs(wanted)))


@pytest.mark.slow
def test_a_cascade_is_measured_like_any_law():
    law = cascade_pid(k_v=0.3, k_p=2.0, k_i=30.0, T_v=0.1, feedforward=1.0, sample_time_s=TS)
    measured = assess(law, STAND, VALUES, so.ControllerSpec(**{**SPEC.to_dict(), "measured": ("tau_s", "thetad_m")}))
    assert measured.achieved.stable
    assert measured.signals == ("tau_s", "theta_m")
    certificate = so.certify(measured, {"swing": SWING}, VALUES, ranges={"J_l": (0.2, 0.3)}, samples=50)
    assert {"design sliding", "design stuck", "swing sliding", "swing stuck"} == set(certificate.plants)
    assert certificate.simulated.verification is not None
    assert certificate.simulated.passivity is not None


def test_the_noise_of_every_signal_reaches_the_force(two):
    """Of two signals with noises of their own: against the root of summed powers of the loop written out."""
    stage = Rig(controller=two, plant=STAND, sensors=so.Sensors(noise_std={"tau_s": 0.02, "deflection": 3e-4}))
    assert not stage.is_ideal
    assert not Rig(controller=two, plant=STAND, sensors=so.Sensors(quantisation={"deflection": 1e-5})).is_ideal
    view = linearise_last_phase(stage, default_scenarios(two, STAND)[0], VALUES)
    f = np.linspace(1e-3, 499.99, 60_000)
    t = np.abs(1.0 - view.loop.sensitivity(f))
    wanted = np.sqrt(np.mean(t**2) * ((0.6 * 0.02) ** 2 + (0.4 * 300.0 * 3e-4) ** 2))
    assert view.force_std() == pytest.approx(wanted, rel=0.02)


def test_a_limit_that_is_missed_is_explained():
    law = cascade_pid(k_v=0.1, k_p=0.5, k_i=1.0, feedforward=1.0, sample_time_s=TS)
    weak = assess(law, STAND, VALUES, so.ControllerSpec(measured=("tau_s", "thetad_m"), bandwidth_hz=15))
    assert not weak.feasible
    assert any("|S| reaches" in line for line in weak.blocked_by)


def test_what_does_not_fit_is_refused(speed):
    with pytest.raises(ControlError, match="names 1"):
        assess(speed.law, STAND, VALUES, so.ControllerSpec(**{**SPEC.to_dict(), "measured": "tau_s"}))
    with pytest.raises(ControlError, match="omega"):
        assess(speed.law, STAND, VALUES, so.ControllerSpec(**{**SPEC.to_dict(), "measured": ("tau_s", "omega")}))
    for wrong in ((), ("tau_s", "tau_s"), ("tau_s", "")):
        with pytest.raises(ControlError, match="measured"):
            so.ControllerSpec(measured=wrong)
    with pytest.raises(ControlError, match="2 numbers"):
        realise(speed.law).reset(measurement=1.0)


def test_a_speed_that_is_no_output_is_read_from_its_position():
    assert find_signals(so.plants.rotary(link="locked"), ("tau_s", "thetad_m")) == ("tau_s", "theta_m")
