"""Limit cycles of friction: textbook ones, and those that a simulator of the tests' own has."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import casadi as ca
import numpy as np
import pytest

import seaopt as so
from seaopt.control import MPCSpec, force_mpc
from seaopt.control.laws.friction import describe_friction, predict_limit_cycles
from seaopt.control.laws.plausibility import PlausibilityGate
from seaopt.errors import ControlError, SimulationError
from seaopt.plants.friction import friction_states
from seaopt.plants.roles import Friction
from seaopt.robustness import linear_controller
from seaopt.robustness.verification.limit_cycles import seek_limit_cycles
from seaopt.robustness.verification.play_cycles import predict_play_cycles
from tests import laws
from tests.stick_slip import Mass, simulate

RELAY = 2.0


@pytest.fixture(scope="module")
def rubbing(thor):
    return thor.update(k=120e3, m_l=0.9, l=0.005, N_p=1, K_tau=0.075, J=1.2e-5, b_r=2.5e-4, eta=0.86, f_c=25, v_s=0.004)


@pytest.fixture(scope="module")
def blind(stand, rubbing):
    """Return a law of 25 Hz and Ms 1.59 where the friction sticks, as if it were a damper; sliding its Ms is 7."""
    spec = so.ControllerSpec(bandwidth_hz=25, compute_delay_samples=2)
    tuned = so.tune(stand, rubbing.update(f_c=0.0), replace(spec, bandwidth_range_hz=(24.5, 25.5)))
    ahead, back = laws.multiply_out("pid", 1e-3, k_p=4.1182, k_i=193.96, k_d=0.036216, T_f=1.2604e-3, k_r=5.1182)
    law = laws.law_of(back.num, back.den, (ahead.num, ahead.den))
    return replace(tuned, law=law, spec=spec, design=(stand, rubbing))


def scaled(controller, factor, **spec):
    return replace(controller, law=laws.scaled(controller.law, factor), spec=replace(controller.spec, **spec))


def third_order_lag(steepness):
    """1/(s + 1)^3 from the friction's effort to its velocity, friction a smoothed relay of 2."""
    return so.Plant(
        name="relay and lag", states={"v": "N", "a": "N", "b": "N"}, inputs={"I": "A"}, outputs={"v": "N"},
        parameters={"level": so.Parameter(name="level", value=RELAY, unit="N")},
        f=lambda t, x, u, p: {"v": x.a - x.v, "a": x.b - x.a, "b": u.I - x.b - u.relay},
        h=lambda t, x, u, p: {"v": x.v},
        friction={"relay": Friction(
            velocity=lambda x, p: x.v, force=lambda v, p: p.level * ca.tanh(v * steepness),
            slopes=lambda p: (0.0, p.level * steepness),
        )},
    )  # fmt: skip


def test_a_relay_with_a_third_order_lag_oscillates_at_the_square_root_of_three(blind):
    """The textbook's example: the lag is 1/8 at 180 degrees, so that the amplitude is 4 M/(8 pi)."""
    plant = third_order_lag(1e5)
    spec = so.ControllerSpec(measured="v", bandwidth_hz=25)
    open_loop = replace(blind, law=laws.law_of([0.0]), spec=spec, design=(plant, so.ParameterSet()))
    (cycle,) = predict_limit_cycles(open_loop, plant, so.ParameterSet())
    assert cycle.stable
    assert cycle.frequency_hz == pytest.approx(np.sqrt(3.0) / (2 * np.pi), rel=1e-4)
    assert cycle.velocity == pytest.approx(4 * RELAY / (8 * np.pi), rel=1e-2)
    assert cycle.force_N == pytest.approx(cycle.velocity, rel=1e-6)
    (found,) = seek_limit_cycles(open_loop, third_order_lag(1e3), so.ParameterSet())
    assert found.lasts
    f = np.linspace(0.2, 0.35, 15001)  # Tsypkin's condition, with every harmonic: sum of Im G(jnw)/n over odd n
    lag = [(1.0 / (1.0 + 2j * np.pi * n * f) ** 3) for n in range(1, 40, 2)]
    exact = int(np.argmin(np.abs(sum(np.imag(g) / n for n, g in zip(range(1, 40, 2), lag, strict=True)))))
    assert found.simulated.frequency_hz == pytest.approx(f[exact], rel=0.005)
    assert found.simulated.force_N == pytest.approx(4 * RELAY / np.pi * np.abs(lag[0][exact]), rel=0.02)


def test_a_cycle_whose_simulation_fails_is_still_predicted(blind, monkeypatch):
    """A stable one stands as predicted, and is held against the controller; an unstable one does not last."""
    plant = third_order_lag(1e3)
    spec = so.ControllerSpec(measured="v", bandwidth_hz=25)
    open_loop = replace(blind, law=laws.law_of([0.0]), spec=spec, design=(plant, so.ParameterSet()))

    def fail(*args, **kwargs):
        raise SimulationError("the integration does not end")

    monkeypatch.setattr("seaopt.robustness.verification.limit_cycles.run_loop", fail)
    (found,) = seek_limit_cycles(open_loop, plant, so.ParameterSet())
    assert found.predicted.frequency_hz == pytest.approx(np.sqrt(3.0) / (2 * np.pi), rel=1e-2)
    assert found.lasts and found.force_N == found.predicted.force_N
    assert found.not_simulated == "the integration does not end"
    assert "the integration does not end" in str(found)
    assert not replace(found, predicted=replace(found.predicted, stable=False)).lasts


def test_an_oscillation_that_grows_below_the_predicted_one_does_not_die_out(blind, monkeypatch):
    """It was held to, though 20 % of the force grew to 84 % of it."""
    plant = third_order_lag(1e3)
    spec = so.ControllerSpec(measured="v", bandwidth_hz=25)
    open_loop = replace(blind, law=laws.law_of([0.0]), spec=spec, design=(plant, so.ParameterSet()))
    (cycle,) = predict_limit_cycles(open_loop, plant, so.ParameterSet())

    def grow(loop, params, reference, **options):
        time = open_loop.sample_time_s * np.arange(reference.size)
        size = 0.2 * cycle.force_N * np.exp(np.log(4.2) * time / time[-1])
        return SimpleNamespace(outputs={"v": (size * np.sin(2 * np.pi * cycle.frequency_hz * time))[None]})

    monkeypatch.setattr("seaopt.robustness.verification.limit_cycles.run_loop", grow)
    (found,) = seek_limit_cycles(open_loop, plant, so.ParameterSet())
    assert found.runs_away and found.lasts


def test_what_a_plan_is_refused_for_is_no_oscillation_that_grows(planned, stand, monkeypatch):
    mpc, params = planned

    def refuse(*args, **options):
        raise ControlError("no such signal")

    monkeypatch.setattr("seaopt.robustness.verification.playback.close_loop", refuse)
    with pytest.raises(ControlError, match="no such signal"):
        seek_limit_cycles(linear_controller(mpc), stand, params, plan=mpc)


def test_the_describing_function_is_the_declared_curves(thor):
    """Stribeck's, by SciPy's quadrature, above the slope that falls most."""
    from scipy.integrate import quad

    plant = so.plants.high_impedance(parts=["stribeck"])
    params = plant.complete(thor).update(f_c=20.0, f_s=30.0, v_st=0.01, v_s=1e-3)
    v = np.linspace(0.0, 0.05, 400001)
    curve = (20.0 + 10.0 * np.exp(-((v / 0.01) ** 2))) * np.tanh(v / 1e-3)
    flattest = np.min(np.diff(curve)) / v[1]
    for amplitude in (1e-4, 5e-3, 0.2):

        def integrand(theta, amplitude=amplitude):
            at = amplitude * np.sin(theta)
            force = (20.0 + 10.0 * np.exp(-((at / 0.01) ** 2))) * np.tanh(at / 1e-3)
            return (force - flattest * at) * np.sin(theta)

        expected = 4.0 / np.pi / amplitude * quad(integrand, 0.0, np.pi / 2, limit=400, epsrel=1e-9)[0]
        found = describe_friction(plant, params, "F_f", np.array([amplitude]))[0]
        assert found == pytest.approx(expected, rel=2e-2)


def test_an_unstable_cycle_bounds_what_friction_holds(blind, stand, rubbing):
    """Sliding the loop grows; below the predicted cycle friction stops it, above it does not, in either simulator."""
    wild = scaled(blind, 1.5)
    (cycle,) = predict_limit_cycles(wild, stand, rubbing)
    assert not cycle.stable
    mass = Mass.of({name: rubbing[name].value for name in rubbing})
    first = cycle.velocity * np.array([0.6, 2.0])
    runs = simulate([mass] * 2, [wild.to_dict()] * 2, np.zeros((2, 300)), substeps=20, velocity=first)
    still, grown = np.max(np.abs(runs.force[:, -50:]), axis=1)
    assert still < 0.01 * cycle.force_N and grown > 10.0 * cycle.force_N
    spectrum = np.abs(np.fft.rfft(runs.force[1, :120] * np.hanning(120), 4096))
    assert np.argmax(spectrum) / 4.096 == pytest.approx(cycle.frequency_hz, rel=0.05)
    (found,) = seek_limit_cycles(wild, stand, rubbing)
    assert found.runs_away


@pytest.fixture(scope="module")
def planned(stand, rubbing):
    """Return a plan, and a stiffer and lighter actuator on which its loop grows sliding."""
    free = {"max_sensitivity": False, "max_complementary": False}
    spec = MPCSpec(current_limit_A=4.0, bandwidth_hz=30.0, compute_delay_samples=2, **free)
    return force_mpc(stand, rubbing, spec), rubbing.update(J=6e-6, k=240e3)


def play_by_hand(mpc, params, push, n, substeps=20):
    """Return the force of the plan's own steps on the mass with smoothed friction, by Runge and Kutta, from a state."""
    p = {name: params[name].value for name in params}
    mass, r, x = Mass.of(p), p["l"] / (2 * np.pi * p["N_p"]), np.array(push)
    state, commands, force, h = mpc.start, [], np.zeros(n), mpc.sample_time_s / substeps

    def rates(x, effort):
        friction = mass.b * x[1] + mass.f_c * np.tanh(x[1] / mass.v_s)
        return np.array([x[1], (effort - friction - mass.k * x[0]) / mass.m])

    for k in range(n):
        force[k] = mass.k * x[0]
        command, state = mpc.command(state, 0.0, force[k])
        commands.append(command)
        effort = p["eta"] * p["K_tau"] / r * (commands[k - 2] if k >= 2 else 0.0)
        for _ in range(substeps):
            first = rates(x, effort)
            second = rates(x + 0.5 * h * first, effort)
            third = rates(x + 0.5 * h * second, effort)
            x = x + h / 6.0 * (first + 2.0 * second + 2.0 * third + rates(x + h * third, effort))
    return force


def test_of_predictive_control_its_own_step_is_played(planned, stand):
    """The law of the linear region grows without end there, and was said to die out; the plan's limits make a cycle."""
    mpc, params = planned
    linear = linear_controller(mpc)
    (cycle,) = predict_limit_cycles(linear, stand, params)
    assert not cycle.stable
    (grown,) = seek_limit_cycles(linear, stand, params)
    assert grown.runs_away and grown.lasts
    (found,) = seek_limit_cycles(linear, stand, params, plan=mpc)
    end = play_by_hand(mpc, params, 1.5 * np.array(cycle.state), 1000)[-400:]
    spectrum = np.abs(np.fft.rfft(end * np.hanning(400), 16384)) / 100.0
    top = int(np.argmax(spectrum))
    assert found.lasts and not found.runs_away
    assert found.simulated.frequency_hz == pytest.approx(top / 16.384, rel=0.01)
    assert found.simulated.force_N == pytest.approx(spectrum[top], rel=0.03)
    below = play_by_hand(mpc, params, 0.5 * np.array(cycle.state), 1000)  # as the unstable cycle says
    assert np.max(np.abs(below[-100:])) < 0.05 * cycle.force_N


def test_the_certificate_of_predictive_control_has_the_plans_cycle(planned, stand):
    mpc, params = planned
    certificate = so.certify(mpc, {"stiff": stand}, params, samples=1, runs=1)
    (cycle,) = (each for each in certificate.cycles["stiff"] if each.predicted is not None)
    (found,) = seek_limit_cycles(linear_controller(mpc), stand, params, plan=mpc)
    assert cycle.simulated == found.simulated
    assert any(row.name == "limit_cycle" and not row.met for row in certificate.requirements)


def test_of_bristles_no_cycle_is_predicted_that_does_not_bend_them(blind, rubbing):
    """Where they slide at the largest velocity, sigma_0 z = f_c; from the curve of steady sliding it was 2 N of 25."""
    plant = so.plants.high_impedance(parts=["lugre"])
    params = rubbing.with_parameters(*(one for one in plant.parameters.values() if one.name not in rubbing))
    cycles = predict_limit_cycles(scaled(blind, 1.5), plant, params)
    place, sigma_0 = list(plant.states).index("z_f"), params["sigma_0"].value
    assert all(sigma_0 * cycle.state[place] == pytest.approx(25.0, rel=0.1) for cycle in cycles)
    assert not cycles


def test_a_cycle_that_the_current_holds_fails_the_certificate(blind, stand, rubbing):
    wild = scaled(blind, 1.5, current_limit_A=10.0)
    certificate = so.certify(wild, {"stand": stand}, rubbing, simulations=False)
    friction = certificate.to_dict()["friction"]["stand"]
    assert friction["sector_stable"] is None
    cycle = friction["limit_cycles"][0]
    assert cycle["simulated"]["frequency_hz"] == pytest.approx(cycle["predicted"]["frequency_hz"], rel=0.1)
    (row,) = [row for row in certificate.requirements if row.name == "limit_cycle"]
    assert not row.met and row.value == cycle["simulated"]["force_N"]


def test_near_the_edge_nothing_is_predicted_and_stability_is_shown(blind, stand, rubbing):
    """1.2 times the gain: the sliding loop's spectral radius is .991."""
    edge = scaled(blind, 1.2)
    radius = np.max(np.abs(edge.close(friction_states(stand)["sliding"], rubbing).eigenvalues()))
    assert 0.99 < radius < 0.995
    assert seek_limit_cycles(edge, stand, rubbing) == ()
    certificate = so.certify(edge, {"stand": stand}, rubbing, simulations=False)
    assert certificate.to_dict()["friction"]["stand"]["sector_stable"] is True
    assert certificate.cycles == {}


@pytest.mark.slow
def test_with_play_nothing_is_shown_and_no_step_is_absurd(stand, thor):
    """Tuned within the play, where the spring is soft, the loop runs away beyond it."""
    loose, rubbing = so.plants.high_impedance(parts=["backlash"]), thor.update(f_c=20.0)
    controller = so.tune(loose, rubbing, so.ControllerSpec(bandwidth_hz=20, max_sensitivity=1.6, current_limit_A=9.0))
    certificate = so.certify(controller, {"stand": loose}, rubbing, simulations=False)
    assert not certificate.passed
    assert certificate.to_dict()["friction"]["stand"]["sector_stable"] is None
    assert "not linear" in certificate.friction["stand"].multiplier
    assert min(step.phases[-1].force_N for step in certificate.steps.scenarios["stand"]) > 1.0


@pytest.mark.slow
def test_play_makes_the_cycle_of_an_independent_simulator(stand, thor):
    """An integral and little damping: within the play the spring is soft, and the loop grows into it."""
    loose = so.plants.high_impedance(parts=["backlash"])
    params = loose.complete(thor).update(g_b=5e-5, eps_b=1e-6, b_r=2e-5)
    tight = so.tune(stand, thor.update(b_r=2e-5), so.ControllerSpec(bandwidth_hz=20))
    ahead, back = laws.multiply_out("pid", 1e-3, k_p=0.07, k_i=85.0, k_d=0.036, T_f=1e-3, k_r=1.07)
    controller = replace(tight, law=laws.law_of(back.num, back.den, (ahead.num, ahead.den)))
    assert predict_play_cycles(controller, stand, thor) == ()
    (found,) = seek_limit_cycles(controller, loose, params)
    assert found.predicted.stable and found.lasts
    mass = Mass.of({name: params[name].value for name in params})
    runs = simulate([mass], [controller.to_dict()], np.zeros((1, 3000)), substeps=20, velocity=np.array([0.03]))
    end = runs.force[0, -2048:]
    spectrum = np.abs(np.fft.rfft(end * np.hanning(2048), 16384)) / 512.0
    top = int(np.argmax(spectrum))
    assert found.simulated.frequency_hz == pytest.approx(top / 16.384, rel=0.01)
    assert found.simulated.force_N == pytest.approx(spectrum[top], rel=0.03)
    assert found.predicted.frequency_hz == pytest.approx(top / 16.384, rel=0.03)
    assert found.predicted.force_N == pytest.approx(spectrum[top], rel=0.1)


def test_a_gate_that_gives_its_sensor_up_does_not_end_a_cycle(blind, stand, rubbing):
    law = scaled(blind, 1.5, current_limit_A=9.0)
    (found,) = seek_limit_cycles(law, stand, rubbing)
    half = 0.5 * found.predicted.force_N
    gate = PlausibilityGate(range_N=(-half, half), max_step_N=1e4, max_held=5, ramp_per_s=90.0)
    (gated,) = seek_limit_cycles(replace(law, gate=gate), stand, rubbing)
    assert found.lasts
    assert gated.simulated == found.simulated
