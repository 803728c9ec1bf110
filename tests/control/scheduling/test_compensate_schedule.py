"""What a schedule compensates: against equations of the test's own, a leg that is simulated here, and the C code."""

from __future__ import annotations

import ctypes
import json
import math
import subprocess
from dataclasses import replace

import numpy as np
import pytest
from numpy.polynomial.chebyshev import chebval

import seaopt as so
from seaopt.control import (
    CompensateFriction,
    CompensateGravity,
    CompensateRipple,
    Impedance,
    ScheduledController,
    add_impedance,
    compensate_schedule,
    export,
    tune_schedule,
)
from seaopt.errors import ControlError
from seaopt.files import to_json
from tests.c_code import STRICT, CompiledSchedule

N, K_TAU, ETA, J_M, B_R, F_C, V_S, K_S, J_L, D_L, L, G = (
    100.0, 0.0369, 0.7, 1.5e-5, 4e-4, 0.002, 1.0, 280.0, 0.2, 0.1, 0.2, 9.81
)  # fmt: skip
TS, LOADS = 1e-3, (2.0, 5.0, 8.0)


@pytest.fixture(scope="module")
def leg():
    """Return the locked and the swinging leg, and their parameters."""
    named = {
        "N": N, "K_tau": K_TAU, "eta": ETA, "J_m": J_M, "b_r": B_R, "f_c": F_C, "v_s": V_S, "k_s": K_S, "J_l": J_L,
        "d_l": D_L, "L": L, "m": 4.0,
    }  # fmt: skip
    stand, swing = so.plants.rotary(link="locked"), so.plants.rotary(link="pendulum")
    return stand, swing, swing.defaults.update(**named)


@pytest.fixture(scope="module")
def plain(leg):
    """Return a schedule over the load, tuned on the locked leg."""
    stand, swing, values = leg
    spec = so.ControllerSpec(
        measured="tau_s", bandwidth_hz=15, max_sensitivity=1.6, max_noise_gain=45, reserve=0.03, current_limit_A=9.0
    )
    return tune_schedule(stand, values, spec, "m", LOADS, {"swing": swing})


@pytest.fixture(scope="module")
def schedule(plain, leg):
    """Return it with friction, the weight of the load and cogging compensated."""
    _, swing, values = leg
    return compensate_schedule(
        plain,
        friction=CompensateFriction(fraction=0.4, source="speed", speed=5.0),
        gravity=CompensateGravity(fraction=0.95),
        ripple=CompensateRipple(cycles=(6,), cos=(0.05,), sin=(-0.02,), fraction=1.0),
        link=(swing, values),
    )


def test_the_terms_are_those_of_the_load_at_its_place(schedule, plain):
    """The weight of each load is on a line between the points: it is in proportion to the load, as m g L sin is."""
    angles = np.linspace(-3.0, 3.0, 41)
    for load in (2.0, 3.3, 6.0, 8.0):
        term = schedule.at(load).compensation.gravity
        expected = 0.95 * load * G * L * np.sin(angles)
        np.testing.assert_allclose([term.effort(x) for x in angles], expected, atol=2e-5 * load * G * L)
    bare, full, rng = plain.runnable(limit=np.inf), schedule.runnable(limit=np.inf), np.random.default_rng(5)
    terms = [each.compensation.gravity.coefficients for each in schedule.controllers]
    one, other, before = bare.reset(place=2.0, command=-0.05), full.reset(place=2.0), None
    friction = 0.4 * N * F_C
    for k in range(600):
        load, (r, y) = 5.0 - 3.0 * math.cos(k / 90.0), 0.1 * rng.normal(size=2)
        motor, link = 0.7 * math.sin(k / 40.0), 0.7 * math.sin(k / 70.0)
        low = 0 if load < 5.0 else 1
        t = (load - LOADS[low]) / 3.0
        series = (1 - t) * np.array(terms[low]) + t * np.array(terms[low + 1])
        weight = chebval(np.clip(link / math.pi, -1, 1), series)
        rubbed = 0.0 if before is None else friction * np.clip((motor - before) / TS / 5.0, -1, 1)
        cogging = 0.05 * math.cos(6 * motor) - 0.02 * math.sin(6 * motor)
        expected, one = bare.step(one, r + weight, y, load)
        got, other = full.step(other, r, y, load, [motor, link])
        assert got == pytest.approx(expected + bare.per_effort * rubbed + cogging, abs=1e-9)
        before = motor


def move_leg(x, current, load):
    """Return the rates of theta_m, its rate, theta_l and its rate."""
    torque = K_S * (x[0] / N - x[2])
    rubs = B_R * x[1] + F_C * math.tanh(x[1] / V_S)
    push = (K_TAU * ETA * current - rubs - torque / N) / J_M
    return np.array([x[1], push, x[3], (torque - D_L * x[3] - load * G * L * math.sin(x[2])) / J_L])


def step_leg(x, current, load):
    """Return the leg a sample later, by Runge-Kutta's method in steps of a tenth of it."""
    h = TS / 10
    for _ in range(10):
        a = move_leg(x, current, load)
        b = move_leg(x + h / 2 * a, current, load)
        c = move_leg(x + h / 2 * b, current, load)
        x = x + h / 6 * (a + 2 * b + 2 * c + move_leg(x + h * c, current, load))
    return x


def swing_leg(law, start, loads):
    """Return the link's angle under a law that is asked for no torque."""
    weight = loads[0] * G * L * math.sin(start)
    x = np.array([N * (start + weight / K_S), 0.0, start, 0.0])
    command, reads = weight / (N * K_TAU * ETA), () if law.compensation is None else law.compensation.reads
    further = [{"theta_l": start}[name] for name in reads]
    state, angles = law.reset(0.0 if further else weight, weight, loads[0], command, readings=further), []
    for load in loads:
        torque, waiting = K_S * (x[0] / N - x[2]), command
        command, state = law.step(state, 0.0, torque, load, [{"theta_l": x[2]}[name] for name in reads])
        x = step_leg(x, waiting, load)
        angles.append(x[2])
    return np.array(angles)


def test_a_leg_whose_load_grows_stays_where_it_is(plain, leg):
    """Zero torque is asked of a leg at 0.5 rad: it falls, unless its load is carried for it, whatever that is."""
    _, swing, values = leg
    carried = compensate_schedule(plain, gravity=CompensateGravity(fraction=1.0), link=(swing, values))
    loads = np.linspace(2.0, 8.0, 1500)
    falls, stays = (swing_leg(each.runnable(), 0.5, loads) for each in (plain, carried))
    assert np.max(np.abs(stays - 0.5)) < 0.12 < 0.4 < np.max(np.abs(falls - 0.5))


@pytest.mark.parametrize(("precision", "share"), [("double", 0.0), ("float", 5e-3)])
def test_in_c_every_command_is_pythons(schedule, precision, share, compiler, tmp_path):
    law, compiled, rng = (
        schedule.runnable(),
        CompiledSchedule(compiler, tmp_path, schedule, precision),
        np.random.default_rng(2),
    )
    n = 3000
    references, readings = 5.0 * rng.normal(size=n), rng.normal(size=n)
    references[900:1200] += 60.0
    loads = 5.0 + 4.0 * np.sin(np.arange(n) / 200.0)
    motor, link = 40.0 * np.sin(np.arange(n) / 300.0), 3.5 * np.cos(np.arange(n) / 500.0)
    loads[300:320], references[50], readings[60], motor[70], link[80:84] = np.nan, np.nan, np.inf, np.nan, np.inf
    start = 0.5, 0.2, 4.0, 1.0
    compiled.reset(*start, further=(1.2, 0.3))
    state, pairs = law.reset(*start, readings=[1.2, 0.3]), []
    for r, y, load, *more in zip(references, readings, loads, motor, link, strict=True):
        command, state = law.step(state, r, y, load, more)
        pairs.append((compiled.step(r, y, load, further=more), command))
        assert compiled.law.held == state.held
    got, expected = np.array(pairs).T
    assert 0.02 < np.mean(np.abs(expected) == law.command_limit) < 0.7
    np.testing.assert_allclose(got, expected, rtol=0.0, atol=share * law.command_limit)


def test_a_file_of_it_reads_back_the_same(schedule):
    written = to_json(schedule.to_dict())
    again = ScheduledController.from_dict(json.loads(written), *schedule.design, schedule.others)
    assert to_json(again.to_dict()) == written


def test_what_differs_in_more_than_coefficients_is_refused(schedule, leg):
    first, *others = schedule.controllers
    term = replace(first.compensation.gravity, high=2.0)
    changed = replace(first, compensation=replace(first.compensation, gravity=term))
    with pytest.raises(ControlError, match="at m = 5 compensates with other terms"):
        _ = replace(schedule, controllers=(changed, *others)).table


@pytest.mark.slow
def test_it_is_certified_at_its_places_with_what_it_compensates(schedule, leg):
    """Rows of the terms at every value, the eigenvalue of the weight below 1; more than there is, is not met."""
    stand, swing, values = leg
    options = {"samples": 9, "ranges": {"J_l": (0.19, 0.21)}, "simulations": False}
    for fraction, met in ((0.9, True), (1.4, False)):
        heavy = compensate_schedule(schedule, gravity=CompensateGravity(fraction=fraction), link=(swing, values))
        certificate = so.certify(heavy, {"stand": stand, "swing": swing}, values, **options)
        rows = [row for row in certificate.requirements if row.name == "gravity_compensation"]
        assert len(rows) == len(certificate.places) and all(row.met for row in rows) == met


def test_a_scheduled_leg_stands_where_a_stiffness_holds_its_load(plain, leg, compiler, tmp_path):
    """At rest K (x_0 - x) = m g L sin x, for every load on the way; the outer loop in C is that of its equations."""
    _, swing, values = leg
    stiffness, damping, filter_s, target = 60.0, 4.0, 0.005, 0.6
    impedance = Impedance(stiffness=stiffness, damping=damping, velocity_filter_s=filter_s)
    laws = [add_impedance(each, swing, values, impedance, name="swing") for each in plain.controllers]
    stiff = replace(plain, controllers=tuple(laws))
    export(stiff, tmp_path, name="law")
    run, begin = load_outer(compiler, tmp_path)
    law = stiff.runnable()
    loads = np.concatenate([np.full(1000, 2.0), np.linspace(2.0, 8.0, 3000), np.full(1000, 8.0)])
    x, state, command, speed, before, angles = np.zeros(4), law.reset(place=2.0), 0.0, 0.0, 0.0, []
    begin()
    for load in loads:
        speed, before = (filter_s * speed + (x[2] - before)) / (filter_s + TS), x[2]
        asked = stiffness * (target - x[2]) - damping * speed
        assert run(target, x[2]) == pytest.approx(asked, rel=1e-9, abs=1e-9)
        torque, waiting = K_S * (x[0] / N - x[2]), command
        command, state = law.step(state, asked, torque, load)
        x = step_leg(x, waiting, load)
        angles.append(x[2])
    slow, weights = np.array(angles)[1500:4000:50], loads[1500:4000:50] * G * L
    np.testing.assert_allclose(stiffness * (target - slow), weights * np.sin(slow), atol=0.5)
    assert abs(stiffness * (target - angles[-1]) - 8.0 * G * L * math.sin(angles[-1])) < N * F_C


def load_outer(compiler, folder):
    """Return the outer loop and the reset of exported code."""
    code = folder / "wrap.c"
    code.write_text(
        '#include "law.h"\nstatic law_law law;\nvoid begin(void) { law_init(&law); }\n'
        "double outer(double wanted, double position) { return law_outer(&law, wanted, position); }\n"
    )
    flags = [*STRICT, "-O1", "-shared", "-fPIC", str(folder / "law.c"), str(code), "-o", str(folder / "outer.so")]
    subprocess.run([*compiler, *flags], check=True)
    library = ctypes.CDLL(str(folder / "outer.so"))
    library.outer.argtypes, library.outer.restype = [ctypes.c_double] * 2, ctypes.c_double
    return library.outer, library.begin


def test_a_schedule_whose_points_render_different_impedances_is_refused(plain, leg):
    _, swing, values = leg
    pairs = zip(plain.controllers, (2.0, 3.0, 3.0), strict=True)
    laws = [add_impedance(each, swing, values, Impedance(stiffness=60.0, damping=d)) for each, d in pairs]
    with pytest.raises(ControlError, match="another impedance than that at 2"):
        _ = replace(plain, controllers=tuple(laws)).table
