"""Friction that sticks: against motions in closed form, a simulator of the tests' own, and scipy with events."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import seaopt as so
from seaopt.control.laws.realisation import runnable
from seaopt.control.running.closed_loop import SampledLoop, run_loop
from seaopt.errors import SimulationError
from seaopt.plants.roles import Friction
from seaopt.simulation.sticking import sliding_step, sticking_output, sticking_step
from tests.stick_slip import Mass, simulate

M, K = 2.0, 800.0  # kg, N/m
LEVEL, HELD, FALL = 3.0, 5.0, 0.05  # N sliding, N at rest, m/s of Stribeck's fall


@pytest.fixture(scope="module")
def block():
    """Return a mass on a spring that is pulled at its other end, with the force on the mass as an output."""

    def level(speed, p):
        return p.f_c + (p.f_s - p.f_c) * ca.exp(-((speed / FALL) ** 2))

    return so.Plant(
        name="block", states={"x": "m", "v": "m/s"}, inputs={"F": "N"}, outputs={"x": "m", "a": "m/s^2"},
        parameters={"m": "kg", "k": "N/m", "f_c": "N", "f_s": "N"},
        f=lambda t, x, u, p: {"x": x.v, "v": (u.F - p.k * x.x - u.rub) / p.m},
        h=lambda t, x, u, p: {"x": x.x, "a": (u.F - p.k * x.x - u.rub) / p.m},
        friction={"rub": Friction(
            velocity=lambda x, p: x.v, jump=level,
            force=lambda v, p: level(v, p) * ca.tanh(v / 1e-3),
        )},
    )  # fmt: skip


def march(plant, values, x, effort, h, steps):
    """Return the states step by step; effort is of the time."""
    step, p, states = sticking_step(plant), [values[name] for name in plant.parameters], [np.array(x, dtype=float)]
    for i in range(steps):
        states.append(np.array(step(i * h, states[-1], effort(i * h), p, h)).ravel())
    return np.array(states)


def test_a_block_let_go_loses_four_levels_a_period_and_stops_for_good(block):
    """x = 0.1 m: each half period it comes 2 f_c/k nearer, and stops at the first turn within f_c/k."""
    states = march(block, {"m": M, "k": K, "f_c": LEVEL, "f_s": LEVEL}, [0.1, 0.0], lambda t: 0.0, 1e-3, 3000)
    turns, place = [], 0.1
    while abs(place) > LEVEL / K:
        place = -np.sign(place) * (abs(place) - 2.0 * LEVEL / K)
        turns.append(place)
    assert len(turns) > 10
    speed, x = states[:, 1], states[:, 0]
    assert x[-1] == pytest.approx(turns[-1], abs=1e-7)
    last = round(len(turns) * np.pi * np.sqrt(M / K) / 1e-3) + 2
    assert np.max(np.abs(speed[last:])) < 1e-15 and np.ptp(x[last:]) < 1e-15
    assert np.min(x) == pytest.approx(turns[0], abs=1e-6)


def test_stick_slip_is_that_of_an_integrator_with_events(block):
    """Pulled ever harder, the block jumps again and again: when, and how far, as scipy's integrator finds."""
    values, pull = {"m": M, "k": K, "f_c": LEVEL, "f_s": HELD}, 2.0 * K / 100.0  # N/s
    states = march(block, values, [0.0, 0.0], lambda t: pull * t, 2e-4, 15000)

    def slide(t, y):
        return [y[1], (pull * t - K * y[0] - (LEVEL + (HELD - LEVEL) * np.exp(-((y[1] / FALL) ** 2)))) / M]

    t, x, jumps = 0.0, 0.0, []
    while True:
        t = (HELD + K * x) / pull  # what holds it gives way
        if t >= 3.0 - 0.3:
            break
        stop = solve_ivp(
            slide, (t, t + 2.0), [x, 1e-9], rtol=1e-10, atol=1e-13,
            events=[lambda t, y: y[1]], max_step=1e-3,
        )  # fmt: skip
        ends = [k for k, time in enumerate(stop.t_events[0]) if time > t + 1e-2]
        x = stop.y_events[0][ends[0]][0]
        jumps.append((t, stop.t_events[0][ends[0]], x))
    assert len(jumps) >= 2
    for begin, end, place in jumps:
        after = round((end + 5e-3) / 2e-4)
        assert states[after, 0] == pytest.approx(place, rel=2e-3)
        assert abs(states[after, 1]) < 1e-15
        assert abs(states[round((begin - 5e-3) / 2e-4), 1]) < 1e-15 and states[round((begin + 0.03) / 2e-4), 1] > 1e-4


def test_a_step_that_slides_on_is_the_whole_step_where_nothing_stops(block):
    """A stop is told by the block's speed, by scipy: it turns within the step."""
    values, rng, told = [M, K, LEVEL, HELD], np.random.default_rng(3), [0, 0]
    whole, slide = sticking_step(block), sliding_step(block)
    for _ in range(600):
        x, effort, h = [0.01 * rng.normal(), 0.02 * rng.normal()], [10.0 * rng.normal()], 5e-4
        after, stops = slide(0.0, x, effort, values, h)
        sign = np.sign(x[1])
        level = lambda v: LEVEL + (HELD - LEVEL) * np.exp(-((v / FALL) ** 2))  # noqa: E731
        run = solve_ivp(
            lambda _, z, u=effort[0], s=sign, level=level: [z[1], (u - K * z[0] - s * level(max(s * z[1], 0.0))) / M],
            (0.0, h), x, rtol=1e-10, atol=1e-14,
        )  # fmt: skip
        assert bool(stops) == (sign * run.y[1, -1] <= 0.0)
        told[bool(stops)] += 1
        if not stops:
            np.testing.assert_allclose(np.array(after), np.array(whole(0.0, x, effort, values, h)), rtol=1e-13)
            np.testing.assert_allclose(np.array(after)[:, 0], run.y[:, -1], rtol=1e-5, atol=1e-7)
    assert min(told) > 20


def test_what_stands_still_is_held_by_the_force_that_keeps_it_so(block):
    """The acceleration that is read is zero while less than f_s pulls, else what is left; sliding, Newton's."""
    read, p = sticking_output(block), [M, K, LEVEL, HELD]
    for x, v, force, expected in (
        (0.0, 0.0, 4.9, 0.0), (0.001, 0.0, -3.0, 0.0), (0.0, 0.0, 6.0, 0.5), (0.0, 0.0, -6.0, -0.5),
        (0.0, 10.0, 6.0, (6.0 - LEVEL) / M), (0.0, -10.0, 6.0, (6.0 + LEVEL) / M),
    ):  # fmt: skip
        assert np.array(read(0.0, [x, v], force, p)).ravel() == pytest.approx([x, expected], abs=1e-12)


@pytest.mark.slow
def test_two_joints_that_rub_on_one_another_stand_or_slide():
    """Two blocks on a table, a spring between them; against a stiff integrator, smoothed at 1e-6."""
    mass, rub, spring = (1.0, 3.0), (2.0, 4.0), 500.0

    def joint(i):
        return Friction(
            velocity=lambda x, p: getattr(x, f"v{i}"), jump=lambda speed, p: rub[i],
            force=lambda v, p: rub[i] * ca.tanh(v / 1e-6),
        )  # fmt: skip

    plant = so.Plant(
        name="two blocks", states={"x0": "m", "v0": "m/s", "x1": "m", "v1": "m/s"}, inputs={"F": "N"},
        outputs={"x0": "m", "x1": "m"}, parameters={"k": "N/m"},
        f=lambda t, x, u, p: {
            "x0": x.v0, "v0": (u.F - p.k * (x.x0 - x.x1) - u.r0) / mass[0],
            "x1": x.v1, "v1": (p.k * (x.x0 - x.x1) - u.r1) / mass[1],
        },
        h=lambda t, x, u, p: {"x0": x.x0, "x1": x.x1},
        friction={"r0": joint(0), "r1": joint(1)},
    )  # fmt: skip

    def force(t):
        return 9.0 * np.sin(2 * np.pi * 1.3 * t)

    def rate(t, y):
        pull, own = spring * (y[0] - y[2]), [rub[i] * np.tanh(y[2 * i + 1] / 1e-6) for i in (0, 1)]
        return [y[1], (force(t) - pull - own[0]) / mass[0], y[3], (pull - own[1]) / mass[1]]

    h, steps = 1e-4, 12000
    states = march(plant, {"k": spring}, np.zeros(4), lambda t: force(t + 0.5 * h), h, steps)
    exact = solve_ivp(rate, (0.0, h * steps), np.zeros(4), method="Radau", rtol=1e-7, atol=1e-10, max_step=2e-3)
    times = h * np.arange(steps + 1)
    for i in (0, 2):
        expected = np.interp(times, exact.t, exact.y[i])
        assert states[:, i] == pytest.approx(expected, abs=2e-3 * np.max(np.abs(expected)))
    still = np.abs(states[:, 1::2]) < 1e-14
    assert np.all(np.mean(still, axis=0) > 0.05) and not np.all(still[:, 0] == still[:, 1])


def test_a_joint_that_never_moves_does_not_keep_another_from_stopping():
    """A block is pulled by 1 N under 2 N of friction beside one at rest for good: exactly where it is alone."""
    force = {"r0": 5.0, "r1": 2.0}
    plant = so.Plant(
        name="two blocks", states={"x0": "m", "v0": "m/s", "x1": "m", "v1": "m/s"}, inputs={"F": "N"},
        outputs={"x0": "m", "x1": "m"}, parameters={"m": "kg"},
        f=lambda t, x, u, p: {"x0": x.v0, "v0": (1e-3 * u.F - u.r0) / p.m, "x1": x.v1, "v1": (u.F - u.r1) / p.m},
        h=lambda t, x, u, p: {"x0": x.x0, "x1": x.x1},
        friction={name: Friction(
            velocity=lambda x, p, i=i: getattr(x, f"v{i}"), jump=lambda speed, p, name=name: force[name],
            force=lambda v, p, name=name: force[name] * ca.tanh(v / 1e-6),
        ) for i, name in enumerate(force)},
    )  # fmt: skip
    states = march(plant, {"m": 1.0}, [0.0, 0.0, 0.0, 0.0237], lambda t: 1.0, 1e-3, 200)
    assert states[-1, 2] == pytest.approx(0.5 * 0.0237**2, rel=2e-3)  # it slows down by 1 m/s^2
    assert np.max(np.abs(states[30:, 1::2])) < 1e-15 and np.max(np.abs(states[:, 0])) < 1e-15


@pytest.fixture(scope="module")
def rubbing(thor):
    return thor.update(k=120e3, m_l=0.9, l=0.005, N_p=1, K_tau=0.075, J=1.2e-5, b_r=2.5e-4, eta=0.86, f_c=25, v_s=0.004)


@pytest.fixture(scope="module")
def controller(stand, rubbing):
    spec = so.ControllerSpec(bandwidth_hz=20, max_noise_gain=25, compute_delay_samples=2, current_limit_A=10)
    return so.tune(stand, rubbing, spec)


@pytest.mark.parametrize("compiler", ["", "none"])
def test_a_loop_on_a_joint_that_sticks_is_that_of_the_independent_simulator(
    compiler, monkeypatch, controller, stand, rubbing
):  # fmt: skip
    monkeypatch.setenv("SEAOPT_COMPILER", compiler)
    stand = so.plants.high_impedance()  # a plant whose kernels are not loaded yet
    loop = SampledLoop(
        plant=stand,
        law=runnable(controller),
        measured="F1",
        delay_samples=controller.compute_delay_samples,
        sticks=True,
    )
    steps = np.array([2.5, 30.0, 100.0])
    wanted = np.repeat(steps[:, None], 600, axis=1)
    run = run_loop(loop, [rubbing] * 3, wanted)
    mass = Mass.of({name: rubbing[name].value for name in rubbing}, jump=True)
    alone = simulate([mass] * 3, [controller.to_dict()] * 3, wanted, substeps=50)
    assert run.outputs["F1"] / steps[:, None] == pytest.approx(alone.force / steps[:, None], abs=3e-4)
    assert run.peaks["F1"] / steps == pytest.approx(alone.largest / steps, abs=1e-3)
    still = np.abs(run.states[:, :, 1]) < 1e-15
    assert np.mean(still[0]) > 0.25  # the smallest step waits for the integral, and does not creep
    held = still[0] & np.append(still[0][1:], False)  # at the last sample friction lets go
    force = [run.outputs[name][0][held] for name in ("F1", "F2")]
    assert force[0] == pytest.approx(force[1], abs=1e-9)  # the mass between both does not accelerate


def test_the_force_that_a_late_command_makes_at_once_is_among_the_peaks(controller, rubbing):
    """F2 of the lumped drive is the motor's force less friction, and largest at the first command."""
    lumped = so.plants.high_impedance(drive="lumped")
    late = rubbing.with_parameters(so.Parameter(name="delay_s", value=3.7e-4, unit="s"))
    loop = SampledLoop(
        plant=lumped, law=runnable(controller), measured="F1", delay_samples=2, longest_delay_s=3.7e-4, sticks=True
    )
    run = run_loop(loop, [late], np.full(200, 60.0))
    largest = np.max(np.abs(run.current)) / controller.command.per_effort
    assert run.peaks["F2"] == pytest.approx(largest - rubbing["f_c"].value, rel=1e-3)


def test_a_plant_without_a_jump_cannot_stick(controller):
    loop = {"law": runnable(controller), "measured": "F1", "delay_samples": 1, "sticks": True}
    rotary = so.plants.rotary()
    smooth = replace(rotary, friction={name: replace(one, jump=None) for name, one in rotary.friction.items()})
    with pytest.raises(SimulationError, match="jump"):
        SampledLoop(plant=smooth, **(loop | {"measured": "tau_s"}))
