"""The exported outer loop with its force law, compiled strictly, against NumPy."""

from __future__ import annotations

import ctypes
import json
import subprocess

import numpy as np
import pytest

import seaopt as so
from seaopt.control import Controller, Impedance, add_impedance, runnable
from seaopt.control.deploy.export import export
from seaopt.files import to_json
from tests.c_code import STRICT

SWING, THOR = so.plants.moving_output(), so.plants.thor()
NAN = float("nan")


@pytest.fixture(scope="module")
def controller(tuned):
    impedance = Impedance(stiffness=20_000.0, damping=900.0, velocity_filter_s=3e-3)
    return add_impedance(tuned, SWING, THOR, impedance, name="swing")


class Law(ctypes.Structure):
    _fields_ = (
        ("x", ctypes.c_double * 2), ("current_A", ctypes.c_double), ("held", ctypes.c_ulong), ("status", ctypes.c_int),
        ("outer_state", ctypes.c_double), ("outer_N", ctypes.c_double), ("outer_known", ctypes.c_int),
    )  # fmt: skip


@pytest.fixture(scope="module")
def compiled(controller, compiler, tmp_path_factory):
    folder = tmp_path_factory.mktemp("outer")
    export(controller, folder, name="law")
    command = [*compiler, *STRICT, "-shared", "-fPIC", str(folder / "law.c"), "-o", str(folder / "law.so")]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    library = ctypes.CDLL(str(folder / "law.so"))
    for function in (library.law_outer, library.law_step):
        function.argtypes = [ctypes.POINTER(Law), ctypes.c_double, ctypes.c_double]
        function.restype = ctypes.c_double
    return library


def test_compiled_c_is_the_outer_loop_and_the_law(controller, compiled):
    rng = np.random.default_rng(5)
    x_0, x = np.cumsum(rng.normal(size=(2, 500)), axis=1) * 1e-4
    force = 30.0 * rng.normal(size=500)
    law = Law()
    compiled.law_init(ctypes.byref(law))
    inner = runnable(controller)
    state, outer = inner.reset(), controller.outer
    speed = 0.0
    for k in range(500):
        speed = (3e-3 * speed + (x[k] - x[max(k - 1, 0)])) / 4e-3  # by hand; link 2 feels -F
        by_hand = -(20_000.0 * (x_0[k] - x[k]) - 900.0 * speed)
        if k == 0:
            place = outer.reset(float(x[0]))
        asked, place = outer.step(place, float(x_0[k]), float(x[k]))
        current, state = inner.step(state, asked, float(force[k]))
        got = compiled.law_outer(ctypes.byref(law), x_0[k], x[k])
        assert got == pytest.approx(by_hand, rel=1e-9, abs=1e-9)
        assert got == pytest.approx(asked, rel=1e-12, abs=1e-12)
        assert compiled.law_step(ctypes.byref(law), got, force[k]) == pytest.approx(current, rel=1e-10, abs=1e-12)


def test_what_is_not_a_number_is_bridged(compiled):
    law = Law()
    compiled.law_init(ctypes.byref(law))
    first = compiled.law_outer(ctypes.byref(law), 0.0, 1e-3)
    assert first == pytest.approx(20.0)
    assert compiled.law_outer(ctypes.byref(law), 0.0, NAN) == first
    assert compiled.law_outer(ctypes.byref(law), float("inf"), 1e-3) == first
    assert compiled.law_outer(ctypes.byref(law), 0.0, 1e-3) == pytest.approx(first)


def test_it_is_stored_and_read_again(controller):
    content = json.loads(to_json(controller.to_dict()))
    assert content["blocks"]["impedance"]["stiffness"] == 20_000.0
    assert content["blocks"]["impedance"]["direction"] == -1.0
    read = Controller.from_dict(content, so.plants.high_impedance(), THOR)
    assert read.outer == controller.outer
    position = content["blocks"]["impedance"].pop("position")
    with pytest.raises(so.SeaoptError, match=r"impedance\.position is missing.*tune again"):
        Controller.from_dict(content, so.plants.high_impedance(), THOR)
    content["blocks"]["impedance"] |= {"position": position, "stiffness": -1.0}
    with pytest.raises(so.SeaoptError, match=r"impedance.*stiffness"):
        Controller.from_dict(content, so.plants.high_impedance(), THOR)
