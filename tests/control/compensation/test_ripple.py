"""Compensation of ripple: the series, its slopes, what it removes from a plant that ripples, and the exported code."""

from __future__ import annotations

import ctypes
import json
import math
import subprocess
from dataclasses import replace
from types import SimpleNamespace

import casadi as ca
import numpy as np
import pytest

import seaopt as so
from seaopt.control import (
    CompensateFriction,
    CompensateGravity,
    CompensateRipple,
    Controller,
    SampledLoop,
    add_compensation,
    run_loop,
    runnable,
)
from seaopt.control.compensation.ripple import make_ripple_term
from seaopt.control.deploy.export import export
from seaopt.control.running.equilibrium import equilibrium
from seaopt.files import to_json
from tests.c_code import STRICT
from tests.hanging_link import HELD, KNEE, VALUES, tune_held

RIPPLE = CompensateRipple(cycles=(6, 1, 42), cos=(0.1, 0.02, 0.0), sin=(-0.05, 0.0, 0.01), fraction=1.0)


@pytest.fixture(scope="module")
def plain():
    return tune_held()


def series(asked, angle):
    """Return the command at an angle in rad, from the library's sine and cosine."""
    rows = zip(asked.cycles, asked.cos, asked.sin, strict=True)
    return asked.fraction * sum(a * np.cos(n * angle) + b * np.sin(n * angle) for n, a, b in rows)


def test_series_is_that_of_the_library(plain):
    controller = add_compensation(plain, ripple=RIPPLE)
    term, per_effort = controller.compensation.ripple, controller.command.per_effort
    for angle in np.random.default_rng(0).uniform(-60.0, 60.0, 100):
        assert per_effort * term.effort(angle) == pytest.approx(series(RIPPLE, angle), abs=2e-13)
    angles = np.linspace(0.0, 2.0 * np.pi, 20001)
    slopes = np.gradient(series(RIPPLE, angles), angles, edge_order=2) / per_effort
    low, high = term.steepest
    assert low <= slopes.min() * 0.9999 and high >= slopes.max() * 0.9999
    assert (low, high) == pytest.approx((slopes.min(), slopes.max()), rel=3e-3)
    assert term.slope(1.0) == pytest.approx(np.interp(1.0, angles, slopes), rel=1e-3)


def test_a_plant_that_ripples_follows_as_if_it_did_not(plain):
    def f(t, x, u, p):
        def command(value):
            return SimpleNamespace(**{**vars(u), "I": value})

        ripple = sum(
            a * ca.cos(n * x.theta_m) + b * ca.sin(n * x.theta_m)
            for n, a, b in zip(RIPPLE.cycles, RIPPLE.cos, RIPPLE.sin, strict=True)
        )
        return HELD.f(t, x, command(u.I - ripple), p)

    rippling = replace(HELD, name="rippling", f=f)
    reference = 8.0 * np.sin(2.0 * np.pi * 0.5 * np.arange(4000) / 1000.0)
    runs = {}
    for name, plant, controller in (
        ("smooth", HELD, plain), ("left", rippling, plain), ("met", rippling, add_compensation(plain, ripple=RIPPLE)),
    ):  # fmt: skip
        loop = SampledLoop(plant=plant, law=runnable(controller), measured="tau_s", delay_samples=1)
        runs[name] = run_loop(loop, [VALUES], reference).outputs["tau_s"][0, 500:]
    left, met = (np.sqrt(np.mean((runs[name] - runs["smooth"]) ** 2)) for name in ("left", "met"))
    assert met < 0.4 * left


def test_a_loop_rests_where_it_did(plain):
    controller = add_compensation(plain, ripple=RIPPLE)
    raised = VALUES.with_parameters(so.Parameter(name="theta_l", value=0.4, unit="rad"))
    for values in (VALUES, raised):
        loop = SampledLoop(plant=KNEE, law=runnable(controller), measured="tau_s", delay_samples=1)
        rest = equilibrium(loop, [KNEE.complete(values)])
        run = run_loop(loop, [values], np.full(300, rest.reference[0]), start=rest.state)
        assert np.ptp(run.outputs["tau_s"][0]) < 1e-6


def test_compiled_c_commands_what_python_does(plain, compiler, tmp_path):
    controller = add_compensation(
        plain, ripple=RIPPLE, gravity=CompensateGravity(fraction=0.8), link=(KNEE, VALUES.update(f_c=0.002)),
    )  # fmt: skip
    rubbing = replace(controller, design=(HELD, VALUES.update(f_c=0.002)))
    friction = add_compensation(rubbing, friction=CompensateFriction(source="speed", speed=20.0)).compensation.friction
    controller = replace(controller, compensation=replace(controller.compensation, friction=friction))
    assert controller.compensation.reads == ("theta_m", "theta_l")
    content = json.loads(to_json(controller.to_dict()))
    assert Controller.from_dict(content, HELD, VALUES).compensation == controller.compensation
    export(controller, tmp_path, name="law")
    command = [*compiler, *STRICT, "-shared", "-fPIC", str(tmp_path / "law.c"), "-o", str(tmp_path / "law.so")]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    library = ctypes.CDLL(str(tmp_path / "law.so"))
    library.law_step.restype = ctypes.c_double
    memory = ctypes.create_string_buffer(1024)
    rng, law = np.random.default_rng(2), runnable(controller)
    library.law_init(memory)
    library.law_reset(memory, *map(ctypes.c_double, (0.4, 3.0, 0.3, -7.7, 0.05)))  # gravity's reading before ripple's
    state = law.reset(0.4, 3.0, 0.05, readings=(-7.7, 0.3))
    for k in range(300):
        inputs = [*rng.normal(size=2), 30.0 * rng.normal(), 2.5 * rng.normal()]
        inputs[2] = {100: math.nan, 150: 1e300, 200: math.inf}.get(k, inputs[2])
        current, state = law.step(state, inputs[0], inputs[1], inputs[2:])
        assert library.law_step(memory, *map(ctypes.c_double, inputs)) == pytest.approx(current, abs=1e-10)


def test_reset_continues_from_the_command(plain):
    law = runnable(add_compensation(plain, ripple=RIPPLE))
    current, _ = law.step(law.reset(0.0, 0.0, 0.3, readings=[1.3]), 0.0, 0.0, [1.3])
    assert current == pytest.approx(0.3, abs=1e-12)


@pytest.mark.parametrize(
    ("asked", "named"),
    [
        ({"cycles": (6,), "cos": (0.1, 0.2), "sin": (0.0,)}, "one of each per harmonic"),
        ({"cycles": (0,), "cos": (0.1,), "sin": (0.0,)}, "whole number"),
        ({"cycles": (6, 6), "cos": (0.1, 0.1), "sin": (0.0, 0.0)}, "twice"),
        ({"cycles": (6,), "cos": (0.0,), "sin": (0.0,)}, "all zero"),
        ({"cycles": (6,), "cos": (0.1,), "sin": (0.0,), "fraction": 2.0}, "fraction = 0.9"),
        ({"cycles": (6,), "cos": (math.nan,), "sin": (0.0,)}, "cos"),
    ],
)
def test_what_cannot_be_compensated_is_named(asked, named):
    with pytest.raises(so.SeaoptError, match=named):
        CompensateRipple(**asked)


def test_position_in_metres_wants_a_period():
    stand = so.plants.high_impedance()
    with pytest.raises(so.SeaoptError, match="period"):
        make_ripple_term(stand, 1.0, RIPPLE)
    term = make_ripple_term(stand, 1.0, replace(RIPPLE, period=0.002))
    assert term.effort(0.0003) == pytest.approx(term.effort(0.0023))
