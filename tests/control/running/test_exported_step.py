"""One step in Python, in the compiled loop and in C: random laws with random parts, and readings that fail."""

from __future__ import annotations

import ctypes
import subprocess
from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

import seaopt as so
from seaopt.control.deploy.export import export
from seaopt.control.laws.plausibility import PlausibilityGate
from seaopt.control.laws.realisation import realise
from seaopt.control.loops.compensation.ripple_term import RippleTerm
from seaopt.control.loops.compensation.terms import Compensation, FrictionTerm, GravityTerm
from seaopt.control.running import closed_loop
from seaopt.control.running.closed_loop import SampledLoop, run_loop
from seaopt.plants.motor.heat_guard import HeatGuard
from tests.c_code import STRICT
from tests.laws import law_of

TS, SAMPLES, PER_EFFORT = 1e-3, 400, 0.01
HOT = {"a_11": 0.985, "a_12": 0.01, "a_21": 0.001, "a_22": 0.9989, "b_1": 0.02, "b_2": 1e-5}


def make_plant():
    """Return a plant that hardly feels the command, so that the readings are those that the test gives."""
    names = {"F": "N", "G": "N", "q": "m", "x": "m"}
    return so.Plant(
        name="deaf", states={"s": ""}, inputs={"I": "A"}, outputs=names, parameters={},
        f=lambda t, x, u, p: {"s": 1e-6 * u.I - x.s}, h=lambda t, x, u, p: dict.fromkeys(names, 1e-3 * x.s),
    )  # fmt: skip


def draw_law(rng):
    """Return a law of 0 to 2 integrators and 0 to 3 stable poles, of one measured signal or two."""
    pole = rng.uniform(-0.5, 0.98, rng.integers(0, 4))
    den = np.atleast_1d(np.poly([*np.ones(rng.integers(0, 3)), *pole]))
    ahead, back = (
        50 * np.atleast_1d(np.poly(rng.uniform(-0.6, 0.99, den.size - 1))) * rng.uniform(0.5, 2.0) for _ in range(2)
    )
    law = law_of(back, den, reference=(ahead, den))
    if rng.random() < 0.5:
        more = rng.normal(size=law.c.size) * np.abs(law.b[:, 1])
        more[: law.integrators] *= 0.1
        law = replace(law, b=np.column_stack([law.b, more]), d=np.append(law.d, rng.normal()))
    return law


def draw_terms(rng):
    """Return compensation of some of friction, gravity and ripple; None for none of them."""
    source = rng.choice(["reference", "speed"])
    friction = FrictionTerm(
        effort=rng.uniform(10, 80), speed=0.02, speed_unit="m/s", fraction=0.8, source=str(source),
        reads="q" if source == "speed" else "", velocity_per_rate=0.01 if source == "speed" else 1e-5,
    )  # fmt: skip
    gravity = GravityTerm(
        coefficients=tuple(rng.normal(size=rng.integers(1, 5)) * 50),
        low=-1.0,
        high=1.5,
        reads="x",
        unit="m",
        fraction=1.0,
    )
    cycles = tuple(sorted({int(n) for n in rng.integers(1, 8, 3)}))
    cos, sin = (tuple(rng.normal(size=len(cycles)) * 20) for _ in range(2))
    ripple = RippleTerm(cycles=cycles, cos=cos, sin=sin, period=0.7, reads="q", unit="m", fraction=1.0)
    terms = {"friction": friction, "gravity": gravity, "ripple": ripple}
    kept = {name: term for name, term in terms.items() if rng.random() < 0.5}
    return Compensation(sample_time_s=TS, **kept) if kept else None


def draw_runnable(rng):
    """Return a law, and the same with random parts and limit."""
    gate = PlausibilityGate(range_N=(-2e3, 2e3), max_step_N=300.0, max_held=int(rng.integers(0, 7)), ramp_A_per_s=90.0)
    heat = HeatGuard(**HOT, resistance=0.6, slope=0.002, allowed_rise=rng.uniform(20, 90), share=0.02, ambient=21.0)
    source = draw_law(rng)
    return source, realise(
        source, per_effort=PER_EFFORT, command_limit=rng.choice([None, 4.0, 9.0]), compensation=draw_terms(rng),
        gate=gate if rng.random() < 0.6 else None, heat=heat if rng.random() < 0.5 else None,
    )  # fmt: skip


def draw_signals(rng, count):
    """Return a reference and readings, with steps, spikes, numbers that are none, and outages."""
    rows = lfilter([0.05], [1, -0.95], rng.normal(size=(1 + count, SAMPLES))) * 900
    rows[0, 200:] += 800.0
    rows[3:] *= 1e-3  # positions
    for row in rows:
        for at in rng.integers(5, SAMPLES, 6):
            row[at] = rng.choice([np.nan, np.inf, -np.inf, 2e15, -3e3, 700.0])
        first = rng.integers(SAMPLES // 2, SAMPLES)
        row[first : first + rng.integers(1, 9)] = np.nan
    rows[:, :2] = rng.normal(size=(1 + count, 2))
    return rows


def play_python(law, reference, readings):
    state, commands = law.reset(), []
    for r, row in zip(reference.tolist(), readings.T, strict=True):
        measured = float(row[0]) if law.measured == 1 else row[: law.measured]
        command, state = law.step(state, r, measured, row[law.measured :].tolist())
        commands.append(command)
    return np.array(commands)


def export_all(compiler, laws, controller, folder):
    """Return the steps of exported laws, compiled into one library: a function of rows of inputs."""
    code = ["#include <stddef.h>"]
    command = replace(controller.command, per_effort=PER_EFFORT)
    for number, (source, law) in enumerate(laws):
        name, inputs = f"law{number}", 1 + law.measured + count_further(law)
        stored = replace(
            controller, law=source, design=None, compensation=law.compensation, reads=("F", "G")[: law.measured],
            command=command,
        )  # fmt: skip
        limit = law.command_limit
        export(stored, folder, name=name, gate=law.gate or False, derate=law.heat or False, command_limit=limit)
        given = ", ".join(f"in[{i}]" for i in range(inputs))
        code.append(f'#include "{name}.h"\nvoid run{number}(const double *in, size_t n, double *out) {{')
        code.append(f"    {name}_law law;\n    size_t i;\n    {name}_init(&law);")
        code.append(f"    for (i = 0; i < n; i++, in += {inputs}) out[i] = {name}_step(&law, {given});\n}}")
    (folder / "driver.c").write_text("\n".join(code) + "\n")
    sources = [str(path) for path in sorted(folder.glob("*.c"))]
    command = [*compiler, *STRICT, "-O0", "-shared", "-fPIC", *sources, "-o", str(folder / "laws.so")]
    subprocess.run(command, check=True)
    library = ctypes.CDLL(str(folder / "laws.so"))

    def play(number, rows):
        rows, out = np.ascontiguousarray(rows.T), np.zeros(rows.shape[1])
        pointer = ctypes.POINTER(ctypes.c_double)
        getattr(library, f"run{number}")(
            rows.ctypes.data_as(pointer), ctypes.c_size_t(out.size), out.ctypes.data_as(pointer)
        )
        return out

    return play


def count_further(law):
    return 0 if law.compensation is None else len(law.compensation.reads)


@pytest.mark.parametrize("count", [20, pytest.param(1000, marks=pytest.mark.slow)])
def test_python_compiled_loop_and_c_give_the_same_commands(count, compiler, tuned, tmp_path, monkeypatch):
    rng, plant = np.random.default_rng(count), make_plant()
    laws = [draw_runnable(rng) for _ in range(count)]
    play_c = export_all(compiler, laws, tuned, tmp_path)
    saturated, differing = 0, 0
    for number, (_, law) in enumerate(laws):
        reference, *noise = draw_signals(rng, law.measured + count_further(law))
        loop = SampledLoop(plant=plant, law=law, measured=("F", "G")[: law.measured], delay_samples=0)
        monkeypatch.setattr(closed_loop, "_noise", lambda *_, noise=noise: np.array(noise).T[None].copy())
        run = run_loop(loop, [so.ParameterSet()], reference)
        readings = np.array([run.outputs[name][0] for name in loop.signals]) + noise
        commands = play_python(law, reference, readings)
        scale = 1e-12 * max(1.0, np.max(np.abs(commands)))
        np.testing.assert_allclose(run.current[0], commands, rtol=0, atol=scale, err_msg=f"compiled loop, law {number}")
        found = play_c(number, np.vstack([reference, readings]))
        np.testing.assert_allclose(found, commands, rtol=0, atol=scale, err_msg=f"C, law {number}")
        saturated += bool(np.any(np.abs(commands) >= law.command_limit * (1 - 1e-9)))
        differing += np.unique(commands).size > SAMPLES // 2
    assert saturated > 0.15 * count
    assert differing > 0.2 * count
