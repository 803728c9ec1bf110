"""Logs of every n-th tick of a machine with dry friction, compared with its model as those of every tick are."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import seaopt as so
from tests.machine.conftest import FRICTION, play_against_friction
from tests.machine.simulator import Machine, multisine

RIGHT = replace(Machine(), coulomb=FRICTION, smoothing=5e-3)


@pytest.fixture(scope="module")
def dry(dry_bench):
    return dry_bench, play_against_friction(dry_bench, 8)


LINES = np.unique(np.round(np.geomspace(2, 180, 24)).astype(int))
REFERENCE = multisine(1000, LINES, 30, 60.0, 3, bias=300.0)


def keep_every(log, every, first=0):
    columns = {name: log[name][first::every] for name in ("reference", "F1", "I")}
    return so.Log.from_arrays(time=log.time[first::every], source="bench", **columns)


@pytest.mark.parametrize(("every", "first"), [(2, 0), (2, 1)])
def test_a_right_machine_is_one_of_those_that_were_certified(dry, every, first):
    """And its figures are as played, as in a log of every tick: it was met with nothing compared at all."""
    bench, reference = dry
    log = bench.log(RIGHT, reference, noise=0.5)
    whole, part = (so.accept(bench.controller, [each]) for each in (log, keep_every(log, every, first)))
    assert part.replayed and part.replays[0].ticks_per_row == every
    assert part.differences is not None and part.differences.inside and part.differences.misfit < 2.0, part
    assert "differences" not in part.left_out
    for row, other in zip(whole.response.judged, part.response.judged, strict=True):
        assert (row.name, row.state) == (other.name, other.state)
        if row.predicted is not None:
            assert other.predicted == pytest.approx(row.predicted, rel=0.02), (row, other)
    assert whole.met == part.met


def test_friction_that_is_doubled_is_named(dry):
    bench, reference = dry
    log = bench.log(replace(RIGHT, coulomb=2.0 * FRICTION), reference, noise=0.5)
    result = so.accept(bench.controller, [keep_every(log, 2)])
    first = result.differences.found[0]
    assert result.replayed and not result.met and "f_c" in (first.name, *first.alike), result
    assert np.isclose(
        dict(zip((first.name, *first.alike), (first.value, *first.alike_values), strict=True))["f_c"], 2.0, rtol=0.1
    )


@pytest.mark.parametrize(("delay", "right"), [(0.0, True), (1e-3, False)])
def test_a_command_that_is_logged_a_tick_late_is_not_the_delay_of_the_machine(controller, bench, delay, right):
    """A machine with a tick of delay more, whose command is logged as late, looked as the certified one."""
    log = bench.log(replace(Machine(), delay_s=delay), REFERENCE, noise=0.5)
    logged = so.Log.from_arrays(
        time=log.time, source="bench", reference=log["reference"], F1=log["F1"], I=np.r_[0.0, log["I"][:-1]]
    )
    result = so.accept(controller, [keep_every(logged, 2)])
    assert result.replayed and (result.replays[0].ticks_per_row, result.replays[0].command_late) == (2, 1)
    assert (result.met, result.differences.inside) == (right, right), result
    if not right:
        first = result.differences.found[0]
        assert first.kind == "delay" and np.isclose(first.value, delay, rtol=0.1), result
