"""Files as instruments write them open, or fail, as their README says: measured ones, and simulated in their format."""

from __future__ import annotations

import json

import numpy as np
import pytest

from seaopt.errors import LogError
from seaopt.logs import Column, Counter, Hold, Linear, contents, read_log, read_table

SCOPE = {"pos": Column(column="CH2(pos_t)", unit="m")}
BAGS = ["example.bag", "example-lz4.bag", "example-bz2.bag"]
MESSAGES = {
    "cdr_test_0": 7, "talker": 20, "topics_and_services": 13,
}  # fmt: skip


@pytest.fixture
def formats(recorded):
    return recorded("formats")


@pytest.mark.parametrize("name", BAGS)
def test_ros1_bags_hold_8647_messages(formats, name):
    found = contents(formats / "ros1" / name)
    assert found.notes[0].startswith("8647 messages")
    assert sum(item.length for item in found.fields if item.name == item.clock) == 8647


def test_a_bag_gives_what_rosbags_decodes(formats):
    rosbags = pytest.importorskip("rosbags.highlevel")
    path = formats / "ros1" / "example.bag"
    topics = {"/turtle1/pose": ("x", "theta"), "/tf": ("transforms[0].transform.rotation.z",)}
    with rosbags.AnyReader([path]) as reader:
        for topic, names in topics.items():
            rows = [
                (time, reader.deserialize(raw, item.msgtype))
                for item, time, raw in reader.messages([c for c in reader.connections if c.topic == topic])
            ]
            channels = {field: Column(column=f"{topic}.{field}", unit="-") for field in names}
            table = read_table(path, time=topic, channels=channels)
            times = np.array([time for time, _ in rows])
            np.testing.assert_allclose(table.time, (times - reader.start_time) * 1e-9, atol=1e-9)
            for field in names:
                key = field.replace("[0]", "")
                expected = [_attribute(message, key) for _, message in rows]
                np.testing.assert_array_equal(table.signals[field].values, expected)


@pytest.mark.parametrize("name", BAGS[1:])
def test_packed_bags_hold_the_same(formats, name):
    plain, packed = (read_table(formats / "ros1" / bag, time="/turtle1/cmd_vel") for bag in ("example.bag", name))
    np.testing.assert_array_equal(packed.time, plain.time)
    for key, signal in plain.signals.items():
        np.testing.assert_array_equal(packed.signals[key].values, signal.values)


def _attribute(message, key):
    for part in key.split("."):
        message = getattr(message, part)
        message = message[0] if isinstance(message, list) else message
    return message


@pytest.mark.parametrize("kind", ["db3", "mcap"])
@pytest.mark.parametrize("name", MESSAGES)
def test_ros2_recordings_hold_their_messages(formats, name, kind):
    found = contents(formats / "ros2" / f"{name}_0.{kind}" if (formats / "ros2" / f"{name}_0.{kind}").exists()
                     else formats / "ros2" / f"{name}.{kind}")  # fmt: skip
    assert found.notes[0].startswith(f"{MESSAGES[name]} messages")


@pytest.mark.parametrize("kind", ["db3", "mcap"])
def test_cdr_is_decoded_as_rosbags_does(formats, kind):
    """Arrays of every type, of strings, of structs and of empty structs, which test each alignment."""
    rosbags = pytest.importorskip("rosbags.highlevel")
    path = formats / "ros2" / f"cdr_test_0.{kind}"
    with rosbags.AnyReader([path]) as reader:
        for topic in ("/test_topic", "/array_topic"):
            table = read_table(path, time=topic)
            connection = next(c for c in reader.connections if c.topic == topic)
            messages = [reader.deserialize(raw, c.msgtype) for c, _, raw in reader.messages([connection])]
            checked = 0
            for name, signal in table.signals.items():
                key, _, index = name.removeprefix(f"{topic}.").partition("[")
                if index.count(".") or "byte" in key or key.startswith("constants"):
                    continue
                found = [getattr(message, key) for message in messages]
                expected = [value[int(index.rstrip("]"))] if index else value for value in found]
                np.testing.assert_array_equal(signal.values, np.array(expected, dtype=float), err_msg=name)
                checked += 1
            assert checked > 10


def test_a_recording_is_read_by_time_window(formats):
    path = formats / "ros1" / "example.bag"
    whole = read_table(path, time="/turtle1/pose")
    part = read_table(path, time="/turtle1/pose", window_s=(5, 6))
    keep = (whole.time >= 5) & (whole.time <= 6)
    np.testing.assert_array_equal(part.time, whole.time[keep])
    np.testing.assert_array_equal(part.signals["/turtle1/pose.x"].values, whole.signals["/turtle1/pose.x"].values[keep])
    seek = formats / "ros2" / "test_bag_for_seek_0.mcap"
    np.testing.assert_allclose(read_table(seek, window_s=(0.05, 0.25)).time, [0.1, 0.2])


def test_topics_of_two_rates_need_a_rule(formats):
    path = formats / "ros1" / "example.bag"
    channels = {
        "x": Column(column="/turtle1/pose.x", unit="m"),
        "u": Column(column="/turtle1/cmd_vel.linear.x", unit="m/s"),
    }
    with pytest.raises(LogError, match=r"/turtle1/cmd_vel.*Hold\(\), Linear\(\), Nearest"):
        read_log(path, time="/turtle1/pose", channels=channels)
    with pytest.raises(LogError, match="holds several clocks"):
        read_log(path, channels=channels)
    log = read_log(path, time="/turtle1/pose", channels=channels, align=Hold())
    assert len(log) == 1344 and np.isnan(log["u"][0])


def test_unsorted_empty_and_false_bags(formats):
    assert read_table(formats / "ros1" / "example-unsorted-chunks.bag", time="foo", channels={}).time.tolist() == [
        0,
        1,
        2,
    ]
    assert contents(formats / "ros1" / "no-messages.bag").notes[0].startswith("0 messages")
    with pytest.raises(LogError, match="holds no column of numbers"):
        read_table(formats / "ros1" / "no-messages.bag")
    with pytest.raises(LogError, match="too few samples"):
        read_table(formats / "ros2" / "empty_bag_0.db3", time="/rosout", channels={})
    with pytest.raises(LogError, match="the file is empty"):
        read_table(formats / "ros1" / "empty-file.bag")
    with pytest.raises(LogError):
        read_table(formats / "ros1" / "asci-file.txt")
    with pytest.raises(LogError, match="is a folder"):
        read_table(formats / "ros1")


@pytest.mark.parametrize("keep", [0.2, 0.5, 0.9, 0.999])
@pytest.mark.parametrize("name", ["ros1/example.bag", "ros2/talker.db3", "ros2/talker.mcap", "acqtools/Dms3_oo1.mat"])
def test_cut_recordings_are_one_line(formats, tmp_path, name, keep):
    raw = (formats / name).read_bytes()
    path = tmp_path / name.split("/")[1]
    path.write_bytes(raw[: int(keep * len(raw))])
    with pytest.raises(LogError) as raised:
        read_table(path, time="/rosout")
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize("name", ["Wex1_noError", "Wmsr1_ini", "Wmsr2_loss"])
def test_scope_files_have_27_rows_at_25_khz(formats, name):
    log = read_log(formats / "acqtools" / f"{name}.csv", time="Time[usec]", channels=SCOPE)
    assert len(log) == 27 and log.rate_hz == pytest.approx(25e3)


@pytest.mark.parametrize(("name", "lost"), [("Wex1_noError", 0), ("Wmsr1_ini", 0), ("Wmsr2_loss", 1)])
def test_the_lossy_scope_file_has_a_gap(formats, name, lost):
    path = formats / "acqtools" / f"{name}.csv"
    log = read_log(path, channels=SCOPE, counter=Counter(column="CH1(msr)", samples_per_count=2))
    assert len(log.gaps) == lost
    suspected = [note for note in read_table(path).notes if "looks like a sample counter that misses 1 sample" in note]
    assert len(suspected) == lost


def test_matlab_files(recorded):
    motor = recorded("twomass") / "MultisineTypeA.mat"
    log = read_log(motor, time=Column(column="time", unit="us"), channels={"I": Column(column="iq_adx", unit="A")})
    assert len(log) == 50000 and log.rate_hz == pytest.approx(2500)
    with pytest.raises(LogError, match=r'"BA" holds a MATLAB object \(tf\)'):
        read_log(motor, time=Column(column="time", unit="us"), channels={"I": Column(column="BA", unit="A")})
    fields = {item.name: item.length for item in contents(recorded("formats") / "acqtools" / "Dms3_oo1.mat").fields}
    assert fields["ref"] == 800000 and fields["vib"] == 400000


def test_matlab_files_that_share_a_clock_become_one_log(recorded):
    names = ("vm", "theta", "alpha")
    files = [recorded("flexlink") / f"data_{name}.mat" for name in names]
    times = {name: Column(column=f"data_{name}(:,1)", unit="s") for name in names}
    log = read_log(
        files, time=times["vm"], align=Linear(),
        channels={
            "V": Column(column="data_vm(:,2)", unit="V"),
            "theta": Column(column="data_theta(:,3)", unit="deg", time=times["theta"]),
            "alpha": Column(column="data_alpha(:,2)", unit="deg", time=times["alpha"]),
        },
    )  # fmt: skip
    import scipy.io

    np.testing.assert_allclose(log["alpha"], np.deg2rad(scipy.io.loadmat(files[2])["data_alpha"][:, 1]), rtol=1e-12)
    assert len(log) == 2500 and log.rate_hz == pytest.approx(500)


def test_the_servos_wrapping_load_is_declared(recorded):
    for path in sorted(recorded("xl330").glob("*.json")):
        entries = json.loads(path.read_text())["entries"]
        log = read_log(
            path, time=Column(column="timestamp", unit="s"),
            channels={"load": Column(column="load", unit="-", wrap_bits=16, scale=1e-3)},
        )  # fmt: skip
        expected = np.array([entry["load"] for entry in entries], dtype=np.uint16).astype(np.int16) / 1000
        np.testing.assert_allclose(log["load"], expected, rtol=1e-12)
        assert np.abs(log["load"]).max() <= 1.0


def test_a_load_that_wraps_is_noted(recorded):
    for path in sorted(recorded("xl330").glob("*.json")):
        notes = read_table(path, time=Column(column="timestamp", unit="s")).notes
        wraps = max(entry["load"] for entry in json.loads(path.read_text())["entries"]) >= 2**15
        assert [note.split(":")[0] for note in notes if "field of 16 bits" in note] == ["load"] * wraps


def test_a_recording_without_messages_is_refused(formats):
    with pytest.raises(LogError, match="holds no sample; record"):
        read_table(formats / "ros2" / "empty_bag_0.db3")


@pytest.mark.parametrize("name", ["ak80", "flexlink", "formats", "twomass", "xl330"])
def test_every_file_opens_or_fails_in_one_line(recorded, name):
    for path in sorted(recorded(name).rglob("*")):
        error = failure(path)
        assert error is None or "\n" not in error, path


def failure(path):
    try:
        contents(path)
    except LogError as error:
        return str(error)
    return None
