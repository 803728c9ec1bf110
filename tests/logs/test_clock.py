"""Clocks as devices write them: steps of several lengths, rounded stamps, lost samples."""

from __future__ import annotations

import numpy as np
import pytest

import seaopt as so
from seaopt.logs.quality.clock import assess_clock, shorten_rate


def alternating(short, long, runs, count=1200, seed=0):
    """Return times whose steps are of two lengths, in runs of random length."""
    rng = np.random.default_rng(seed)
    step = np.concatenate([[short] * rng.integers(1, runs + 1) + [long] for _ in range(count)])
    return np.concatenate([[0.0], np.cumsum(step)])


@pytest.mark.parametrize("runs", [1, 2, 5])
def test_the_rate_of_a_clock_of_two_steps_is_that_of_their_mean(runs):
    """2.7 and 10 ms: the rate is samples per second, and no 10 ms are a gap."""
    time = alternating(2.7e-3, 10e-3, runs)
    mean = (time.size - 1) / np.ptp(time)
    clock = assess_clock(time, "log")
    log = so.Log.from_arrays(time=time, F1=np.sin(time))
    assert clock.rate_hz == pytest.approx(mean, rel=1e-6) and log.rate_hz == pytest.approx(mean, rel=1e-6)
    assert clock.gaps.size == 0 and log.gaps == []
    assert len(log.resample(rate_hz=mean).segments) == 1
    (finding,) = log.quality.of("jitter")
    assert finding.severity == "error" and not log.quality.of("gap")


def test_of_a_clock_of_two_steps_that_is_mostly_long_ones_they_are_no_gaps():
    """As in a record of a mean rate of 155 Hz: 51 % of 10 ms, 49 % of 2.7 ms, in any order."""
    step = np.random.default_rng(0).choice([2.7e-3, 10e-3], size=3000, p=[0.485, 0.515])
    time = np.concatenate([[0.0], np.cumsum(step)])
    log = so.Log.from_arrays(time=time, F1=np.sin(time))
    assert log.gaps == [] and log.rate_hz == pytest.approx(1.0 / step.mean(), rel=1e-6)


def test_a_gap_in_a_clock_of_two_steps_is_still_one():
    time = alternating(2.7e-3, 10e-3, 2)
    time[1500:] += 0.08
    log = so.Log.from_arrays(time=time, F1=np.sin(time))
    assert log.gaps == [(time[1499], time[1500])]
    assert assess_clock(time, "log").gaps.tolist() == [1500]
    assert len(log.resample(rate_hz=150).segments) == 2


def test_samples_that_are_often_lost_are_gaps_and_change_no_rate():
    rng = np.random.default_rng(1)
    time = np.flatnonzero(rng.random(8000) > 0.1) / 1000.0
    log = so.Log.from_arrays(time=time, F1=np.sin(time))
    assert log.rate_hz == pytest.approx(1000.0)
    assert len(log.gaps) == np.count_nonzero(np.diff(time) > 1.5e-3)


def test_stamps_rounded_to_nearly_a_period_are_no_gaps():
    """800 Hz written in milliseconds: every fourth step is twice as long."""
    true = np.arange(4000) / 800.0
    log = so.Log.from_arrays(time=np.round(true, 3), F1=np.sin(true))
    assert log.rate_hz == pytest.approx(800.0, rel=1e-3) and log.gaps == []
    np.testing.assert_allclose(log.restamp().time, true, atol=1e-3)


@pytest.mark.parametrize(
    ("rate_hz", "meant"), [(1000.4, 1000.0), (1021.59, 1022.0), (99.95, 100.0), (18432.6, 18430.0)]
)
def test_a_rate_is_advised_with_the_digits_that_it_takes(rate_hz, meant):
    assert shorten_rate(rate_hz) == meant and abs(meant / rate_hz - 1.0) < 1e-3
