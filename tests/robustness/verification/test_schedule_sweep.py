"""Sweeps of a scheduling variable against simulations of the test's own."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from scipy.linalg import expm

import seaopt as so
from seaopt.control import PlausibilityGate
from seaopt.executors import Shared
from seaopt.plants.plant import output_function
from seaopt.robustness.verification.schedule_motion import describe_motion, move_schedule
from seaopt.robustness.verification.schedule_sweep import (
    SWEEP,
    _choose_pulses,
    _run_sweep,
    find_fastest,
    make_swept_plant,
    sweep_schedule,
)
from tests.schedules import read_knee, tune_knee

L_A, K, MASS, B, FORCE = 0.0725, 655e3, 294.0, 11600.0, 240.0  # problems/lever_knee.toml


def place_at(t, low, high, frequency_hz):
    return low + 0.5 * (high - low) * (1.0 - np.cos(2.0 * np.pi * frequency_hz * t))


def test_a_swept_state_moves_the_spring_as_its_sweep_and_rate_say():
    _, swing, values = read_knee()
    swept = make_swept_plant(swing, "phi")
    assert list(swept.states) == ["q", "v"]
    low, high, omega = 0.1, 0.9, 5.0
    units = ("rad", "rad", "rad/s")
    pairs = zip(SWEEP, (low, high, omega), units, strict=True)
    moved = values.with_parameters(*(so.Parameter(name=name, value=value, unit=unit) for name, value, unit in pairs))
    p = swept.complete(moved).vector
    dynamics = ca.Function("f", [swept.t, swept.x, swept.u, swept.p], [swept.dynamics])
    for t in (0.0, 0.13, 0.7):
        phi = place_at(t, low, high, omega / (2.0 * np.pi))
        x, current = np.array([0.01, -0.2]), 1.5
        force = K * (x[0] - L_A * np.sin(phi))
        rates = dynamics(t, x, current, p).full().ravel()
        assert rates == pytest.approx([x[1], (FORCE * current - B * x[1] - force) / MASS], rel=1e-12)
        outputs = output_function(swept)(t, x, current, p).full().ravel()
        assert outputs == pytest.approx([L_A * np.cos(phi) * force, phi], rel=1e-12)


def test_a_sweep_is_what_an_exact_simulation_of_the_stand_shows():
    """On the stand only the arm moves: the drive is linear, and its sampled step a matrix exponential."""
    schedule, (stand, _, values) = tune_knee(), read_knee()
    law, frequency = schedule.runnable(), 2.0
    pulses = _choose_pulses(schedule, stand, values)
    sweep = _run_sweep(Shared((schedule, "stand", stand, values, pulses)), frequency)
    block = np.zeros((3, 3))
    block[:2] = [[0.0, 1.0, 0.0], [-K / MASS, -B / MASS, FORCE / MASS]]
    step = expm(block * 1e-3)[:2]
    pulse = np.tile(np.repeat([1.0, 0.0], pulses.samples), 4)
    x, state, waiting, response = np.zeros(2), law.reset(place=0.0), 0.0, np.zeros(pulse.size)
    for k, wanted in enumerate(pulse):
        phi = place_at(k * 1e-3, schedule.points[0], schedule.points[-1], frequency)
        response[k] = L_A * np.cos(phi) * K * x[0] / pulses.size
        command, state = law.step(state, pulses.size * wanted, response[k] * pulses.size, phi)
        x, waiting = step @ [*x, waiting], command  # one sample late
    ends = np.arange(pulse.size) % pulses.samples >= 0.75 * pulses.samples
    assert sweep.peak == pytest.approx(max(np.max(response), 1.0 - np.min(response)), rel=1e-4)
    assert sweep.left == pytest.approx(np.max(np.abs(response - pulse)[ends]), rel=1e-3, abs=1e-5)
    assert sweep.rate == pytest.approx(0.5 * schedule.points[-1] * 2.0 * np.pi * frequency)


def test_a_sweep_that_is_too_fast_does_not_keep_the_judgement():
    schedule, (_, swing, values) = tune_knee(), read_knee()
    pulses = _choose_pulses(schedule, swing, values)
    fast = _run_sweep(Shared((schedule, "swing", swing, values, pulses)), 15.0)
    assert fast.fault and find_fastest([fast]) == 0.0


def test_a_gate_that_gives_its_sensor_up_is_named_in_sweeps_and_pushes():
    schedule, (_, swing, values) = tune_knee(), read_knee()
    gate = PlausibilityGate(range_N=(-4e3, 4e3), max_step_N=1e-6, max_held=1, ramp_per_s=90.0)
    gated = replace(schedule, controllers=tuple(replace(each, gate=gate) for each in schedule.controllers))
    (sweep,) = sweep_schedule(gated, "swing", swing, values)
    motion = move_schedule(gated, "swing", swing, values, 1.0)
    assert "gate gives its sensor up" in sweep.fault and "gate gives its sensor up" in motion.lost
    assert "is not reached: a larger push is lost: the gate" in describe_motion(motion, "phi", "rad/s")


def test_a_parameter_that_moves_has_no_rate_of_its_own():
    stand, _, _ = read_knee()
    assert list(make_swept_plant(stand, "phi").states) == ["q", "v"]
    assert list(make_swept_plant(so.plants.high_impedance(), "k").states) == list(so.plants.high_impedance().states)
