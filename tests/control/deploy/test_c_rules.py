"""What the exported C asks of compilers: refused and wanted flags, strict warnings, MISRA; and extreme numbers."""

from __future__ import annotations

import ctypes
import re
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from seaopt.control import MPCSpec, PlausibilityGate, export_mpc, force_mpc
from seaopt.control.deploy.export import export
from seaopt.control.laws.plausibility import Agreement
from seaopt.control.laws.realisation import runnable
from seaopt.control.loops.compensation.ripple_term import RippleTerm
from seaopt.control.loops.compensation.terms import Compensation, FrictionTerm, GravityTerm
from seaopt.control.loops.outer_loop import OuterLoop
from seaopt.errors import ControlError
from seaopt.plants.motor.heat_guard import HeatGuard
from tests.c_code import CONVERSIONS, STRICT, CompiledLaw, CompiledMPC
from tests.control.deploy.test_schedule_export import CompiledSchedule
from tests.schedules import tune_knee

TS = 1e-3
GATE = PlausibilityGate(range_N=(-4000.0, 4000.0), max_step_N=300.0, max_held=5, ramp_per_s=90.0)
AGREEING = replace(GATE, agreement=Agreement(reads=("q", "phi"), weights=(655e3, -4e4), limit=12.0, share=0.02))
HEAT = HeatGuard(
    a_11=0.99, a_12=0.01, a_21=0.001, a_22=0.998, b_1=0.005, b_2=0.0, resistance=0.7, slope=0.003, allowed_rise=99.0,
    share=0.01, ambient=21.0,
)  # fmt: skip
EVERYTHING = Compensation(
    sample_time_s=TS,
    friction=FrictionTerm(
        effort=4.0, speed=0.01, speed_unit="m/s", fraction=0.8, source="speed", reads="q", velocity_per_rate=1.0
    ),
    gravity=GravityTerm(coefficients=(1.0, 3.0), low=-0.5, high=0.5, reads="phi", unit="rad", fraction=1.0),
    ripple=RippleTerm(cycles=(2,), cos=(0.1,), sin=(3.0,), period=4.0, reads="q", unit="m", fraction=1.0),
)  # fmt: skip
FINITE = [0.0, -0.0, 5e-324, -5e-324, 1e-308, -2e-308, 1.0000001e15, -1e16, 1e154, -1e300, 1.7e308, -1.7e308]
EXTREME = [*FINITE, np.nan, np.inf, -np.inf]
DEVIATIONS = {"2.4", "2.5", "8.7", "8.9", "14.1", "15.5"}  # docs/howto/on_the_target.md has the reasons


@pytest.fixture(scope="module")
def mpc(stand, thor):
    return force_mpc(stand, thor, MPCSpec(current_limit_A=9.0))


@pytest.fixture(scope="module")
def sources(tuned, mpc, tmp_path_factory):
    """Return folders of all that is exported, in double and in float."""
    folder = tmp_path_factory.mktemp("exported")
    outer = OuterLoop(
        stiffness=2e4, damping=900.0, velocity_filter_s=3e-3, direction=-1.0, sample_time_s=TS, place_unit="m"
    )
    whole = replace(tuned, design=None, compensation=EVERYTHING, outer=outer)
    for precision in ("double", "float"):
        at = folder / precision
        export(tuned, at / "plain", name="law", precision=precision)
        export(tuned, at / "gated", name="law", precision=precision, gate=GATE)
        export(whole, at / "whole", name="law", precision=precision, gate=AGREEING, derate=HEAT)
        export_mpc(mpc, at / "mpc", single_precision=precision == "float")
    return folder


def compile_file(compiler, path, *flags):
    command = [*compiler, *flags, "-c", str(path), "-o", str(path.with_suffix(".o"))]
    return subprocess.run(command, capture_output=True, text=True, check=False)


FILES = ["plain/law.c", "mpc/force_mpc.c", "mpc/active_set.c"]
LAWS = ["plain", "gated", "whole"]


@pytest.mark.parametrize("flag", ["-ffast-math", "-ffinite-math-only"])
@pytest.mark.parametrize("file", FILES)
def test_flags_that_take_out_the_check_for_numbers_are_refused(file, flag, compiler, sources):
    done = compile_file(compiler, sources / "double" / file, "-O2", flag)
    assert done.returncode != 0
    assert "compile without -ffast-math and -ffinite-math-only" in done.stderr


@pytest.mark.parametrize("file", FILES)
@pytest.mark.parametrize("name", ["gcc", "clang"])
def test_with_the_flag_of_the_header_nothing_is_fused(name, file, sources):
    """In the assembly of a core that can; gcc fuses without the flag, clang obeys the pragma in the file."""
    if shutil.which(name) is None:
        pytest.skip(f"no {name} on this machine")
    path = sources / "double" / file
    made = path.with_suffix(".s")

    def count_fused(*flags):
        command = [name, "-std=gnu99", "-O2", "-mfma", *flags, "-S", str(path), "-o", str(made)]
        if subprocess.run(command, capture_output=True, check=False).returncode:
            pytest.skip("this compiler is of another core")
        return len(re.findall(r"\bvfn?m(?:add|sub)\d", made.read_text()))  # vfmsubadd: gcc 12 leaves one in any case

    assert count_fused("-ffp-contract=off") == 0
    assert (count_fused() > 0) == (name == "gcc")
    headers = "".join(header.read_text() for header in path.parent.glob("*.h"))
    assert "-ffp-contract=off" in headers


@pytest.mark.parametrize("file", LAWS)
@pytest.mark.parametrize("precision", ["double", "float"])
def test_no_conversion_is_implicit(precision, file, compiler, sources):
    done = compile_file(compiler, sources / precision / file / "law.c", *STRICT, *CONVERSIONS)
    assert done.returncode == 0, done.stderr


def check_misra(folder):
    if shutil.which("cppcheck") is None:
        pytest.skip("no cppcheck on this machine")
    command = ["cppcheck", "--addon=misra", "--std=c99", "--enable=style", "law.c"]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    broken = set(re.findall(r"misra-c2012-([\d.]+)", done.stderr))
    if not broken:
        pytest.skip("this cppcheck has no misra addon")
    assert broken <= DEVIATIONS, done.stderr


@pytest.mark.slow
@pytest.mark.parametrize("file", LAWS)
def test_misra_deviations_are_those_that_the_documentation_lists(file, sources):
    check_misra(sources / "double" / file)


@pytest.mark.slow
@pytest.mark.parametrize("precision", ["double", "float"])
def test_a_schedule_keeps_the_same_rules(precision, compiler, tmp_path):
    export(tune_knee(), tmp_path, name="law", precision=precision)
    done = compile_file(compiler, tmp_path / "law.c", *STRICT, *CONVERSIONS)
    assert done.returncode == 0, done.stderr
    done = compile_file(compiler, tmp_path / "law.c", "-ffinite-math-only")
    assert "compile without -ffast-math and -ffinite-math-only" in done.stderr
    check_misra(tmp_path)


def test_documentation_lists_the_deviations():
    text = Path("docs/howto/on_the_target.md").read_text(encoding="utf-8")
    assert set(re.findall(r"^\| (\d+\.\d+) \|", text, flags=re.MULTILINE)) == DEVIATIONS


def mix(seed, extremes, samples=400):
    """Return three columns of ordinary numbers with extreme ones among them."""
    rng = np.random.default_rng(seed)
    values = rng.normal(size=(samples, 3)) * [300.0, 300.0, 0.5]
    struck = rng.random(values.shape) < 0.15
    values[struck] = rng.choice(extremes, size=np.count_nonzero(struck))
    values[-100:] = [100.0, 90.0, 0.3]
    return values


@pytest.mark.parametrize("gate", [None, GATE])
def test_c_takes_extreme_numbers_as_python_does(gate, compiler, tuned, tmp_path):
    compiled, law = CompiledLaw(compiler, tmp_path, tuned, "double", gate=gate), runnable(tuned, gate=gate)
    rng = np.random.default_rng(2)
    for seed in range(8):
        state = law.reset()
        compiled.init()
        for reference, reading, current in mix(seed, EXTREME):
            if rng.random() < 0.05:
                compiled.reset(reference, reading, current)
                try:
                    state = law.reset(reference, reading, current)
                except ControlError:  # where C takes zero, or the limit, in place of what Python refuses
                    usable = [value if abs(value) <= 1e15 else 0.0 for value in (reference, reading, current)]
                    reset = replace(law, gate=None).reset(*usable[:2], float(np.clip(usable[2], -9.0, 9.0)))
                    believed = abs(reading) <= 4000.0 and gate is not None
                    state = replace(reset, gate=law.gate.start(reading)) if believed else reset
            wanted, state = law.step(state, reference, reading)
            assert compiled.step(reference, reading) == pytest.approx(wanted, rel=0, abs=1e-10)
            assert (compiled.law.held, compiled.law.status) == (state.held, ("ok", "held", "fault").index(state.status))
            assert np.all(np.isfinite(compiled.law.x)) and np.all(np.isfinite(state.x))


@pytest.mark.parametrize("precision", ["double", "float"])
@pytest.mark.parametrize("limit", [9.0, np.inf])
def test_extreme_numbers_leave_state_and_command_finite_and_the_law_alive(precision, limit, compiler, tuned, tmp_path):
    compiled = CompiledLaw(compiler, tmp_path, tuned, precision, current_limit_A=limit)
    largest = [9e14, -1e15, 3e38, -3e38, 1e-38, -1e-45, *EXTREME]
    for seed in range(8):
        for k, (reference, reading, current) in enumerate(mix(seed, largest)):
            if k % 7 == 0:
                compiled.reset(reference, reading, current)
                assert np.isfinite(compiled.law.current_A) and np.all(np.isfinite(compiled.law.x))
            command = compiled.step(reference, reading)
            assert np.isfinite(command) and abs(command) <= limit
            assert np.all(np.isfinite(compiled.law.x))
        assert compiled.law.held == 0  # a hundred ordinary samples later


@pytest.mark.slow
@pytest.mark.parametrize("precision", ["double", "float"])
def test_a_schedule_takes_extreme_numbers_as_python_does(precision, compiler, tmp_path):
    schedule = tune_knee()
    compiled, law = CompiledSchedule(compiler, tmp_path, schedule, precision), schedule.runnable()
    for seed in range(4):
        state = law.reset()
        compiled.library.law_init(ctypes.byref(compiled.law))
        for k, (reference, reading, place) in enumerate(mix(seed, EXTREME)):
            if k == 200:
                compiled.reset(1e308, -1e308, 1e308, 1e308)
                assert compiled.law.current_A == 0.0
                state = law.reset(place=np.nan)
            wanted, state = law.step(state, reference, reading, place)
            found = compiled.step(reference, reading, place)
            assert (compiled.law.held, compiled.law.misplaced) == (state.held, state.misplaced)
            assert np.isfinite([found, *compiled.law.x]).all()
            assert precision == "float" or found == pytest.approx(wanted, rel=0, abs=1e-10)
    with pytest.raises(ControlError, match=r"reference = 1e\+308, .*: give finite numbers, within"):
        law.reset(reference=1e308)


def test_python_refuses_to_start_from_what_c_takes_as_zero(tuned):
    law = runnable(tuned)
    for given in ({"reference": 1e308}, {"measurement": -1e300}, {"reference": np.inf}, {"command": np.nan}):
        with pytest.raises(ControlError, match=f"{next(iter(given))} = .*give finite numbers, within"):
            law.reset(**given)


@pytest.mark.parametrize("single", [False, True])
def test_a_plan_outlives_extreme_readings(single, mpc, compiler, tmp_path):
    """1e308 is predicted as what is no number is; afterwards the plan goes on."""
    compiled = CompiledMPC(compiler, tmp_path, mpc, single_precision=single)
    readings = np.full(120, 400.0)
    readings[[20, 21, 30, 40, 50]] = [1e308, -1e308, 1e16, np.nan, 1e300]
    rows = compiled.run(np.full(120, 500.0), readings)
    assert np.flatnonzero(rows[:, 4]).tolist() == [20, 21, 30, 40, 50]
    state, commands = mpc.start, []
    for reading in readings:
        result = mpc.step(state, 500.0, reading)
        state = result.state
        commands.append(result.command)
    np.testing.assert_allclose(rows[:, 0], commands, rtol=0, atol=2e-2 if single else 1e-7)
    assert rows[-1, 1] == 1 and np.all(np.isfinite(rows))
