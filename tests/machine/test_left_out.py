"""Periods that a response is not taken from are counted, with why and what to do, wherever an acceptance is shown."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

import seaopt as so
from seaopt.control import PlausibilityGate
from seaopt.files import to_json
from seaopt.machine.page import write_acceptance_page
from seaopt.machine.response.periods import Played
from tests.machine.simulator import Bench, Machine, multisine
from tests.machine.test_response import LINES, REFERENCE

PERIOD = 1000


def read_everywhere(result, folder):
    """Return what terminal and page say, as one line each, and the record."""
    page = write_acceptance_page(result, folder / "page.html").read_text()
    return " ".join(repr(result).split()), " ".join(page.split()), json.loads(to_json(result.to_dict()))


def test_periods_at_the_limit_are_counted_and_said(controller, bench, tmp_path):
    log = bench.log(Machine(), multisine(PERIOD, LINES, 12, 115.0, 3), noise=6.0)
    at_limit = np.any(np.abs(log["I"]).reshape(-1, PERIOD) >= 9.0 * (1.0 - 1e-6), axis=1)
    reached, free = int(np.sum(at_limit[1:])), int(np.sum(~at_limit[1:]))
    assert reached and free >= 2, at_limit
    result = so.accept(controller, [log])
    terminal, page, record = read_everywhere(result, tmp_path)
    says = f"{reached} of 11 periods left out: in {reached} of them the command is at its limit: lower the amplitude"
    assert says in terminal and says in page and "or allow a larger limit" in page
    (part,) = record["response"]["measured"]
    assert part["left_out"] == {"limit": reached, "gate": 0, "gap": 0} and part["periods"] == free
    share = f"{100.0 * np.mean(np.abs(log['I']) >= 9.0 * (1.0 - 1e-6)):.2g} %"
    assert share in terminal and share in page  # of the ticks, in the table of the replay


def test_periods_in_which_the_gate_did_not_believe_a_reading_are_counted(compiler, controller, tmp_path):
    gate = PlausibilityGate(range_N=(-4000.0, 4000.0), max_step_N=12.5, max_held=20, ramp_A_per_s=50.0)
    gated = replace(controller, gate=gate)
    log = Bench(compiler, tmp_path, gated, "gated").log(
        Machine(), REFERENCE * np.minimum(np.arange(REFERENCE.size) / PERIOD, 1.0)
    )
    believed, held, rows = log["F1"][0], 0, np.zeros(len(log), dtype=bool)
    for k, reading in enumerate(log["F1"]):
        if abs(reading - believed) <= gate.max_step_N * (held + 1):
            believed, held = reading, 0
        else:
            held, rows[k] = held + 1, True
    refused = int(np.sum(np.any(rows.reshape(-1, PERIOD), axis=1)[1:]))
    assert 0 < refused < 8, refused
    result = so.accept(gated, [log])
    assert result.replayed, result.left_out
    assert result.response is not None, result.left_out
    terminal, page, record = read_everywhere(result, tmp_path)
    assert record["response"]["measured"][0]["left_out"] == {"limit": 0, "gate": refused, "gap": 0}
    says = f"in {refused} of them the gate did not believe a reading"
    assert says in terminal and says in page


def test_periods_beyond_a_gap_are_counted(controller, bench, tmp_path):
    whole = bench.log(Machine(), REFERENCE)
    kept = np.delete(np.arange(len(whole)), slice(7200, 7300))
    columns = {name: whole[name][kept] for name in ("reference", "F1", "I")}
    log = so.Log.from_arrays(time=whole.time[kept], source="bench", **columns)
    terminal, page, record = read_everywhere(so.accept(controller, [log]), tmp_path)
    assert record["response"]["measured"][0]["left_out"] == {"limit": 0, "gate": 0, "gap": 2}
    assert "2 of them would lie beyond a gap" in terminal and "2 of them would lie beyond a gap" in page


def test_stability_is_shown_with_what_it_is_and_its_limit(controller, bench, tmp_path):
    result = so.accept(controller, [bench.log(Machine(), REFERENCE)])
    (part,) = result.response.measured
    centre, radius = part.loop.disc(0.05 / part.f.size)
    least = np.min(np.abs(1.0 + centre) / radius)
    terminal, page, _ = read_everywhere(result, tmp_path)
    assert f"stability confirmed at least 1 {least:.3g} –" in terminal  # nothing predicted: what follows is in Hz
    assert "Stability is the least |1 + L| over the radius of its disc (no unit)" in terminal
    assert "Stability is the least |1 + L| over the radius of its disc (no unit)" in page


@pytest.mark.parametrize(("rows", "says"), [(700, "shorter than one period"), (1700, "shorter than two periods")])
def test_a_log_that_is_shorter_than_its_periods_is_told_so_and_how_long_to_record(controller, bench, rows, says):
    log = bench.log(Machine(), REFERENCE[:rows])
    result = so.accept(controller, [log], played=Played(period_s=1.0, lasts_s=12.0))
    text = result.left_out["bench"]
    assert f"it lasts {rows / PERIOD:g} s, {says}" in text and "of 1 s each" in text and "record all" in text
    assert "12 s" in text and "three after it, 4 s" in text
    unknown = so.accept(controller, [log]).left_out["bench"]
    assert "the log is shorter than two of them" in unknown and "at least 3 periods" in unknown
