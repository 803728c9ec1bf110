"""The C code of a scheduled law against the law in NumPy, sample by sample."""

import json
import math

import numpy as np
import pytest

import seaopt as so
from seaopt.control.deploy.schedule_export import read_runnable
from seaopt.errors import ControlError, FileError
from seaopt.files import to_json
from tests.c_code import CompiledSchedule
from tests.schedules import tune_knee


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
    assert np.array_equal(got, expected)


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
    assert np.array_equal(law.anti_windup, schedule.runnable().anti_windup) and law.limit == 5.0


def test_a_table_that_was_edited_or_is_not_feasible_is_not_exported(tmp_path, schedule):
    content = json.loads(to_json(schedule.to_dict()))
    with pytest.raises(ControlError, match="misses"):
        so.export(content | {"feasible": False, "broken": ["max_sensitivity at phi = 0.1"]}, tmp_path)
    with pytest.raises(FileError, match="anti_windup"):
        so.export(content | {"anti_windup": [0.5, 0.5, 0.5]}, tmp_path)
    assert not list(tmp_path.iterdir())
    so.export(
        content | {"feasible": False, "broken": ["max_sensitivity at phi = 0.1"]}, tmp_path, allow_infeasible=True
    )
    assert "NOT FEASIBLE" in (tmp_path / "force_law.h").read_text()


@pytest.mark.parametrize(("limit", "stated"), [(6.0, True), (5.0, False)])
def test_a_limit_above_that_of_the_design_is_stated(tmp_path, schedule, limit, stated):
    so.export(schedule, tmp_path, current_limit_A=limit)
    assert ("It was designed with a limit of 5 A" in (tmp_path / "force_law.h").read_text()) == stated


def test_a_gate_is_refused(tmp_path, schedule):
    with pytest.raises(ControlError, match="derate"):
        so.export(schedule, tmp_path, derate=True)
