"""Model predictive control against dynamic programming, another solver, its own C, and plants it was not made for."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from scipy.signal import lfilter

import seaopt as so
from seaopt.control import MPCSpec, NoiseModel, close_loop, force_mpc, sample
from seaopt.control.mpc.active_set import INFEASIBLE, SOLVED, UNFINISHED
from seaopt.control.mpc.force_plant import interpolate_knots, spread_knots
from seaopt.control.mpc.quadratic_program import QPSolution, QuadraticProgram
from seaopt.errors import ControlError
from tests.c_code import CompiledMPC

SENSOR = so.Sensors(noise_std={"F1": 2.0})

TS = 1e-3


def made(plant, params, **options):
    return force_mpc(plant, params, MPCSpec(**{"current_limit_A": 9.0, "current_slew_A_per_s": 2000.0, **options}))


@pytest.fixture(scope="module")
def mpc(stand, thor):
    return made(stand, thor)


def weighed(mpc):
    """Return the sampled plant and the row of F + tau dF/dt, tau = decay / (2 pi bandwidth), by python-control."""
    plant, values = mpc.design
    model, digital = plant.linearize(values), sample(plant, values, "F1", 1.0, TS, 0)
    tau = mpc.spec.decay / (2 * np.pi * mpc.spec.bandwidth_hz)
    return digital, model.C[0] + tau * model.C[0] @ model.A


def riccati(mpc, steps):
    """Return gains of [x, last current] -> increment by backward recursion over `steps`, from nothing at the end."""
    digital, w = weighed(mpc)
    n, rho = digital.b.size, mpc.regulator.rho
    A = np.block([[digital.a, digital.b[:, None]], [np.zeros((1, n)), np.eye(1)]])
    B, c = np.append(digital.b, 1.0)[:, None], np.append(w / mpc.static_gain, 0.0)
    P, K = np.zeros((n + 1, n + 1)), np.zeros((1, n + 1))
    for _ in range(steps):
        K = np.linalg.solve(rho + B.T @ P @ B, B.T @ P @ A)
        P = np.outer(c, c) + A.T @ P @ (A - B @ K)
    return K[0]


@pytest.mark.parametrize("horizon_s", [0.01, 0.05])
def test_without_limits_and_with_every_sample_free_it_is_the_regulator_of_dynamic_programming(stand, thor, horizon_s):
    mpc = made(stand, thor, horizon_s=horizon_s, moves=round(horizon_s / TS))
    gains = -np.linalg.solve(mpc.prediction.H, mpc.prediction.F)[0] * 9.0
    expected = riccati(mpc, 5000)
    assert gains == pytest.approx([*-expected[:-1], 1 - expected[-1]], rel=1e-7)


def exact(mpc, x0, u_last, reference, drift, samples):
    """Return the best first current: the uncondensed problem, one variable a sample, by qpOASES."""
    digital, w = weighed(mpc)
    a, b, g = digital.a, digital.b, mpc.static_gain
    u_s = np.clip(reference / g - drift, -9, 9)
    x_s = np.linalg.solve(np.eye(2) - a, b * (u_s + drift))
    u, cost, x, last = ca.SX.sym("u", samples), 0, ca.DM(x0), u_last
    slopes = []
    for j in range(samples):
        cost += (ca.dot(w, x - x_s) / g) ** 2 + mpc.regulator.rho * (u[j] - last) ** 2
        slopes.append(u[j] - last)
        x, last = a @ x + b * (u[j] + drift), u[j]
    end = ca.vertcat(x - x_s, last - u_s)
    cost += ca.bilin(ca.DM(mpc.regulator.Pi), end, end)
    options = {"printLevel": "none", "print_time": False}
    solver = ca.qpsol("exact", "qpoases", {"x": u, "f": cost, "g": ca.vertcat(*slopes)}, options)
    slew = mpc.spec.slew_per_sample
    found = solver(lbx=-9, ubx=9, lbg=-slew, ubg=slew, x0=u_last)
    return float(found["x"][0])


@pytest.mark.parametrize("slew", [500.0, pytest.param(2000.0, marks=pytest.mark.slow)])
def test_with_limits_it_is_what_another_solver_finds(stand, thor, slew):
    """From 25 random states, every sample free, no delay."""
    mpc = made(stand, thor, horizon_s=0.03, moves=30, current_slew_A_per_s=slew, compute_delay_samples=0)
    rng = np.random.default_rng(7)
    at_limit = 0
    for _ in range(25):
        x0 = np.array([rng.uniform(-2000, 2000) / thor["k"].value, rng.uniform(-0.05, 0.05)])
        drift, last, reference = rng.uniform(-0.5, 0.5), rng.uniform(-9, 9), rng.uniform(-2500, 2500)
        z = np.concatenate([x0, [0.0, drift]])
        state = replace(mpc.start, command=last, kalman=replace(mpc.kalman.start, predicted=z))
        step = mpc.step(state, reference, float(mpc.kalman.C[0] @ z))
        assert step.solved
        best = exact(mpc, x0, last, reference, drift, 30)
        assert step.command == pytest.approx(best, abs=1e-8)
        at_limit += abs(abs(best - last) - mpc.spec.slew_per_sample) < 1e-6 or abs(best) > 9 - 1e-6
    assert 5 < at_limit < 25


def test_few_free_currents_cost_little(stand, thor, mpc):
    """Settling after a step that saturates, 12 free currents against all 50."""
    reference = np.full(200, 1500.0)
    few, all_free = (
        close_loop(one.command, one.start, stand, thor, reference) for one in (mpc, made(stand, thor, moves=50))
    )
    miss = [np.sum((run.force - 1500.0) ** 2) for run in (few, all_free)]
    assert miss[0] == pytest.approx(miss[1], rel=0.02)


@pytest.mark.parametrize("delay", [0, 1, 3])
@pytest.mark.parametrize("bandwidth", [2, 15, 30, 60])
def test_bandwidth_where_no_limit_is_felt(stand, thor, delay, bandwidth):
    mpc = made(stand, thor, bandwidth_hz=bandwidth, compute_delay_samples=delay, moves=20)
    figures = mpc.close(stand, thor).figures()
    assert figures.stable
    assert figures.bandwidth_hz == pytest.approx(bandwidth, rel=0.02)


def test_a_plant_with_parts_is_designed_for(thor):
    """Screw mode, current loop and load cell: eight states or so, and a cell that reads what the spring carries."""
    plant = so.plants.high_impedance(parts=("screw_mode", "current_loop", "load_cell"))
    mpc = made(plant, plant.complete(thor), bandwidth_hz=20)
    assert mpc.close(plant, plant.complete(thor)).figures().stable
    run = close_loop(mpc.command, mpc.start, plant, plant.complete(thor), np.full(400, 500.0))
    assert run.force[-1] == pytest.approx(500.0, rel=1e-3)


@pytest.mark.parametrize("delay", [0, 2])
def test_without_limits_it_is_its_transfer_functions(stand, thor, delay):
    mpc = made(stand, thor, compute_delay_samples=delay, current_limit_A=1000.0, current_slew_A_per_s=None)
    reference = np.repeat(np.random.default_rng(1).uniform(-300, 300, 6), 50)
    run = close_loop(mpc.command, mpc.start, stand, thor, reference, delay_samples=delay)
    c_r, c_y = mpc.unlimited().transfer_functions()
    expected = lfilter(c_r.num, c_r.den, reference) - lfilter(c_y.num, c_y.den, run.force)
    assert np.max(np.abs(run.current - expected)) < 0.02 * np.max(np.abs(expected))


@pytest.mark.parametrize("slew", [pytest.param(None, marks=pytest.mark.slow), 500.0])
def test_limits_are_never_broken(stand, thor, slew):
    """References that jump beyond reach, a sensor that spikes and fails."""
    mpc = made(stand, thor, current_slew_A_per_s=slew)
    rng = np.random.default_rng(2)
    state, currents, solved = mpc.start, [0.0], 0
    for k in range(300):
        reference = 4000.0 * np.sign(np.sin(k / 37.0))
        measurement = np.nan if k % 50 == 7 else rng.normal() * (1e5 if k % 101 == 5 else 500.0)
        step = mpc.step(state, reference, measurement)
        state, solved = step.state, solved + step.solved
        currents.append(step.command)
    assert np.max(np.abs(currents)) <= 9.0
    assert np.max(np.abs(np.diff(currents))) <= mpc.spec.slew_per_sample * (1 + 1e-12)
    assert solved == 300


@pytest.mark.slow
@pytest.mark.parametrize(("torque", "inertia"), [(0.9, 1.0), (1.1, 1.1)])
def test_no_offset_is_left_on_a_plant_it_was_not_made_for(stand, thor, mpc, torque, inertia):
    real = thor.update(K_tau=thor["K_tau"].value * torque, J=thor["J"].value * inertia)
    run = close_loop(mpc.command, mpc.start, stand, real, np.full(2000, 1000.0), disturbance=-0.5)
    assert run.force[-1] == pytest.approx(1000.0, abs=1.5)


def test_a_force_out_of_reach_becomes_the_nearest(stand, thor, mpc):
    run = close_loop(mpc.command, mpc.start, stand, thor, np.full(600, 5000.0))
    assert run.current[-1] == pytest.approx(9.0, abs=1e-9)
    assert run.force[-1] == pytest.approx(9.0 * mpc.static_gain, rel=1e-6)


def test_designed_on_the_stand_it_holds_on_the_swing(swing, thor, mpc):
    """In the nonlinear simulation too; the pendulum swings to an angle that holds the force."""
    figures = mpc.close(swing, thor).figures()
    assert figures.stable and figures.ms < 2.0
    run = close_loop(mpc.command, mpc.start, swing, thor, np.full(3000, 60.0), sensors=SENSOR)
    assert np.mean(run.force[-500:]) == pytest.approx(60.0, abs=10.0)
    assert np.std(run.force[-500:]) < 5.0
    assert np.degrees(np.max(np.abs(run.state[:, 2]))) > 10.0


@pytest.mark.parametrize(
    ("status", "x", "said"),
    [
        (UNFINISHED, 3.0, "maximum iterations reached, solution breaks a limit by "),
        (INFEASIBLE, 0.0, "the bounds contradict each other"),
        (SOLVED, np.nan, "not finite"),
        (SOLVED, 3.0, "breaks a limit by "),
    ],
)
def test_a_solver_that_fails_leaves_the_safe_current(mpc, monkeypatch, status, x, said):
    def fail(*_):
        return QPSolution(x=np.full(12, x), sides=np.zeros(24, dtype=int), status=status, iterations=7)

    monkeypatch.setattr(QuadraticProgram, "solve", fail)
    step = mpc.step(mpc.start, 1000.0, 0.0)
    assert not step.solved
    assert said in step.status
    assert step.command == 2.0  # towards 1000 N / 240 N/A as fast as 2000 A/s let it
    after = mpc.step(replace(step.state, command=4.0), 1000.0, 0.0)
    assert after.command == pytest.approx(1000.0 / mpc.static_gain, abs=0.5)


def test_a_step_is_a_function_of_its_arguments(stand, thor, mpc):
    """Whatever was solved in between."""
    first = mpc.step(mpc.start, 1500.0, 3.0)
    state = mpc.start
    for k in range(40):
        state = mpc.step(state, 2000.0 * (-1.0) ** (k // 7), 100.0 * k).state
    assert mpc.step(mpc.start, 1500.0, 3.0).command == first.command


def test_a_reference_that_is_no_number_is_refused(mpc):
    with pytest.raises(ControlError, match="reference_N = nan"):
        mpc.step(mpc.start, np.nan, 0.0)


@pytest.mark.parametrize(("single", "error_A"), [(False, 1e-10), (True, 2e-3)])
def test_the_c_code_does_the_same(compiler, stand, thor, mpc, tmp_path, single, error_A):
    """Over 600 samples that saturate, one of them without a measurement."""
    measurements = []

    def watched(state, reference, measurement):
        measurements.append(np.nan if len(measurements) == 300 else measurement)
        return mpc.command(state, reference, measurements[-1])

    reference = np.repeat([0.0, 2000.0, -2000.0, 500.0], 150)
    run = close_loop(watched, mpc.start, stand, thor, reference, sensors=SENSOR)
    rows = CompiledMPC(compiler, tmp_path / "code", mpc, single_precision=single).run(reference, measurements)
    assert np.max(np.abs(run.current)) == 9.0
    assert rows[:, 0] == pytest.approx(run.current, abs=error_A)
    assert np.all(rows[:, 1] == 1)


def test_an_open_loop_is_the_simulation(swing, thor):
    current = 0.2 * np.sin(np.arange(800) / 25.0)
    log = so.Log.from_arrays(time=TS * np.arange(800), I=np.concatenate([[0.0, 0.0], current])[:800])
    run = close_loop(lambda k, r, y: (float(current[k]), k + 1), 0, swing, thor, np.zeros(800), delay_samples=2)
    truth = so.simulate(swing, thor, log)
    assert np.max(np.abs(run.force - truth["F1"])) < 1e-5 * np.max(np.abs(truth["F1"]))


def test_overshoot_and_settling_of_a_known_answer(stand, thor):
    """A constant current: peak exp(-pi zeta / sqrt(1 - zeta^2)) of a second-order plant."""
    run = close_loop(lambda s, r, y: (r / 240.3318, s), None, stand, thor, np.full(1000, 240.3318), delay_samples=0)
    zeta = 0.41838
    assert run.overshoot == pytest.approx(np.exp(-np.pi * zeta / np.sqrt(1 - zeta**2)), rel=1e-2)
    late = np.abs(run.force / run.force[-1] - 1) > 0.02
    assert run.settling_time_s() == pytest.approx((np.flatnonzero(late)[-1] + 1) * TS, abs=2e-3)


@pytest.mark.parametrize(("samples", "moves"), [(5, 5), (50, 2), (50, 12), (500, 40)])
def test_knots_reach_from_end_to_end(samples, moves):
    knots = spread_knots(samples, moves)
    assert knots.size == moves and knots[0] == 0 and knots[-1] == samples - 1 and np.all(np.diff(knots) > 0)
    W = interpolate_knots(knots)
    assert W.shape == (samples, moves) and W.sum(axis=1) == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"current_limit_A": 0.0}, "current_limit_A = 0 is not above 0"),
        ({"current_slew_A_per_s": -1.0}, "current_slew_A_per_s"),
        ({"bandwidth_hz": 300.0}, "sample more than four times as fast"),
        ({"compute_delay_samples": -1}, "compute_delay_samples = -1"),
        ({"bandwidth_hz": 1e-3}, "slower than any weight makes it"),
        ({"bandwidth_hz": 240.0}, "beyond what any weight gives"),
        ({"decay": 1.0}, "decay = 1 is not from 0 to below 1"),
        ({"moves": 60}, "horizon_s = 0.05 is 50 samples"),
        ({"measured": "F9"}, "not an output of high_impedance"),
        ({"measured": "F2"}, "follows the current at once"),
        ({"largest_force_N": 3000.0}, "holds 2163 N, less than largest_force_N = 3000"),
        ({"noise": NoiseModel(sensor_std={"F1": 2.0}, input_noise={"I": 1.0})}, "takes the force's offset away"),
    ],
)
def test_what_cannot_be_is_said_in_one_line(stand, thor, options, said):
    with pytest.raises(ControlError, match=said) as caught:
        made(stand, thor, **options)
    assert "\n" not in str(caught.value)


def test_a_plant_whose_zero_swallows_the_force_is_refused(swing, thor):
    with pytest.raises(ControlError, match=r"the force is lost near 0\.[89].* Hz.*design on the stand"):
        made(swing, thor)


def test_a_plant_without_rest_is_refused(thor):
    plant = so.plants.rotary()
    with pytest.raises(ControlError, match="constant current"):
        made(plant, plant.defaults, measured="tau_s")
