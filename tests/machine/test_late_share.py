"""Logs by a process of its own, which writes a share of the rows a tick late: what is confirmed of them is true.

A share q of the commands late makes the measured loop gain L / (1 - q + q exp(-j w T)), one with less delay than there
is, of the readings its inverse. The replay takes such logs for the law's own only where q is so small that this is
nothing: of every tick 2 % are too many, of every second one about 5 %.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import seaopt as so
from seaopt.machine.replay import replay
from seaopt.machine.response.periods import cut_periods
from seaopt.machine.response.verdicts import judge_response
from seaopt.machine.ticks import take_ticks
from tests.machine.simulator import Machine
from tests.machine.test_fewer_ticks import LINES, REFERENCE
from tests.machine.test_response import respond

LIMIT = 1.6 * 1.05


def find_sensitivity(controller, machine):
    return float(np.max(1.0 / np.abs(1.0 + respond(machine, LINES.astype(float), controller, 1)[0])))


@pytest.fixture(scope="module")
def strong(controller):
    """Return a machine whose force per ampere takes Ms a hundredth above its limit, by its own equations."""
    low, high = 1.0, 2.0
    for _ in range(30):
        middle = 0.5 * (low + high)
        machine = replace(Machine(), per_ampere=middle * Machine().per_ampere)
        low, high = (low, middle) if find_sensitivity(controller, machine) > 1.01 * LIMIT else (middle, high)
    return machine


def write(log, names, share, every, seed=4):
    """Return every n-th row of a log, with some of the columns of the row before in a random share of the rows."""
    chosen = np.random.default_rng(seed).uniform(size=len(log)) < share
    columns = {name: log[name] for name in ("reference", "F1", "I")}
    columns |= {name: np.where(chosen, np.roll(log[name], 1), log[name]) for name in names}
    return so.Log.from_arrays(
        time=log.time[::every], source="bench", **{name: column[::every] for name, column in columns.items()}
    )


def judge(controller, log):
    """Return whether a log is of the law, and what it says of Ms."""
    ticks = take_ticks(controller, log)
    if not replay(controller, ticks).met:
        return None
    return next(
        row for row in judge_response(controller, [cut_periods(controller, ticks)], 0.95).judged if row.name == "Ms"
    )


@pytest.mark.parametrize("names", [("F1",), ("I",), ("F1", "reference")])
def test_a_log_of_every_tick_with_some_late_is_not_of_the_law(controller, bench, names):
    log = bench.log(Machine(), REFERENCE, noise=0.5)
    assert judge(controller, write(log, (), 0.0, 1)).outcome == "confirmed"
    assert judge(controller, write(log, names, 0.02, 1)) is None


@pytest.mark.parametrize("names", [("F1",), ("I",)])
def test_of_every_second_tick_nothing_is_confirmed_that_is_not_so(controller, bench, strong, names):
    """Ms is a hundredth above its limit, and less by what is logged late."""
    taken = 0
    for share, seed in ((0.0, 1), (0.02, 2), (0.05, 3), (0.2, 4)):
        right, wrong = (bench.log(each, REFERENCE, noise=0.5, seed=seed) for each in (Machine(), strong))
        row = judge(controller, write(right, names, share, 2, seed))
        taken += row is not None
        if share == 0.0:
            assert row.outcome == "confirmed"
        if share == 0.2:
            assert row is None
        above = judge(controller, write(wrong, names, share, 2, seed))
        assert above is None or above.outcome != "confirmed", (share, above)
    assert taken < 4
