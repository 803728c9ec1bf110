"""Damage that a format can show is refused: a bit flipped anywhere gives an error, or the numbers that were written."""

from __future__ import annotations

import json

import numpy as np
import polars as pl
import pytest

from seaopt.errors import SeaoptError
from seaopt.logs import read_table

T = np.arange(60) / 100
FORCE = np.sin(9 * T)


def write_mcap(path, **options):
    writing = pytest.importorskip("mcap.writer")
    with path.open("wb") as stream:
        writer = writing.Writer(stream, compression=writing.CompressionType.NONE, chunk_size=500, **options)
        writer.start()
        schema = writer.register_schema(name="force", encoding="jsonschema", data=b'{"type": "object"}')
        channel = writer.register_channel(topic="/force", message_encoding="json", schema_id=schema)
        for t, force in zip(T, FORCE, strict=True):
            stamp = int(1e9 * t)
            writer.add_message(channel, log_time=stamp, publish_time=stamp, data=json.dumps({"F": force}).encode())
        writer.finish()


def read(path):
    table = read_table(path)
    return np.array([table.time, *(signal.values for signal in table.signals.values())])


def refuse_or_equal(path, rng, tries):
    """Flip one bit at each of some places; return how often the file was refused where it does not read the same."""
    content, expected, refused = path.read_bytes(), read(path), 0
    for place in rng.choice(len(content), size=tries, replace=False).tolist():
        damaged = bytearray(content)
        damaged[place] ^= 1 << int(rng.integers(8))
        path.write_bytes(damaged)
        try:
            np.testing.assert_array_equal(read(path), expected)
        except SeaoptError:
            refused += 1
    return refused


@pytest.mark.parametrize("options", [{}, {"use_chunking": False, "enable_data_crcs": True}])
def test_a_flipped_bit_of_an_mcap_is_never_another_number(tmp_path, options):
    path = tmp_path / "log.mcap"
    write_mcap(path, **options)
    np.testing.assert_allclose(read(path)[-1], FORCE)
    assert refuse_or_equal(path, np.random.default_rng(1), 150) > 100


def test_a_damaged_parquet_is_one_line(tmp_path, capfd):
    path = tmp_path / "log.parquet"
    pl.DataFrame({"t [s]": T, "F [N]": FORCE}).write_parquet(path)
    content, rng, messages = path.read_bytes(), np.random.default_rng(2), []
    for place in rng.choice(len(content), size=150, replace=False).tolist():
        damaged = bytearray(content)
        damaged[place] = int(rng.integers(256))
        path.write_bytes(damaged)
        try:
            read(path)
        except SeaoptError as error:
            messages.append(str(error))
    assert len(messages) > 5 and not any("\n" in message for message in messages)
    assert capfd.readouterr().err == ""


def write_tdms(path):
    nptdms = pytest.importorskip("nptdms")
    wave = {"wf_increment": 0.01, "wf_start_offset": 0.0}
    with nptdms.TdmsWriter(path) as writer:
        for part in (slice(0, 25), slice(25, 60)):
            writer.write_segment([nptdms.ChannelObject("g", name, FORCE[part], properties=wave) for name in "FG"])


def write_db3(path):
    rosbag2 = pytest.importorskip("rosbags.rosbag2")
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    kind, bag = "std_msgs/msg/Float64", path.with_suffix("")
    with rosbag2.Writer(bag, version=9, storage_plugin=rosbag2.StoragePlugin.SQLITE3) as writer:
        connection = writer.add_connection("/force", kind, typestore=store)
        for t, force in zip(T, FORCE, strict=True):
            message = store.serialize_cdr(store.types[kind](data=force), kind)
            writer.write(connection, 10**9 + int(1e9 * t), message)
    (bag / f"{bag.name}.db3").rename(path)


def write_hdf5(path):
    h5py = pytest.importorskip("h5py")
    with h5py.File(path, "w", libver="latest") as file:
        for name, values in {"time": np.arange(1000) / 100, "F": np.resize(FORCE, 1000)}.items():
            file.create_dataset(name, data=values, chunks=(250,), fletcher32=True).attrs["units"] = "s"


def test_a_tdms_cut_anywhere_is_refused(tmp_path):
    path = tmp_path / "log.tdms"
    write_tdms(path)
    content = path.read_bytes()
    second = content.index(b"TDSm", 4)
    for place in [second - 1, *range(second + 1, len(content), 7)]:
        path.write_bytes(content[:place])
        with pytest.raises(SeaoptError, match="cut off"):
            read_table(path)


def test_a_tdms_whose_counts_contradict_its_segments_is_refused(tmp_path):
    path = tmp_path / "log.tdms"
    write_tdms(path)
    content = path.read_bytes()
    count = (25).to_bytes(8, "little")
    place = content.index(count)
    path.write_bytes(content[:place] + (20).to_bytes(8, "little") + content[place + 8 :])
    with pytest.raises(SeaoptError, match="damaged"):
        read_table(path)


def test_a_flipped_bit_of_hdf5_with_checksums_is_never_another_number(tmp_path):
    path = tmp_path / "log.h5"
    write_hdf5(path)
    assert refuse_or_equal(path, np.random.default_rng(3), 100) > 50


def test_a_db3_that_lacks_rows_is_refused(tmp_path):
    """Times stand twice in it, in the table and in its index; a row that one of them lacks is damage."""
    path = tmp_path / "log.db3"
    write_db3(path)
    content, times = path.read_bytes(), read(path)[0]
    rng, refused = np.random.default_rng(4), 0
    for place in rng.choice(len(content), size=100, replace=False).tolist():
        damaged = bytearray(content)
        damaged[place] ^= 1 << int(rng.integers(8))
        path.write_bytes(damaged)
        try:
            np.testing.assert_array_equal(read(path)[0], times)
        except SeaoptError:
            refused += 1
    assert refused > 5
