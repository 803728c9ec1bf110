"""Simulation against scipy's DOP853 at rtol 1e-10; both ways of the pass against each other and finite differences."""

from __future__ import annotations

import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from unittest.mock import create_autospec

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicHermiteSpline
from scipy.signal import butter

import seaopt as so
from seaopt.errors import LogError, SimulationError
from seaopt.plants.plant import follow_readings
from seaopt.simulation import (
    Clock,
    Layout,
    Model,
    Point,
    Segment,
    Weights,
    interpreted,
    layout_of,
    make_model,
    run,
    run_passes,
    stream,
)
from seaopt.simulation.compiled import Program
from seaopt.simulation.interpreted import interpret_pass
from seaopt.simulation.native import find_compiler
from seaopt.simulation.passes import Pass
from tests.casadi_functions import compile_expression

RATE = 400.0


def reference(plant, params, u, x0, hold):
    """Integrate sample by sample with DOP853, so that the hold's corners fall on step ends."""
    u = np.hstack([u, np.zeros((len(u), len(plant.inputs) - u.shape[1]))])
    p = plant.complete(params).vector
    arguments = (plant.t, plant.x, plant.u, plant.p)
    f, h = (compile_expression(arguments, expression) for expression in (plant.dynamics, plant.output))
    x, out = np.array(x0, float), []
    for k in range(len(u)):
        out.append(h(k / RATE, x, u[k], p))
        after = u[min(k + 1, len(u) - 1)] if hold == "first" else u[k]

        def rate(t, state, k=k, after=after):
            part = (t - k / RATE) * RATE
            return f(t, state, u[k] + (after - u[k]) * part, p)

        x = solve_ivp(rate, (k / RATE, (k + 1) / RATE), x, method="DOP853", rtol=1e-10, atol=1e-13).y[:, -1]
    return np.array(out)


CASES = {
    "stand": (so.plants.high_impedance(), {}),
    "stand lumped": (so.plants.high_impedance(drive="lumped"), {}),
    "stand link2": (so.plants.high_impedance(spring="link2"), {}),
    "stand friction": (so.plants.high_impedance(), {"f_c": 40.0, "v_s": 5e-3}),
    "swing": (so.plants.moving_output(), {}),
    "swing lumped": (so.plants.moving_output(drive="lumped"), {}),
    "swing friction": (so.plants.moving_output(), {"f_c": 40.0, "v_s": 5e-3, "d": 0.2}),
    "two masses": (so.plants.two_link("mass", "mass"), {}),
    "mass and pendulum, lumped": (so.plants.two_link("mass", "pendulum", drive="lumped"), {}),
    "two pendulums, spring at link 2": (so.plants.two_link("pendulum", "pendulum", spring="link2"), {}),
    "rotary": (so.plants.rotary(), {}),
    "every part": (
        so.plants.moving_output(parts=(
            "stribeck", "backlash", "hardening", "spring_damping", "screw_mode", "current_loop", "load_cell",
            "command_delay", "measurement_delay",
        )),
        {"f_c": 20.0, "f_s": 30.0, "v_s": 0.02, "v_st": 0.05, "g_b": 2e-5, "eps_b": 1e-5, "k_3": 1e11, "c_k": 50.0},
    ),
}  # fmt: skip


COGGING = {"f_c": 40.0, "v_s": 5e-3, "a_g": 30.0, "b_g": -20.0, "n_g": 1500.0}
FOLLOWS = {"follows": (follow_readings(so.plants.moving_output(parts=("cogging",))), COGGING)}


@pytest.mark.parametrize("hold", ["zero", "first"])
@pytest.mark.parametrize("name", CASES)
def test_simulation_is_dop853s(name, hold, thor):
    plant, changes = CASES[name]
    params = plant.complete(plant.defaults if name == "rotary" else thor).update(**changes)
    rng = np.random.default_rng(5)
    u = rng.normal(size=(40, 1)) * 3
    x0 = {state: 1e-3 * rng.normal() for state in plant.states}
    if name == "every part":
        x0 |= {"q": 1e-4, "s": 1e-6}  # a millimetre in its hardening spring would be 10^8 N
    log = so.Log.from_arrays(time=np.arange(40) / RATE, I=u[:, 0])
    run = so.simulate(plant, params, log, initial_state=x0, hold=hold)
    expected = reference(plant, params, u, list(x0.values()), hold)
    for column, output in enumerate(plant.outputs):
        scale = np.max(np.abs(expected[:, column]))
        np.testing.assert_allclose(run[output], expected[:, column], atol=1e-6 * scale, rtol=0)


@pytest.mark.slow
@given(
    st.integers(0, 10_000), st.sampled_from([n for n in CASES if n != "every part"]), st.sampled_from(["zero", "first"])
)
@settings(max_examples=20)
def test_random_plants_are_dop853s(seed, name, hold):
    """Random parameters, every input random, random initial state."""
    rng = np.random.default_rng(seed)
    plant = CASES[name][0]
    defaults = plant.defaults
    around = {n: v.value * 10 ** rng.uniform(-0.4, 0.4) for n, v in defaults.items() if v.value and n != "g"}
    at_the_motor = defaults["f_c"].unit == "N m"
    around |= {"f_c": rng.uniform(0, 0.1), "v_s": 5.0} if at_the_motor else {"f_c": rng.uniform(0, 30), "v_s": 0.01}
    params = defaults.update(**around)
    u = rng.normal(size=(15, len(plant.inputs))) * ([3] + [50] * (len(plant.inputs) - 1))
    log = so.Log.from_arrays(time=np.arange(15) / RATE, **dict(zip(plant.inputs, u.T, strict=True)))
    x0 = dict(zip(plant.states, 1e-3 * rng.normal(size=len(plant.states)), strict=True))
    run = so.simulate(plant, params, log, initial_state=x0, hold=hold)
    expected = reference(plant, params, u, list(x0.values()), hold)
    for column, output in enumerate(plant.outputs):
        scale = np.max(np.abs(expected[:, column]))
        np.testing.assert_allclose(run[output], expected[:, column], atol=1e-6 * scale, rtol=0)


def test_a_whole_sample_of_delay_shifts_the_response(stand, thor):
    u = np.r_[np.zeros(5), np.ones(60)]
    log = so.Log.from_arrays(time=np.arange(65) / RATE, I=u)
    plain = so.simulate(stand, thor, log)["F1"]
    late = so.simulate(stand, thor, log, delay_s=2 / RATE)["F1"]
    np.testing.assert_allclose(late[2:], plain[:-2], atol=1e-9)


@pytest.mark.parametrize("plant_name", ["stand", "swing friction"])
def test_half_a_sample_of_delay_is_the_finer_simulation(plant_name, thor):
    """A delay of half a period is a whole sample of a log at twice the rate."""
    plant, changes = CASES[plant_name]
    params = thor.update(**changes)
    rng = np.random.default_rng(1)
    u = rng.normal(size=60)
    coarse = so.Log.from_arrays(time=np.arange(60) / RATE, I=u)
    fine = so.Log.from_arrays(time=np.arange(120) / (2 * RATE), I=np.repeat(u, 2))
    expected = so.simulate(plant, params, fine, delay_s=0.5 / RATE)["F1"][::2]
    found = so.simulate(plant, params, coarse, delay_s=0.5 / RATE)["F1"]
    np.testing.assert_allclose(found, expected, atol=2e-6 * np.abs(expected).max())


@pytest.mark.parametrize("name", ["stand", "swing", "swing friction"])
@pytest.mark.parametrize("delay_s", [0.0, 0.0007, 0.0025, 0.0062])
def test_a_late_input_of_straight_lines_is_dop853s(name, delay_s, thor):
    """The continuous plant with the interpolated input, shifted: integrated between the corners of both clocks."""
    plant, changes = CASES[name]
    params = plant.complete(thor).update(**changes)
    rng = np.random.default_rng(6)
    n, time = 40, np.arange(40) / RATE
    u, x0 = 3 * rng.normal(size=n), 1e-3 * rng.normal(size=len(plant.states))
    p = plant.complete(params).vector
    arguments = (plant.t, plant.x, plant.u, plant.p)
    f, h = (compile_expression(arguments, expression) for expression in (plant.dynamics, plant.output))

    def late(t):
        return np.r_[np.interp(t - delay_s, time, u), np.zeros(len(plant.inputs) - 1)]

    corners = np.unique(np.round(np.r_[time, (time + delay_s)[time + delay_s < time[-1]]], 12))
    x, expected = np.array(x0), []
    for start, end in zip(corners, [*corners[1:], corners[-1]], strict=True):
        if np.min(np.abs(time - start)) < 1e-11:
            expected.append(h(start, x, late(start), p))
        if end > start:
            x = solve_ivp(
                lambda t, x: f(t, x, late(t), p), (start, end), x, method="DOP853", rtol=1e-10, atol=1e-13
            ).y[:, -1]  # fmt: skip
    log = so.Log.from_arrays(time=time, I=u)
    start = dict(zip(plant.states, x0, strict=True))
    run = so.simulate(plant, params, log, initial_state=start, hold="first", delay_s=delay_s)
    for column, output in enumerate(plant.outputs):
        wanted = np.array(expected)[:, column]
        np.testing.assert_allclose(run[output], wanted, atol=1e-6 * np.max(np.abs(wanted)), rtol=0)


@pytest.mark.parametrize("delay_s", [0.0, 0.0007, 0.0062])
def test_a_reading_is_of_the_logs_own_time_whatever_the_delay(delay_s, thor):
    """The command comes late and is held; the position in the cogging's phase is scipy's Hermite spline of samples."""
    plant, changes = FOLLOWS["follows"]
    params = plant.complete(thor).update(**changes)
    rng, n = np.random.default_rng(6), 40
    time, u, read = np.arange(n) / RATE, 3 * rng.normal(size=n), 2e-3 * np.sin(0.3 * np.arange(n))
    ends = np.r_[read[0], read, read[-1]]
    curve = CubicHermiteSpline(time, read, 0.5 * RATE * (ends[2:] - ends[:-2]))
    p, x = plant.complete(params).vector, np.zeros(len(plant.states))
    arguments = (plant.t, plant.x, plant.u, plant.p)
    f, h = (compile_expression(arguments, expression) for expression in (plant.dynamics, plant.output))
    corners = np.unique(np.round(np.r_[time, (time + delay_s)[time + delay_s < time[-1]]], 12))
    expected = []
    for start, end in zip(corners, [*corners[1:], corners[-1]], strict=True):
        late = u[max(int(np.floor((start - delay_s) * RATE + 1e-9)), 0)]
        if np.min(np.abs(time - start)) < 1e-11:
            before = u[max(int(np.ceil((start - delay_s) * RATE - 1e-9)) - 1, 0)] if delay_s else late
            expected.append(h(start, x, np.r_[before, curve(start)], p))
        if end > start:
            x = solve_ivp(
                lambda t, x, late=late: f(t, x, np.r_[late, curve(t)], p), (start, end), x,
                method="DOP853", rtol=1e-10, atol=1e-13,
            ).y[:, -1]  # fmt: skip
    model, clock = make_model(plant, params), Clock(period=1 / RATE, delay_s=delay_s)
    ny = len(plant.outputs)
    point = Point(theta=np.zeros(0), offset=np.zeros(ny), gain=np.ones(ny), clock=clock, substeps=64)
    y = run_passes(model, Segment(u=(u, read)), point, np.zeros(model.nx), sums=False, outputs=True).outputs
    size = np.max(np.abs(expected), axis=0)
    assert np.all(np.abs(y[:-1] - np.array(expected)[:-1]) < 1e-5 * size)


def passes(case, thor, *, clock=None, filtered=False, n=700, free=("J", "b_r", "eta"), loss="square", corrected=False):
    plant, changes = (CASES | FOLLOWS)[case]
    params = plant.complete(thor).update(**changes)
    free = (*free, *(name for name in ("f_c", "a_g", "n_g") if changes.get(name)))
    model = make_model(plant, params, free, ("F1", "F2"))
    rng = np.random.default_rng(2)
    y = 300 * rng.normal(size=(n, 2))
    y[7, 1] = np.nan
    keep = np.ones((n, 2), dtype=np.uint8)
    keep[100:120] = 0
    read = tuple(2e-3 * np.sin(0.3 * np.arange(n)) for _ in plant.read_inputs)
    segment = Segment(
        u=(rng.normal(size=n), *read), y=tuple(y.T.copy()), keep=tuple(keep.T.copy()), drift_span=(-1.0, 2.0 / n)
    )
    clock = clock or Clock(period=1 / RATE)
    correction = None
    if corrected:  # weak enough to be stable, with made-up derivatives
        shape = (1 + model.np + clock.delay_free + 2, model.nx, 2)
        correction = 1e-5 * rng.normal(size=shape) * np.array([1e-2, *np.ones(model.nx - 1)])[:, None]
        correction[1:] /= np.array([*params.values_of(free), *([1e-3] * clock.delay_free), 1.0, 1.0])[:, None, None]
    point = Point(
        theta=np.array(params.values_of(free)), offset=rng.normal(size=2), gain=np.array([1.1, 0.9]), clock=clock,
        drift=rng.normal(size=(2, 2)), substeps=2, correction=correction,
    )  # fmt: skip
    weights = Weights(sections=np.zeros((0, 5)), settle=0, knee=np.array([200.0, 9e9]), loss=loss)
    if filtered:
        sos = butter(4, [5, 100], "bandpass", fs=RATE, output="sos")
        sections = np.ascontiguousarray(sos[:, [0, 1, 2, 4, 5]])
        weights = replace(weights, sections=sections, settle=50)
    return model, segment, point, weights, 1e-3 * rng.normal(size=model.nx)


SETTINGS = [
    {},
    {"filtered": True, "loss": "huber"},
    {"clock": Clock(period=1 / RATE, hold="first"), "loss": "soft_l1"},
    {"clock": Clock(period=1 / RATE, delay_s=0.0033, delay_free=True)},
    {"clock": Clock(period=1 / RATE, delay_s=0.0013, delay_free=True), "corrected": True},
    {"corrected": True},
    {"clock": Clock(period=1 / RATE, hold="first", delay_s=0.0033, delay_free=True)},
    {"clock": Clock(period=1 / RATE, hold="first", delay_s=0.0013, delay_free=True), "corrected": True},
    {"clock": Clock(period=1 / RATE, hold="first", delay_s=0.0038)},
]


@pytest.mark.skipif(find_compiler() is None, reason="no C compiler")
@pytest.mark.parametrize(
    ("case", "options"),
    [
        pytest.param(case, options, marks=pytest.mark.slow if case == "swing" or number in others else ())
        for case, others in (("stand", ()), ("swing", ()), ("swing friction", (3, 5, 6)), ("follows", (0, 1, 2, 5, 7)))
        for number, options in enumerate(SETTINGS)
    ],
)
def test_compiled_and_interpreted_give_the_same_numbers(case, options, thor):
    keep = {"outputs": True, "columns": True, "states": True}
    model, segment, point, weights, x0 = passes(case, thor, n=140, **options)
    for stop, start in ((140, x0), (60, 2 * x0)):
        fast = Program.make(model, segment, point, weights).run(0, stop, start, **keep)
        slow = interpret_pass(model, segment, point, weights, stop, start)
        for name in ("gram", "loss", "count", "outputs", "columns", "states"):
            a, b = getattr(fast, name), getattr(slow, name)
            scale = np.max(np.abs(b), axis=0, keepdims=True)
            np.testing.assert_allclose(a, b, atol=1e-10 * np.max(scale), rtol=1e-10, err_msg=name)
            np.testing.assert_allclose(a / (scale + 1e-300), b / (scale + 1e-300), atol=1e-9, err_msg=name)


def test_without_a_compiler_a_short_run_takes_its_samples_and_no_others(thor, monkeypatch):
    """Forty samples were run as four thousand; pieces, whose ends are filled up, are the run in one."""
    model, segment, point, weights, x0 = passes("swing friction", thor, n=140)
    sizes, chain = [], interpreted._chain
    monkeypatch.setattr(interpreted, "_chain", lambda *given: sizes.append(given[-1]) or chain(*given))
    whole = interpret_pass(model, segment, point, weights, 140, x0)
    monkeypatch.setattr(interpreted, "FOLDED_SAMPLES", 100)
    pieces = interpret_pass(model, segment, point, weights, 140, x0)
    assert sizes == [256, 128, 64]
    np.testing.assert_allclose(pieces.columns, whole.columns, rtol=1e-12, atol=1e-12 * np.max(np.abs(whole.columns)))


@pytest.mark.parametrize(
    ("case", "options"),
    [(case, options) for case in ("stand", "swing friction") for options in SETTINGS]
    + [("follows", SETTINGS[number]) for number in (3, 6)],
)
def test_derivatives_are_finite_differences(case, options, thor):
    """Every column of v: shared, initial state, each output's own. The correction moves as it says it does."""
    model, segment, point, weights, x0 = passes(case, thor, n=250, **options)
    weights = replace(weights, loss="square")
    layout = layout_of(model.nx, model.ny, model.np, point)

    def residual(moved, start=x0):
        return run_passes(model, segment, moved, start, weights, columns=True).columns[:, :, 0]

    def moved(what, i, step):
        shift = step * np.eye(1, 99, i).ravel()
        g = point.correction
        gain = None if g is None else {"correction": np.concatenate([g[:1] + step * g[i + 1 : i + 2], g[1:]])}
        if what == "theta":
            return replace(point, theta=point.theta + shift[: model.np], **(gain or {})), x0
        if what == "delay":
            clock = replace(point.clock, delay_s=point.clock.delay_s + step)
            return replace(point, clock=clock, **(gain or {})), x0
        if what == "rest":
            return replace(point, **gain), x0
        return point, x0 + shift[: model.nx]

    shared = [("theta", i, 1e-5 * value) for i, value in enumerate(point.theta)]
    shared += [("delay", model.np, 1e-7)] * point.clock.delay_free
    shared += [("rest", i, 1e-5) for i in range(len(shared), layout.shared)]
    columns = run_passes(model, segment, point, x0, weights, columns=True).columns
    for column, (what, i, step) in enumerate(shared + [("x0", i, 1e-6) for i in range(model.nx)], start=1):
        numeric = (residual(*moved(what, i, step)) - residual(*moved(what, i, -step))) / (2 * step)
        check_derivative(columns[:, :, column], numeric)
        with pytest.raises(AssertionError):
            check_derivative(columns[:, :, column] * (1 + 1e-5), numeric)
    for o in range(2):
        own = 1 + layout.shared + layout.nx + (o * layout.per_output if layout.corrected else 0)
        for k, (what, place, step) in enumerate(
            [("offset", o, 0.01), ("drift", (o, 0), 0.01), ("drift", (o, 1), 0.01), ("gain", o, 1e-5)]
        ):
            ends = []
            for sign in (1, -1):
                value = getattr(point, what).copy()
                value[place] += sign * step
                ends.append(residual(replace(point, **{what: value})))
            numeric = (ends[0] - ends[1]) / (2 * step)
            where = slice(None) if layout.corrected else o
            check_derivative(columns[:, where, own + k], numeric[:, where])


def check_derivative(exact, numeric):
    np.testing.assert_allclose(exact, numeric, atol=2e-6 * np.max(np.abs(numeric)))


def test_gram_is_the_product_of_the_columns(thor):
    model, segment, point, weights, x0 = passes("stand", thor)
    found = run_passes(model, segment, point, x0, weights, columns=True)
    for o in range(2):
        v = found.columns[:, o]
        v = v[(segment.keep[o] > 0) & np.isfinite(segment.y[o])]
        np.testing.assert_allclose(found.gram[o], v.T @ v, rtol=1e-9, atol=1e-9 * np.max(found.gram[o]))
        assert found.count[o] == len(v)
        assert found.loss[o] == pytest.approx(0.5 * np.sum(v[:, 0] ** 2))


@pytest.mark.parametrize("options", [{}, {"filtered": True}, {"corrected": True}])
def test_a_stream_is_the_whole(options, thor):
    model, segment, point, weights, x0 = passes("stand", thor, **options)
    whole = run_passes(model, segment, point, x0, weights, outputs=True, columns=True)
    parts = stream(model, segment, point, x0, weights, chunk=123, columns=True)
    columns, outputs = zip(*((part.columns.copy(), part.outputs.copy()) for part in parts), strict=True)
    assert len(columns) == 6
    np.testing.assert_allclose(np.vstack(columns), whole.columns, rtol=1e-12)
    np.testing.assert_allclose(np.vstack(outputs), whole.outputs, rtol=1e-12)


@pytest.mark.parametrize("name", ["stand", "swing"])
@pytest.mark.parametrize("corrected", [False, True])
def test_a_simulation_alone_is_that_with_sums(name, corrected, thor):
    model, segment, point, weights, x0 = passes(name, thor, corrected=corrected)
    whole = run_passes(model, segment, point, x0, weights, outputs=True, states=True)
    alone = run_passes(model, segment, point, x0, weights, sums=False, outputs=True, states=True)
    for found, expected in ((alone.outputs, whole.outputs), (alone.states, whole.states)):
        scale = np.max(np.abs(expected), axis=0)
        np.testing.assert_allclose(found / scale, expected / scale, rtol=0, atol=1e-11)
    first = run_passes(model, segment, point, x0, weights, outputs=True, output_rows=9).outputs
    np.testing.assert_array_equal(first, whole.outputs[:9])


def test_bad_input_is_refused(stand, swing, thor):
    log = so.Log.from_arrays(time=np.arange(10) / RATE, J=np.ones(10))
    with pytest.raises(LogError, match='no channel "I"'):
        so.simulate(stand, thor, log)
    gap = so.Log.from_arrays(time=np.r_[0:10, 20:30] / RATE, I=np.ones(20))
    with pytest.raises(LogError, match="gaps"):
        so.simulate(stand, thor, gap)
    holed = so.Log.from_arrays(time=np.arange(3) / RATE, I=[1.0, np.nan, 1.0])
    with pytest.raises(LogError, match="missing at t"):
        so.simulate(stand, thor, holed)
    with pytest.raises(SimulationError, match="hold"):
        so.simulate(stand, thor, so.Log.from_arrays(time=np.arange(3) / RATE, I=np.ones(3)), hold="cubic")


def test_an_overflow_is_said(thor):
    runaway = so.Plant(
        name="runaway", states={"x": "m"}, inputs={"u": "N"}, outputs={"x": "m"}, parameters={"a": "1/s"},
        f=lambda t, x, u, p: {"x": p.a * x.x**3 + u.u}, h=lambda t, x, u, p: {"x": x.x},
    )  # fmt: skip
    log = so.Log.from_arrays(time=np.arange(400) / 10, u=np.ones(400))
    with pytest.raises(SimulationError, match="runaway"):
        so.simulate(runaway, so.ParameterSet.of(a=(5.0, "1/s")), log)


def test_other_parameter_values_need_no_other_code(swing, thor):
    """Fixed parameters are data: the source of steps depends on which are zero, not on their values."""
    from seaopt.simulation.compiled import step_source

    layout = Layout(shared=1, nx=4, ny=2, drift_terms=0, corrected=False)
    a, b = (step_source(make_model(swing, thor.update(I_p=v), ("J",)), layout, 0, measured=True) for v in (0.2, 0.5))
    assert a == b


def test_plants_of_one_size_share_their_passes():
    """Only steps have a plant's equations, of a hanging mass as of a van der Pol oscillator."""
    from seaopt.simulation.compiled import pass_source, step_source

    def make(name, rate):
        return so.Plant(
            name=name, states={"x": "m", "v": "m/s"}, inputs={"u": "N"}, outputs={"x": "m"}, parameters={"a": "-"},
            f=lambda t, x, u, p: {"x": x.v, "v": rate(x, p) + u.u}, h=lambda t, x, u, p: {"x": x.x},
        )  # fmt: skip

    swinging = make("swinging", lambda x, p: -p.a * ca.sin(x.x))
    ringing = make("ringing", lambda x, p: p.a * (1 - x.x**2) * x.v - x.x)
    params, layout = so.ParameterSet.of(a=(1.3, "-")), Layout(shared=1, nx=2, ny=1, drift_terms=0, corrected=False)
    models = [make_model(plant, params, ("a",)) for plant in (swinging, ringing)]
    passes = [pass_source(model, layout, 0, measured=True) for model in models]
    steps = [step_source(model, layout, 0, measured=True) for model in models]
    assert passes[0] == passes[1]
    assert steps[0] != steps[1]

    t = np.arange(600) / 200
    log = so.Log.from_arrays(time=t, u=np.full(t.size, 0.3))
    rates = (lambda x: -1.3 * np.sin(x[0]), lambda x: 1.3 * (1 - x[0] ** 2) * x[1] - x[0])
    for plant, rate in zip((swinging, ringing), rates, strict=True):
        right = solve_ivp(
            lambda _, x, rate=rate: (x[1], rate(x) + 0.3), (0.0, 3.0), [0.0, 0.0], t_eval=t, rtol=1e-10, atol=1e-12
        )
        assert so.simulate(plant, params, log)["x"] == pytest.approx(right.y[0], abs=1e-6)


def test_other_unknowns_of_a_linear_plant_need_no_other_code(stand, thor):
    """Their count, and that of drift terms, are data, in the room of whole vectors."""
    from seaopt.simulation.compiled import pass_source

    def source(free, drift_terms):
        layout = Layout(shared=len(free), nx=2, ny=2, drift_terms=drift_terms, corrected=False)
        return pass_source(make_model(stand, thor, free), layout, 0, measured=True)

    assert source(("J", "b_r"), 0) == source(("J", "b_r"), 1) == source(("k", "eta", "b_r"), 0)


def test_too_many_filter_sections_are_refused():
    with pytest.raises(SimulationError, match="9 filter sections"):
        Weights(sections=np.zeros((9, 5)), settle=0, knee=np.ones(1))


def test_threads_share_the_passes_that_are_kept(monkeypatch):
    """Each adds and drops: the oldest was looked for while another thread changed what there is."""
    monkeypatch.setattr(run, "KEPT_BYTES", 20_000)
    kept, interval = run._Kept(), sys.getswitchinterval()
    model, segment = (create_autospec(kind, instance=True) for kind in (Model, Segment))

    def work(first):
        for i in range(3000):
            made = Pass(gram=np.zeros((1, 10, 10)), loss=np.zeros(1), count=np.zeros(1), outputs=np.zeros((100, 1)))
            key = (7 * i + first) % 40
            if kept.find(key, 0, columns=False) is None:
                kept.add(key, made, model, segment)

    sys.setswitchinterval(1e-6)
    try:
        with ThreadPoolExecutor(4) as pool:
            list(pool.map(work, range(4)))
    finally:
        sys.setswitchinterval(interval)
    assert kept._bytes == sum(run._measure_bytes(each) for each, *_ in kept._passes.values()) <= run.KEPT_BYTES


@pytest.mark.parametrize(("first", "second", "c"), [(1e6, 1e6 + 4.0, 0.5 - 1e6), (1.0000001, 1.0000049, 0.5)])
def test_denominators_that_differ_in_late_digits_have_their_own_reciprocals(first, second, c):
    two = so.Plant(
        name="two",
        states={"a": "m", "b": "m"},
        inputs={"i": "A"},
        outputs={"y": "m", "z": "m"},
        parameters={"c": "s"},
        f=lambda t, x, u, p: {"a": (ca.tanh(u.i) - x.a) / (p.c + first), "b": (ca.tanh(u.i) - x.b**3) / (p.c + second)},
        h=lambda t, x, u, p: {"y": x.a, "z": x.b},
    )
    model = make_model(two, so.ParameterSet.of(c=(c, "s")), ("c",))
    u = np.random.default_rng(0).normal(size=400)
    segment = Segment(u=(u,), y=(np.zeros(400), np.zeros(400)))
    point = Point(
        theta=np.array([c]), offset=np.zeros(2), gain=np.ones(2), clock=Clock(period=0.01, hold="zero"), substeps=4
    )
    here = run_passes(model, segment, point, np.zeros(2), outputs=True).outputs
    there = interpret_pass(model, segment, point, Weights.plain(2), 400, np.zeros(2)).outputs
    assert here == pytest.approx(there, rel=1e-11, abs=1e-13)
