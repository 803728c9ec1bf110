"""The status that the exported C has in a log, beside what the replay says of it."""

from __future__ import annotations

import numpy as np
import pytest

import seaopt as so
from tests.c_code import CompiledLaw
from tests.machine.simulator import Machine
from tests.machine.test_left_out import read_everywhere, trip
from tests.machine.test_response import REFERENCE

FIRST = 6300


def add(log, status):
    """Return a log with its status."""
    columns = {name: log[name] for name in log.signals if name != "time"}
    return so.Log.from_arrays(time=log.time, source="bench", status=np.asarray(status, dtype=float), **columns)


@pytest.fixture(scope="module")
def tripped(compiler, controller, tmp_path_factory):
    """Return a law with a gate, a log in which it trips, and the status of its C in each tick."""
    folder = tmp_path_factory.mktemp("tripped")
    gated, log = trip(compiler, controller, folder, FIRST)
    law, status = CompiledLaw(compiler, folder, gated, "double", gate=gated.gate), list[int]()
    for goal, reading, current in zip(log["reference"], log["F1"], log["I"], strict=True):
        assert abs(law.step(goal, reading) - current) < 1e-6
        status.append(law.law.status)
    assert set(status) == {0, 1, 2}
    return gated, log, np.array(status)


def test_a_fault_is_said_beside_the_trip_that_the_replay_finds(tripped, tmp_path):
    gated, log, status = tripped
    result = so.accept(gated, [add(log, status)])
    terminal, page, record = read_everywhere(result, tmp_path)
    told, (row,) = record["replay"]["logs"][0]["status"], result.replays
    assert told == {"held": 3, "fault_s": pytest.approx(1e-3 * (FIRST + 3)), "contradicts": False}
    assert told["fault_s"] == pytest.approx(row.trip.at_s)
    assert "its status is a fault from 6.303 s on" in terminal and "its status is a fault from 6.303 s on" in page


def test_a_status_without_a_fault_contradicts_a_trip(tripped, tmp_path):
    gated, log, status = tripped
    result = so.accept(gated, [add(log, 0.0 * status)])
    terminal, _, record = read_everywhere(result, tmp_path)
    assert record["replay"]["logs"][0]["status"] == {"held": 0, "fault_s": None, "contradicts": True}
    assert "its status has no fault, though the gate tripped" in terminal and "though the gate" in str(result)


def test_a_fault_contradicts_a_law_that_goes_on(controller, bench):
    log = bench.log(Machine(), REFERENCE)
    result = so.accept(controller, [add(log, np.where(np.arange(len(log)) < 5000, 0, 2))])
    (told,) = result.reported
    assert (told.fault_s, told.contradicts) == (pytest.approx(5.0), True)
    assert "a fault from 5.000 s on, but the logged command is that of the law to the end" in " ".join(
        str(result).split()
    )


@pytest.mark.parametrize(("code", "says"), [(2, "a fault from 6.000 s on"), (0, "no fault: a stage ended itself")])
def test_of_a_command_that_was_stopped_the_status_says_by_what(controller, bench, code, says):
    log = bench.log(Machine(), REFERENCE)
    status = np.where(np.arange(len(log)) < 6000, 0, code)
    command = np.where(np.arange(len(log)) < 6000, log["I"], 0.0)
    stopped = so.Log.from_arrays(time=log.time, reference=log["reference"], F1=log["F1"], I=command)
    result = so.accept(controller, [add(stopped, status)])
    assert result.replays[0].causes[0].kind == "stopped" and not result.reported[0].contradicts
    assert says in " ".join(repr(result).split())


def test_a_column_of_other_numbers_is_no_status_and_one_without_a_fault_says_nothing(controller, bench):
    log = bench.log(Machine(), REFERENCE)
    other = so.accept(controller, [add(log, np.full(len(log), 7))])
    assert other.reported == (None,) and other.to_dict()["replay"]["logs"][0]["status"] is None
    fine = so.accept(controller, [add(log, np.zeros(len(log)))])
    assert fine.reported[0].fault_s is None and "its status" not in repr(fine)
