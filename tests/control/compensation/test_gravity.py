"""Compensation of gravity: what it adds, that a link stays where it is with it, and the exported code."""

from __future__ import annotations

import ctypes
import json
import math
import subprocess

import numpy as np
import pytest

import seaopt as so
from seaopt.control import (
    CompensateFriction,
    CompensateGravity,
    Controller,
    SampledLoop,
    add_compensation,
    run_loop,
    runnable,
)
from seaopt.control.compensation.gravity import make_gravity_term
from seaopt.control.deploy.export import export
from seaopt.control.running.equilibrium import equilibrium
from seaopt.files import to_json
from tests import hanging_link
from tests.c_code import STRICT
from tests.hanging_link import HELD, KNEE

VALUES = hanging_link.VALUES.update(f_c=0.002)
WEIGHT = 4.0 * 9.81 * 0.2


@pytest.fixture(scope="module")
def plain():
    return so.tune(HELD, VALUES, so.ControllerSpec(measured="tau_s", bandwidth_hz=15, max_sensitivity=1.6))


def compensate(plain, fraction=1.0, **more):
    return add_compensation(plain, gravity=CompensateGravity(fraction=fraction), link=(KNEE, VALUES), **more)


def let_go(controller, angle, seconds=4.0):
    """Return where the link goes from rest at an angle, held there by nothing."""
    raised = VALUES.with_parameters(so.Parameter(name="theta_l", value=angle, unit="rad"))
    loop = SampledLoop(plant=KNEE, law=runnable(controller), measured="tau_s", delay_samples=1)
    rest = equilibrium(loop, [KNEE.complete(raised)])
    run = run_loop(loop, [VALUES], np.zeros(round(1000 * seconds)), start=rest.state)
    return rest, run.outputs["theta_l"][0]


def test_what_is_added_is_the_weight(plain):
    term = compensate(plain, 0.7).compensation.gravity
    angles = np.linspace(-3.1, 3.1, 50)
    assert np.allclose([term.effort(one) for one in angles], 0.7 * WEIGHT * np.sin(angles), atol=1e-5 * WEIGHT)
    assert np.allclose([term.slope(one) for one in angles], 0.7 * WEIGHT * np.cos(angles), atol=1e-3 * WEIGHT)
    swing, thor = so.plants.moving_output(), so.plants.thor()
    stand = so.tune(so.plants.high_impedance(), thor, so.ControllerSpec(bandwidth_hz=30))
    linear = add_compensation(stand, gravity=CompensateGravity(), link=(swing, thor)).compensation.gravity
    for phi in (-1.0, -0.3, 0.6):  # link 2 feels -F1
        by_hand = -4.0 * 9.81 * 0.3 * math.tan(phi) / 0.0725
        assert linear.effort(0.0725 * math.sin(phi)) == pytest.approx(by_hand, rel=1e-4)


def test_a_link_stays_where_it_is(plain):
    rest, floats = let_go(compensate(plain), 0.6)
    assert rest.reference[0] == pytest.approx(0.0, abs=1e-4 * WEIGHT)
    assert np.max(np.abs(floats - 0.6)) < 2e-3
    _, falls = let_go(plain, 0.6)
    assert abs(falls[-1] - 0.6) > 0.3
    _, slowly = let_go(compensate(plain, 0.9), 0.6)
    assert 0.0 < np.max(np.abs(slowly)) <= 0.6 + 1e-3
    assert abs(slowly[-1]) < 0.6
    _, rises = let_go(compensate(plain, 1.3), 0.6)
    assert rises[-1] > 0.65


def test_held_link_stands_where_it_is_said_to(plain):
    loop = SampledLoop(plant=HELD, law=runnable(compensate(plain)), measured="tau_s", delay_samples=1)
    assert loop.standing == ("theta_l",)
    run = run_loop(loop, [VALUES, VALUES], np.zeros(1500), standing=np.array([0.0, 0.5]))
    assert np.allclose(run.outputs["tau_s"][:, -1], [0.0, WEIGHT * math.sin(0.5)], atol=1e-2)


def test_compiled_c_commands_what_python_does(plain, compiler, tmp_path):
    controller = compensate(plain, 0.8, friction=CompensateFriction(source="speed", speed=20.0))
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
    reset = (0.4, 3.0, 0.3, 0.05)
    library.law_init(memory)
    library.law_reset(memory, *map(ctypes.c_double, (0.4, 3.0, 0.3, 0.05)))
    state = law.reset(0.4, 3.0, 0.05, readings=(0.0, 0.3))
    assert reset[2] == 0.3
    for k in range(300):
        inputs = [*rng.normal(size=2), 0.01 * k, 2.5 * rng.normal()]
        inputs[3] = math.nan if k == 100 else inputs[3]
        current, state = law.step(state, inputs[0], inputs[1], inputs[2:])
        assert library.law_step(memory, *map(ctypes.c_double, inputs)) == pytest.approx(current, abs=1e-10)


def test_a_link_that_is_held_has_no_weight(plain):
    with pytest.raises(so.SeaoptError, match="holds its link"):
        add_compensation(plain, gravity=CompensateGravity())
    free = so.plants.rotary()
    with pytest.raises(so.SeaoptError, match="rests without effort"):
        add_compensation(plain, gravity=CompensateGravity(), link=(free, VALUES))


def test_half_of_the_weight_of_a_pendulum():
    term = make_gravity_term(KNEE, VALUES, "tau_s", CompensateGravity(fraction=0.5))
    assert term.effort(0.5) == pytest.approx(0.5 * WEIGHT * math.sin(0.5))
