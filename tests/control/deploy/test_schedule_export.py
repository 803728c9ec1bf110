"""The C code of a scheduled law against the law in NumPy, sample by sample."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest

import seaopt as so
from seaopt.control import PlausibilityGate, ScheduledController
from seaopt.control.deploy.schedule_export import read_runnable
from seaopt.errors import ControlError, FileError
from seaopt.files import to_json
from seaopt.plants.motor.heat_guard import HeatGuard
from tests.c_code import CompiledSchedule
from tests.schedules import read_knee, tune_knee


@pytest.fixture(scope="module")
def schedule():
    return tune_knee()


@pytest.fixture(scope="module")
def samples():
    """Return reference, measurement and place: within the table and beyond, saturated and not, some not finite."""
    rng = np.random.default_rng(3)
    references, measurements = 3.0 * rng.normal(size=(2, 3000))
    references[1000:1600] += 40.0
    place = 0.4 + 0.6 * np.sin(np.arange(3000) / 200.0)
    place[300:320] = place[0] = math.nan
    place[700], place[701] = math.inf, -math.inf
    references[50], measurements[51:55] = math.nan, math.inf
    return references, measurements, place


def run_both(compiled, law, samples):
    compiled.reset(0.5, 0.2, math.nan, 1.0)
    state, pairs = law.reset(0.5, 0.2, math.nan, 1.0), []
    for row in zip(*samples, strict=True):
        command, state = law.step(state, *row)
        pairs.append((compiled.step(*row), command))
        assert (compiled.law.held, compiled.law.misplaced) == (state.held, state.misplaced)
    return np.array(pairs).T


def test_in_double_every_command_is_numpys(compiler, tmp_path, schedule, samples):
    compiled = CompiledSchedule(compiler, tmp_path, schedule)
    got, expected = run_both(compiled, schedule.runnable(), samples)
    assert np.any(np.abs(expected) == 5.0) and np.mean(np.abs(expected) < 5.0) > 0.3
    np.testing.assert_allclose(got, expected, rtol=0.0, atol=5e-13)


def test_in_float_commands_agree_to_its_digits(compiler, tmp_path, schedule, samples):
    compiled = CompiledSchedule(compiler, tmp_path, schedule, precision="float")
    got, expected = run_both(compiled, schedule.runnable(), samples)
    assert np.max(np.abs(got - expected)) < 1e-3


def test_a_reset_continues_from_its_command(compiler, tmp_path, schedule):
    compiled = CompiledSchedule(compiler, tmp_path, schedule)
    compiled.reset(2.0, 2.0, 0.3, 1.25)
    assert compiled.step(2.0, 2.0, 0.3) == pytest.approx(1.25, rel=1e-12)


def test_before_any_place_the_fallback_counts(compiler, tmp_path, schedule):
    compiled = CompiledSchedule(compiler, tmp_path, schedule)
    law = schedule.runnable()
    assert compiled.step(0.1, 0.0, math.nan) == law.step(law.reset(), 0.1, 0.0, schedule.fallback)[0]
    assert compiled.law.misplaced == 2


def test_the_stored_schedule_runs_as_the_one_that_was_stored(schedule):
    law, _ = read_runnable(json.loads(to_json(schedule.to_dict())))
    assert np.array_equal(law.anti_windup, schedule.runnable().anti_windup) and law.command_limit == 5.0


def test_a_table_that_was_edited_or_is_not_feasible_is_not_exported(tmp_path, schedule):
    content = json.loads(to_json(schedule.to_dict()))
    missed = {"schedule": content["schedule"] | {"broken": ["max_sensitivity at phi = 0.1"]}, "feasible": False}
    with pytest.raises(ControlError, match="misses"):
        so.export(content | missed, tmp_path)
    with pytest.raises(FileError, match="anti_windup"):
        so.export(content | {"schedule": content["schedule"] | {"anti_windup": [0.5, 0.5, 0.5]}}, tmp_path)
    assert not list(tmp_path.iterdir())
    so.export(content | missed, tmp_path, allow_infeasible=True)
    assert "NOT FEASIBLE" in (tmp_path / "force_law.h").read_text()


@pytest.mark.parametrize(("limit", "stated"), [(6.0, True), (5.0, False)])
def test_a_limit_above_that_of_the_design_is_stated(tmp_path, schedule, limit, stated):
    so.export(schedule, tmp_path, current_limit_A=limit)
    assert ("It was designed with a limit of 5 A" in (tmp_path / "force_law.h").read_text()) == stated


GATE = PlausibilityGate(range_N=(-8.0, 8.0), max_step_N=9.0, max_held=6, ramp_per_s=20.0)
HEAT = HeatGuard(
    a_11=0.985, a_12=0.01, a_21=0.001, a_22=0.9989, b_1=0.08, b_2=1e-4, resistance=0.6, slope=0.002,
    allowed_rise=40.0, share=0.02, ambient=21.0,
)  # fmt: skip


@pytest.mark.parametrize("guards", [{"gate": GATE}, {"derate": HEAT}, {"gate": GATE, "derate": HEAT}])
def test_guards_act_as_in_python(compiler, tmp_path, schedule, samples, guards):
    references, measurements, place = (row.copy() for row in samples)
    measurements[400:404], measurements[2900:2908] = [math.nan, 1e9, -1e16, math.inf], math.nan
    compiled = CompiledSchedule(compiler, tmp_path, schedule, **guards)
    law = replace(schedule.runnable(), gate=guards.get("gate"), heat=guards.get("derate"))
    state, pairs, statuses = law.reset(), [], set()
    for row in zip(references, measurements, place, strict=True):
        command, state = law.step(state, *row)
        pairs.append((compiled.step(*row), command))
        assert (compiled.law.held, compiled.law.misplaced, compiled.law.place) == (
            state.held,
            state.misplaced,
            state.place,
        )
        statuses.add(compiled.law.status)
    got, expected = np.array(pairs).T
    np.testing.assert_allclose(got, expected, rtol=0, atol=1e-12)
    assert np.mean(np.abs(expected) > 0.0) > 0.5
    if "gate" in guards:
        assert statuses == {0, 1, 2}
        assert expected[-1] == 0.0  # a fault, until a reset
    if "derate" in guards:
        assert compiled.law.rise_winding == pytest.approx(state.heat[0], rel=1e-10)
        assert compiled.law.limit < 5.0


def test_what_nothing_is_known_of_is_not_derated(tmp_path, schedule):
    with pytest.raises(ControlError, match="thermal"):
        so.export(schedule, tmp_path, derate=True)


def test_a_schedule_keeps_the_guards_of_its_file(schedule):
    guarded = replace(schedule, controllers=tuple(replace(each, gate=GATE) for each in schedule.controllers))
    assert guarded.runnable().gate == GATE
    assert "6 others in a row are bridged" in " ".join(repr(guarded).split())
    content = json.loads(to_json(guarded.to_dict()))
    stand, _, values = read_knee()
    assert ScheduledController.from_dict(content, stand, values).runnable().gate == GATE
