"""Damage that a format can show is refused: what is read of a damaged file are the numbers that were written.

Bits are flipped, bytes lost, added and turned round, files cut: each gives an error, a note, or the same numbers. Where
a format has no checksum of its samples, a few of them may be others; never their count, nor all of them.
"""

from __future__ import annotations

import json
import shutil
import struct
import zlib

import numpy as np
import polars as pl
import pytest
import scipy.io

from seaopt.errors import SeaoptError
from seaopt.logs import Column, contents, read_table

T = np.arange(60) / 100
FORCE = np.sin(9 * T)


def write_mat(path, **options):
    scipy.io.savemat(path, {"time": T[:, None], "F": FORCE[:, None], "run": {"x": FORCE[:, None]}}, **options)


def write_mat4(path):
    scipy.io.savemat(path, {"time": T[:, None], "F": FORCE[:, None]}, format="4")


def write_hdf5(path, file=None, **options):
    h5py = pytest.importorskip("h5py")
    with h5py.File(path, "w", **(file or {})) as opened:
        for name, values in {"time": T, "F": FORCE}.items():
            opened.create_dataset(name, data=values, **options)


def write_mat73(path):
    write_hdf5(path, {"userblock_size": 512}, chunks=(30,), compression="gzip")
    with path.open("r+b") as stream:
        stream.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(512, b" "))


def write_npz(path, save=np.savez):
    with path.open("wb") as stream:
        save(stream, time=T, F=FORCE)


def write_parquet(path):
    pl.DataFrame({"time": T, "F": FORCE}).write_parquet(path)


def write_mdf(path, compression=0):
    asammdf = pytest.importorskip("asammdf")
    with asammdf.MDF(version="4.10") as file:
        file.append([asammdf.Signal(FORCE, T, name="F", unit="N")])
        file.save(path, overwrite=True, compression=compression)


def write_tdms(path):
    nptdms = pytest.importorskip("nptdms")
    wave = {"wf_increment": 0.01, "wf_start_offset": 0.0}
    with nptdms.TdmsWriter(path) as writer:
        for part in (slice(0, 25), slice(25, 60)):
            writer.write_segment([nptdms.ChannelObject("g", name, FORCE[part], properties=wave) for name in "FG"])


def write_bag(path, compression=None):
    rosbag1 = pytest.importorskip("rosbags.rosbag1")
    from rosbags.typesys import Stores, get_typestore

    store, kind = get_typestore(Stores.ROS1_NOETIC), "std_msgs/msg/Float64"
    path.unlink(missing_ok=True)
    writer = rosbag1.Writer(path)
    if compression:
        writer.set_compression(rosbag1.Writer.CompressionFormat[compression])
    with writer:
        connection = writer.add_connection("/force", kind, typestore=store)
        for t, force in zip(T, FORCE, strict=True):
            writer.write(connection, 10**9 + int(1e9 * t), store.serialize_ros1(store.types[kind](data=force), kind))


def write_db3(path):
    rosbag2 = pytest.importorskip("rosbags.rosbag2")
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    kind, bag = "std_msgs/msg/Float64", path.with_suffix("")
    shutil.rmtree(bag, ignore_errors=True)
    with rosbag2.Writer(bag, version=9, storage_plugin=rosbag2.StoragePlugin.SQLITE3) as writer:
        connection = writer.add_connection("/force", kind, typestore=store)
        for t, force in zip(T, FORCE, strict=True):
            message = store.serialize_cdr(store.types[kind](data=force), kind)
            writer.write(connection, 10**9 + int(1e9 * t), message)
    (bag / f"{bag.name}.db3").rename(path)


def write_mcap(path, compression="NONE", **options):
    writing = pytest.importorskip("mcap.writer")
    with path.open("wb") as stream:
        writer = writing.Writer(stream, compression=writing.CompressionType[compression], chunk_size=500, **options)
        writer.start()
        schema = writer.register_schema(name="force", encoding="jsonschema", data=b'{"type": "object"}')
        channel = writer.register_channel(topic="/force", message_encoding="json", schema_id=schema)
        for t, force in zip(T, FORCE, strict=True):
            stamp = int(1e9 * t)
            writer.add_message(channel, log_time=stamp, publish_time=stamp, data=json.dumps({"data": force}).encode())
        writer.finish()


def write_csv(path):
    rows = zip(T.tolist(), FORCE.tolist(), strict=True)
    path.write_text("time,F\n" + "".join(f"{t},{force}\n" for t, force in rows))


def write_json(path, lines=False):
    rows = [{"time": t, "F": force} for t, force in zip(T.tolist(), FORCE.tolist(), strict=True)]
    path.write_text("".join(json.dumps(row) + "\n" for row in rows) if lines else json.dumps({"entries": rows}))


# Name of a file, what writes it, its clock and column, and whether a checksum is over the samples.
FORMATS = {
    "mat": ("a.mat", write_mat, "time", "F", False),
    "mat, packed": ("a.mat", lambda path: write_mat(path, do_compression=True), "time", "F", True),
    "mat 4": ("a.mat", write_mat4, "time", "F", False),
    "mat 7.3": ("a.mat", write_mat73, "time", "F", True),
    "hdf5": ("a.h5", write_hdf5, "time", "F", False),
    "hdf5, checksums": (
        "a.h5", lambda path: write_hdf5(path, {"libver": "latest"}, chunks=(30,), fletcher32=True), "time", "F", True,
    ),
    "npz": ("a.npz", write_npz, "time", "F", True),
    "npz, packed": ("a.npz", lambda path: write_npz(path, np.savez_compressed), "time", "F", True),
    "mdf": ("a.mf4", write_mdf, "time", "F", False),
    "mdf, packed": ("a.mf4", lambda path: write_mdf(path, 1), "time", "F", True),
    "mdf, transposed": ("a.mf4", lambda path: write_mdf(path, 2), "time", "F", True),
    "tdms": ("a.tdms", write_tdms, "g:time", "g/F", False),
    "bag": ("a.bag", write_bag, "/force", "/force.data", False),
    "bag, bz2": ("a.bag", lambda path: write_bag(path, "BZ2"), "/force", "/force.data", True),
    "bag, lz4": ("a.bag", lambda path: write_bag(path, "LZ4"), "/force", "/force.data", False),
    "db3": ("a.db3", write_db3, "/force", "/force.data", False),
    "mcap": ("a.mcap", write_mcap, "/force", "/force.data", True),
    "mcap, lz4": ("a.mcap", lambda path: write_mcap(path, "LZ4"), "/force", "/force.data", True),
    "mcap, zstd": ("a.mcap", lambda path: write_mcap(path, "ZSTD"), "/force", "/force.data", True),
    "mcap, flat": (
        "a.mcap", lambda path: write_mcap(path, use_chunking=False, enable_data_crcs=True), "/force", "/force.data",
        True,
    ),
    "csv": ("a.csv", write_csv, "time", "F", False),
    "json lines": ("a.jsonl", lambda path: write_json(path, lines=True), "time", "F", False),
    "json": ("a.json", write_json, "time", "F", False),
}  # fmt: skip
LINES = ("csv", "json lines")  # of which a part is a log of its own, and a line more or less is not to be told
# Share whose byte order or index of chunks is damaged, which have no checksum in files of HDF5 1.8.
UNTOLD = {"hdf5": 0.003, "mat 7.3": 0.006}
FEW = 6  # samples that one damaged place may change: up to 31 bytes


def read_force(path, clock, column):
    table = read_table(
        path, time=Column(column=clock, unit="s"), channels={"F": Column(column=column, unit="N")}, digest=False
    )
    return np.array([table.time, table.signals["F"].values]), table.notes


def damage(content, rng):
    """Return how a file was damaged, and what it is then."""
    kind = ("flip", "byte", "cut", "append", "lose", "add", "turn")[
        rng.choice(7, p=[0.35, 0.15, 0.2, 0.1, 0.08, 0.07, 0.05])
    ]
    damaged, at = bytearray(content), int(rng.integers(len(content)))
    if kind == "flip":
        damaged[at] ^= 1 << int(rng.integers(8))
    elif kind == "byte":
        damaged[at] = int(rng.integers(256))
    elif kind == "cut":
        end = max(at, len(content) - int(rng.integers(1, 40))) if rng.random() < 0.5 else at
        damaged = damaged[:end]
    elif kind == "append":
        count = int(rng.integers(1, 24))
        damaged += rng.bytes(count) if rng.random() < 0.5 else b"\0" * count
    elif kind == "lose":
        del damaged[at : at + int(rng.integers(1, 12))]
    elif kind == "add":
        damaged[at:at] = rng.bytes(int(rng.integers(1, 12)))
    else:
        stop = at + int(rng.integers(2, 32))
        damaged[at:stop] = damaged[at:stop][::-1]
    return kind, bytes(damaged)


def judge(name, kind, expected, notes, got, said):
    """Return whether what was read of a damaged file is as it should be."""
    if got.shape == expected.shape and np.array_equal(got, expected, equal_nan=True):
        return True
    if said != notes:
        return True
    whole = FORMATS[name][-1]
    if name in LINES and kind in ("cut", "lose", "add") and got.shape != expected.shape:
        rows = {tuple(row) for row in expected.T.tolist()}
        return sum(tuple(row) not in rows for row in got.T.tolist()) <= (0 if kind == "cut" else FEW)
    return (
        not whole and kind not in ("cut", "append") and got.shape == expected.shape and np.sum(got != expected) <= FEW
    )


def try_damage(folder, name, count, seed=7):
    """Damage a file so many times; return what was read as other numbers, and how often it was refused."""
    file, write, clock, column, _ = FORMATS[name]
    path, rng = folder / file, np.random.default_rng(seed)
    write(path)
    content = path.read_bytes()
    expected, notes = read_force(path, clock, column)
    np.testing.assert_allclose(expected, [T + expected[0, 0], FORCE], atol=1e-12)
    wrong, refused = [], 0
    for number in range(count):
        kind, damaged = damage(content, rng)
        path.write_bytes(damaged)
        try:
            got, said = read_force(path, clock, column)
        except SeaoptError:
            refused += 1
            continue
        if not judge(name, kind, expected, notes, got, said):
            wrong.append((number, kind))
    return wrong, refused


@pytest.mark.parametrize("name", FORMATS)
def test_a_damaged_file_is_never_read_as_others(tmp_path, name):
    count = 15 if name.startswith("mdf") else 60
    wrong, refused = try_damage(tmp_path, name, count)
    assert not wrong and refused > count / 5


@pytest.mark.slow
@pytest.mark.parametrize("name", FORMATS)
def test_many_damaged_files_are_never_read_as_others(tmp_path, name):
    count = 30 if name.startswith("mdf") else 200
    wrong, refused = try_damage(tmp_path, name, count)
    assert len(wrong) <= UNTOLD.get(name, 0.0) * 1500 and refused > count / 15, wrong


def test_a_packed_mat_is_read_to_the_end_of_its_stream(tmp_path):
    """The checksum of each stream, changed alone: the numbers are those that were written, and nothing says so."""
    path = tmp_path / "a.mat"
    write_mat(path, do_compression=True)
    content = bytearray(path.read_bytes())
    at, ends = 128, []
    while at < len(content):
        at += 8 + struct.unpack("<I", content[at + 4 : at + 8])[0]
        ends.append(at)
    assert len(ends) == 3
    for end, column in zip(ends, ("time", "F", "run.x"), strict=True):
        path.write_bytes(content[: end - 1] + bytes([content[end - 1] ^ 1]) + content[end:])
        with pytest.raises(SeaoptError, match=r"a\.mat"):
            read_force(path, "time", column)


@pytest.mark.parametrize(
    ("name", "more", "words"),
    [
        ("mat", 7, "7 bytes behind its last variable"),
        ("mat, packed", 3, "3 bytes behind"),
        ("hdf5", 24, "says that it"),
    ],
)
def test_what_is_longer_than_it_says_is_refused(tmp_path, name, more, words):
    file, write, *_ = FORMATS[name]
    path = tmp_path / file
    write(path)
    path.write_bytes(path.read_bytes() + b"\0" * more)
    with pytest.raises(SeaoptError, match=words):
        contents(path)


@pytest.mark.parametrize("compression", [0, 1])
@pytest.mark.parametrize("counted", [59, 61])
def test_an_mdf_that_counts_other_records_than_it_has_is_refused(tmp_path, compression, counted):
    path = tmp_path / "a.mf4"
    write_mdf(path, compression)
    content = bytearray(path.read_bytes())
    group = content.index(b"##CG")
    links = struct.unpack("<Q", content[group + 16 : group + 24])[0]
    place = group + 24 + 8 * links + 8
    assert struct.unpack("<Q", content[place : place + 8])[0] == 60
    content[place : place + 8] = struct.pack("<Q", counted)
    path.write_bytes(content)
    with pytest.raises(SeaoptError, match=f"records take {16 * counted} bytes and 960 are there"):
        contents(path)


def test_a_packed_mdf_block_has_its_checksum(tmp_path):
    path = tmp_path / "a.mf4"
    write_mdf(path, 1)
    content = bytearray(path.read_bytes())
    block = content.index(b"##DZ")
    packed = struct.unpack("<Q", content[block + 40 : block + 48])[0]
    end = block + 48 + packed
    assert zlib.decompress(content[block + 48 : end])
    content[end - 1] ^= 1
    path.write_bytes(content)
    with pytest.raises(SeaoptError, match=r"a\.mf4"):
        contents(path)


@pytest.mark.parametrize("encoding", ["utf-8", "utf-16", "cp1252"])
@pytest.mark.parametrize(("end", "noted"), [("\n", False), ("\r\n", False), ("\n\x1a", False), ("", True), ("3", True)])
def test_a_csv_whose_last_line_does_not_end_is_noted(tmp_path, end, noted, encoding):
    path = tmp_path / "a.csv"
    path.write_bytes(f"t [s],angle [°]\n0.0,1.5\n0.1,1.25{end}".encode(encoding))
    notes = read_table(path).notes
    assert any("its last line does not end" in note for note in notes) == noted
    if noted:
        assert any(f'"0.1,1.25{end}"' in note for note in notes)


@pytest.mark.parametrize("kind", ["exponent", "filter"])
def test_a_damaged_description_of_hdf5_numbers_is_refused(tmp_path, kind):
    """Object headers of the first version have no checksum: a type of another exponent, chunks whose filter is lost."""
    path = tmp_path / "a.h5"
    write_hdf5(path, chunks=(30,), compression="gzip")
    content = path.read_bytes()
    mark = b"\x40\x00\x34\x0b\x00\x34\xff\x03" if kind == "exponent" else b"\x0b\x00\x20\x00\x01\x00\x00\x00"
    mark = mark if mark in content else b"\x0b\x00"
    refused = 0
    for at in [at for at in range(len(content)) if content.startswith(mark, at)]:
        damaged = bytearray(content)
        damaged[at + 6 if kind == "exponent" else at] ^= 4 if kind == "exponent" else 0x20
        path.write_bytes(damaged)
        try:
            np.testing.assert_array_equal(read_force(path, "time", "F")[0], [T, FORCE])
        except SeaoptError:
            refused += 1
    assert refused


def read(path):
    table = read_table(path)
    return np.array([table.time, *(signal.values for signal in table.signals.values())])


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
