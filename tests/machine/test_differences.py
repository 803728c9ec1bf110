"""What differs between a machine and its model, told beside what was certified, on machines of the tests' own."""

from __future__ import annotations

from dataclasses import replace
from unittest.mock import create_autospec

import numpy as np
import pytest
from scipy.optimize import minimize

import seaopt as so
from seaopt.machine.differences.certified import compare
from seaopt.machine.differences.comparison import Comparison
from seaopt.machine.differences.joint import explains
from seaopt.machine.differences.leeway import take_spread
from seaopt.machine.response.discs import Ratio
from seaopt.machine.stepped import make_setting, play, run_setting
from seaopt.machine.ticks import find_edges, take_ticks
from tests.machine.simulator import Machine
from tests.machine.test_response import LINES, REFERENCE

RANGES = {"eta": (0.95, 1.05), "b_r": (0.8 * 1.31e-4, 1.2 * 1.31e-4)}
RIGHT = Machine()


def scale(**factors):
    return replace(RIGHT, **{name: factor * getattr(RIGHT, name) for name, factor in factors.items()})


def accept(controller, log, **options):
    return so.accept(controller, [log], uncertainty=so.plants.thor(), ranges=RANGES, **options).differences


@pytest.mark.parametrize(
    ("per_ampere", "damping"),
    [
        (0.96, 0.85),
        (1.04, 1.15),
        *(pytest.param(*pair, marks=pytest.mark.slow) for pair in ((0.96, 1.15), (1.04, 0.85))),
    ],
)
@pytest.mark.parametrize(("fault", "names", "factor"), [("stiffness", {"k"}, 0.8), ("mass", {"J"}, 1.3)])
def test_a_fault_of_a_machine_that_is_not_the_nominal_one_besides(
    controller, bench, per_ampere, damping, fault, names, factor
):
    machine = scale(per_ampere=per_ampere, damping=damping, **{fault: factor})
    differences = accept(controller, bench.log(machine, REFERENCE, seed=4))
    first = differences.found[0]
    assert names & {first.name, *first.alike} and first.kind == "parameter", differences
    assert first.explains > 0.95


def test_the_size_of_a_fault_is_found_beside_what_was_certified(controller, bench):
    first = accept(controller, bench.log(scale(stiffness=0.8, per_ampere=1.04), REFERENCE)).found[0]
    factors = dict(zip((first.name, *first.alike), (first.value, *first.alike_values), strict=True))
    assert np.isclose(factors["k"], 0.8, atol=0.01) and first.high - first.low < 0.05


def test_a_fault_is_named_beside_a_range_that_begins_at_the_nominal_value(controller, bench):
    log = bench.log(scale(stiffness=0.8), REFERENCE)
    for eta in ((0.97, 1.0), (1.0, 1.03)):
        differences = so.accept(controller, [log], uncertainty=so.plants.thor(), ranges={"eta": eta}).differences
        first = differences.found[0]
        assert "k" in (first.name, *first.alike) and first.explains > 0.99, differences


def test_a_value_that_was_drawn_is_a_cause_of_its_own_whole_size(controller, bench):
    first = accept(controller, bench.log(scale(per_ampere=0.7), REFERENCE)).found[0]
    assert {"eta", "K_tau"} <= {first.name, *first.alike} and np.isclose(first.value, 0.7, atol=0.02), first


def test_a_mode_stays_a_mode_beside_what_was_certified(controller, bench):
    machine = replace(scale(per_ampere=1.04, damping=1.15)).with_mode(40.0)
    first = accept(controller, bench.log(machine, REFERENCE)).found[0]
    assert first.kind == "mode" and np.isclose(first.value, 40.0, rtol=0.05)


@pytest.mark.parametrize(("hertz", "share"), [(40.0, 0.15), (25.0, 0.05)])
def test_a_modes_size_has_an_interval_about_that_of_the_equations(controller, bench, hertz, share):
    """A mass on a spring at the nut adds m2 s^2 (k2 + c2 s)/(m2 s^2 + c2 s + k2) to M s^2 + b s + k."""
    machine, off = RIGHT.with_mode(hertz, share), list[float]()
    s = 2j * np.pi * LINES
    stretched = machine.stiffness2 + machine.damping2 * s
    alone = RIGHT.mass * s**2 + RIGHT.damping * s + RIGHT.stiffness
    whole = alone + machine.mass2 * s**2 * stretched / (machine.mass2 * s**2 + stretched)
    truth = np.max(np.abs(np.log(np.abs(alone / whole))))
    for seed in (1, 2, 3):
        first = so.accept(controller, [bench.log(machine, REFERENCE, seed=seed)]).differences.found[0]
        assert first.kind == "mode" and first.changes_low < first.changes < first.changes_high, first
        low, middle, high = np.log([first.changes_low, first.changes, first.changes_high])
        off.append((middle - truth) / ((high - low) / 3.92))
        assert high - low < 0.5 * truth, (low, high, truth)
    assert np.sum(np.square(off)) < 12.8, off  # chi square of 3, 99.5 %


def with_encoder(log, machine, sign=1.0):
    """Return a log with the nut's place, in steps of a micrometre, that the force stands for."""
    place = np.round(sign * log["F1"] / machine.stiffness, 6)
    signals = {name: log[name] for name in ("reference", "I", "F1")}
    return so.Log.from_arrays(time=log.time, q=place, units={"q": "m"}, **signals)


WIDE = {"eta": (0.9, 1.1), "b_r": (0.3 * 1.31e-4, 3.0 * 1.31e-4)}


def find_first(controller, log):
    return so.accept(controller, [log], uncertainty=so.plants.thor(), ranges=WIDE).differences.found[0]


@pytest.mark.parametrize(("fault", "name", "factor"), [("stiffness", "k", 0.8), ("mass", "J", 1.25)])
def test_force_over_deflection_tells_a_soft_spring_from_a_heavy_motor(controller, bench, fault, name, factor):
    machine = scale(**{fault: factor})
    log = with_encoder(bench.log(machine, 300.0 + 0.25 * (REFERENCE - 300.0)), machine)
    told = find_first(controller, log)
    assert told.name == name and not {"k", "J"} & {*told.alike}, told


def test_force_alone_tells_no_soft_spring_from_a_heavy_motor(controller, bench):
    """Both move the resonance alike, where damping and efficiency are as little known as here."""
    told = find_first(controller, bench.log(scale(stiffness=0.8), 300.0 + 0.25 * (REFERENCE - 300.0)))
    assert {"k", "J"} <= {told.name, *told.alike}, told


def test_an_encoder_that_is_turned_refuses_no_machine(controller, bench):
    log = bench.log(RIGHT, REFERENCE)
    assert so.accept(controller, [with_encoder(log, RIGHT, sign=-1.0)]).met


def test_leeway_is_that_of_the_draws():
    """Least squares over the values that were drawn, each within its range, by a general optimiser."""
    rng, f = np.random.default_rng(1), np.linspace(1.0, 20.0, 15)
    of_unit = {"a": 0.1 / (1.0 + 1j * f), "b": 0.02j * f}
    draws = [{"a": 2.0 + rng.uniform(-1, 1), "b": 5.0 + rng.uniform(-0.5, 0.5), "c": 1.0} for _ in range(4000)]
    spread = take_spread(draws, {"a": 2.0, "b": 5.0})
    slopes = np.array(
        [(place[k] - at) * of_unit[k] for place, k, at in zip(spread.places, "ab", (2.0, 5.0), strict=True)]
    )
    assert spread.names == ("a", "b")
    alone = spread.leave(slopes, "a")
    ends = sorted(float(each) for each in (alone.low[0], alone.high[0]))
    assert np.allclose(
        np.abs(np.outer(ends, alone.directions[0])), np.abs(np.outer([-0.5, 0.5], of_unit["b"])), rtol=0.01
    )
    both = spread.leave(slopes)
    target = 0.8 * of_unit["a"] - 0.3 * of_unit["b"]

    def off(z):
        return np.sum(np.abs(target - z[0] * of_unit["a"] - z[1] * of_unit["b"]) ** 2)

    z = minimize(off, [0.0, 0.0], bounds=[(-1, 1), (-0.5, 0.5)], tol=1e-15).x
    columns = np.vstack([both.directions.real.T, both.directions.imag.T])
    c = np.linalg.lstsq(columns, np.concatenate([target.real, target.imag]))[0]
    assert np.all((both.low <= c) & (c <= both.high))
    assert np.allclose(c @ both.directions, z[0] * of_unit["a"] + z[1] * of_unit["b"], atol=1e-4)


SINE = 300.0 + 60.0 * np.sin(4.0 * np.pi * np.arange(10000) * 1e-3)
STEPS = 300.0 + 40.0 * np.sign(np.sin(20.0 * np.arange(10000) * 1e-3))
REFERENCES = {"multisine": REFERENCE, "sine": SINE, "steps": STEPS}


@pytest.mark.parametrize("noise", [0.0, 2.0])
@pytest.mark.parametrize("played", REFERENCES)
def test_a_sensor_is_at_its_range_where_many_readings_are_one(bench, controller, played, noise):
    edge = 338.3
    right = bench.log(replace(RIGHT, force_step=1.0), REFERENCES[played], noise=noise)["F1"]
    clipped = bench.log(replace(RIGHT, sensor_range=edge), REFERENCES[played], noise=noise)["F1"]
    assert not find_edges(right)
    (top,) = find_edges(clipped)
    assert np.array_equal(top, clipped == edge) and np.count_nonzero(top) > 100


def test_a_range_on_one_side_is_found_where_the_other_side_goes_further():
    rng = np.random.default_rng(2)
    reading = 5.0 * np.sin(0.01 * np.arange(8000)) + rng.normal(scale=0.02, size=8000)
    (low,) = find_edges(np.maximum(reading, -3.0))
    assert np.array_equal(low, reading <= -3.0)


@pytest.mark.parametrize("played", ["sine", "steps"])
def test_a_reading_at_its_range_is_rounded_alike_in_all_rows(bench, controller, played):
    """The law read 338.3 N where 338.3 to a whole newton was logged: its integral of the difference is no other law."""
    machine = replace(RIGHT, sensor_range=338.3)
    setting = make_setting(controller, take_ticks(controller, bench.log(machine, REFERENCES[played], decimals=0)))
    assert play(setting).met
    error, allowed = play(setting).error, play(setting).allowed
    assert 0.1 < np.sqrt(np.mean(error**2) / np.mean(allowed**2)) < 2.0


def test_a_long_log_is_allowed_the_walk_that_an_integral_makes_of_rounding(controller):
    rng, n = np.random.default_rng(3), 40000
    time, reference, ends = 1e-3 * np.arange(n), np.full(n, 300.0), []
    for _ in range(12):
        seen = 300.0 + rng.normal(scale=3.0, size=n)
        rows = {"time": time, "reference": reference, "I": reference, "F1": seen}
        setting = make_setting(controller, take_ticks(controller, so.Log.from_arrays(**rows)))
        rows |= {"I": run_setting(setting, setting.ticks, setting.law.reset()), "F1": np.round(seen)}
        match = play(make_setting(controller, take_ticks(controller, so.Log.from_arrays(**rows))))
        ends.append(match.error[-1] / match.allowed[-1])
    assert 0.6 < np.sqrt(np.mean(np.square(ends))) < 1.5


WIDER = {"eta": (0.7, 1.3), "b_r": (0.1 * 1.31e-4, 10.0 * 1.31e-4)}


@pytest.mark.parametrize("ranges", [WIDE, WIDER])
@pytest.mark.parametrize(("fault", "factor"), [("stiffness", 0.8), ("mass", 1.25)])
def test_a_fault_within_reach_of_the_draws_at_each_line_is_outside_of_all_of_them(
    controller, bench, ranges, fault, factor
):
    machine = scale(per_ampere=1.05, damping=1.5, **{fault: factor})
    result = so.accept(controller, [bench.log(machine, REFERENCE)], uncertainty=so.plants.thor(), ranges=ranges)
    assert result.differences.each_line and not result.differences.inside
    assert "none of them explains all lines together" in " ".join(str(result).split())


@pytest.mark.parametrize("ranges", [WIDE, WIDER])
def test_without_the_fault_it_is_inside(controller, bench, ranges):
    log = bench.log(scale(per_ampere=1.05, damping=1.5), REFERENCE)
    assert so.accept(controller, [log], uncertainty=so.plants.thor(), ranges=ranges).differences.inside


def test_between_the_draws_a_machine_is_found_by_going_on_from_the_nearest(controller, bench):
    """Of eight draws none is the machine, to the noise of the log."""
    machine, draws = scale(per_ampere=1.03, damping=1.1), np.random.default_rng(2).uniform(-1.0, 1.0, size=(8, 2))
    rows = [{"eta": 1.0 + 0.1 * a, "b_r": 1.31e-4 * (1.0 + 0.5 * b)} for a, b in draws]
    log = bench.log(machine, REFERENCE, noise=0.3)
    measured = so.accept(controller, [log]).response.measured
    differences = compare(controller, measured, [take_ticks(controller, log)], rows, 0.95)
    assert differences.inside and differences.nearest_misfit > 100.0


def test_the_joint_probability_of_what_is_left_is_the_one_that_is_stated(controller):
    """Right machines are refused as often as is stated, where none of the difference is tolerated, by simulation."""
    rng, blocks, m, alpha = np.random.default_rng(4), 6, 20, 0.1
    truth = np.exp(-1j * np.linspace(0.1, 3.0, m))
    refused, lines = 0, create_autospec(Comparison, instance=True)
    for _ in range(2000):
        noise = rng.normal(size=(blocks, m)) + 1j * rng.normal(size=(blocks, m))
        ratio = Ratio(
            numerator=truth + 1e3 * noise, denominator=np.ones((blocks, m), dtype=complex)
        )  # 2 % of it is nothing then
        lines.response, lines.std, lines.ratios = ratio.value, ratio.std, [ratio]
        refused += not explains(lines, truth, alpha)
    assert abs(refused / 2000 - alpha) < 0.025


@pytest.mark.parametrize("noise", [1.0, 2.0])
def test_a_gain_that_no_line_shows_by_itself_is_outside_of_what_was_certified(controller, bench, noise):
    """4 % of the motor's torque, of 0.25 % that were certified, was "one of those that were certified", and its row
    said 0.96 (0.952 to 0.968).
    """
    for seed in (1, 2):
        machine = replace(Machine(), per_ampere=0.96 * Machine().per_ampere)
        log = bench.log(machine, REFERENCE, noise=noise, seed=seed)
        ranges = {"eta": (0.9975, 1.0025)}
        result = so.accept(controller, [log], uncertainty=so.plants.thor(), ranges=ranges)
        first = result.differences.found[0]
        assert not result.differences.inside and not result.met, first
        assert {"eta", "K_tau", "gain"} == {first.name, *first.alike} and first.low <= 0.96 <= first.high
        assert first.high - first.low > 0.005, first  # of all three: that of eta alone knows what was certified of it
        right = bench.log(Machine(), REFERENCE, noise=noise, seed=seed)
        assert so.accept(controller, [right], uncertainty=so.plants.thor(), ranges=ranges).differences.inside
