"""What an acceptance says of how far it goes."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

import seaopt as so
from seaopt.machine.differences.size_fit import Difference
from seaopt.machine.page.page import describe
from seaopt.machine.page.verdict import judge
from seaopt.machine.wording import say_difference
from seaopt.reporting.sections.data import Commands
from tests.machine.simulator import Machine
from tests.machine.test_left_out import read_everywhere
from tests.machine.test_response import REFERENCE


@pytest.fixture(scope="module")
def judged(controller, bench):
    fading = np.minimum(np.arange(REFERENCE.size) / 1000, 1.0)
    log = bench.log(Machine(), REFERENCE * fading)
    return log, so.accept(controller, [log])


def test_up_to_which_command_the_log_judges_is_data_and_said(judged, tmp_path):
    log, result = judged
    terminal, page, record = read_everywhere(result, tmp_path)
    (row,) = record["replay"]["logs"]
    size = np.sort(np.abs(log["I"]))
    assert row["command_most"] == size[-1]
    assert size[int(0.95 * size.size) - 1] <= row["command_mostly"] <= size[int(0.95 * size.size) + 1]
    says = f"The command goes up to {size[-1]:.3g} A, of 9 A allowed, in 95 % of the ticks to"
    assert says in terminal and says in page


@pytest.mark.parametrize(
    ("value", "says"),
    [
        (15.0, "a larger reference comes nearer"),
        (31.0, "it is 31 Hz (27.9 to 34.1), which is what was asked"),
        (29.0, "it is 29 Hz (26.1 to 31.9), which is what was asked"),
        (
            27.1,
            "it is 27.1 Hz (24.4 to 29.8), which is less than was asked and no less than the 27 Hz that are allowed",
        ),
        (46.0, "1.5 times what was asked: nothing bounds it above"),
        (66.0, "2.2 times what was asked"),
    ],
)
@pytest.mark.parametrize(("limit", "little"), [(5.4, True), (27.0, False)])
def test_a_stuck_bandwidth_is_said_beside_what_was_asked(judged, value, says, limit, little):
    _, result = judged
    rows = [
        replace(row, state="stuck", value=value, low=0.9 * value, high=1.1 * value, limit=limit)
        if row.name == "bandwidth"
        else row
        for row in result.response.judged
    ]
    text = " ".join(repr(replace(result, response=replace(result.response, judged=tuple(rows)))).split())
    assert says in text
    assert ("The limit of 5.4 Hz is 18 % of what was asked" in text) == little


@pytest.mark.parametrize(
    ("name", "says", "never"),
    [
        ("f_c", "record a larger amplitude, beside which dry friction is less", "138"),
        ("k", "record 138 periods", "is less"),
    ],
)
def test_no_periods_are_asked_for_where_friction_is_what_differs(judged, name, says, never):
    _, result = judged
    rows = [
        replace(row, outcome="undecided", periods=138) if row.name == "bandwidth" else row
        for row in result.response.judged
    ]
    made = {"kind": "parameter", "unit": "-", "explains": 1.0, "low": 1.9, "high": 2.1, "value": 2.0}
    differences = replace(result.differences, inside=False, found=(Difference(name=name, **made),))
    other = replace(result, response=replace(result.response, judged=tuple(rows)), differences=differences)
    first, reason = (each.what for each in judge(other, Commands()).reasons)
    assert first == f"{name} is 2 times its value"
    assert f"bandwidth: {says}" in reason and never not in reason


def test_no_periods_are_asked_for_where_a_sensor_is_at_its_range(judged):
    """Nineteen of them were, of a log that has eighteen: more would be clipped as well."""
    _, result = judged
    rows = [
        replace(row, outcome="undecided", periods=19) if row.name == "bandwidth" else row
        for row in result.response.judged
    ]
    clipped = Difference(kind="range", name="F1", value=60.0, low=None, high=None, unit="N", explains=1.0)
    differences = replace(result.differences, inside=False, found=(clipped,))
    other = replace(result, response=replace(result.response, judged=tuple(rows)), differences=differences)
    first, reason = (each.what for each in judge(other, Commands()).reasons)
    assert first == "F1 stops at 60 N: its sensor is at its range" and "19 periods" not in reason
    assert "bandwidth: record again with the readings within the range of their sensor" in reason
    assert read_row(other, "bandwidth")["would decide"] == ""


def read_row(result, name):
    """Return the cells of a figure's row in the printed table."""
    (table,) = next(each for each in describe(result) if each.part == "response").tables
    return dict(zip(table.head, next(row for row in table.rows if row[0] == name), strict=True))


def test_a_number_of_periods_that_nobody_records_is_a_larger_amplitude_in_the_table(judged):
    _, result = judged
    for periods, cell in ((21, "21 periods"), (1449, "a larger amplitude at 22 Hz")):
        rows = [
            replace(row, outcome="undecided", periods=periods, where_hz=22.0) if row.name == "Ms" else row
            for row in result.response.judged
        ]
        other = replace(result, response=replace(result.response, judged=tuple(rows)))
        assert read_row(other, "Ms")["would decide"] == cell
        assert {row["periods"] for row in other.to_dict()["response"]["figures"] if row["name"] == "Ms"} == {periods}


def test_a_factor_at_the_end_of_what_is_tried_is_said_to_be_that_or_more():
    made = {"kind": "parameter", "name": "b_r", "unit": "-", "explains": 1.0, "low": None, "high": None}
    largest = Difference(value=math.exp(3.0), alike=("k", "gain"), alike_values=(math.exp(-3.0), 0.03), **made)
    assert say_difference(largest) == "b_r is 20 times its value or more (or k 0.05 or less, or gain 0.03)"
    assert say_difference(Difference(value=19.9, **made)) == "b_r is 19.9 times its value"


@pytest.mark.parametrize("left", [1.0, 9.0])
def test_an_interval_says_what_else_may_differ(judged, tmp_path, left):
    """A loop 1 ms later with a fifth more friction was given as 0.936 ms (0.891 to 0.982), explained to the noise."""
    _, result = judged
    late = Difference(
        kind="delay", name="delay", value=9.36e-4, low=8.91e-4, high=9.82e-4, unit="s", explains=0.995, left=left
    )
    mode = replace(late, kind="mode", name="mode", value=40.0, low=39.0, high=41.0, unit="Hz")
    either = replace(late, unless=(("N_p",), ("b_r", "J")))
    for found in ((late,), (mode,), (late, mode), (either,)):
        differences = replace(result.differences, inside=False, found=found)
        for text in read_everywhere(replace(result, differences=differences), tmp_path)[:2]:
            assert ("An interval holds where no more than two of" in text) == (found != (mode,))
            assert ("hold where nothing else differs" in text) == (mode in found)
            assert ("No row explains all of it to the noise." in text) == (left > result.differences.most_noise)
            told = (
                "The interval of delay holds unless one of these is off, too, which does what it does: N_p, b_r with J."
            )
            assert (told in text) == (either in found)
