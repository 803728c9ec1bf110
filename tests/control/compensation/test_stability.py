"""The test of stability with friction compensated from the speed: against a lifted loop, its poles, and simulations."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import expm

import seaopt as so
from seaopt.control import CompensateFriction, SampledLoop, add_compensation, run_loop, runnable
from seaopt.control.compensation.compensate import find_compensation_margins
from seaopt.control.compensation.friction import find_motor_friction, find_velocity_per_rate
from seaopt.control.laws.friction import take_friction_out
from seaopt.control.loops.compensation import stability
from seaopt.control.loops.compensation.stability import SpeedReading, compensation_margin

STAND, PARAMETERS = so.plants.high_impedance(), so.plants.thor().update(f_c=100.0)
SUBSTEPS = 120


@pytest.fixture(scope="module")
def controller():
    return so.tune(STAND, PARAMETERS, so.ControllerSpec(bandwidth_hz=20, max_sensitivity=1.6))


@pytest.fixture(scope="module")
def loop(controller):
    return take_friction_out(controller, STAND, [PARAMETERS])[0]


def lift(controller, differenced):
    """Return the closed sampled loop from (friction on substeps, compensation) to (mean velocities, speed read).

    One period as matrices, made by stepping the plant's own equations: x, the last position, the law and the command
    that waits.
    """
    model = STAND.linearize(so.plants.thor())  # without friction
    a, c_force = np.array(model.A), np.array(model.C)[0]
    to_effort = np.array(model.B)[:, 0] * controller.command.per_effort
    n, law, ts = len(a), controller.law, controller.sample_time_s
    h = ts / SUBSTEPS
    whole = expm(h * np.block([[a, to_effort[:, None]], [np.zeros((1, n + 1))]]))
    a_h, b_h = whole[:n, :n], whole[:n, n]  # friction acts as the motor's effort does, the other way round
    m = law.c.size
    size = n + 1 + m + 1
    inputs = SUBSTEPS + 1

    def unit(i, width):
        return np.eye(1, width, k=i)[0]

    # The sample: x, last position, law, waiting command; inputs are all of the period.
    x_row = np.hstack([np.eye(n), np.zeros((n, size - n))])
    force = c_force @ x_row
    state = np.hstack([np.zeros((m, n + 1)), np.eye(m), np.zeros((m, 1))])
    command = law.c @ state + law.d[1] * force
    position, speed = x_row[0], x_row[1]
    read = (position - unit(n, size)) / ts if differenced else speed
    after_law = law.a @ state + np.outer(law.b[:, 1], force)
    x, x_in = x_row, np.zeros((n, inputs))
    held, velocity, velocity_in = unit(size - 1, size), [], []
    for i in range(SUBSTEPS):
        before, before_in = x, x_in
        x = a_h @ x + np.outer(b_h, held)
        x_in = a_h @ x_in + np.outer(b_h, unit(i, inputs))
        velocity.append((x - before)[0] / h)
        velocity_in.append((x_in - before_in)[0] / h)
    step = np.vstack([x, position, after_law, command])
    step_in = np.vstack([x_in, np.zeros((1 + m, inputs)), unit(inputs - 1, inputs)])
    return step, step_in, np.vstack([*velocity, read]), np.vstack([*velocity_in, np.zeros(inputs)])


@pytest.mark.parametrize("differenced", [False, True])
def test_needed_inverse_is_that_of_a_lifted_loop(controller, loop, differenced):
    reading = SpeedReading(velocity=loop.velocity[0], differenced=differenced)
    theta = np.array([1e-3, 0.02, 0.1, 0.14, 0.4, 1.5, 3.0])
    readings = stability._LoopAtAngles.at(loop, reading, theta)
    found = stability._MultiplierTest.of(readings, np.ones_like).find_least_inverse("1")
    phi, gamma, rows, through = lift(controller, differenced)
    inverse_slope = PARAMETERS["v_s"].value / 100.0
    for ratio in (0.3 * found.ratio, found.ratio, 4.0 * found.ratio):
        for angle, computed in zip(theta, found.at_ratio(ratio), strict=True):
            z = np.exp(1j * angle)
            h = rows @ np.linalg.solve(z * np.eye(len(phi)) - phi, gamma) + through
            friction, speed = h[:SUBSTEPS] / SUBSTEPS, -ratio * h[SUBSTEPS:]
            form = np.vstack([friction, speed])
            form[:SUBSTEPS, :SUBSTEPS] += inverse_slope * np.eye(SUBSTEPS) / SUBSTEPS
            form = 0.5 * (form + form.conj().T)
            inner, border = form[:-1, :-1], form[:-1, -1]
            assert np.linalg.eigvalsh(inner)[0] > 0.0
            needed = np.real(border.conj() @ np.linalg.solve(inner, border) - form[-1, -1]) / ratio
            scale = abs(needed) + 1e-6
            assert -5e-3 * scale <= computed - needed <= 3e-2 * scale  # bounds of what is left out only add


def test_what_is_shown_is_no_more_than_the_poles_allow(controller, loop):
    reading = SpeedReading(velocity=loop.velocity[0], differenced=True)
    margin = compensation_margin(loop, reading, 1e5)
    phi, gamma, rows, _ = lift(controller, differenced=True)

    def radius(slope):
        return np.max(np.abs(np.linalg.eigvals(phi + slope * np.outer(gamma[:, -1], rows[-1]))))

    assert not margin.shown
    assert radius(margin.slope) < 1.0
    unstable = next(slope for slope in margin.slope * np.geomspace(1.0, 100.0, 60) if radius(slope) > 1.0)
    assert margin.slope < unstable < 5.0 * margin.slope  # it is no empty statement either


def test_what_is_shown_comes_to_rest_and_too_steep_a_compensation_does_not(controller):
    def last_motion(compensation):
        controlled = add_compensation(controller, friction=compensation)
        loop = SampledLoop(plant=STAND, law=runnable(controlled), measured="F1", delay_samples=1)
        reference = np.concatenate([np.full(200, 200.0), np.zeros(2800)])
        run = run_loop(loop, [PARAMETERS], reference)
        (margin,) = find_compensation_margins(controlled, STAND, [PARAMETERS])
        return margin, np.ptp(run.outputs["F1"][0, -500:])

    for fraction in (0.8, 1.4):  # more than all of it, too
        margin, motion = last_motion(CompensateFriction(fraction=fraction, source="speed"))
        assert margin.shown
        assert motion < 1e-2
    margin, motion = last_motion(CompensateFriction(fraction=1.4, source="speed", speed=2e-4))
    assert not margin.shown
    assert motion > 5.0


def test_smoothing_that_is_chosen_leaves_what_is_shown_twice(controller):
    chosen = add_compensation(controller, friction=CompensateFriction(source="speed"))
    (margin,) = find_compensation_margins(chosen, STAND, [PARAMETERS], enough=np.inf)
    assert margin.factor == pytest.approx(2.0, rel=0.05)
    wider = find_compensation_margins(
        add_compensation(controller, friction=CompensateFriction(source="speed", speed=0.1)), STAND, [PARAMETERS]
    )
    assert wider[0].slope >= 1e3


def test_plant_that_is_not_shown_stable_by_itself_shows_nothing(controller):
    chosen = add_compensation(controller, friction=CompensateFriction(source="speed", speed=0.01))
    none = so.plants.thor()
    assert find_compensation_margins(chosen, STAND, [none])[0].slope == 0.0
    faster = replace(chosen, law=chosen.law.scaled(20.0))
    (margin,) = find_compensation_margins(faster, STAND, [PARAMETERS])
    assert (margin.slope, margin.multiplier) == (0.0, "unstable without friction")


def test_friction_is_that_of_the_motor_and_its_velocity_that_of_the_spring():
    assert find_motor_friction(so.plants.high_impedance(), so.plants.thor().update(f_c=50.0)).level == pytest.approx(50)
    per_rate = find_velocity_per_rate(so.plants.moving_output(), so.plants.thor().update(f_c=50.0), "F1", "F_f")
    assert 1 / per_rate == pytest.approx(so.plants.thor()["k"].value)
