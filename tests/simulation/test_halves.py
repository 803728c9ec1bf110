"""Two halves at once against one pass, and against CasADi's interpreter."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

import seaopt as so
from seaopt.simulation import Segment, Weights, keep_passes, make_model, run_passes
from seaopt.simulation.compiled import PARALLEL, Program
from seaopt.simulation.discretisation import Clock
from seaopt.simulation.halves import find_run_up
from seaopt.simulation.interpreted import interpret_pass
from seaopt.simulation.passes import Pass, Point

SAMPLES, PERIOD, X0 = PARALLEL + 4000, 2.5e-3, np.array([1e-3, 0.0])


def make_program(damping: float, friction: float = 100.0) -> tuple[Program, Point]:
    stand = so.Plant(
        name="stand",
        states={"x": "m", "v": "m/s"},
        inputs={"i": "A"},
        outputs={"F": "N"},
        parameters={"m": "kg", "b": "N s/m", "Kf": "N/A", "Fc": "N", "k": "N/m", "v_s": "m/s"},
        f=lambda t, x, u, p: {
            "x": x.v,
            "v": (p.Kf * u.i - p.b * x.v - p.Fc * ca.tanh(x.v / p.v_s) - p.k * x.x) / p.m,
        },
        h=lambda t, x, u, p: {"F": p.k * x.x},
    )
    values = so.ParameterSet.of(
        m=(250.0, "kg"), b=(damping, "N s/m"), Kf=(200.0, "N/A"), Fc=(100.0, "N"), k=(655e3, "N/m"), v_s=(5e-3, "m/s")
    )
    model = make_model(stand, values, ("m", "b", "Kf", "Fc"))
    rng = np.random.default_rng(5)
    current = np.repeat(rng.uniform(-4.0, 4.0, SAMPLES // 40), 40)
    segment = Segment(
        u=(current,),
        y=(rng.normal(0.0, 300.0, SAMPLES),),
        keep=(np.asarray(rng.uniform(size=SAMPLES) < 0.9, dtype=np.uint8),),
        drift_span=(-1.0, 2.0 / SAMPLES),
    )
    point = Point(
        theta=np.array([250.0, damping, 200.0, friction]),
        offset=np.array([20.0]),
        gain=np.array([1.1]),
        drift=np.array([[3.0, -2.0]]),
        clock=Clock(period=PERIOD, hold="zero", delay_s=1.3e-3, delay_free=True),
        substeps=2,
    )
    program = Program.make(model, segment, point, Weights.plain(1))
    if program is None:
        pytest.skip("no C compiler")
    return program, point


def assert_same(a: Pass, b: Pass, tolerance: float) -> None:
    scale = np.sqrt(np.einsum("oii->oi", b.gram))
    scale = np.where(scale > 0.0, scale, 1.0)
    assert np.max(np.abs(a.gram - b.gram) / (scale[:, :, None] * scale[:, None, :])) < tolerance
    assert np.allclose(a.loss, b.loss, rtol=tolerance, atol=0.0)
    assert np.array_equal(a.count, b.count)
    for one, other in ((a.outputs, b.outputs), (a.columns, b.columns)):
        assert one is not None and other is not None
        assert np.max(np.abs(one - other), axis=0) == pytest.approx(0.0, abs=tolerance * np.max(np.abs(other)))


def test_two_halves_are_the_pass_and_the_interpreters():
    program, point = make_program(3000.0)
    whole = program.run(0, SAMPLES, X0, outputs=True, columns=True)
    run_up = find_run_up(whole.sensitivity, SAMPLES)
    assert 500 < run_up < 6000  # b/(2 m) = 6 a second: 34.5 time constants are 2,300 samples; friction forgets besides
    halves = program.run_halves(X0, run_up, output_rows=SAMPLES, columns=True)
    assert halves is not None
    assert_same(halves, whole, 1e-11)
    interpreted = interpret_pass(program.model, program.segment, point, Weights.plain(1), SAMPLES, X0)
    assert_same(halves, interpreted, 1e-9)


def test_fewer_outputs_are_kept_from_both_halves():
    program, _ = make_program(3000.0)
    for rows in (100, SAMPLES // 2 + 3000):
        whole = program.run(0, SAMPLES, X0, outputs=True, output_rows=rows)
        halves = program.run_halves(X0, 4000, output_rows=rows, columns=False)
        assert halves is not None and halves.columns is None
        assert halves.outputs == pytest.approx(whole.outputs, abs=1e-9)


def test_what_remembers_its_state_is_not_joined():
    program, _ = make_program(1.0, friction=0.0)
    whole = program.run(0, SAMPLES, X0)
    assert find_run_up(whole.sensitivity, SAMPLES) == 0  # b/(2 m) = 0.002 a second
    assert program.run_halves(X0, 3000, output_rows=0, columns=False) is None


def test_passes_that_are_kept_are_halved_from_the_second_on(monkeypatch: pytest.MonkeyPatch):
    (program, point), calls = make_program(3000.0), list[int]()
    halved = Program.run_halves

    def count(self: Program, x0: np.ndarray, run_up: int, **kept: object) -> Pass | None:
        calls.append(run_up)
        return halved(self, x0, run_up, **kept)

    monkeypatch.setattr(Program, "run_halves", count)
    with keep_passes():
        first = run_passes(program.model, program.segment, point, X0)
        assert not calls
        moved = replace(point, theta=point.theta * 1.001)
        second = run_passes(program.model, program.segment, moved, X0)
        assert len(calls) == 1
    alone = run_passes(program.model, program.segment, moved, X0)
    assert len(calls) == 1
    assert second.loss == pytest.approx(alone.loss, rel=1e-11)
    assert second.loss != pytest.approx(first.loss, rel=1e-6)
