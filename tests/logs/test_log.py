"""Slicing, resampling, decimating and appending logs, and their way to frames and back."""

from __future__ import annotations

import sys

import numpy as np
import polars as pl
import pytest

import seaopt as so
from seaopt.errors import LogError, UnitError
from seaopt.logs import Hold, Linear, Nearest, concatenate
from seaopt.signals import Origin, Signal

ORIGIN = Origin(file="chirp.csv", sha256="ab", column="F1 [kN]", conversion="kN to N")


def sine(t, f=3.0):
    return np.sin(2 * np.pi * f * t + 0.3)


def make(t, **channels):
    signals = {name: Signal(name=name, values=values, unit="N", origin=ORIGIN) for name, values in channels.items()}
    return so.Log(time=t, signals=signals, source="chirp.csv")


@pytest.fixture
def gapped():
    t = np.arange(4000) / 1000
    return make(np.delete(t, slice(1500, 1700)), F1=np.delete(sine(t), slice(1500, 1700)))


@pytest.mark.parametrize(
    "change",
    [
        lambda log: log.between(0.1, 0.9),
        lambda log: log.resample(rate_hz=1000),
        lambda log: log.decimate(4),
        lambda log: concatenate([log, log], gap_s=1.0),
    ],
)
def test_what_is_done_is_noted_and_the_origin_kept(gapped, change):
    log = change(gapped)
    assert log.signal("F1").origin == ORIGIN and log.signal("F1").unit == "N"
    assert len(log.notes) == 1 and log.notes[0] in repr(log)


def test_resampling_a_jittered_log_is_a_line_between_samples():
    rng = np.random.default_rng(0)
    t = np.arange(2000) / 500 + rng.uniform(-4e-4, 4e-4, 2000)
    log = make(t, F1=sine(t))
    with pytest.raises(LogError, match=r"log.resample\(rate_hz=500\)"):
        _ = log.segments
    with pytest.raises(LogError, match=r"log.resample\(rate_hz=5000\)"):  # not 5e+03
        _ = make(t / 10, F1=sine(t)).segments
    even = log.resample(rate_hz=500)
    assert len(even.segments) == 1
    np.testing.assert_allclose(even.time, t[0] + np.arange(len(even)) / 500, atol=1e-12)
    np.testing.assert_allclose(even["F1"], np.interp(even.time, t, sine(t)), atol=1e-12)


def test_holding_takes_the_latest_sample():
    log = make(np.array([0.0, 0.9, 2.1, 3.0]), F1=np.array([1.0, 2.0, 3.0, 4.0]))
    assert log.resample(rate_hz=1, rule=Hold())["F1"].tolist() == [1.0, 2.0, 2.0, 4.0]
    assert log.resample(rate_hz=1, rule=Nearest(tolerance_s=0.2))["F1"].tolist() == [1.0, 2.0, 3.0, 4.0]


def test_steps_keep_their_area_on_a_new_clock():
    """A command that is held between uneven samples moves as much as on its own clock; against a sum on a fine one."""
    rng, period = np.random.default_rng(1), 1 / 800
    t = np.arange(800) * period + np.append(0.0, 6e-5 * rng.uniform(-1, 1, 799))
    command = np.cumsum(rng.normal(size=t.size))
    even = make(t, I=command, F1=sine(t)).resample(rate_hz=800, steps=("I",))
    fine = even.time[:-1, None] + (np.arange(2000) + 0.5) * period / 2000
    truth = command[np.searchsorted(t, fine, side="right") - 1].mean(axis=1)
    np.testing.assert_allclose(even["I"][:-1], truth, atol=2e-3)
    np.testing.assert_allclose(even["F1"], np.interp(even.time, t, sine(t)), atol=1e-12)
    assert "I as the mean of its steps" in even.notes[-1]


def test_steps_are_lines_across_a_lost_sample_and_missing_where_more_are_missing_than_is_bridged():
    t, values = np.delete(np.arange(50) / 50, [10, 11]), np.delete(np.arange(50.0), [10, 11])
    values[20:24] = np.nan
    even = make(t, I=values).resample(rate_hz=50, steps=("I",), bridge_s=0.07)
    assert np.flatnonzero(np.isnan(even["I"])).tolist() == [22, 23, 24, 25]
    np.testing.assert_allclose(np.delete(even["I"], np.s_[22:26]), np.delete(np.arange(50.0), np.s_[22:26]), atol=1e-9)


def test_steps_name_channels():
    with pytest.raises(LogError, match='steps names "i"; known: I'):
        make(np.arange(50) / 50, I=np.zeros(50)).resample(rate_hz=50, steps=("i",))


def test_gaps_stay_gaps(gapped):
    even = gapped.resample(rate_hz=900)
    assert len(even.gaps) == 1
    assert even.gaps[0] == pytest.approx((1.499, 1.7), abs=1 / 900)
    np.testing.assert_allclose(even["F1"], sine(even.time), atol=1e-4)


def test_bridging_joins_what_is_declared(gapped):
    assert not gapped.resample(rate_hz=1000, rule=Linear(), bridge_s=0.3).gaps


def test_a_missing_sample_stays_missing():
    values = sine(np.arange(50) / 50)
    values[20] = np.nan
    even = make(np.arange(50) / 50, F1=values).resample(rate_hz=100)
    assert np.flatnonzero(np.isnan(even["F1"])).tolist() == [39, 40, 41]


def test_rows_that_devices_fill_in_turn_are_joined_where_a_bridge_is_declared():
    """Each channel has its own samples, on lines between them, and at the ends what is next to them."""
    t = np.arange(2000) / 1000
    rows = np.arange(t.size)
    log = make(t, F1=np.where(rows % 2 == 0, sine(t), np.nan), F2=np.where(rows % 4 == 1, sine(t), np.nan))
    assert np.isnan(log.resample(rate_hz=1000)["F1"]).sum() == 1000
    joined = log.resample(rate_hz=1000, bridge_s=0.0045)
    np.testing.assert_allclose(joined["F1"], sine(t), atol=2e-2)
    np.testing.assert_array_equal(joined["F1"][::2], sine(t)[::2])
    assert np.abs(joined["F2"][1:-3] - sine(t)[1:-3]).max() < 1e-3 and np.isfinite(joined["F2"][0])
    assert np.isnan(log.resample(rate_hz=1000, bridge_s=0.003)["F2"]).sum() > 1490
    faults = [fault for fault in log.quality.findings if fault.kind == "missing"]
    assert [fault.keys[0]["resample"]["bridge_s"] for fault in faults] == [0.0025, 0.0045]


def test_restamping_straightens_rounded_timestamps_and_touches_no_sample():
    t = np.arange(3000) / 400
    log = make(np.round(t, 3), F1=sine(t))
    even = log.restamp()
    assert np.max(np.abs(even.time - t)) < 5e-4
    assert len(even.segments) == 1
    np.testing.assert_array_equal(even["F1"], log["F1"])


def test_the_rate_is_of_the_mean_step_where_the_median_one_is_off():
    time = np.floor(4.25 * np.arange(4001)) / 1e3  # cut to milliseconds: three steps of four are of 4 ms
    time[2000:] += 1.0
    log = make(time, F1=sine(time))
    assert np.median(np.diff(time)) == pytest.approx(4e-3)
    assert log.rate_hz == pytest.approx(1000 / 4.25, rel=1e-3)
    with pytest.raises(LogError, match=f"rise at {log.rate_hz:.6g} Hz on average"):
        log.restamp(rate_hz=300.0)


def test_restamping_refuses_real_jitter():
    t = np.arange(1000) / 400 + np.random.default_rng(0).uniform(-5e-4, 5e-4, 1000)
    with pytest.raises(LogError, match="more than their rounding"):
        make(t, F1=sine(t)).restamp()


@pytest.mark.parametrize("factor", [2, 5, 7])
def test_decimation_passes_the_pass_band_and_stops_what_would_fold(factor):
    rate, n = 1000.0, 12000
    t = np.arange(n) / rate
    edge = 0.4 * rate / factor  # 0.8 of the new Nyquist frequency
    log = make(t, low=sine(t, 3.0), edge=sine(t, edge), folds=sine(t, 1.01 * 0.5 * rate / factor))
    slow = log.decimate(factor)
    assert slow.rate_hz == pytest.approx(rate / factor)
    np.testing.assert_allclose(slow["low"], sine(slow.time, 3.0), atol=2e-4)
    np.testing.assert_allclose(slow["edge"], sine(slow.time, edge), atol=1.2e-3)  # 0.01 dB
    assert np.max(np.abs(slow["folds"])) < 1e-4  # 80 dB
    assert "pass band 0 to" in slow.notes[0]


def test_decimation_filters_each_segment_alone(gapped):
    slow = gapped.decimate(4)
    assert len(slow.segments) == 2
    np.testing.assert_allclose(slow["F1"], sine(slow.time), atol=2e-4)


def test_decimation_leaves_out_what_missing_samples_carry():
    t = np.arange(6000) / 1000
    values = sine(t)
    values[3000:3200] = np.nan
    values[1000] = np.nan  # one sample that a line bridges
    slow = make(t, F1=values).decimate(5)
    lost = slow.time[np.isnan(slow["F1"])]
    assert lost.min() > 2.9 and lost.max() < 3.3 and lost.size >= 40
    good = np.isfinite(slow["F1"]) & ((slow.time < 2.9) | (slow.time > 3.3))
    np.testing.assert_allclose(slow["F1"][good], sine(slow.time)[good], atol=3e-4)


def test_appending_on_one_clock_keeps_the_times():
    t = np.arange(100) / 10
    both = concatenate([make(t[:40], F1=sine(t[:40])), make(t[40:], F1=sine(t[40:]))])
    np.testing.assert_array_equal(both.time, t)
    assert not both.gaps


def test_polars_round_trip(short_log):
    again = so.Log.from_frame(short_log.to_polars())
    assert again.signal("F1").unit == "N"
    for name in short_log.signals:
        np.testing.assert_array_equal(again[name], short_log[name])


def test_pandas_round_trip(short_log):
    pandas = pytest.importorskip("pandas")
    frame = short_log.to_pandas()
    assert isinstance(frame, pandas.DataFrame)
    frame.loc[3, "F1 [N]"] = None
    again = so.Log.from_frame(frame, channels={"force": "F1 [N]"})
    assert np.isnan(again["force"][3])
    np.testing.assert_array_equal(again["force"][4:], short_log["F1"][4:])


def test_without_pandas_the_remedy_is_named(short_log, monkeypatch):
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(LogError, match="pip install pandas"):
        short_log.to_pandas()


def test_arrays_round_trip(short_log):
    again = so.Log.from_arrays(**short_log.to_arrays())
    np.testing.assert_array_equal(again["F1"], short_log["F1"])


@pytest.mark.parametrize(
    ("call", "error", "words"),
    [
        (lambda log: log.resample(rate_hz=0), LogError, "not positive"),
        (lambda log: log.resample(rate_hz=100), LogError, "would alias"),
        (lambda log: log.decimate(0), LogError, "not a whole number"),
        (lambda log: log.decimate(100), LogError, "without a gap"),
        (lambda log: concatenate([log, log]), LogError, "before the log ahead"),
        (lambda log: concatenate([log, log], gap_s=1e-3), LogError, "gap_s = 0.001"),
        (lambda log: concatenate([]), LogError, "at least one"),
        (lambda log: concatenate([log, log.decimate(2)], gap_s=1), LogError, "resample or decimate"),
        (lambda log: concatenate([log, make(log.time, F2=log["F1"])], gap_s=1), LogError, "same channels"),
        (lambda log: so.Log.from_frame(3), LogError, "int is not a frame"),
        (lambda log: so.Log.from_frame(pl.DataFrame({"t": [1.0]})), LogError, "no column"),
        (lambda log: so.Log.from_frame(pl.DataFrame({"t [ms]": ["a"]}), time="t [ms]"), LogError, "not numeric"),
        (lambda log: so.Log.from_frame(pl.DataFrame({"t [N]": [1.0, 2.0]}), time="t [N]"), UnitError, "not one of s"),
    ],
)
def test_bad_arguments_are_refused(gapped, call, error, words):
    with pytest.raises(error, match=words):
        call(gapped)


@pytest.mark.parametrize("n", [2, 99_999, 100_002, 450_001])
def test_the_period_is_the_mean_step_within_segments(n: int) -> None:
    step = np.random.default_rng(n).uniform(0.9e-3, 1.1e-3, n - 1)
    kept = step.copy()
    if n > 2:
        step[[n // 3, n - 2]], kept[[n // 3, n - 2]] = (7.0, 2.0), np.nan
    log = so.Log.from_arrays(time=np.concatenate([[0.0], np.cumsum(step)]), I=np.ones(n))
    assert log.period == pytest.approx(np.nanmean(kept), rel=1e-9)


@pytest.mark.parametrize(
    ("row", "value", "said"),
    [(250_000, np.nan, "not a number in sample 250001"), (299_999, np.inf, "not a number in sample 300000"),
     (100_000, 99_999.0, "repeats at sample 100001"), (200_001, 5.0, "runs backwards at sample 200002")],
)  # fmt: skip
def test_a_fault_of_time_is_found_wherever_it_is(row: int, value: float, said: str) -> None:
    time = np.arange(300_000.0)
    time[row] = value
    with pytest.raises(LogError, match=said):
        so.Log.from_arrays(time=time, I=np.ones(time.size))


def test_a_step_of_time_beyond_all_numbers_is_refused() -> None:
    with pytest.raises(LogError, match="leaps at sample 2"):
        so.Log.from_arrays(time=[-1.7e308, 1.7e308], I=np.ones(2))


@pytest.mark.parametrize(
    ("options", "words"),
    [({"time": "zeit"}, 'no column "zeit" for time'), ({"channels": {"time": "F [N]"}}, 'a channel is named "time"')],
)
def test_a_frame_s_clock_is_the_one_named(options, words):
    with pytest.raises(LogError, match=words):
        so.Log.from_frame(pl.DataFrame({"time [s]": [0.0, 1.0], "F [N]": [1.0, 2.0]}), **options)


def test_columns_of_one_name_in_two_units_are_both_kept():
    log = so.Log.from_frame(pl.DataFrame({"time [s]": [0.0, 1.0], "F [N]": [1.0, 2.0], "F [kN]": [3.0, 4.0]}))
    assert {name: log[name].tolist() for name in log.signals} == {"F [N]": [1.0, 2.0], "F [kN]": [3000.0, 4000.0]}


def test_a_held_command_keeps_its_value_over_short_holes():
    time, command = np.arange(1000) / 1000, np.full(1000, np.nan)
    command[::10] = np.repeat([0.0, 1.0], 5)[np.arange(100) % 10]
    log = so.Log.from_arrays(time=time, I=command).resample(rate_hz=1000, steps=("I",), bridge_s=0.0115)
    assert log["I"][:991] == pytest.approx(np.repeat(command[::10], 10)[:991])
