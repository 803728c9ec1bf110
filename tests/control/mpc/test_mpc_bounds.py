"""Bounds of outputs and states, references known ahead, and steps without a solution, against independent programs."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

import seaopt as so
from seaopt.control import MPCSpec, close_loop, force_mpc, sample
from seaopt.control.mpc.active_set import UNFINISHED
from seaopt.control.mpc.quadratic_program import QPSolution, QuadraticProgram
from seaopt.errors import ControlError
from tests.c_code import CompiledMPC

SENSOR = so.Sensors(noise_std={"F1": 2.0})

TS, SPEED, FORCE = 1e-3, 0.05, 800.0
SPEED_LIMIT = {"qd": (-SPEED, SPEED)}


def made(plant, params, **options):
    defaults = {"current_limit_A": 9.0, "current_slew_A_per_s": 2000.0, "bandwidth_hz": 20.0}
    return force_mpc(plant, params, MPCSpec(**{**defaults, **options}))


def run_on(mpc, plant, params, reference, **options):
    """Return the run and its steps."""
    steps = []

    def law(state, r, y):
        steps.append(mpc.step(state, r, y))
        return steps[-1].command, steps[-1].state

    return close_loop(law, mpc.start, plant, params, reference, **options), steps


def exact(mpc, x0, last, references, bounds):
    """Return the best first current, one variable per sample, with hard bounds at each, by qpOASES; None without one.

    The model, its cost and its target are written down again here; no drift, no delay.
    """
    plant, values = mpc.design
    digital, model = sample(plant, values, "F1", 1.0, TS, 0), plant.linearize(values)
    a, b, g, tau = digital.a, digital.b, mpc.static_gain, 0.8 / (2 * np.pi * mpc.spec.bandwidth_hz)
    w = model.C[0] + tau * model.C[0] @ model.A
    rows = {"F1": model.C[0], "q": np.array([1.0, 0.0]), "qd": np.array([0.0, 1.0])}
    u_s = references[-1] / g
    x_s = np.linalg.solve(np.eye(2) - a, b * u_s)
    N = mpc.spec.samples
    r = np.append(references, np.full(N + 1 - len(references), references[-1]))
    u, cost, x, before = ca.SX.sym("u", N), 0, ca.DM(x0), last
    held, low, high = [], [], []
    for j in range(N):
        cost += ((ca.dot(w, x) - r[j] - tau * (r[j + 1] - r[j]) / TS) / g) ** 2
        cost += mpc.regulator.rho * (u[j] - before) ** 2
        x, before = a @ x + b * u[j], u[j]
        for name, ends in bounds.items():
            scale = 2.0 / (ends[1] - ends[0])
            held = [*held, scale * ca.dot(rows[name], x)]
            low, high = [*low, scale * ends[0]], [*high, scale * ends[1]]
    end = ca.vertcat(x - x_s, before - u_s)
    cost += ca.bilin(ca.DM(mpc.regulator.Pi), end, end)
    options = {"printLevel": "none", "print_time": False, "error_on_fail": False}
    solver = ca.qpsol("exact", "qpoases", {"x": u, "f": cost, "g": ca.vertcat(*held)}, options)
    found = solver(lbx=-9, ubx=9, lbg=low, ubg=high, x0=last)
    return float(found["x"][0]) if solver.stats()["success"] else None


@pytest.mark.parametrize(
    ("bounds", "ahead"),
    [({"qd": (-0.08, 0.06), "F1": (-1000.0, 1200.0)}, 0), ({}, 6), (SPEED_LIMIT, 6)],
)
def test_it_is_what_another_solver_finds_with_hard_bounds(stand, thor, bounds, ahead):
    """Where hard bounds can be kept the soft ones are: the penalty is exact. Every sample is free, and held."""
    mpc = made(
        stand, thor, horizon_s=0.012, moves=12, compute_delay_samples=0, bounds=bounds, preview_samples=ahead,
        current_slew_A_per_s=None,
    )  # fmt: skip
    rng = np.random.default_rng(11)
    solved = active = 0
    for _ in range(8):
        x0 = np.array([rng.uniform(-900, 900) / thor["k"].value, rng.uniform(-0.04, 0.04)])
        last, references = float(x0[0] * thor["k"].value / mpc.static_gain), rng.uniform(-950, 950, ahead + 1)
        best = exact(mpc, x0, last, references, bounds)
        if best is None:
            continue
        z = np.concatenate([x0, [0.0, 0.0]])
        state = replace(mpc.start, command=last, kalman=replace(mpc.kalman.start, predicted=z))
        step = mpc.step(state, references, float(mpc.kalman.C[0] @ z))
        assert step.solved and step.slack < 2e-3
        assert step.command == pytest.approx(best, abs=2e-2)
        loose = exact(mpc, x0, last, references, {})
        solved, active = solved + 1, active + (abs(loose - best) > 0.05)
    assert solved >= 4
    assert active >= 2 or not bounds


def test_a_motor_speed_is_kept_that_a_step_breaks_without(stand, thor):
    """On the nonlinear plant, simulated between samples too; with a current that is 10 % stronger than the model's."""
    params = thor.update(f_c=50.0, v_s=1e-3)
    reference = np.repeat([0.0, 1000.0, -1000.0], [10, 90, 100])
    bound = made(stand, params, bounds=SPEED_LIMIT)
    loose, _ = run_on(made(stand, params), stand, params, reference)
    tight, steps = run_on(bound, stand, params, reference)
    stronger, _ = run_on(bound, stand, params.update(K_tau=1.1 * params["K_tau"].value), reference)
    speeds = [np.max(np.abs(run.state[:, 1])) for run in (loose, tight, stronger)]
    assert speeds[0] > 1.5 * SPEED
    assert 0.95 * SPEED < speeds[1] < 1.01 * SPEED
    assert speeds[2] < 1.12 * SPEED
    assert tight.force[-1] == pytest.approx(-1000.0, abs=10.0)
    assert all(step.solved for step in steps)


@pytest.mark.parametrize(
    ("name", "ends", "stays"),
    [("F1", (-300.0, 800.0), 800.0), ("q", (-1e-3, 1e-3), 655.0), ("F2", (-900.0, 900.0), 900.0)],
)
def test_a_bound_on_force_or_position_is_where_it_rests(stand, thor, name, ends, stays):
    """F2 of the stand follows the current at once; q is the spring's deflection there."""
    mpc = made(stand, thor, bounds={name: ends})
    run, steps = run_on(mpc, stand, thor, np.full(300, 1500.0))
    assert run.force[-1] == pytest.approx(stays, rel=2e-3)
    assert steps[-1].target_N == pytest.approx(stays, rel=1e-3)
    log = so.Log.from_arrays(time=run.time, I=np.append(0.0, run.current[:-1]))
    true = so.simulate(stand, thor, log)[name]
    assert np.max(true) < ends[1] * 1.005


def test_a_speed_that_is_there_already_is_broken_as_little_as_can_be(stand, thor):
    """The program has a solution from every state: a hard bound would leave none."""
    mpc = made(stand, thor, bounds=SPEED_LIMIT)
    z = np.array([0.0, 3.0 * SPEED, 0.0, 0.0])
    state = replace(mpc.start, kalman=replace(mpc.kalman.start, predicted=z))
    step = mpc.step(state, 1000.0, 0.0)
    assert step.solved and step.slack > 0.5
    assert step.command == pytest.approx(-2.0, abs=1e-9)  # brakes as hard as 2000 A/s let it


@pytest.mark.slow
def test_noise_and_jumps_leave_the_command_within_limits_and_the_speed_near_its_own(stand, thor):
    mpc = made(stand, thor, bounds=SPEED_LIMIT)
    rng = np.random.default_rng(3)
    run, steps = run_on(mpc, stand, thor, np.repeat(rng.uniform(-1500, 1500, 5), 50), sensors=SENSOR)
    assert np.max(np.abs(run.state[:, 1])) < 1.25 * SPEED
    assert np.max(np.abs(run.current)) <= 9.0
    assert np.max(np.abs(np.diff(run.current, prepend=0.0))) <= 2.0 + 1e-9
    assert max(step.iterations for step in steps) <= mpc.spec.max_iterations


def test_references_known_ahead_are_tracked_better(stand, thor):
    time = TS * np.arange(250)
    reference = 300.0 * np.sin(2 * np.pi * 10 * time)
    errors = []
    for ahead in (0, 20):
        mpc = made(stand, thor, preview_samples=ahead)
        run, _ = run_on(mpc, stand, thor, reference, preview_samples=ahead)
        errors.append(np.sqrt(np.mean((run.force - reference)[100:] ** 2)))
    assert errors[0] > 10 * errors[1]


@pytest.mark.parametrize("delay", [1, 3])
def test_a_reference_known_for_the_delay_alone_is_one_that_comes_so_much_earlier(stand, thor, delay):
    reference = np.repeat(np.random.default_rng(1).uniform(-500, 500, 8), 30)
    early = np.append(reference[delay:], np.full(delay, reference[-1]))
    known = made(stand, thor, compute_delay_samples=delay, preview_samples=delay)
    plain = made(stand, thor, compute_delay_samples=delay)
    first, _ = run_on(known, stand, thor, reference, delay_samples=delay, preview_samples=delay)
    second, _ = run_on(plain, stand, thor, early, delay_samples=delay)
    assert first.current == pytest.approx(second.current, abs=1e-9)


def test_a_reference_that_stays_is_no_other_with_preview(stand, thor):
    one, other = made(stand, thor), made(stand, thor, preview_samples=30)
    for references in (700.0, np.full(31, 700.0), np.full(4, 700.0)):
        assert other.step(other.start, references, 3.0).command == one.step(one.start, 700.0, 3.0).command


def test_without_a_solution_the_last_plan_goes_on_and_after_a_horizon_the_current_of_rest(stand, thor, monkeypatch):
    mpc = made(stand, thor, bounds=SPEED_LIMIT)
    good = mpc.step(mpc.start, 1000.0, 0.0)
    knots = mpc.prediction.knots
    step, currents = good, []

    def fail(program, q, low, high, sides, max_iterations):
        return QPSolution(x=np.full(q.size, 3.0), sides=sides, status=UNFINISHED, iterations=max_iterations)

    monkeypatch.setattr(QuadraticProgram, "solve", fail)
    for _ in range(mpc.spec.samples + 1):
        step = mpc.step(step.state, 1000.0, np.nan)
        assert not step.solved and "breaks a limit" in step.status
        currents.append(step.command)
    planned = np.interp(np.arange(1, 9), knots, good.state.plan)
    assert currents[:3] == pytest.approx(planned[:3], abs=1e-9)  # the first knots are a sample apart
    assert currents[-1] == pytest.approx(1000.0 / mpc.static_gain, abs=2.0)


def test_the_c_code_does_the_same_with_bounds_and_preview_and_where_iterations_do_not_suffice(
    compiler, stand, thor, tmp_path
):
    ahead = 8
    spec = {"bounds": {**SPEED_LIMIT, "F2": (-1500.0, FORCE)}, "preview_samples": ahead, "max_iterations": 6}
    mpc = made(stand, thor, **spec)
    reference = np.repeat(np.random.default_rng(5).uniform(-1500, 1500, 4), 40)
    measurements, steps = [], []

    def law(state, r, y):
        measurements.append(y)
        steps.append(mpc.step(state, r, y))
        return steps[-1].command, steps[-1].state

    run = close_loop(law, mpc.start, stand, thor, reference, preview_samples=ahead, sensors=SENSOR)
    padded = np.append(reference, np.full(ahead, reference[-1]))
    rows = CompiledMPC(compiler, tmp_path / "code", mpc).run(
        [padded[k : k + ahead + 1] for k in range(reference.size)], measurements
    )
    assert rows[:, 0] == pytest.approx(run.current, abs=1e-9)
    assert rows[:, 1:3].tolist() == [[float(step.solved), float(step.iterations)] for step in steps]
    unfinished = [step for step in steps if step.status.startswith(UNFINISHED)]
    assert 0 < sum(not step.solved for step in unfinished) < len(unfinished)  # some keep the limits, and are used
    assert np.max(rows[:, 2]) == 6


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"bounds": {"theta": (-1.0, 1.0)}}, 'bounds of "theta": not an output or state of high_impedance'),
        ({"bounds": {"I_drift": (-1.0, 1.0)}}, 'bounds of "I_drift"'),
        ({"bounds": {"qd": (1.0, -1.0)}}, "leave nothing between"),
        ({"bounds": {"qd": (-np.inf, 1.0)}}, "are not two numbers"),
        ({"preview_samples": 80}, "preview_samples = 51 at most"),
        ({"preview_samples": -1}, "preview_samples = -1"),
        ({"max_iterations": 0}, "max_iterations = 0"),
    ],
)
def test_what_cannot_be_is_said_in_one_line(stand, thor, options, said):
    with pytest.raises(ControlError, match=said) as caught:
        made(stand, thor, **options)
    assert "\n" not in str(caught.value)


def test_more_references_than_can_be_known_are_refused(stand, thor):
    mpc = made(stand, thor)
    with pytest.raises(ControlError, match="preview_samples = 4 in the specification"):
        mpc.step(mpc.start, np.zeros(5), 0.0)
    with pytest.raises(ControlError, match="preview_samples = -2"):
        close_loop(mpc.command, mpc.start, stand, thor, np.zeros(5), preview_samples=-2)
