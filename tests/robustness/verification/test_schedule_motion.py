"""A plant that moves its own scheduling variable, against SciPy's integrator with the law written out here."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import seaopt as so
from seaopt.control import CompensateGravity
from seaopt.control.compensation.gravity import make_gravity_term
from seaopt.control.loops.compensation.terms import Compensation
from seaopt.robustness.verification import schedule_motion
from seaopt.robustness.verification.schedule_motion import describe_motion, move_schedule
from seaopt.robustness.verification.schedule_sweep import RestStart, sweep_schedule
from tests.schedules import read_knee, tune_knee

L_A, K, MASS, B, FORCE = 0.0725, 655e3, 294.0, 11600.0, 240.0  # problems/lever_knee.toml
I_P, MGL, D, TS = 0.36, 11.8, 2.0, 1e-3
RATE = 0.8


def shank(t, x, current):
    q, v, phi, omega = x
    force = K * (q - L_A * np.sin(phi))
    return [
        v, (FORCE * current - B * v - force) / MASS, omega,
        (L_A * np.cos(phi) * force - MGL * np.sin(phi) - D * omega) / I_P,
    ]  # fmt: skip


def push(size, at_rest, lasting, period):
    """Return the reference: 1, -1, -1, 1 three times, then nothing twice, with edges of a raised cosine."""
    steps = np.repeat([1.0, -1.0, -1.0, 1.0] * 3 + [0.0, 0.0], lasting)
    edge = 1.0 - np.cos(2.0 * np.pi * np.arange(period + 2) / (period + 1))
    return at_rest + size * np.convolve(steps, edge / edge.sum())[: steps.size]


def simulate(table, reference, middle):
    """Return torque and angle at each sample: gains between the points on lines, one sample of delay, 5 A."""
    torque = MGL * np.sin(middle)
    force = torque / (L_A * np.cos(middle))
    x, waiting = np.array([L_A * np.sin(middle) + force / K, 0.0, middle, 0.0]), force / FORCE
    place = {name: float(np.interp(middle, table.points, row)) for name, row in table.gains.items()}
    integral = force - (place["k_r"] - place["k_p"]) * torque
    slow_r = slow_y = torque
    out = np.zeros((reference.size, 2))
    for n, r in enumerate(reference):
        y = L_A * np.cos(x[2]) * K * (x[0] - L_A * np.sin(x[2]))
        out[n] = y, x[2]
        g = {name: float(np.interp(x[2], table.points, row)) for name, row in table.gains.items()}
        alpha = 1.0 / (g["T_f"] + TS)
        effort = g["k_r"] * r - g["k_p"] * y + integral + 0.5 * TS * g["k_i"] * (r - y)
        effort += g["k_d"] * alpha * (g["c"] * (r - slow_r) - (y - slow_y))
        assert abs(effort) < 5.0 * FORCE  # the anti-windup never acts
        integral += TS * g["k_i"] * (r - y)
        slow_r, slow_y = slow_r + alpha * TS * (r - slow_r), slow_y + alpha * TS * (y - slow_y)
        x = solve_ivp(shank, (0.0, TS), x, args=(waiting,), method="DOP853", rtol=1e-11, atol=1e-13).y[:, -1]
        waiting = effort / FORCE
    return out


@pytest.mark.parametrize("fraction", [0.0, 0.8])
def test_a_run_starts_at_the_rest_that_the_equations_have(fraction):
    """Torque, spring and current of an angle at which the shank is held, and nothing moves while the push is none."""
    schedule, (_, swing, values), angle = tune_knee(), read_knee(), 0.3
    if fraction:
        link = so.plants.rotary(link="pendulum")
        weight = link, link.defaults.update(m=MGL / (9.81 * 0.2), L=0.2)
        term = replace(make_gravity_term(*weight, "tau_s", CompensateGravity(fraction=fraction)), reads="phi")
        terms = Compensation(sample_time_s=TS, gravity=term)
        laws = tuple(replace(each, compensation=terms) for each in schedule.controllers)
        schedule = replace(schedule, controllers=laws)
    start = RestStart.at_rest(schedule, swing, values, angle)
    run = start.run(swing, start.params, np.zeros((1, 300)))
    torque = MGL * np.sin(angle)
    force = torque / (L_A * np.cos(angle))
    assert run.outputs["tau"][0] == pytest.approx(np.full(300, torque), rel=1e-9)
    assert run.current[0] == pytest.approx(np.full(300, force / FORCE), rel=1e-9)
    assert start.states == pytest.approx({"q": L_A * np.sin(angle) + force / K, "v": 0.0, "phi": angle, "omega": 0.0})
    assert start.equilibrium.reference[0] == pytest.approx((1.0 - fraction) * torque, rel=1e-5)
    assert np.max(np.abs(start.find_errors(run, np.full(300, angle)))) < 1e-9 * torque


@pytest.mark.slow
def test_the_shank_under_the_schedule_moves_as_an_own_simulation_says():
    schedule, (_, swing, values) = tune_knee(), read_knee()
    motion = move_schedule(schedule, "swing", swing, values, RATE)
    assert not motion.fault and RATE <= motion.rate < 1.05 * RATE
    middle, room = 0.5 * schedule.points[-1], 0.5 * schedule.points[-1]
    period = int(np.ceil(1.0 / 30.0 / TS))
    lasting = int(np.clip(round(room / RATE / TS), 5 * period, 20 * period))
    reference = push(motion.size, MGL * np.sin(middle), lasting, period)
    torque, angle = simulate(schedule.table, reference, middle).T
    assert motion.rate == pytest.approx(np.max(np.abs(np.diff(angle))) / TS, rel=1e-4)
    assert (motion.low, motion.high) == pytest.approx((np.min(angle), np.max(angle)), rel=1e-4)
    ends = lasting * np.arange(1, 15)
    windows = np.array([(torque - reference)[end - 2 * period : end] for end in ends]) / (2.0 * motion.size)
    time = np.arange(2 * period)
    fast = [row - np.polyval(np.polyfit(time, row, 2), time) for row in windows]
    assert motion.left == pytest.approx(np.max(np.abs(windows)), rel=1e-3)
    assert motion.ringing == pytest.approx(np.max(np.abs(fast)), rel=2e-2, abs=1e-6)
    assert schedule.points[0] < motion.low < middle < motion.high < schedule.points[-1]


def test_a_loop_that_rings_while_it_moves_is_found(monkeypatch):
    """A motor six times as strong as the law was tuned for: short pushes to and fro once."""
    for name, value in (("ROUNDS", 1), ("MOST_PERIODS", 6)):
        monkeypatch.setattr(schedule_motion, name, value)
    schedule, (_, swing, values) = tune_knee(), read_knee()
    motion = move_schedule(schedule, "swing", swing, values.update(K_f=6 * FORCE), RATE)
    assert motion.fault.startswith("rings")
    assert "rings" in describe_motion(motion, "phi", "rad/s")


@pytest.mark.slow
def test_a_link_too_heavy_for_the_rate_asked_shows_less():
    """A push of 5 A turns 20 kg m^2 by at most F L_a t/I_p in its 20 periods of the bandwidth: 2.9 rad/s."""
    schedule, (_, swing, values) = tune_knee(), read_knee()
    inertia, asked = 20.0, 8.0
    bound = 5.0 * FORCE * L_A * (20.0 / 30.0) / inertia
    motion = move_schedule(schedule, "swing", swing, values.update(I_p=inertia), asked)
    assert bound < asked == motion.asked
    assert 0.5 < motion.rate < bound and not motion.fault
    assert "8 rad/s is not reached within" in describe_motion(motion, "phi", "rad/s")
    assert schedule.points[0] < motion.low < motion.high < schedule.points[-1]


def test_a_plant_that_holds_the_variable_is_not_pushed():
    schedule, (stand, _, values) = tune_knee(), read_knee()
    assert move_schedule(schedule, "stand", stand, values, RATE) is None


def test_a_weight_beyond_the_command_is_a_finding_and_no_error():
    """The law cannot be started where the plant rests: 0.23 A hold the shank in the middle."""
    schedule, (_, swing, values) = tune_knee(), read_knee()
    weak = [replace(law, spec=replace(law.spec, current_limit_A=0.2)) for law in schedule.controllers]
    schedule = replace(schedule, controllers=tuple(weak))
    motion = move_schedule(schedule, "swing", swing, values, RATE)
    middle = 0.5 * schedule.points[-1]
    needed = MGL * math.sin(middle) / (L_A * math.cos(middle)) / FORCE
    assert f"{needed:.4g} A" in motion.fault and motion.rate == 0.0
    (sweep,) = sweep_schedule(replace(schedule, points=(0.4, 0.5, 0.65)), "swing", swing, values)
    assert "limit of 0.2 A" in sweep.fault
