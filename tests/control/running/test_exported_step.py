"""One step in Python, in the compiled loop and in C: random laws with random parts, and readings that fail."""

from __future__ import annotations

import ctypes
import subprocess
from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

import seaopt as so
from seaopt.control import GainTable, LinkPath
from seaopt.control.deploy import export as export_module
from seaopt.control.deploy.export import export
from seaopt.control.laws.plausibility import Agreement, PlausibilityGate
from seaopt.control.laws.realisation import realise
from seaopt.control.laws.structures import Nominal, SpeedLoop
from seaopt.control.loops.compensation.ripple_term import RippleTerm
from seaopt.control.loops.compensation.terms import Compensation, FrictionTerm, GravityTerm
from seaopt.control.loops.outer_loop import OuterLoop
from seaopt.control.loops.transfer_function import TransferFunction
from seaopt.control.running import closed_loop
from seaopt.control.running.closed_loop import SampledLoop, run_loop
from seaopt.control.scheduling.runnable_schedule import RunnableSchedule, make_runnable
from seaopt.plants.motor.heat_guard import HeatGuard
from tests.c_code import STRICT
from tests.laws import law_of

TS, SAMPLES, PER_EFFORT = 1e-3, 400, 0.01
STRUCTURES = 80  # each compiles a loop of its own
HOT = {"a_11": 0.985, "a_12": 0.01, "a_21": 0.001, "a_22": 0.9989, "b_1": 0.02, "b_2": 1e-5}


def make_plant():
    """Return a plant that hardly feels the command, so that the readings are those that the test gives."""
    names = {"F": "N", "G": "N", "H": "N", "q": "m", "x": "m"}
    return so.Plant(
        name="deaf", states={"s": ""}, inputs={"I": "A"}, outputs=names, parameters={},
        f=lambda t, x, u, p: {"s": 1e-6 * u.I - x.s}, h=lambda t, x, u, p: dict.fromkeys(names, 1e-3 * x.s),
    )  # fmt: skip


def draw_law(shape, rng):
    """Return a law of 0 to 2 integrators and 0 to 3 stable poles, of one measured signal or two."""
    den = np.atleast_1d(np.poly([*np.ones(shape.integers(0, 3)), *rng.uniform(-0.5, 0.98, shape.integers(0, 4))]))
    ahead, back = (
        50 * np.atleast_1d(np.poly(rng.uniform(-0.6, 0.99, den.size - 1))) * rng.uniform(0.5, 2.0) for _ in range(2)
    )
    law = law_of(back, den, reference=(ahead, den))
    if shape.random() < 0.5:
        more = rng.normal(size=law.c.size) * np.abs(law.b[:, 1])
        more[: law.integrators] *= 0.1
        law = replace(law, b=np.column_stack([law.b, more]), d=np.append(law.d, rng.normal()))
    return law


def draw_terms(shape, rng, outer):
    """Return compensation of some of friction, gravity and ripple; None for none of them."""
    source = "speed" if outer or shape.random() < 0.5 else "reference"
    friction = FrictionTerm(
        effort=rng.uniform(10, 80), speed=0.02, speed_unit="m/s", fraction=0.8, source=source,
        reads="q" if source == "speed" else "", velocity_per_rate=0.01 if source == "speed" else 1e-5,
    )  # fmt: skip
    coefficients = tuple(rng.normal(size=shape.integers(1, 5)) * 50)
    gravity = GravityTerm(coefficients=coefficients, low=-1.0, high=1.5, reads="x", unit="m", fraction=1.0)
    cycles = tuple(sorted({int(n) for n in shape.integers(1, 8, 3)}))
    cos, sin = (tuple(rng.normal(size=len(cycles)) * 20) for _ in range(2))
    ripple = RippleTerm(cycles=cycles, cos=cos, sin=sin, period=0.7, reads="q", unit="m", fraction=1.0)
    terms = {"friction": friction, "gravity": gravity, "ripple": ripple}
    kept = {name: term for name, term in terms.items() if shape.random() < 0.5}
    return Compensation(sample_time_s=TS, **kept) if kept else None


def change_terms(terms, rng):
    """Return terms of the same shape with other coefficients."""
    changed = {
        "friction": ("effort", "velocity_per_rate"), "gravity": ("coefficients",), "ripple": ("cos", "sin"),
    }  # fmt: skip
    made = {}
    for name, fields_of in changed.items():
        if (term := getattr(terms, name)) is not None:
            values = {key: getattr(term, key) for key in fields_of}
            more = {
                key: tuple(rng.uniform(0.5, 1.5, len(v)) * v) if isinstance(v, tuple) else v * rng.uniform(0.5, 1.5)
                for key, v in values.items()
            }
            made[name] = replace(term, **more)
    return replace(terms, **made)


def draw_part(number, rng):
    """Return a law, the same with random parts and limit, and its outer loop or None; `number`: of its structure."""
    shape, outer = np.random.default_rng(number), draw_outer(rng)
    outer = replace(outer, stiffness=outer.stiffness * (number % 2)) if shape.random() < 0.3 else None
    guards = draw_guards(shape, rng)
    source, terms = draw_law(shape, rng), draw_terms(shape, rng, outer)
    return source, realise(source, per_effort=PER_EFFORT, compensation=terms, **guards), outer


def draw_outer(rng):
    return OuterLoop(
        stiffness=rng.uniform(100, 2000), damping=rng.uniform(0, 20), velocity_filter_s=rng.choice([0.0, 0.004]),
        direction=float(rng.choice([-1.0, 1.0])), sample_time_s=TS, place_unit="m", position="x",
    )  # fmt: skip


def draw_damping(number, rng):
    """Return an outer loop of every third schedule, half of them without stiffness."""
    outer = draw_outer(rng)
    return replace(outer, stiffness=outer.stiffness * (number % 6 == 0)) if number % 3 == 0 else None


def draw_guards(shape, rng):
    """Return a limit, and a gate and a heat guard or not."""
    reads = ("q", "x")[: shape.integers(1, 3)]
    agreement = Agreement(reads=reads, weights=(300.0, -200.0)[: len(reads)], limit=250.0, share=0.1)
    gate = PlausibilityGate(
        range_N=(-2e3, 2e3), max_step_N=300.0, max_held=int(rng.integers(0, 7)), ramp_per_s=90.0,
        agreement=agreement if shape.random() < 0.5 else None,
    )  # fmt: skip
    heat = HeatGuard(**HOT, resistance=0.6, slope=0.002, allowed_rise=rng.uniform(20, 90), share=0.02, ambient=21.0)
    return {
        "command_limit": shape.choice([None, 4.0, 9.0]), "gate": gate if shape.random() < 0.6 else None,
        "heat": heat if shape.random() < 0.5 else None,
    }  # fmt: skip


def draw_schedule(number, rng):
    """Return a schedule with random parts, of 2 to 5 points."""
    shape = np.random.default_rng(number)
    count, observer, speed = shape.integers(2, 6), shape.random() < 0.3, None
    gains = {"k_p": 0.1, "k_i": 5.0 * (shape.random() < 0.8), "k_d": 1e-3, "T_f": 2e-3, "k_r": 0.1, "c": 0.5}
    if shape.random() < 0.4:
        gains |= {"notch_frequency_hz": 70.0, "notch_width": 0.4, "notch_depth": 0.3}
    if shape.random() < 0.5:
        gains |= {"prefilter_corner_hz": 30.0, **({"prefilter_damping": 0.8} if shape.random() < 0.5 else {})}
    if not observer and shape.random() < 0.4:
        speed = SpeedLoop(differenced=bool(shape.random() < 0.5))
        gains |= {"k_v": 0.02, "k_ff": 1.1, **({"T_v": 0.05} if shape.random() < 0.5 else {})}
    if observer:
        gains |= {"T_q": 0.02}
        lag = TransferFunction(num=np.array([3.0, -4.0, 1.2]), den=np.array([1.0, -0.9, 0.1]))
        nominal = Nominal(
            kept=np.array([0.0, 0.7, 0.3]), inverse=(lag, TransferFunction(num=np.array([0.3]), den=np.ones(1)))
        )
    links = ()
    if shape.random() < 0.3:
        kind = {"is_speed": bool(shape.random() < 0.5), "high_pass_hz": 2.0 * (shape.random() < 0.5)}
        links = tuple(
            LinkPath(measured="G", unit="m", inertia=m, damping=9.0 * m, fraction=0.5, corner_hz=20.0 * m, **kind)
            for m in rng.uniform(0.5, 1.5, count)
        )
    table = GainTable(
        over="phi", unit="rad", points=np.sort(rng.uniform(-1.0, 1.0, count)), sample_time_s=TS, speed=speed,
        gains={name: value * rng.uniform(0.5, 1.5, count) for name, value in gains.items()},
        links=links, structure="pid_dob" if observer else "pid" if speed is None else "cascade",
        nominals=tuple(nominal.scaled(gain) for gain in rng.uniform(0.2, 0.4, count)) if observer else (),
    )  # fmt: skip
    guards, terms = draw_guards(shape, rng), draw_terms(shape, rng, None) if shape.random() < 0.6 else None
    made = [] if terms is None else [change_terms(terms, rng) for _ in range(count)]
    return make_runnable(table, per_effort=PER_EFFORT, limit=guards.pop("command_limit"), compensations=made, **guards)


def draw_signals(rng, names, placed):
    """Return a reference and readings by name, with steps, spikes, numbers that are none, and outages. `placed`: the
    reference is a position.
    """
    rows = dict(zip(["reference", *names], lfilter([0.05], [1, -0.95], rng.normal(size=(9, SAMPLES))), strict=False))
    for name, row in rows.items():
        row *= 0.9 if name in "qx" or (name == "reference" and placed) else 900.0
        row[200:] += 0.8 * (name == "reference") * (1.0 if placed else 1e3)
        row[rng.integers(0, SAMPLES, 6)] = rng.choice([np.nan, np.inf, -np.inf, 2e15, -3e3, 700.0], 6)
        first = rng.integers(SAMPLES // 2, SAMPLES)
        row[first : first + rng.integers(1, 9)] = np.nan
    return rows


def play_python(law, reference, measured, further, places=None):
    """Return the commands, and the size of what is summed to them, of which rounding is."""
    state, commands, largest = law.reset(), [], 1.0
    for k, r in enumerate(reference.tolist()):
        size = np.sum(np.abs(state.x)) if isinstance(law, RunnableSchedule) else np.abs(law.c) @ np.abs(state.x)
        largest = max(largest, PER_EFFORT * float(size))
        read = float(measured[0][k]) if law.measured == 1 else np.array([row[k] for row in measured])
        at = [] if places is None else [float(places[k])]
        command, state = law.step(state, r, read, *at, [float(row[k]) for row in further])
        commands.append(command)
        largest = max(largest, abs(command))
    return np.array(commands), largest


def export_all(compiler, parts, controller, folder, monkeypatch):
    """Return the steps of exported laws, compiled into one library: a function of rows of inputs."""
    code = ["#include <stddef.h>"]
    command = replace(controller.command, per_effort=PER_EFFORT)
    for number, (source, law, outer) in enumerate(parts):
        name, scheduled = f"law{number}", isinstance(law, RunnableSchedule)
        inputs = 1 + law.measured + len(law.further) + scheduled
        stored = replace(
            controller, law=source or controller.law, design=None, compensation=law.compensation,
            reads=("F", "G", "H")[: law.measured], command=command, outer=outer,
        )  # fmt: skip
        if scheduled:
            monkeypatch.setattr(export_module, "read_runnable", lambda *_, law=law, of=stored: (law, of))
            stored = {"schedule": {"broken": []}, "feasible": True}
        limit = law.command_limit
        export(stored, folder, name=name, gate=law.gate or False, derate=law.heat or False, command_limit=limit)
        given = "".join(f", in[{i}]" for i in range(1, inputs))
        asked = "in[0]" if outer is None else f"{name}_outer(&law, in[0], in[{inputs}])"
        if outer is not None and not outer.stiffness:
            asked = f"in[0] + {name}_outer(&law, 0.0, in[{inputs}])"
        code.append(f'#include "{name}.h"\nvoid run{number}(const double *in, size_t n, double *out) {{')
        code.append(f"    {name}_law law;\n    size_t i;\n    {name}_init(&law);")
        code.append(f"    for (i = 0; i < n; i++, in += {inputs + (outer is not None)})")
        code.append(f"        out[i] = {name}_step(&law, {asked}{given});\n}}")
    (folder / "driver.c").write_text("\n".join(code) + "\n")
    sources = [str(path) for path in sorted(folder.glob("*.c"))]
    subprocess.run([*compiler, *STRICT, "-O0", "-shared", "-fPIC", *sources, "-o", str(folder / "laws.so")], check=True)
    library, pointer = ctypes.CDLL(str(folder / "laws.so")), ctypes.POINTER(ctypes.c_double)

    def play(number, rows):
        rows, out = np.ascontiguousarray(np.array(rows).T), np.zeros(SAMPLES)
        given, made = (array.ctypes.data_as(pointer) for array in (rows, out))
        getattr(library, f"run{number}")(given, ctypes.c_size_t(SAMPLES), made)
        return out

    return play


@pytest.mark.parametrize("count", [20, pytest.param(667, marks=pytest.mark.slow)])
def test_python_compiled_loop_and_c_give_the_same_commands(count, compiler, tuned, tmp_path, monkeypatch):
    rng, plant = np.random.default_rng(count), make_plant()
    parts = [draw_part(number % STRUCTURES, rng) for number in range(count)]
    parts += [
        (None, draw_schedule((33 + number) % (STRUCTURES // 2), rng), draw_damping(number, rng))
        for number in range(count // 2)
    ]
    play_c = export_all(compiler, parts, tuned, tmp_path, monkeypatch)
    saturated, differing = 0, 0
    for number, (_, force_law, outer) in enumerate(parts):
        names, law, places = ("F", "G", "H")[: force_law.measured], replace(force_law, outer=outer), None
        loop = SampledLoop(plant=plant, law=law, measured=names, delay_samples=0)
        signals = draw_signals(rng, loop.signals, outer is not None and outer.stiffness > 0.0)
        reference, *noise = signals.values()
        if isinstance(law, RunnableSchedule):
            places = 1.5 * np.sin(0.03 * np.arange(SAMPLES) + rng.uniform(0.0, 6.0))
            places[rng.integers(0, SAMPLES, 20)] = rng.choice([np.nan, np.inf, 3e15], 20)
        monkeypatch.setattr(closed_loop, "_noise", lambda *_, noise=noise: np.array(noise).T[None].copy())
        run = run_loop(loop, [so.ParameterSet()], reference, places=np.nan if places is None else places)
        readings = {name: run.outputs[name][0] + signals[name] for name in loop.signals}
        measured, further = ([readings[name] for name in part] for part in (names, law.further))
        commands, largest = play_python(law, reference, measured, further, places)
        scale = 1e-12 * largest
        np.testing.assert_allclose(run.current[0], commands, rtol=0, atol=scale, err_msg=f"compiled loop, law {number}")
        inputs = [reference, *measured, *(readings[name] for name in force_law.further)]
        inputs += [] if places is None else [places]
        inputs += [] if outer is None else [readings["x"]]
        np.testing.assert_allclose(play_c(number, inputs), commands, rtol=0, atol=scale, err_msg=f"C, law {number}")
        saturated += bool(np.any(np.abs(commands) >= law.command_limit * (1 - 1e-9)))
        differing += np.unique(commands).size > SAMPLES // 2
    assert saturated > 0.15 * len(parts)
    assert differing > 0.2 * len(parts)
