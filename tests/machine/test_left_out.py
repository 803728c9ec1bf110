"""Periods that a response is not taken from are counted, with why and what to do, wherever an acceptance is shown."""

from __future__ import annotations

import json
import re
from dataclasses import replace

import numpy as np
import pytest

import seaopt as so
from seaopt.control import PlausibilityGate, runnable
from seaopt.files import to_json
from seaopt.machine.page.page import write_acceptance_page
from seaopt.machine.response.periods import Played, shorten
from seaopt.machine.ticks import take_ticks
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
    gate = PlausibilityGate(range_N=(-4000.0, 4000.0), max_step_N=12.5, max_held=20, ramp_per_s=50.0)
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


def test_a_gate_that_was_left_out_is_named(controller, bench):
    """The C without a gate, of readings that the gate of the law would not have believed."""
    gate = PlausibilityGate(range_N=(-4000.0, 4000.0), max_step_N=12.5, max_held=20, ramp_per_s=50.0)
    log = bench.log(Machine(), multisine(PERIOD, LINES, 10, 60.0, 3, bias=300.0), noise=6.0)
    (row,) = so.accept(replace(controller, gate=gate), [log]).replays
    first = row.causes[0]
    assert not row.met and (first.kind, first.what, first.explains) == ("gate", "left out", True)


def trip(compiler, controller, folder, first, reading=9000.0):
    """Return a law with a gate, and the log of its C in which the sensor fails in a row: readings that stay at a value,
    and what the law steps make of them.
    """
    gate = PlausibilityGate(range_N=(-1500.0, 1500.0), max_step_N=1000.0, max_held=3, ramp_per_s=50.0)
    gated = replace(controller, gate=gate)
    log = Bench(compiler, folder, gated, "gated").log(Machine(), REFERENCE)
    force, law = np.where(np.arange(len(log)) < first, log["F1"], reading), runnable(gated, gate=gate)
    state, current = law.reset(), np.empty(len(log))
    for k, (goal, read) in enumerate(zip(log["reference"].tolist(), force.tolist(), strict=True)):
        current[k], state = law.step(state, goal, read)
    assert np.allclose(current[:first], log["I"][:first], atol=1e-6)
    return gated, so.Log.from_arrays(time=log.time, source="bench", reference=log["reference"], F1=force, I=current)


def test_a_gate_that_tripped_is_named_with_when_and_the_log_ends_before_it(compiler, controller, tmp_path):
    first = 6300
    gated, log = trip(compiler, controller, tmp_path, first)
    result = so.accept(gated, [log])
    terminal, page, record = read_everywhere(result, tmp_path)
    told = record["replay"]["logs"][0]["trip"]
    assert result.replayed and np.all(log["I"][first + 500 :] == 0.0)
    assert told["row"] == first and (told["readings"], told["reading"], told["why"]) == (4, 9000.0, "range")
    assert told["at_s"] == pytest.approx(1e-3 * (first + 3)) and told["stopped_s"] == pytest.approx(10.0 - told["at_s"])
    (part,) = record["response"]["measured"]
    assert part["periods"] == 5 and part["left_out"] == {"limit": 0, "gate": 0, "gap": 0}
    ((_, experiment),) = result.experiments
    assert first - 2 <= len(experiment) <= first and experiment["F1"][-1] == log["F1"][first - 1]
    says = f"the gate tripped at {1e-3 * (first + 3):.3f} s, of 4 readings in a row outside its range, -1500 to 1500 N"
    assert says in terminal and says in page and "the law was stopped for the rest" in terminal


@pytest.mark.parametrize("rows", [1, 20, 800, 1500])
def test_a_gate_that_tripped_too_early_for_a_response_is_why_there_is_none(compiler, controller, tmp_path, rows):
    gated, log = trip(compiler, controller, tmp_path, rows)
    result = so.accept(gated, [log])
    says = " ".join(repr(result).split())
    assert result.response is None and not result.met and result.replays[0].trip is not None
    assert "no response: the gate tripped before" in says and "the gate tripped at" in says
    assert len(result.experiments) == (rows > 100)


def test_after_a_trip_it_is_not_asked_for_what_the_log_has(compiler, controller, tmp_path):
    """Of a log that decides nothing, as with dry friction and few sets of phases before the trip."""
    gated, log = trip(compiler, controller, tmp_path, 4300)
    result = so.accept(gated, [log])
    judged = tuple(replace(row, outcome="undecided", periods=12, near=None) for row in result.response.judged)
    says = " ".join(repr(replace(result, response=replace(result.response, judged=judged, needs_phases=True))).split())
    assert "record all of the reference again, without a trip of the gate" in says
    assert "sets of random phases" not in says and "periods in all" not in says


def lose(log, rows):
    """Return a log without some of its rows."""
    kept = np.delete(np.arange(len(log)), rows)
    columns = {name: log[name][kept] for name in ("reference", "F1", "I")}
    return so.Log.from_arrays(time=log.time[kept], source="bench", **columns)


@pytest.mark.parametrize(("rows", "lost"), [([7200], 1), (range(7200, 7300), 1), ([999, 3500, 3700, 6100], 2)])
def test_periods_with_a_gap_are_counted_and_all_others_used(controller, bench, rows, lost, tmp_path):
    rows, whole = list(rows), bench.log(Machine(), REFERENCE)
    terminal, page, record = read_everywhere(so.accept(controller, [lose(whole, rows)]), tmp_path)
    (part,) = record["response"]["measured"]
    assert part["left_out"] == {"limit": 0, "gate": 0, "gap": lost} and part["periods"] == 9 - lost
    says = f"in {lost} of them a row or a number is missing"
    assert says in terminal and says in page
    gaps, says = record["replay"]["logs"][0]["gaps"], f"bench has no row of {len(rows)} tick"
    assert (gaps["ticks"], gaps["rows"]) == (len(rows), 0)
    assert says in terminal and says in page
    assert gaps["first_s"] == pytest.approx((rows[0] - 1) * 1e-3, abs=1e-12)
    says = f"the first after {(rows[0] - 1) * 1e-3:g} s"
    assert says in terminal and says in page


def test_periods_beside_gaps_say_what_they_say_without(controller, bench):
    """The mean over the periods that are left, by an FFT of the log's own rows."""
    whole = bench.log(Machine(), REFERENCE)
    result = so.accept(controller, [lose(whole, [2500, 5100, 5101, 8999])])
    (part,) = result.response.measured
    kept = [1, 3, 4, 6, 7, 9]
    force, goal = (
        np.fft.rfft(whole[name].reshape(10, PERIOD)[kept].mean(axis=0))[LINES] for name in ("F1", "reference")
    )
    assert part.periods == len(kept) and np.allclose(part.f, LINES)
    assert np.allclose(part.tracking.value, force / goal, rtol=1e-9)


def test_what_is_simulated_beside_a_log_with_gaps_has_its_reference_whole(controller, bench):
    log = lose(bench.log(Machine(), REFERENCE), [500, 501, 1700, 2500])
    assert np.array_equal(shorten(take_ticks(controller, log, whole=True)).reference, REFERENCE[: 3 * PERIOD])


def test_a_gap_of_a_period_and_more_begins_a_stretch(controller, bench):
    result = so.accept(controller, [lose(bench.log(Machine(), REFERENCE), range(3300, 4800))])
    (part,) = result.response.measured
    assert part.periods >= 6 and part.left_out.gap >= 1 and result.met


def test_a_log_with_a_gap_in_each_period_says_so_and_how_many(controller, bench, tmp_path):
    rng = np.random.default_rng(1)
    rows = np.unique(rng.integers(1, 9999, 100))
    log = lose(bench.log(Machine(), REFERENCE), rows)
    terminal, page, record = read_everywhere(
        so.accept(controller, [log], played=Played(period_s=1.0, lasts_s=12.0)), tmp_path
    )
    assert record["response"] is None and "whole periods of 1 s" in record["left_out"]["bench"]
    assert "shorter than" not in record["left_out"]["bench"] and "in 9 of them a row" in record["left_out"]["bench"]
    assert record["replay"]["logs"][0]["gaps"]["ticks"] == rows.size
    assert f"no row of {rows.size} ticks" in terminal and f"no row of {rows.size} ticks" in page


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


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("decimals", [None, 2])
def test_all_stretches_of_a_right_law_are_replayed_however_short(controller, bench, seed, decimals):
    whole = bench.log(Machine(), REFERENCE, seed=seed, decimals=decimals)
    log = lose(whole, np.unique(np.random.default_rng(seed).integers(1, 9999, 100)))
    (row,) = so.accept(controller, [log]).replays
    lengths = [segment.stop - segment.start for segment in log.segments]
    taken = [length for length in lengths if length >= 50]
    assert row.met and row.stretches == len(taken) and row.ticks == sum(taken) > 0.8 * len(log)
    assert row.mismatch < 2e-3 * row.rms


def test_a_stretch_of_another_law_beside_a_longer_one_of_this_is_found_and_named(controller, bench, tmp_path):
    log = lose(bench.log(Machine(), REFERENCE), [2000, 3000])
    command = log["I"].copy()
    command[:2000] *= 0.5
    columns = {name: log[name] for name in ("reference", "F1")}
    result = so.accept(controller, [so.Log.from_arrays(time=log.time, source="bench", I=command, **columns)])
    (row,) = result.replays
    assert not row.met and (row.causes[0].kind, row.causes[0].what, row.causes[0].explains) == ("factor", "I", True)
    assert row.causes[0].value == pytest.approx(0.5, rel=1e-6) and result.response is None


def test_stretches_are_said_with_how_their_states_are_found(controller, bench, tmp_path):
    result = so.accept(controller, [lose(bench.log(Machine(), REFERENCE), [2500, 5100])])
    terminal, page, record = read_everywhere(result, tmp_path)
    says = "3 stretches without, of 9998 ticks in all, each from a state that its own first rows tell"
    assert says in terminal and says in page and record["replay"]["logs"][0]["stretches"] == 3


def read_section(page, name):
    """Return the text of a section of a page, without its heading."""
    (found,) = re.findall(rf'<section id="{name}".*?</h2>(.*?)</section>', page, flags=re.DOTALL)
    return " ".join(re.sub(r"<[^>]*>", " ", found).split())


def test_a_page_without_a_response_says_why_and_what_to_record(controller, bench, tmp_path):
    log = bench.log(Machine(), REFERENCE[: 2 * PERIOD])
    result = so.accept(controller, [log])
    terminal, page, _ = read_everywhere(result, tmp_path)
    section = read_section(page, "response")
    assert section.startswith("No response") and "1 whole period of 1 s" in section, section
    assert "at least 3 periods" in section and terminal.count("at least 3 periods") == 1
    half = so.Log.from_arrays(time=log.time, source="bench", reference=log["reference"], F1=log["F1"], I=0.5 * log["I"])
    section = read_section(read_everywhere(so.accept(controller, [half]), tmp_path)[1], "response")
    assert "not of this law; mend that first, then record again" in section
    assert read_section(
        read_everywhere(so.accept(controller, [bench.log(Machine(), REFERENCE)]), tmp_path)[1], "response"
    )


def test_a_page_tells_the_problem_file_from_the_logs(controller, bench, tmp_path):
    names = {"actuator.toml": "problem file", "first.csv": "log", "second.csv": "log"}
    files = [tmp_path / name for name in names]
    for file in files:
        file.write_text(file.name)
    result = so.accept(controller, [bench.log(Machine(), REFERENCE[: 2 * PERIOD])])
    page = write_acceptance_page(result, tmp_path / "page.html", files=files[:1], logs=files[1:]).read_text()
    rows = re.findall(r"<td[^>]*>([^<]*)</td>\s*<td[^>]*>([^<]*)</td>\s*<td[^>]*>[0-9a-f]{64}</td>", page)
    assert {file.rpartition("/")[2]: use for file, use in rows} == names
