"""Logs as recorders, cameras and spreadsheets write them: what is missing is stated by the user, in one place."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.io

import seaopt as so
from seaopt.errors import LogError
from seaopt.logs import Linear, contents


@pytest.fixture
def file(tmp_path):
    def write(text, name="log.csv"):
        path = tmp_path / name
        path.write_text(text, encoding="utf-8")
        return path

    return write


PAIRS = "X [s],Y,X [s],Y\n0,1,0,10\n1,2,0.5,20\n2,3,1,30\n,,1.5,40\n,,2,50\n"


def test_pairs_under_repeated_headers_are_read_by_number(file):
    log = so.read_log(
        file(PAIRS), time=3,
        channels={"F1": so.Column(column=4, unit="N"),
                  "I": so.Column(column=2, unit="A", time=1, align=Linear())},
    )  # fmt: skip
    assert log.time.tolist() == [0, 0.5, 1, 1.5, 2]
    assert log["F1"].tolist() == [10, 20, 30, 40, 50] and log["I"].tolist() == [1, 1.5, 2, 2.5, 3]
    shorter = so.read_log(file(PAIRS), time=1, channels={"I": so.Column(column=2, unit="A")})
    assert shorter.time.tolist() == [0, 1, 2]
    assert [field.name for field in contents(file(PAIRS)).fields] == ["X#1 [s]", "Y#2", "X#3 [s]", "Y#4"]


def test_a_number_beyond_the_columns_and_a_repeated_header_say_what_to_give(file):
    with pytest.raises(LogError, match="no column 9 for F1; the file has 4"):
        so.read_log(file(PAIRS), time=1, channels={"F1": 9})
    with pytest.raises(LogError, match="column = 2"):
        so.read_log(file(PAIRS), time=1, channels={"F1": "Y"})
    for wrong in (0, True, 1.5):
        with pytest.raises(LogError, match="column"):
            so.Column(column=wrong)


def test_a_file_without_a_clock_has_a_rate(file):
    path = file("cur [A],F1 [N]\n1,10\n2,20\n3,30\n4,40\n")
    log = so.read_log(path, rate_hz=500)
    assert log.time.tolist() == [0, 0.002, 0.004, 0.006] and log["cur"].tolist() == [1, 2, 3, 4]
    cut = so.read_log(path, rate_hz=500, channels={"F1": "F1 [N]"}, window_s=(0.002, 0.004))
    assert cut["F1"].tolist() == [20, 30]
    for wrong in (0.0, -1.0, float("nan"), "fast"):
        with pytest.raises(LogError, match="rate_hz"):
            so.read_log(path, rate_hz=wrong)
    with pytest.raises(LogError, match="keep one of them"):
        so.read_log(path, rate_hz=500, time="cur [A]")


LONG = "id,value,t [ms]\nI,1,0\nF1,10,0\nstate,running,0\nI,2,10\nF1,20,10\nI,3,20\nF1,30,20\n"


def rows(name, **options):
    return so.Column(column="value", where={"id": name}, **options)


def test_a_table_of_names_and_values_holds_many_channels(file):
    log = so.read_log(file(LONG), time="t [ms]", channels={"I": rows("I", unit="mA"), "F1": rows("F1", unit="N")})
    assert log.time.tolist() == [0, 0.01, 0.02]
    np.testing.assert_allclose(log["I"], [0.001, 0.002, 0.003])
    assert log["F1"].tolist() == [10, 20, 30]


def test_its_channels_at_other_instants_need_a_rule(file):
    path = file(LONG.replace("F1,20,10", "F1,20,15"))
    channels = {"I": rows("I", unit="A"), "F1": rows("F1", unit="N")}
    with pytest.raises(LogError, match="align"):
        so.read_log(path, time="t [ms]", channels=channels)
    log = so.read_log(path, time="t [ms]", channels=channels, align=Linear())
    np.testing.assert_allclose(log["F1"], [10, 10 + 20 / 3, 30])
    with pytest.raises(LogError, match="no row has id = F9"):
        so.read_log(path, time="t [ms]", channels={"F1": rows("F9", unit="N")})
    with pytest.raises(LogError, match='"running"'):
        so.read_log(path, time="t [ms]", channels={"F1": rows("state", unit="N")})


def test_such_a_table_of_numbers_may_have_any_format(tmp_path):
    path = tmp_path / "can.npz"
    np.savez(path, id=[1, 2, 1, 2], value=[5.0, 6.0, 7.0, 8.0], t=[0.0, 0.0, 1.0, 1.0])
    channels = {
        name: so.Column(column="value", unit="N", where={"id": number}) for name, number in (("F1", 1), ("F2", 2))
    }
    log = so.read_log(path, time=so.Column(column="t", unit="s"), channels=channels)
    assert log["F1"].tolist() == [5, 7] and log["F2"].tolist() == [6, 8]


HEADER = "# bench 3\n# kp = 200 N/m\n# mass [g]: 500\nload;0,5;kg\nt [s];F1 [N]\n0,0;1\n0,1;2\n"


def test_constants_come_from_the_header(file):
    channels = {
        "F1": "F1 [N]",
        "k": so.Column(column="kp", from_header=True),
        "m": so.Column(column="mass", from_header=True),
        "load": so.Column(column="load", from_header=True, scale=2.0),
    }
    log = so.read_log(file(HEADER), time="t [s]", channels=channels)
    assert log["k"].tolist() == [200, 200] and log["m"].tolist() == [0.5, 0.5] and log["load"].tolist() == [1.0, 1.0]
    assert list(log.signals) == list(channels)
    with pytest.raises(LogError, match='did you mean "kp"'):
        so.read_log(file(HEADER), time="t [s]", channels={"k": so.Column(column="kpp", from_header=True)})


def test_one_column_may_serve_two_channels_if_that_is_said(file):
    path = file("t [s],F [N]\n0,1\n1,2\n")
    other = so.Column(column="F [N]", scale=-1.0)
    with pytest.raises(LogError, match="shared"):
        so.read_log(path, channels={"F1": "F [N]", "F2": other})
    shared = so.Column(column="F [N]", scale=-1.0, shared=True)
    log = so.read_log(path, channels={"F1": "F [N]", "F2": shared})
    assert log["F1"].tolist() == [1, 2] and log["F2"].tolist() == [-1, -2]


def test_repeated_stamps_are_merged_as_stated(file):
    path = file("t [s],F [N]\n0,1\n1,2\n1,4\n2,\n2,5\n3,6\n")
    with pytest.raises(LogError, match='duplicates = "first" or "mean"'):
        so.read_log(path)
    first, mean = (so.read_log(path, duplicates=how) for how in ("first", "mean"))
    assert first.time.tolist() == mean.time.tolist() == [0, 1, 2, 3]
    np.testing.assert_array_equal(first["F"], [1, 2, np.nan, 6])
    np.testing.assert_array_equal(mean["F"], [1, 3, 5, 6])
    assert "2 samples" in mean.notes[-1]
    with pytest.raises(LogError, match="runs backwards"):
        so.read_log(file("t [s],F [N]\n0,1\n1,2\n0.5,4\n"), duplicates="mean")


def test_late_stamps_of_a_perfect_clock_are_put_on_its_rate():
    """Latency of 30 us rms with rare spikes of two periods, and 7 samples that were lost."""
    rng = np.random.default_rng(1)
    index = np.delete(np.arange(20_000), np.arange(9000, 9007))
    late = np.abs(30e-6 * rng.normal(size=index.size)) + np.where(rng.random(index.size) < 1e-3, 2e-3, 0.0)
    stamps = np.maximum.accumulate(index / 1000 + late) + 1e-12 * np.arange(index.size)
    log = so.Log.from_arrays(time=stamps, F1=index.astype(float))
    with pytest.raises(LogError, match=r"log.restamp\(rate_hz"):
        log.restamp()
    even = log.restamp(rate_hz=1000)
    np.testing.assert_allclose(even.time - even.time[0], index / 1000, atol=1e-9)
    assert [(segment.start, segment.stop) for segment in even.segments] == [(0, 9000), (9000, index.size)]
    with pytest.raises(LogError, match="drift"):
        log.restamp(rate_hz=1020)


@pytest.mark.parametrize("ppm", [0.0, 40.0, -200.0, 2e4])
def test_a_stated_rate_is_nominal(ppm):
    """60 s of a logger whose crystal is off by some ppm, stamped 0.1 ms late by a PC, with a gap of 30 samples."""
    rng = np.random.default_rng(3)
    index = np.delete(np.arange(60_000), np.arange(17_000, 17_030))
    true = index * 1e-3 * (1.0 + 1e-6 * ppm)
    log = so.Log.from_arrays(time=np.round(true + np.abs(rng.normal(0, 1e-4, index.size)), 5), F1=index.astype(float))
    if ppm > 1e4:  # no crystal is so far off: the rate is wrong
        with pytest.raises(LogError, match=r"drift.* 980\.39"):
            log.restamp(rate_hz=1000)
        return
    even = log.restamp(rate_hz=1000)
    np.testing.assert_allclose(even.time - even.time[0], true, atol=2e-5)
    assert [(segment.start, segment.stop) for segment in even.segments] == [(0, 17_000), (17_000, index.size)]
    assert ("than stated" in even.notes[-1]) == (ppm != 0.0)


@pytest.mark.parametrize("share", [3e-3, 3e-2, 0.2])
@pytest.mark.parametrize("ppm", [0.0, -300.0])
def test_rows_that_are_lost_one_by_one_are_counted_whatever_their_share(share, ppm):
    """Stamps that jitter by a fifth of a period to either side, and come late by more once in a thousand."""
    rng = np.random.default_rng(8)
    index = np.flatnonzero(np.append(rng.random(19_999) >= share, True))
    true = index * 1e-3 * (1.0 + 1e-6 * ppm)
    late = rng.uniform(-2e-4, 2e-4, index.size) + np.where(rng.random(index.size) < 1e-3, 1.4e-3, 0.0)
    late[np.append(np.diff(index) > 1, False)] = 0.0  # a late one before a lost one may be either
    stamps = np.maximum.accumulate(true + late) + 1e-12 * np.arange(index.size)
    even = so.Log.from_arrays(time=stamps, F1=index.astype(float)).restamp(rate_hz=1000)
    np.testing.assert_allclose(even.time - even.time[0], true - true[0], atol=1e-4)


@pytest.mark.parametrize("std", [0.1, 0.2, 0.3])
@pytest.mark.parametrize("lost", [0, 3])
def test_no_row_is_lost_by_jitter_alone(std, lost):
    """Gaussian jitter of which one in ten is nearer another row; and a gap, to the row that jitter allows."""
    rng = np.random.default_rng(int(100 * std) + lost)
    index = np.delete(np.arange(20_000), np.arange(9_000, 9_000 + lost))
    stamps = np.maximum.accumulate(1e-3 * (index + rng.normal(scale=std, size=index.size)))
    log = so.Log.from_arrays(time=stamps + 1e-12 * np.arange(index.size), F1=index.astype(float))
    even = log.restamp(rate_hz=1000)
    off = np.round(1000 * (even.time - even.time[0])) - index
    assert np.count_nonzero(off) <= (3 if lost else 0), np.flatnonzero(off)
    assert len(even.segments) == 1 + bool(lost)


@pytest.mark.parametrize("order", ["<", ">"])
def test_matlab_4_files_are_read(tmp_path, order):
    rng = np.random.default_rng(2)
    path, data = tmp_path / "old.mat", rng.normal(size=(50, 3))
    scipy.io.savemat(path, {"t": np.arange(50) / 10, "data": data, "count": np.arange(50, dtype="i2")}, format="4")
    if order == ">":
        path.write_bytes(swap(path.read_bytes()))
    assert contents(path).format == "MAT 4"
    column = {"F1": so.Column(column="data(:,2)", unit="N"), "n": so.Column(column="count", unit="-")}
    log = so.read_log(path, time=so.Column(column="t", unit="s"), channels=column)
    np.testing.assert_array_equal(log["F1"], data[:, 1])
    np.testing.assert_array_equal(log["n"], np.arange(50))
    whole = path.read_bytes()
    for keep in (30, len(whole) // 2, len(whole) - 1):
        path.write_bytes(whole[:keep])
        with pytest.raises(LogError):
            so.read_log(path, time=so.Column(column="t", unit="s"), channels=column)


def swap(content):
    """Return a MATLAB 4 file with its bytes in the other order."""
    out, at = b"", 0
    while at < len(content):
        head = np.frombuffer(content, "<i4", 5, at)
        name = content[at + 20 : at + 20 + head[4]]
        dtype = np.dtype(["f8", "f4", "i4", "i2", "u2", "u1"][head[0] // 10])
        start, count = at + 20 + head[4], int(head[1] * head[2])
        out += np.add(head, [1000, 0, 0, 0, 0]).astype(">i4").tobytes() + name
        out += np.frombuffer(content, dtype, count, start).astype(dtype.newbyteorder(">")).tobytes()
        at = start + count * dtype.itemsize
    return out


def test_irregular_logs_say_that_their_clock_is_what_is_wrong_and_are_resampled_in_one_piece():
    rng = np.random.default_rng(3)
    time = np.cumsum(0.0025 * np.clip(1 + 0.4 * rng.normal(size=4000), 0.1, 3))
    log = so.Log.from_arrays(time=time, I=rng.normal(size=4000), F1=rng.normal(size=4000))
    (finding,) = log.quality.of("unjudged")
    assert "too uneven for spectra" in finding.sentence and "resample" in finding.sentence
    assert log.rate_hz == pytest.approx(3999 / np.ptp(time), rel=0.01) and not log.gaps
    assert len(log.resample(rate_hz=400).segments) == 1
    split = log.resample(rate_hz=400, bridge_s=0.004)
    assert len(split.segments) > 100 and "bridge_s" in split.notes[-1]


def test_the_excited_band_goes_on_past_a_dip_below_the_resonance():
    """A mode of 7.5 Hz with a damping ratio of 0.001: its leakage drowns what lies below it, but nothing is missing."""
    rng = np.random.default_rng(4)
    time = np.arange(30_000) / 400
    current = rng.normal(size=time.size)
    params = so.plants.thor().update(b_r=3e-7)
    forces = so.simulate(so.plants.high_impedance(), params, so.Log.from_arrays(time=time, I=current))["F1"]
    quality = so.Log.from_arrays(
        time=time, I=current, F1=forces + 0.3 * np.std(forces) * rng.normal(size=30_000)
    ).quality
    low, high = quality.excitation["I"].usable_hz
    assert low < 1.0 and high > 7.5
