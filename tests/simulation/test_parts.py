"""Parts of a pass at once against one pass, and against CasADi's interpreter."""

from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
import pytest

import seaopt as so
from seaopt.plants import Plant
from seaopt.simulation import Segment, Weights, keep_passes, make_model, run_passes
from seaopt.simulation.compiled import Program
from seaopt.simulation.discretisation import Clock
from seaopt.simulation.interpreted import interpret_pass
from seaopt.simulation.parts import PARALLEL, count_parts, find_run_up
from seaopt.simulation.passes import Pass, Point

SAMPLES, PERIOD, X0 = PARALLEL + 4000, 2.5e-3, np.array([1e-3, 0.0])
PARAMETERS = {"m": "kg", "b": "N s/m", "Kf": "N/A", "Fc": "N", "k": "N/m", "v_s": "m/s"}


def make_stand(force: Any = None) -> Plant:
    """Return a mass with friction; `force`: (x, u, p) -> another one on it."""
    return so.Plant(
        name="stand",
        states={"x": "m", "v": "m/s"},
        inputs={"i": "A"},
        outputs={"F": "N"},
        parameters=PARAMETERS,
        f=lambda t, x, u, p: {
            "x": x.v,
            "v": (p.Kf * u.i - p.b * x.v - p.Fc * ca.tanh(x.v / p.v_s) - p.k * x.x + (force(t, x, p) if force else 0.0))
            / p.m,
        },
        h=lambda t, x, u, p: {"F": p.k * x.x},
    )


def make_weights(loss: Any) -> Weights:
    return replace(Weights.plain(1), loss=loss, knee=np.array([400.0]))


def make_program(
    damping: float, friction: float = 100.0, *, samples: int = SAMPLES, hold: Any = "zero", shares: bool = False,
    stand: Plant | None = None, loss: Any = "square", in_lanes: bool = True, delay_free: bool = True,
) -> tuple[Program, Point]:  # fmt: skip
    stand = stand or make_stand()
    values = so.ParameterSet.of(
        m=(250.0, "kg"), b=(damping, "N s/m"), Kf=(200.0, "N/A"), Fc=(100.0, "N"), k=(655e3, "N/m"), v_s=(5e-3, "m/s")
    )
    model = make_model(stand, values, ("m", "b", "Kf", "Fc"))
    rng = np.random.default_rng(5)
    current = np.repeat(rng.uniform(-4.0, 4.0, samples // 40), 40)
    force = rng.normal(0.0, 300.0, samples)
    force[rng.uniform(size=samples) < 0.02] = np.nan
    segment = Segment(
        u=(current,),
        y=(force,),
        keep=(np.asarray(rng.uniform(size=samples) < 0.9, dtype=np.uint8),),
        drift_span=(-1.0, 2.0 / samples),
        start_s=3.0,
        shares=np.array([rng.uniform(0.0, 1.0, samples), np.ones(samples)]) if shares else None,
    )
    point = Point(
        theta=np.array([250.0, damping, 200.0, friction]),
        offset=np.array([20.0]),
        gain=np.array([1.1]),
        drift=np.array([[3.0, -2.0]]),
        clock=Clock(period=PERIOD, hold=hold, delay_s=1.3e-3, delay_free=delay_free),
        substeps=5 if shares else 2,
    )
    program = Program.make(model, segment, point, make_weights(loss), in_lanes=in_lanes)
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


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"hold": "first"},
        {"shares": True},
        {"loss": "huber"},
        {"samples": 20_003},  # of which parts have different numbers
        {
            "stand": make_stand(lambda t, x, p: 50.0 * ca.sin(300.0 * x.x + t) * (1.0 + x.v**2) ** 0.3),
            "delay_free": False,
        },
    ],
    ids=["hold", "line", "shares", "huber", "uneven", "functions"],
)
def test_parts_at_once_are_the_pass_and_the_interpreters(options: dict[str, Any]):
    program, point = make_program(12_000.0, **options)
    plain, _ = make_program(12_000.0, **options, in_lanes=False)
    samples = program.segment.n
    assert program.joins and not plain.joins
    whole = plain.run(0, samples, X0, outputs=True, columns=True)
    parts, sensitivities = program.run_parts(X0, 500, output_rows=samples, columns=True)
    assert len(sensitivities) == count_parts(samples) == 8
    assert parts is not None
    assert_same(parts, whole, 1e-11)
    assert_same(program.run(0, samples, X0, outputs=True, columns=True), whole, 1e-12)
    interpreted = interpret_pass(
        program.model, program.segment, point, make_weights(options.get("loss", "square")), samples, X0
    )
    assert_same(parts, interpreted, 1e-9)


def test_outputs_columns_and_changes_of_the_next_state_are_the_pass_s():
    (program, _), (plain, _) = make_program(3000.0), make_program(3000.0, in_lanes=False)
    ways = ({"columns": True}, {"outputs": True, "output_rows": 100}, {"states": True, "changes": True, "sums": False})
    for options in ways:
        one, other = (each.run(0, SAMPLES, X0, **options) for each in (program, plain))
        for name in ("outputs", "columns", "states", "changes"):
            a, b = getattr(one, name), getattr(other, name)
            assert (a is None) == (b is None)
            size = getattr(other, "states" if name == "changes" else name)
            assert a is None or np.max(np.abs(a - b) / np.max(np.abs(size), axis=0)) < 1e-11


def test_a_run_up_is_found_from_how_the_parts_forget():
    program, _ = make_program(3000.0)
    _, sensitivities = program.run_parts(X0, 100, output_rows=0, columns=False)
    # b/(2 m) = 6 a second: 34.5 time constants are 2,300 samples; friction forgets besides.
    assert 300 < find_run_up(sensitivities, SAMPLES) < 2_300
    assert find_run_up(sensitivities, SAMPLES, least=1_400) == 1_400
    assert count_parts(SAMPLES, 1_400) == 8
    assert count_parts(SAMPLES, 2_000) == 4
    assert count_parts(SAMPLES, 4_000) == 2
    assert find_run_up(sensitivities, SAMPLES, least=8_000) == 0


def test_a_run_up_that_is_too_short_is_noticed():
    program, _ = make_program(3000.0)
    assert program.run_parts(X0, 50, output_rows=0, columns=False)[0] is None


def test_what_remembers_its_state_is_not_joined():
    program, _ = make_program(1.0, friction=0.0)
    result, sensitivities = program.run_parts(X0, 1_500, output_rows=0, columns=False)
    assert result is None
    assert find_run_up(sensitivities, SAMPLES) == 0  # b/(2 m) = 0.002 a second


def test_other_functions_than_lanes_have_are_not_made_in_lanes():
    program, _ = make_program(3000.0, stand=make_stand(lambda t, x, p: ca.erf(x.v)))
    assert not program.joins


@pytest.mark.parametrize(("damping", "friction"), [(3000.0, 100.0), (1.0, 0.0)], ids=["forgets", "remembers"])
def test_passes_that_are_kept_are_those_that_are_not(damping: float, friction: float):
    program, point = make_program(damping, friction)
    moved = replace(point, theta=point.theta * 1.001)
    with keep_passes():
        first, second = (run_passes(program.model, program.segment, each, X0) for each in (point, moved))
    alone = run_passes(program.model, program.segment, moved, X0)
    assert second.loss == pytest.approx(alone.loss, rel=1e-11)
    assert second.loss != pytest.approx(first.loss, rel=1e-6)


@pytest.mark.parametrize(("damping", "friction", "joined"), [(12_000.0, 100.0, True), (1.0, 0.0, False)])
def test_long_passes_run_in_parts_where_the_plant_forgets(monkeypatch, damping, friction, joined):
    program, point = make_program(damping, friction)
    alone, run = list[int](), Program.run

    def count(self: Program, *given: Any, **options: Any) -> Pass:
        alone.append(1)
        return run(self, *given, **options)

    monkeypatch.setattr(Program, "run", count)
    with keep_passes():
        run_passes(program.model, program.segment, point, X0, columns=True)
    assert not alone if joined else alone == [1]


def test_a_part_without_a_measured_sample_begins_where_the_one_before_ends():
    """What is not measured tells nothing of a wrong state there: outputs were off by twice their size."""
    program, point = make_program(1.0, 0.0)  # forgets nothing
    measured = (np.arange(program.segment.n) < 0.1 * program.segment.n).astype(np.uint8)
    segment = replace(program.segment, keep=(measured,))
    with keep_passes():
        found = run_passes(program.model, segment, point, X0, outputs=True, columns=True, keep=True)
    expected = run_passes(program.model, segment, point, X0, outputs=True)  # in one piece
    np.testing.assert_allclose(found.outputs, expected.outputs, rtol=1e-8, atol=1e-6)
