from __future__ import annotations

import contextlib

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import seaopt as so
from seaopt.errors import LogError, SeaoptError, UnitError
from seaopt.logs import assess_quality

CHANNELS = {"I": so.Column(column="cur", unit="mA"), "F1": "F1 [N]"}


@pytest.fixture
def csv(tmp_path):
    def write(text, name="log.csv"):
        path = tmp_path / name
        path.write_bytes(text.encode() if isinstance(text, str) else text)
        return path

    return write


def test_units_from_brackets_and_given(csv):
    log = so.read_log(csv("t [ms];cur;F1 [kN]\n0;100;1\n2.5;200;2\n5;300;\n"), time="t [ms]",
                      channels={"I": CHANNELS["I"], "F1": "F1 [kN]"})  # fmt: skip
    np.testing.assert_allclose(log.time, [0, 0.0025, 0.005])
    np.testing.assert_allclose(log["I"], [0.1, 0.2, 0.3])
    np.testing.assert_allclose(log["F1"], [1000, 2000, np.nan])
    assert log.rate_hz == pytest.approx(400)
    assert log.signal("F1").unit == "N"
    assert "1 missing" in repr(log)


def test_round_trip_keeps_every_digit(tmp_path):
    rng = np.random.default_rng(0)
    log = so.Log.from_arrays(time=np.arange(100) / 400, F1=rng.normal(size=100), units={"F1": "N"})
    path = so.write_log(log, tmp_path / "log.csv")
    again = so.read_log(path, time="time [s]", channels={"F1": "F1 [N]"})
    np.testing.assert_array_equal(again["F1"], log["F1"])


@pytest.mark.parametrize(
    ("text", "error", "words"),
    [
        ("", LogError, "empty"),
        ("time [s],cur,F1 [N]\n", LogError, "0 rows"),
        ("time [s],cur,F1[N]\n0,1,2\n1,1,2\n", LogError, 'did you mean "F1\\[N\\]"'),
        ("time [s],cur.,F1 [N]\n0,1,2\n1,1,2\n", LogError, 'write column = "cur."'),
        ("time [s],cur,F1 [N],F1 [N]\n0,1,2,2\n1,1,2,2\n", LogError, "2 columns are named"),
        ("time [s],cur,F1 [N]\n0,1,2\n1,x,2\n", LogError, 'line 3: "x" in column "cur"'),
        ("time [s],cur,F1 [N]\n0,1,2\n1,1,2,9\n", LogError, "cannot be read as CSV"),
        ("time [s],cur,F1 [N]\n0,1,2\n0,1,2\n", LogError, "repeats at sample 2"),
        ("time [s],cur,F1 [N]\n1,1,2\n0,1,2\n", LogError, "runs backwards"),
        ("time [s],cur,F1 [N]\n0,1,\n1,1,\n", LogError, "holds no number"),
        (b"\x00\x01\x02\x03" * 50, LogError, "not a text file"),
        (b"time [s],cur,F1 [N]\n\xff\xfe,1,2\n", LogError, "UTF-8"),
        ("time [N],cur,F1 [N]\n0,1,2\n1,1,2\n", LogError, 'no column "time \\[s\\]"'),
    ],
)
def test_bad_files_say_where_and_what(csv, text, error, words):
    with pytest.raises(error, match=words) as raised:
        so.read_log(csv(text), time="time [s]", channels=CHANNELS)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize("time", ["F1 [N]", "cur [s]", 3, 9])
def test_a_column_that_is_not_the_time_is_refused_with_those_that_may_be(csv, time):
    """It is in another unit, its values run backwards, or it is not there."""
    path = csv("stamp [s],cur [s],F1 [N]\n0,1,2\n1,0,1\n2,1,3\n")
    with pytest.raises(so.SeaoptError, match=r"stamp \[s\], cur \[s\], F1 \[N\]"):
        so.read_log(path, time=time, channels={"F1": "F1 [N]"})


def test_missing_file_and_folder(tmp_path):
    with pytest.raises(LogError, match="no such file"):
        so.read_log(tmp_path / "nothing.csv", time="time [s]", channels=CHANNELS)
    with pytest.raises(LogError, match="is a folder"):
        so.read_log(tmp_path, time="time [s]", channels=CHANNELS)


def test_missing_and_wrong_units(csv):
    path = csv("time [s],cur,F1 [N]\n0,1,2\n1,1,2\n")
    with pytest.raises(LogError, match='"cur" has no unit'):
        so.read_log(path, time="time [s]", channels={"I": "cur"})
    with pytest.raises(UnitError, match="time"):
        so.read_log(path, time=so.Column(column="time [s]", unit="N"), channels={})


@given(st.binary(max_size=400))
def test_any_bytes_end_in_a_log_or_a_seaopt_error(tmp_path_factory, content):
    path = tmp_path_factory.mktemp("fuzz") / "f.csv"
    path.write_bytes(content)
    with contextlib.suppress(SeaoptError):
        so.read_log(path, time="a [s]", channels={"b": so.Column(column="b", unit="N")})


def test_gaps_become_segments():
    time = np.concatenate([np.arange(50), np.arange(70, 120)]) / 100
    log = so.Log.from_arrays(time=time, I=np.zeros(100))
    assert [(piece.start, piece.stop) for piece in log.segments] == [(0, 50), (50, 100)]


def test_jitter_beyond_five_percent_is_refused():
    rng = np.random.default_rng(0)
    time = np.arange(200) / 100 + 0.002 * rng.uniform(-1, 1, 200)
    log = so.Log.from_arrays(time=time, I=np.zeros(200))
    with pytest.raises(LogError, match="resample"):
        _ = log.segments


def test_slices_are_in_seconds():
    log = so.Log.from_arrays(time=5 + np.arange(100) / 100, I=np.arange(100.0))
    part = log.between(0.1, 0.2)
    assert len(part) == 11
    assert part["I"][0] == 10
    with pytest.raises(LogError, match="fewer than 2"):
        log.between(3, 4)


@pytest.mark.parametrize(
    ("arrays", "words"),
    [
        ({"time": [0, 1], "I": [1, 2, 3]}, "3 samples and time has 2"),
        ({"time": [0, 1], "I": ["a", "b"]}, "not numeric"),
        ({"time": [0, 1], "I": [[1, 2]]}, "shape"),
        ({"time": [0], "I": [1]}, "at least 2"),
        ({"time": [0, np.nan], "I": [1, 2]}, "time is not a number"),
    ],
)
def test_bad_arrays(arrays, words):
    with pytest.raises(LogError, match=words):
        so.Log.from_arrays(**arrays)


def test_no_file_is_left_when_writing_fails(tmp_path, monkeypatch):
    import seaopt.files

    def fails(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(seaopt.files.os, "replace", fails)
    with pytest.raises(SeaoptError, match="No space"):
        seaopt.files.write_text(tmp_path / "a.json", "{}")
    assert list(tmp_path.iterdir()) == []


def test_one_column_for_two_forces_is_refused(csv):
    file = csv("t [s],F1 [N],enc [rad]\n0,1,0.1\n0.1,2,0.2\n0.2,3,0.4\n")
    with pytest.raises(LogError, match=r'log.csv: column "F1 \[N\]" is given for F1 and for F2; .*choose another'):
        so.read_log(file, time="t [s]", channels={"F1": "F1 [N]", "F2": so.Column(column="F1 [N]", scale=-1.0)})
    frame = so.read_log(file, time="t [s]").to_polars()
    with pytest.raises(LogError, match=r'frame: column "F1 \[N\]" is given for a and for b'):
        so.Log.from_frame(frame, channels={"a": "F1 [N]", "b": "F1 [N]"})


def test_one_column_for_an_angle_and_a_length_is_noted(csv):
    file = csv("t [s],enc [rad],I [A]\n0,0.1,1\n0.1,0.2,2\n0.2,0.4,1\n")
    channels = {"theta": "enc [rad]", "q": so.Column(column="enc [rad]", unit="m", scale=5e-4), "I": "I [A]"}
    log = so.read_log(file, time="t [s]", channels=channels)
    np.testing.assert_allclose(log["q"], 5e-4 * log["theta"])
    assert log.notes == ('theta and q are the same column "enc [rad]", in rad and in m',)
    assert log.notes[0] in assess_quality(log).notes
