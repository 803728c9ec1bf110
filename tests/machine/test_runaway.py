"""A log that ends in a runaway is told to be one: who is told to record for longer plays it again."""

from __future__ import annotations

import numpy as np
import pytest

import seaopt as so
from seaopt.machine.response.periods import Played
from tests.machine.simulator import Machine
from tests.machine.test_response import REFERENCE

PLAYED = Played(period_s=1.0, lasts_s=12.0)
ROWS = 700  # shorter than a period


def cut(log, rows, turned=1.0):
    """Return the first rows of a log; `turned`: the sign of the readings that the law was given."""
    columns = {name: sign * log[name][:rows] for name, sign in (("reference", 1.0), ("F1", turned), ("I", 1.0))}
    return so.Log.from_arrays(time=log.time[:rows], source="bench", **columns)


def judge(controller, bench, machine, **stop):
    """Return what is said of a log that a stop ends, and how many rows it has."""
    log = bench.log(machine, REFERENCE * np.minimum(np.arange(REFERENCE.size) / 1000, 1.0))
    rows = 1 + int(np.argmax(np.abs(log["F1"]) > stop["force"])) if stop else ROWS
    result = so.accept(controller, [cut(log, rows, machine.reading_sign)], played=PLAYED)
    assert result.replayed and result.response is None
    return result.left_out["bench"], machine.reading_sign * log["F1"][rows - 1], rows


@pytest.mark.parametrize("turned", ["drive_sign", "reading_sign"])
@pytest.mark.parametrize("stop", [800.0, 1900.0])
def test_a_log_that_a_stop_ended_names_the_signs_and_what_ran(controller, bench, turned, stop):
    says, last, rows = judge(controller, bench, Machine(**{turned: -1.0}), force=stop)
    assert rows < ROWS
    assert "the loop ran away" in says and "check the signs of command and readings" in says
    assert f"F1 ran to {last:.3g} N" in says
    assert "record" not in says


def test_a_reading_that_is_dead_takes_the_command_to_its_limit(controller, bench):
    says, _, _ = judge(controller, bench, Machine(per_ampere=0.0))
    assert "I went to its limit of 9 A and stayed there" in says and "check the signs" in says


@pytest.mark.parametrize("rows", range(60, 2000, 241))
def test_a_log_of_a_right_machine_that_is_cut_anywhere_is_none(controller, bench, rows):
    fading = REFERENCE * np.minimum(np.arange(REFERENCE.size) / 1000, 1.0)
    for reference in (fading, fading - 300.0 * np.minimum(np.arange(REFERENCE.size) / 1000, 1.0)):
        says = so.accept(controller, [cut(bench.log(Machine(), reference), rows)], played=PLAYED).left_out
        assert not any("ran away" in text for text in says.values()), says
