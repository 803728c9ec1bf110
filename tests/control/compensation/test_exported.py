"""Compensation of friction in exported C, compiled strictly, against the law in Python and against a formula."""

from __future__ import annotations

import ctypes
import json
import subprocess
from dataclasses import replace

import numpy as np
import pytest

import seaopt as so
from seaopt.control import CompensateFriction, Controller, SampledLoop, add_compensation, run_loop, runnable
from seaopt.control.deploy.export import export
from seaopt.files import to_json
from tests.c_code import STRICT

STAND, PARAMETERS = so.plants.high_impedance(), so.plants.thor().update(f_c=100.0)
NAN = float("nan")


@pytest.fixture(scope="module")
def plain():
    return so.tune(STAND, PARAMETERS, so.ControllerSpec(bandwidth_hz=20, max_sensitivity=1.6, current_limit_A=9.0))


class Law(ctypes.Structure):
    _fields_ = (
        ("x", ctypes.c_double * 2), ("current_A", ctypes.c_double), ("held", ctypes.c_ulong), ("status", ctypes.c_int),
        ("friction_last", ctypes.c_double), ("friction_known", ctypes.c_int),
    )  # fmt: skip


def compile_law(controller, compiler, folder):
    export(controller, folder, name="law")
    command = [*compiler, *STRICT, "-shared", "-fPIC", str(folder / "law.c"), "-o", str(folder / "law.so")]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    library = ctypes.CDLL(str(folder / "law.so"))
    library.law_step.argtypes = [ctypes.POINTER(Law)] + [ctypes.c_double] * (2 + len(controller.compensation.reads))
    library.law_step.restype = ctypes.c_double
    return library


@pytest.mark.parametrize("source", ["reference", "speed"])
def test_compiled_c_commands_what_the_simulation_did(plain, compiler, tmp_path, source):
    controller = add_compensation(plain, friction=CompensateFriction(fraction=0.9, source=source, speed=0.004))
    stored = json.loads(to_json(controller.to_dict()))
    assert Controller.from_dict(stored, STAND, PARAMETERS).compensation == controller.compensation
    library = compile_law(controller, compiler, tmp_path)
    rng = np.random.default_rng(1)
    reference = 300.0 * np.cumsum(rng.normal(size=400)) / 10.0
    loop = SampledLoop(plant=STAND, law=runnable(controller), measured="F1", delay_samples=0)
    run = run_loop(loop, [PARAMETERS], reference)
    state, inner, law = runnable(controller).reset(), runnable(controller), Law()
    library.law_init(ctypes.byref(law))
    for k in range(400):
        read = [float(run.outputs["q"][0, k])] if source == "speed" else []
        measured = float(run.outputs["F1"][0, k])
        current, state = inner.step(state, float(reference[k]), measured, read)
        assert current == pytest.approx(float(run.current[0, k]), rel=1e-8, abs=1e-8)
        assert library.law_step(ctypes.byref(law), reference[k], measured, *read) == pytest.approx(current, abs=1e-11)


def test_added_effort_is_a_share_of_coulomb_friction(plain):
    controller = add_compensation(plain, friction=CompensateFriction(fraction=0.9, source="speed", speed=0.004))
    inner, without = runnable(controller), runnable(plain)
    state = inner.reset()
    _, state = inner.step(state, 0.0, 0.0, [0.3])
    moved, _ = inner.step(state, 0.0, 0.0, [0.3 + 1e-6])  # 1 mm/s of 4 mm/s
    fast, _ = inner.step(state, 0.0, 0.0, [0.3 - 1e-4])
    assert without.step(without.reset(), 0.0, 0.0)[0] == 0.0
    assert moved / inner.per_effort == pytest.approx(0.9 * 100.0 / 4.0, rel=1e-6)
    assert fast / inner.per_effort == pytest.approx(-0.9 * 100.0, rel=1e-6)


def test_a_reading_that_is_not_a_number_is_not_used(plain, compiler, tmp_path):
    controller = add_compensation(plain, friction=CompensateFriction(source="speed", speed=0.004))
    library, law, inner = compile_law(controller, compiler, tmp_path), Law(), runnable(controller)
    library.law_init(ctypes.byref(law))
    state = inner.reset()
    for position in (0.1, 0.100002, NAN, float("inf"), 0.100003):
        current, state = inner.step(state, 5.0, 1.0, [position])
        assert library.law_step(ctypes.byref(law), 5.0, 1.0, position) == pytest.approx(current, abs=1e-12)
        assert law.held == state.held == {0.1: 0, 0.100002: 0, 0.100003: 0}.get(position, law.held)


def test_compiled_and_interpreted_simulations_agree(plain, monkeypatch):
    from seaopt.control.running import loop_kernel

    controller = add_compensation(plain, friction=CompensateFriction(source="speed", speed=0.004))
    loop = SampledLoop(plant=STAND, law=runnable(controller), measured="F1", delay_samples=1)
    reference = 200.0 * np.sin(0.05 * np.arange(200))
    compiled = run_loop(loop, [PARAMETERS], reference)
    known = loop_kernel._kernel
    monkeypatch.setattr(loop_kernel, "_kernel", lambda *given: (*known(*given)[:2], None))
    interpreted = run_loop(loop, [PARAMETERS], reference)
    assert np.allclose(interpreted.current, compiled.current, rtol=1e-9, atol=1e-9)


def test_a_law_that_gets_too_few_readings_says_which(plain):
    controller = add_compensation(plain, friction=CompensateFriction(source="speed", speed=0.004))
    inner = runnable(controller)
    with pytest.raises(so.SeaoptError, match=r"reads q, and got 0"):
        inner.step(inner.reset(), 0.0, 0.0)


def test_reference_of_an_outer_loop_is_refused(plain):
    from seaopt.control import Impedance, add_impedance

    swing = so.plants.moving_output()
    outer = add_impedance(plain, swing, PARAMETERS, Impedance(stiffness=5e3, damping=500.0))
    with pytest.raises(so.SeaoptError, match='take from = "speed"'):
        add_compensation(outer, friction=CompensateFriction())
    with pytest.raises(so.SeaoptError, match="no Coulomb friction"):
        add_compensation(replace(plain, design=(STAND, so.plants.thor())), friction=CompensateFriction())
