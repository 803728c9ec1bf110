"""A law that keeps its winding cool: C and Python against the equations of heat, written again here."""

import ctypes
import json
import subprocess

import numpy as np
import pytest

import seaopt as so
from seaopt.codec import from_content
from seaopt.control.deploy.export import export, read_guard
from seaopt.control.deploy.target import hash_law
from seaopt.control.laws.plausibility import PlausibilityGate
from seaopt.control.laws.realisation import runnable
from seaopt.errors import ControlError, FileError
from seaopt.files import plain, to_json
from seaopt.plants.motor.heat_guard import HeatGuard
from tests.c_code import STRICT

PERIOD = 0.001
HEAT = {"R": 0.7, "R_wc": 1.3, "R_ca": 3.1, "C_w": 0.2, "C_c": 1.5, "T_ambient": 21.0, "T_max": 120.0}
ALPHA, LIMIT_A = 0.00393, 12.0


@pytest.fixture(scope="module")
def controller():
    plant = so.plants.rotary(link="locked", parts=["thermal"])
    spec = so.ControllerSpec(measured="tau_s", bandwidth_hz=15, current_limit_A=LIMIT_A)
    return so.tune(plant, plant.defaults.update(**HEAT), spec)


def slopes(winding, case, current):
    loss = HEAT["R"] * (1 + ALPHA * (HEAT["T_ambient"] + winding - 25)) * current**2
    flow = (winding - case) / HEAT["R_wc"]
    return (loss - flow) / HEAT["C_w"], (flow - case / HEAT["R_ca"]) / HEAT["C_c"]


def warm(currents):
    """Return the winding's temperature after each sample of held currents, from cold: four of Heun's steps each."""
    winding, case, out, h = 0.0, 0.0, [], PERIOD / 4
    for current in currents:
        for _ in range(4):
            first = slopes(winding, case, current)
            second = slopes(winding + h * first[0], case + h * first[1], current)
            winding, case = winding + 0.5 * h * (first[0] + second[0]), case + 0.5 * h * (first[1] + second[1])
        out.append(HEAT["T_ambient"] + winding)
    return np.array(out)


def continuous_current():
    """Return the current whose loss, through both resistances, holds the winding at its largest temperature."""
    rise = HEAT["T_max"] - HEAT["T_ambient"]
    hot = HEAT["R"] * (1 + ALPHA * (HEAT["T_max"] - 25))
    return np.sqrt(rise / (HEAT["R_wc"] + HEAT["R_ca"]) / hot)


def run_law(law, samples, reference, measurement=0.0):
    state, commands, rises = law.reset(), [], []
    for _ in range(samples):
        command, state = law.step(state, reference, measurement)
        commands.append(command)
        rises.append(state.heat[0])
    return np.array(commands), np.array(rises)


def compile_law(compiler, controller, folder, precision="double", gated=False, derate=True, **options):
    """Return the step of an exported law as a function, and its struct."""
    export(controller, folder, name="law", precision=precision, derate=derate, **options)
    library = folder / "law.so"
    command = [*compiler, *STRICT, "-O2", "-shared", "-fPIC", str(folder / "law.c"), "-o", str(library)]
    subprocess.run(command, check=True)
    real = ctypes.c_double if precision == "double" else ctypes.c_float
    gate = [("refused", ctypes.c_ulong), ("measurement_Nm", real), ("known", ctypes.c_int)] if gated else []

    class Law(ctypes.Structure):
        _fields_ = [
            ("x", real * controller.law.c.size), ("current_A", real), ("held", ctypes.c_ulong),
            ("status", ctypes.c_int), ("rise_winding", ctypes.c_double), ("rise_case", ctypes.c_double),
            ("limit", ctypes.c_double), ("derated", ctypes.c_int), *gate,
        ]  # fmt: skip

    law, code = Law(), ctypes.CDLL(str(library))
    code.law_step.argtypes = [ctypes.POINTER(Law), real, real]
    code.law_step.restype = real
    code.law_reset.argtypes = [ctypes.POINTER(Law), real, real, real]
    code.law_init(ctypes.byref(law))
    return lambda *readings: code.law_step(ctypes.byref(law), *readings), law, code


@pytest.mark.slow
def test_under_full_command_for_ever_the_winding_stays_at_its_largest_temperature(controller):
    law = runnable(controller, heat=controller.heat_guard)
    commands, rises = run_law(law, 40_000, 1e6)  # six of the longer time constant
    temperature = warm(commands)
    assert commands[0] == LIMIT_A  # cold: all of it
    assert np.max(temperature) <= HEAT["T_max"]
    assert temperature[-1] == pytest.approx(HEAT["T_max"], abs=0.05)
    ahead = HEAT["T_ambient"] + rises - temperature  # never below, though a sample warms by half a K
    assert -1e-6 <= np.min(ahead) <= np.max(ahead) < 0.1
    assert commands[-1] == pytest.approx(continuous_current(), rel=2e-3)
    hot = np.flatnonzero(temperature > HEAT["T_max"] - 5.0)[0]
    assert np.all(np.diff(commands[hot:]) <= 1e-12)  # once hot, the limit only falls
    assert warm(np.full(1000, LIMIT_A))[-1] > 200.0  # unguarded


def test_without_heat_nothing_is_reduced(controller):
    plain_law, law = runnable(controller), runnable(controller, heat=controller.heat_guard)
    references = 20.0 * np.sin(0.05 * np.arange(300))
    before, _ = plain_law.run(references, 0.9 * references)
    after, _ = law.run(references, 0.9 * references)
    np.testing.assert_array_equal(before, after)


@pytest.mark.parametrize("precision", ["double", "float"])
def test_the_exported_code_does_the_same(controller, compiler, tmp_path, precision):
    step, struct, code = compile_law(compiler, controller, tmp_path, precision)
    law = runnable(controller, heat=controller.heat_guard)
    expected, rises = run_law(law, 8_000, 1e4)
    commands, winding = [], []
    for _ in range(8_000):
        commands.append(step(1e4, 0.0))
        winding.append(struct.rise_winding)
    tolerance = 1e-12 if precision == "double" else 1e-5
    assert np.array(commands) == pytest.approx(expected, rel=tolerance)
    assert np.array(winding) == pytest.approx(rises, rel=tolerance * 10)
    assert np.max(warm(commands)) <= HEAT["T_max"] + (0.0 if precision == "double" else 1e-3)
    assert struct.derated == 1
    assert struct.limit < LIMIT_A
    heat = struct.rise_winding
    code.law_reset(ctypes.byref(struct), 0.0, 0.0, LIMIT_A)  # a reset cools nothing, and keeps to the limit
    assert struct.rise_winding == heat
    assert struct.current_A <= struct.limit * (1 + 1e-6)
    header = (tmp_path / "law.h").read_text()
    assert "120 degC" in header
    assert "21 degC" in header


def test_held_readings_and_faults_heat_and_are_limited_too(controller, compiler, tmp_path):
    gate = PlausibilityGate(range_N=(-1e3, 1e3), max_step_N=10.0, max_held=3, ramp_per_s=20.0)
    law = runnable(controller, heat=controller.heat_guard, gate=gate)
    step, struct, _ = compile_law(compiler, controller, tmp_path, gated=True, gate=gate)
    state = law.reset()
    readings = [0.0] * 1500 + [float("nan")] * 2 + [0.0] * 5 + [1e9] * 700
    for reading in readings:
        command, state = law.step(state, 1e4, reading)
        assert step(1e4, reading) == pytest.approx(command, rel=1e-12, abs=1e-12)
        assert struct.rise_winding == pytest.approx(state.heat[0], rel=1e-10)
    assert state.status == "fault"
    assert command == 0.0


def test_the_file_has_what_the_code_needs(controller, tmp_path):
    content = json.loads(json.dumps(plain(controller.to_dict())))
    assert content["heat"]["continuous_A"] == pytest.approx(continuous_current(), rel=1e-12)
    assert content["heat"]["hottest"] == 120.0
    assert content["heat"]["peak_A"] <= LIMIT_A  # what can be commanded
    assert controller.rating.peak_A(1e-3) == LIMIT_A
    for folder, source in (("a", controller), ("b", content)):
        export(source, tmp_path / folder, name="law", derate=True)
    code = [(tmp_path / folder / "law.c").read_text() for folder in "ab"]
    assert code[0] == code[1]
    assert from_content(HeatGuard, content["heat"]["guard"], "heat.guard", remedy="") == controller.heat_guard
    assert f"({continuous_current():.4g} A)" in repr(controller)
    for change in ({"ambient": 80.0}, {"winding": 0.4}, {"to_air": 1.0}):  # of the network, which the guard then is not
        with pytest.raises(FileError, match=r"heat\.guard"):
            export(content | {"heat": content["heat"] | change}, tmp_path / "c", derate=True)
    for change in ({"winding": 0.0}, {"case": "?"}):
        with pytest.raises(FileError, match=next(iter(change))):
            export(content | {"heat": content["heat"] | change}, tmp_path / "c", derate=True)
    content["heat"]["guard"]["b_1"] = None
    with pytest.raises(FileError, match="b_1"):
        export(content, tmp_path / "c", derate=True)


def test_the_hash_from_memory_is_that_from_the_file(controller):
    again = so.Controller.from_dict(json.loads(to_json(controller.to_dict())), *controller.design)
    derated = hash_law(runnable(controller, heat=controller.heat_guard))
    assert hash_law(runnable(again, heat=again.heat_guard)) == derated != hash_law(runnable(controller))


def test_what_cannot_be_derated_is_one_line(controller, tmp_path):
    cold = so.plants.rotary(link="locked")
    spec = so.ControllerSpec(measured="tau_s", bandwidth_hz=15)
    with pytest.raises(ControlError, match="thermal"):
        export(so.tune(cold, cold.defaults, spec), tmp_path, derate=True)
    driven = so.plants.rotary(link="locked", parts=["thermal", "duty_input"])
    tuned = so.tune(driven, driven.defaults, spec)
    assert tuned.rating is not None
    assert tuned.heat_guard is None
    with pytest.raises(ControlError, match="current"):
        export(tuned, tmp_path, derate=True)
    for options, said in (({"approach_s": 0.0}, "approach_s"), ({"margin_K": 200.0}, "margin_K")):
        with pytest.raises(ControlError, match=said):
            HeatGuard.of_rating(controller.rating, PERIOD, **options)


def test_a_margin_keeps_the_winding_cooler(controller):
    guard = HeatGuard.of_rating(controller.rating, PERIOD, margin_K=20.0)
    commands, _ = run_law(runnable(controller, heat=guard), 8_000, 1e6)
    assert np.max(warm(commands)) <= HEAT["T_max"] - 20.0


def test_the_code_takes_a_guard_with_a_margin(controller, compiler, tmp_path):
    guard = read_guard(json.loads(json.dumps(plain(controller.to_dict()))), margin_K=20.0)
    assert guard == HeatGuard.of_rating(controller.rating, PERIOD, margin_K=20.0)
    step, _, _ = compile_law(compiler, controller, tmp_path, derate=guard)
    temperature = warm(np.array([step(1e6, 0.0) for _ in range(8_000)]))
    assert HEAT["T_max"] - 25.0 < np.max(temperature) <= HEAT["T_max"] - 20.0
    assert "100 degC" in (tmp_path / "law.h").read_text()


def test_without_a_fixed_limit_the_header_names_none(compiler, tmp_path):
    plant = so.plants.rotary(link="locked", parts=["thermal"])
    spec = so.ControllerSpec(measured="tau_s", bandwidth_hz=15)
    tuned = so.tune(plant, plant.defaults.update(**HEAT), spec)
    _, struct, _ = compile_law(compiler, tuned, tmp_path)
    header = (tmp_path / "law.h").read_text()
    assert "LIMIT_A" not in header
    assert "does not saturate" not in header
    assert struct.derated == 1
    assert struct.limit == pytest.approx(tuned.heat_guard.limit((0.0, 0.0)), rel=1e-12)
