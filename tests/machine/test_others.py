"""Intervals of a difference beside another that noise hides, on machines of the tests' own."""

from __future__ import annotations

from dataclasses import replace

import pytest

import seaopt as so
from seaopt.codec import from_content, to_content
from seaopt.machine.differences import certified
from seaopt.machine.differences.size_fit import Difference
from tests.machine.conftest import SPEC
from tests.machine.simulator import Bench, Machine, multisine
from tests.machine.test_response import LINES

RIGHT = Machine()
RANGES = {"eta": (0.98, 1.02), "b_r": (0.95 * 1.31e-4, 1.05 * 1.31e-4)}
REFERENCE = multisine(1000, LINES, 10, 60.0, 3)


def judge(controller, log):
    return so.accept(controller, [log], uncertainty=so.plants.thor(), ranges=RANGES).differences


@pytest.fixture
def judge_alone(monkeypatch):
    """Return what judges with intervals that hold where nothing else differs."""

    def judge_alone(controller, log):
        with monkeypatch.context() as without:
            without.setattr(certified, "state", lambda *given: given[-1])
            return judge(controller, log)

    return judge_alone


def test_an_interval_holds_beside_friction_that_noise_hides(controller, bench, judge_alone):
    """Of a loop 1 ms later with a fifth more friction the delay alone was given as 0.81 ms, 0.63 to 0.997."""
    machine = replace(RIGHT, damping=1.2 * RIGHT.damping, delay_s=1e-3)
    log = bench.log(machine, REFERENCE, noise=10.0, seed=2)
    before, after = judge_alone(controller, log), judge(controller, log)
    alone, late = before.found[0], after.found[0]
    assert (late.name, late.beside, after.inside) == (alone.name, (), before.inside) == ("delay", (), False)
    assert alone.high < 1e-3 and late.low <= 1e-3 <= late.high, (alone, late)
    assert late.low <= late.value <= late.high and late.high - late.low < 1.5 * (alone.high - alone.low)
    assert late.left == alone.left and not late.unless


@pytest.mark.parametrize("seed", [2, 3])
def test_an_interval_names_what_does_the_same(controller, bench, seed):
    """Of the force alone a spring of 1/1.25 is a motor whose inertia and friction are 1.25, to the last digit."""
    heavy = replace(RIGHT, mass=1.25 * RIGHT.mass, damping=1.25 * RIGHT.damping, per_ampere=RIGHT.per_ampere)
    spring = judge(controller, bench.log(heavy, REFERENCE, noise=2.0, seed=seed)).found[0]
    assert spring.name == "k" and spring.low <= 0.8 <= spring.high, spring
    assert spring.unless and any({*each} <= {"J", "b_r"} for each in spring.unless), spring
    assert spring.high - spring.low < 0.02


@pytest.mark.parametrize(
    ("fault", "name", "size"),
    [
        ({"delay_s": 1.2e-3}, "delay", 1.2e-3),
        ({"stiffness": 0.8 * RIGHT.stiffness}, "k", 0.8),
        ({"late": 0.5}, "delay", -5e-4),
    ],
)
def test_a_single_faults_interval_stays_narrow(controller, bench, judge_alone, fault, name, size):
    log = bench.log(replace(RIGHT, **fault), REFERENCE, noise=2.0, seed=2)
    alone, stated = judge_alone(controller, log).found[0], judge(controller, log).found[0]
    assert stated.name == alone.name == name and stated.low <= size <= stated.high, stated
    assert stated.high - stated.low < 2.5 * (alone.high - alone.low), (alone, stated)


def test_what_is_there_beside_nothing_that_goes_with_the_log_alone_names_all_of_it(controller, bench):
    """A torque of 0.84 that explains 41 % of dry friction and a delay had the interval of nothing else, and no word."""
    machine = replace(RIGHT, coulomb=30.0, smoothing=1e-3, delay_s=1e-3)
    torque = judge(controller, bench.log(machine, REFERENCE, noise=10.0, seed=2)).found[1]
    assert torque.name == "K_tau" and torque.left > 4.0 and torque.unless, torque


@pytest.mark.parametrize("damping", [1.0, 3.0])
def test_a_parameter_of_the_plant_may_be_named_gain(compiler, tmp_path, damping):
    """A motor of 0.7 of the torque was given as 15440 times, 15440 to 15440."""
    stand = so.Plant(
        name="stand", states={"x": "m", "v": "m/s"}, inputs={"I": "A"}, outputs={"F1": "N"},
        parameters={"M": "kg", "b": "N s/m", "k": "N/m", "gain": "N/A"},
        f=lambda t, x, u, p: {"x": x.v, "v": (p.gain * u.I - p.b * x.v - p.k * x.x) / p.M},
        h=lambda t, x, u, p: {"F1": p.k * x.x},
    )  # fmt: skip
    parameters = {"M": (RIGHT.mass, "kg"), "b": (RIGHT.damping, "N s/m"), "k": (RIGHT.stiffness, "N/m")}
    values = so.ParameterSet.of(**parameters, gain=(RIGHT.per_ampere, "N/A"))
    bench = Bench(compiler, tmp_path, so.tune(stand, values, SPEC))
    weak = replace(RIGHT, per_ampere=0.7 * RIGHT.per_ampere, damping=damping * RIGHT.damping)
    first = so.accept(bench.controller, [bench.log(weak, REFERENCE, noise=2.0, seed=2)]).differences.found[0]
    (gain,) = (part for part in (first, *first.beside) if part.name == "gain")
    assert gain.low <= 0.7 <= gain.high and 0.002 < gain.high - gain.low < 0.02, first


def test_what_is_named_is_stored_and_read():
    made = {"kind": "parameter", "name": "k", "unit": "-", "explains": 1.0, "low": 0.79, "high": 0.81, "value": 0.8}
    spring = Difference(**made, unless=(("N_p",), ("J", "b_r")))
    content = to_content(spring)
    assert content["unless"] == [["N_p"], ["J", "b_r"]] or content["unless"] == (("N_p",), ("J", "b_r"))
    assert from_content(Difference, content, "a difference", remedy="correct it") == spring
    del content["unless"]  # as of a file that was written before
    assert from_content(Difference, content, "a difference", remedy="correct it") == replace(spring, unless=())
