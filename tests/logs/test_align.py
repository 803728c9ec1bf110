"""Declared conversions and clocks, on one and several files."""

from __future__ import annotations

import numpy as np
import pytest

from seaopt.errors import LogError
from seaopt.logs import Column, Counter, Hold, Linear, Nearest, Readings, read_table
from seaopt.logs.quality.faults import find_counter_losses

FAST = np.arange(40) / 100
SLOW = 0.0513 + np.arange(8) / 20


@pytest.fixture
def files(tmp_path):
    fast, slow = tmp_path / "motor.csv", tmp_path / "cell.csv"
    fast.write_text("t [s],I [A]\n" + "".join(f"{t:.6f},{np.sin(9 * t):.9f}\n" for t in FAST))
    slow.write_text("t [s],F [N]\n" + "".join(f"{t:.6f},{np.cos(9 * t):.9f}\n" for t in SLOW))
    return [fast, slow]


def channels(**options):
    return {"I": "I [A]", "F": Column(column="F [N]", **options)}


def test_another_clock_needs_a_rule(files):
    with pytest.raises(LogError, match=r"cell.csv.*on the clock.*Hold\(\), Linear\(\), Nearest"):
        read_table(files, time="t [s]", channels=channels())


def test_linear_is_numpys_between_samples_and_missing_outside(files):
    table = read_table(files, time="t [s]", channels=channels(align=Linear()))
    inside = np.array([SLOW[0] <= t <= SLOW[-1] for t in FAST])
    expected = np.where(inside, np.interp(FAST, SLOW, np.cos(9 * SLOW)), np.nan)
    np.testing.assert_allclose(table.signals["F"].values, expected, atol=1e-8)
    assert f"{np.sum(~inside)} of 40 samples lie outside" in " ".join(table.notes)


def test_a_reading_counts_once_where_a_cubic_takes_it(files):
    values = read_table(files, time="t [s]", channels=channels(align=Readings())).signals["F"].values
    read = np.isfinite(values)
    assert np.count_nonzero(read) == 6  # of 8: the first would be taken ahead of all, the last is past the log
    np.testing.assert_allclose(values[read], np.cos(9 * FAST[read]), atol=5e-4)
    cubic = Readings()(FAST, SLOW, SLOW**3 - SLOW)
    np.testing.assert_allclose(cubic[read], FAST[read] ** 3 - FAST[read], atol=1e-12)


def test_beside_a_hole_readings_are_no_further_off_than_at_an_end():
    """Of a cubic's nodes none lies across: 5 Hz in 50 Hz, half a sample off, without 0.2 s; and one lost sample."""
    at, time = np.arange(300) / 100, 0.005 + np.arange(150) / 50
    whole = Readings()(at, time, np.sin(10 * np.pi * time))
    usual = np.nanmax(np.abs(whole - np.sin(10 * np.pi * at)))
    assert usual == pytest.approx(0.0053, abs=1e-4)
    for start in np.arange(0.9, 1.1, 0.01):
        for stop in (start + 0.02, start + 0.2):
            kept = (time < start) | (time > stop)
            found = Readings()(at, time[kept], np.sin(10 * np.pi * time[kept]))
            assert np.nanmax(np.abs(found - np.sin(10 * np.pi * at))) < 1.15 * usual
            assert np.count_nonzero(np.isfinite(whole)) - np.count_nonzero(np.isfinite(found)) <= np.sum(~kept) + 2
            assert not np.any(np.isfinite(found[(at > time[kept & (time < start)][-1]) & (at < stop)]))
            read = (at < start - 0.08) | (at > stop + 0.08)
            np.testing.assert_array_equal(found[read], whole[read])


@pytest.mark.parametrize("rate_hz", [130.0, 500.0])
def test_readings_of_a_faster_clock_are_refused_rather_than_left_out(tmp_path, rate_hz):
    """Also where the log stands still in between; of one as fast and uneven none is."""
    at, time = np.arange(300) / 100, np.arange(0.0, 3.0, 1.0 / rate_hz)
    for instants in (at, np.delete(at, slice(100, 200))):
        with pytest.raises(LogError, match=rf"Readings: .*{rate_hz / 100:g} times.*log's clock.*Linear"):
            Readings()(instants, time, np.sin(time))
    with pytest.raises(LogError, match="times"):
        Readings()(at, np.delete(time, slice(20, time.size // 2)), np.ones(time.size - time.size // 2 + 20))
    drive = [*(f"{t},0" for t in at), *[","] * (time.size - at.size)]
    rows = [f"{columns},{t},{t**2}" for columns, t in zip(drive, time, strict=True)]
    (tmp_path / "fast.csv").write_text("\n".join(["t [s],I [A],t2 [s],F [N]", *rows]))
    cell = Column(column="F [N]", time="t2 [s]", align=Readings())
    with pytest.raises(LogError, match=r'clock "t2 \[s\]".* F: Readings: '):
        read_table(tmp_path / "fast.csv", time="t [s]", channels={"I": "I [A]", "F": cell})
    uneven = np.sort(np.random.default_rng(1).uniform(0.0, 3.0, 300))
    assert np.count_nonzero(np.isfinite(Readings()(at, uneven, uneven))) > 150
    for count in range(1, 300):
        Readings()(at, np.arange(count) / 125, np.ones(count))


def test_hold_never_looks_ahead(files):
    table = read_table(files, time="t [s]", channels=channels(align=Hold()))
    for t, value in zip(FAST, table.signals["F"].values, strict=True):
        past = SLOW[t >= SLOW]
        if past.size and t <= SLOW[-1]:
            assert value == pytest.approx(np.cos(9 * past[-1]), abs=1e-8)
        else:
            assert np.isnan(value)


def test_nearest_keeps_to_its_tolerance(files):
    found = read_table(files, time="t [s]", channels=channels(align=Nearest(tolerance_s=0.006))).signals["F"].values
    gap = np.abs(FAST[:, None] - SLOW).min(axis=1)
    inside = np.array([SLOW[0] <= t <= SLOW[-1] for t in FAST])
    np.testing.assert_array_equal(np.isfinite(found), inside & (gap <= 0.006))


def test_limits_leave_gaps_missing():
    time, values = np.array([0.0, 1.0, 5.0, 6.0]), np.array([0.0, 1.0, 5.0, 6.0])
    at = np.array([0.5, 1.5, 3.0, 5.0, 5.5])
    np.testing.assert_array_equal(Linear(max_gap_s=2)(at, time, values), [0.5, np.nan, np.nan, 5, 5.5])
    np.testing.assert_array_equal(Hold(max_age_s=1)(at, time, values), [0, 1, np.nan, 5, 5])


def test_a_declared_offset_moves_a_clock(files):
    late = read_table(files, time="t [s]", channels=channels(align=Linear(), clock_offset_s=-SLOW[0]))
    expected = np.interp(FAST[:30], SLOW - SLOW[0], np.cos(9 * SLOW))
    np.testing.assert_allclose(late.signals["F"].values[:30], expected, atol=1e-7)


def test_a_column_in_two_files_must_say_which(files, tmp_path):
    twin = tmp_path / "twin.csv"
    twin.write_bytes(files[0].read_bytes())
    with pytest.raises(LogError, match=r'"I \[A\]" for I is in .*motor.csv.*twin.csv'):
        read_table([files[0], twin], time="t [s]", channels={"I": "I [A]"})
    table = read_table(
        [files[0], twin], time="t [s]", align=Hold(), channels={"a": Column(column="I [A]", file=files[0]),
                                                               "b": Column(column="I [A]", file=twin)},
    )  # fmt: skip
    np.testing.assert_array_equal(table.signals["a"].values, table.signals["b"].values)


def test_two_rates_in_one_text_file(tmp_path):
    path = tmp_path / "both.csv"
    path.write_text("t [s],I [A],t2 [s],F [N]\n0,1,0,10\n1,2,1.5,25\n2,3,,\n")
    with pytest.raises(LogError, match="is on the clock"):
        read_table(path, time="t [s]", channels={"F": Column(column="F [N]", time="t2 [s]")})


def test_a_wrapped_integer_is_signed_and_scaled(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text("t [s],load\n0,0\n1,65535\n2,32767\n3,32768\n")
    column = Column(column="load", unit="N", wrap_bits=16, scale=0.5, offset=1.0)
    signal = read_table(path, channels={"load": column}).signals["load"]
    np.testing.assert_array_equal(signal.values, [1, 0.5, 16384.5, -16383])
    assert signal.origin.conversion == "two's complement of 16 bits, times 0.5, plus 1"
    path.write_text("t [s],load\n0,0\n1,65536\n")
    with pytest.raises(LogError, match="65536 in sample 2"):
        read_table(path, channels={"load": column})


def test_a_counter_opens_the_gaps_that_rows_hide(tmp_path):
    path = tmp_path / "log.csv"
    counts = [4, 5, 5, 6, 6, 7, 9, 9, 10]  # one sample of 7 is lost, and both of 8
    path.write_text("t [s],n\n" + "".join(f"{i},{n}\n" for i, n in enumerate(counts)))
    table = read_table(path, counter=Counter(column="n", samples_per_count=2))
    np.testing.assert_array_equal(table.time, [0, 1, 2, 3, 4, 5, 9, 10, 11])
    assert "3 lost samples" in " ".join(table.notes)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: Column(column="a", scale=0.0), "scale"),
        (lambda: Column(column="a", wrap_bits=1), "wrap_bits = 1"),
        (lambda: Nearest(tolerance_s=0.0), "tolerance_s = 0"),
        (lambda: Hold(max_age_s=-1.0), "max_age_s = -1"),
        (lambda: Counter(column="a", samples_per_count=0), "samples_per_count"),
    ],
)
def test_senseless_options_are_refused(make, words):
    with pytest.raises(LogError, match=words):
        make()


def test_a_window_cuts_and_refuses_nonsense(files):
    table = read_table(files[0], window_s=(0.1, 0.2))
    np.testing.assert_allclose(table.time[[0, -1]], [0.1, 0.2])
    with pytest.raises(LogError, match="too few samples"):
        read_table(files[0], window_s=(5, 6))
    with pytest.raises(LogError, match="start before stop"):
        read_table(files[0], window_s=(1, 0))


@pytest.mark.parametrize("extreme", [1e308, -1e308, np.inf, -np.inf, np.nan, 2.0**53, 0.5])
def test_what_cannot_be_counted_is_no_counter(extreme):
    """And no difference of it overflows, which was a warning on the terminal."""
    values = np.repeat(np.arange(30.0), 2)
    values[40] = extreme
    assert find_counter_losses(values) is None
    with pytest.raises(LogError, match="whole number that only rises"):
        Counter(column="n").open_gaps(np.arange(60.0), values, "log.csv")


def test_a_counter_that_leaps_is_counted():
    values = np.repeat(np.r_[np.arange(29.0), 1e15], 2)
    assert find_counter_losses(values).lost.sum() == 2 * (10**15 - 29)
    with pytest.raises(LogError, match="samples_per_count"):
        Counter(column="n", samples_per_count=10**5000)
    moved, note = Counter(column="n", samples_per_count=2).open_gaps(np.arange(60.0), values, "log.csv")
    assert moved[-1] == 59.0 + 2 * (1e15 - 29) and "lost samples" in note
