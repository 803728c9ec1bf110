"""A figure that a log does not decide names the lines at which it is open, and what would decide it."""

from __future__ import annotations

import numpy as np

from seaopt.machine.response.periods import cut_periods
from seaopt.machine.response.verdicts import judge_response
from seaopt.machine.ticks import take_ticks
from seaopt.machine.wording import say_open, say_unsure
from tests.machine.simulator import Machine
from tests.machine.test_response import LINES, respond

PERIOD, WEAK = 1000, 5


def play(share, periods):
    """Return a reference whose line at 5 Hz is a share of the others."""
    spectrum = np.zeros(PERIOD // 2 + 1, dtype=complex)
    sizes = np.where(WEAK == LINES, share, 1.0)
    spectrum[LINES] = sizes * np.exp(2j * np.pi * np.random.default_rng(3).uniform(size=LINES.size))
    wave = np.fft.irfft(spectrum, PERIOD)
    return 300.0 + np.tile(60.0 * wave / np.max(np.abs(wave)), periods)


def judge(controller, bench, share, periods, noise):
    log = bench.log(Machine(), play(share, periods), noise=noise, seed=5)
    response = judge_response(controller, [cut_periods(controller, take_ticks(controller, log))], 0.95)
    return {row.name: row for row in response.judged}


def test_the_line_whose_gain_is_not_sure_is_named_beside_an_interval_inside_its_limit(controller, bench):
    assert WEAK in LINES
    row = judge(controller, bench, 0.033, 8, 2.0)["Ms"]
    assert row.outcome == "undecided" and row.high < row.limit, row
    assert (row.doubt.lines_hz, row.doubt.why, row.where_hz) == ((WEAK,), "command", WEAK)
    assert say_open("Ms", row.doubt) == "Ms (at 5 Hz)" and "Ms is open at 5 Hz" in say_unsure("Ms", row.doubt)
    for decided in (judge(controller, bench, 0.033, 2 * row.periods, 2.0), judge(controller, bench, 0.2, 8, 2.0)):
        assert decided["Ms"].outcome == "confirmed" and decided["Ms"].doubt is None, (row, decided)


def test_the_lines_whose_discs_reach_beyond_the_limit_are_named(controller, bench):
    """They lie about the peak of the machine's own equations; elsewhere these keep the limit by far."""
    row = judge(controller, bench, 1.0, 8, 6.0)["Ms"]
    sensitivity = 1.0 / np.abs(1.0 + respond(Machine(), LINES.astype(float), controller, 1)[0])
    assert row.outcome == "undecided" and row.doubt.why == "disc"
    assert float(LINES[np.argmax(sensitivity)]) in row.doubt.lines_hz
    named = np.isin(LINES, row.doubt.lines_hz)
    assert np.min(sensitivity[named]) > 0.75 * row.limit, (row, sensitivity)
    assert all(row.doubt is None for row in judge(controller, bench, 1.0, 60, 0.5).values())
