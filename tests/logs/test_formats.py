"""Each format, written by the library of its field (or NumPy), read back by seaopt."""

from __future__ import annotations

import builtins
import gc
import json
import logging
import struct
import sys
import threading
import warnings
import zipfile
import zlib

import numpy as np
import pytest

from seaopt.errors import LogError
from seaopt.logs import Column, Hold, contents, read_log, read_table
from seaopt.logs.formats.messages import build_wanted_tree
from seaopt.logs.formats.simulink import assign_clocks
from seaopt.logs.formats.source import Field, spread

N = 200
T = np.arange(N) / 100
F = np.sin(7 * T)
S = Column(column="time", unit="s")


def one(path, column, **options):
    signals = read_table(path, channels={"F": Column(column=column, unit="N")}, **options).signals
    return signals["F"].values


def hdf5(path):
    import h5py

    with h5py.File(path, "w") as file:
        file["bench/time"] = T
        file["bench/F"] = F
        file["bench/F"].attrs["units"] = "kN"
        file["bench/m"] = np.column_stack([F, 2 * F])
        table = np.zeros(N, dtype=[("time", "f8"), ("F", "f4")])
        table["time"], table["F"] = T, F
        file["table"] = table
        file["text"] = "hello"
        file["soft"] = h5py.SoftLink("/bench/F")
        file["out"] = h5py.ExternalLink("/etc/passwd", "/")


def test_hdf5(tmp_path):
    path = tmp_path / "log.dat"  # content decides, not the name
    hdf5(path)
    names = {item.name for item in contents(path).fields}
    assert names == {"bench/time", "bench/F", "bench/m[:,0]", "bench/m[:,1]", "table.time", "table.F", "text"}
    table = read_table(path, time=Column(column="bench/time", unit="s"), window_s=(0.5, 1.0))
    np.testing.assert_array_equal(table.signals["bench/F"].values, 1000 * F[50:101])
    np.testing.assert_array_equal(table.signals["bench/m[:,1]"].values, 2 * F[50:101])
    np.testing.assert_allclose(one(path, "table.F", time=Column(column="table.time", unit="s")), F, atol=1e-7)


def test_hdf5_reads_nothing_outside_itself(tmp_path):
    import h5py

    (tmp_path / "raw.bin").write_bytes(b"\0" * 80)
    path = tmp_path / "log.h5"
    with h5py.File(path, "w") as file:
        file.create_dataset("a", (10,), "f8", external=[(str(tmp_path / "raw.bin"), 0, 80)])
        layout = h5py.VirtualLayout((10,), "f8")
        layout[:] = h5py.VirtualSource("other.h5", "x", (10,))
        file.create_virtual_dataset("v", layout)
        file["time"] = np.arange(10.0)
    assert {item.kind for item in contents(path).fields} == {"data in another file", "float64"}
    with pytest.raises(LogError, match="holds data in another file"):
        read_table(path, time=S, channels={"F": Column(column="a", unit="N")})


def test_parquet(tmp_path):
    import polars as pl

    path = tmp_path / "log.parquet"
    pl.DataFrame({"time [ms]": 1000 * T, "F [kN]": F, "on": T > 1, "note": ["a"] * N}).write_parquet(path)
    table = read_table(path, window_s=(0.5, 1.0))
    np.testing.assert_allclose(table.time, T[50:101])
    np.testing.assert_allclose(table.signals["F"].values, 1000 * F[50:101])
    np.testing.assert_array_equal(table.signals["on"].values, T[50:101] > 1)


def test_parquet_with_dates(tmp_path):
    from datetime import UTC, datetime, timedelta

    import polars as pl

    path = tmp_path / "log.parquet"
    start = datetime(2026, 1, 15, tzinfo=UTC)
    pl.DataFrame({"time": [start + timedelta(milliseconds=10 * i) for i in range(5)], "F": np.arange(5)}).write_parquet(
        path
    )
    np.testing.assert_allclose(read_table(path).time - start.timestamp(), np.arange(5) / 100, atol=1e-6)


def test_npz(tmp_path):
    path = tmp_path / "log.npz"
    np.savez_compressed(
        path, time=T, F=F.astype("f4"), m=np.vstack([F, 2 * F, 3 * F]), objects=np.array([{}, []], object)
    )
    kinds = {item.name: item.kind for item in contents(path).fields}
    assert kinds["objects"] == "Python objects" and kinds["m[2,:]"] == "float64"
    np.testing.assert_array_equal(one(path, "m[2,:]", time=S), 3 * F)
    with pytest.raises(LogError, match="holds Python objects"):
        one(path, "objects", time=S)


class Bomb:
    def __reduce__(self):
        return (print, ("this must not run",))


def test_pickles_are_not_run(tmp_path, capsys):
    import pickle

    np.savez(tmp_path / "log.npz", F=np.array([Bomb()], object), time=np.arange(2.0))
    contents(tmp_path / "log.npz")
    (tmp_path / "log.pkl").write_bytes(pickle.dumps(Bomb(), protocol=4))
    with pytest.raises(LogError, match="pickle, which could run code"):
        read_table(tmp_path / "log.pkl")
    assert capsys.readouterr().out == ""


def test_a_zip_bomb_is_not_unpacked(tmp_path, monkeypatch):
    import seaopt.logs.formats.source as source

    monkeypatch.setattr(source, "MAX_UNPACKED", 1 << 20)
    np.savez_compressed(tmp_path / "log.npz", time=np.zeros(1 << 18))
    with pytest.raises(LogError, match="the archive unpacks to"):
        read_table(tmp_path / "log.npz")
    import scipy.io

    scipy.io.savemat(tmp_path / "log.mat", {"time": np.zeros(1 << 18)}, do_compression=True)
    with pytest.raises(LogError, match="the file unpacks to"):
        read_table(tmp_path / "log.mat")


def test_an_array_that_claims_more_than_it_has(tmp_path):
    path = tmp_path / "log.npz"
    head = "{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000,), }".ljust(117) + "\n"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("time.npy", b"\x93NUMPY\x01\x00" + struct.pack("<H", len(head)) + head.encode() + b"\0" * 80)
    with pytest.raises(LogError, match="array time is cut off"):
        read_table(path)


@pytest.mark.parametrize("packed", [False, True])
def test_mat5(tmp_path, packed):
    import scipy.io

    path = tmp_path / "log.mat"
    inner = {"F": F[:, None], "name": "cell", "deep": {"x": np.arange(3.0)}}
    content = {"time": T[:, None], "data": np.column_stack([F, 2 * F]), "run": inner, "c": np.array([1, "a"], object)}
    scipy.io.savemat(path, {**content, "n": np.arange(N, dtype="i2"), "z": F + 1j}, do_compression=packed)
    kinds = {item.name: item.kind for item in contents(path).fields}
    assert (
        kinds["c"] == "a cell array"
        and kinds["run.name"] == "text"
        and kinds["n"] == "int16"
        and kinds["z"] == "complex"
    )
    np.testing.assert_array_equal(one(path, "data(:,2)", time=S), 2 * F)
    np.testing.assert_array_equal(one(path, "run.F", time=S), F)
    np.testing.assert_array_equal(one(path, "n", time=S, window_s=(0.1, 0.5)), np.arange(10, 51))
    with pytest.raises(LogError, match='has 3 samples and the clock "time" 200'):
        one(path, "run.deep.x", time=S)


def test_simulink_struct_with_time_is_its_own_clock(tmp_path):
    import scipy.io

    path = tmp_path / "log.mat"
    signals = np.zeros((1, 2), dtype=[("values", object), ("label", object)])
    signals[0, 0] = (F[:, None], "F")
    signals[0, 1] = (np.column_stack([F, 3 * F]), "both")
    half = {"Time": T[::2, None], "Data": F[::2, None], "Name": "slow"}
    scipy.io.savemat(path, {"out": {"time": T[:, None], "signals": signals}, "ts": half})
    clocks = {item.name: (item.clock, item.unit) for item in contents(path).fields}
    assert clocks["out.signals(2).values(:,2)"] == ("out.time", None) and clocks["ts.Time"] == ("ts.Time", "s")
    channels = {"a": Column(column="out.signals(2).values(:,2)", unit="N"), "b": Column(column="ts.Data", unit="N")}
    with pytest.raises(LogError, match='"ts.Data" is on the clock "ts.Time"'.replace(".", r"\.")):
        read_table(path, time="out.time", channels=channels)
    table = read_table(path, time="out.time", channels=channels, align=Hold())
    np.testing.assert_array_equal(table.signals["a"].values, 3 * F)
    np.testing.assert_array_equal(table.signals["b"].values[:-1], np.repeat(F[::2], 2)[:-1])


def test_mat73_turns_matlabs_axes(tmp_path):
    import h5py

    path = tmp_path / "log.mat"
    with h5py.File(path, "w", userblock_size=512) as file:

        def put(name, value, kind="double"):
            file[name] = value
            file[name].attrs["MATLAB_class"] = np.bytes_(kind)

        put("time", T[None, :])
        put("data", np.vstack([F, 2 * F]))  # an N x 2 matrix in MATLAB
        put("run/F", F[None, :])
        put("text", np.frombuffer("ab".encode("utf-16-le"), "u2")[None], "char")
        put("ts", np.zeros((1, 6), "u4"), "timeseries")
        file["ts"].attrs["MATLAB_object_decode"] = 3
    with path.open("r+b") as stream:
        stream.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(512, b" "))
    np.testing.assert_array_equal(one(path, "data(:,2)", time=S), 2 * F)
    np.testing.assert_array_equal(one(path, "run.F", time=S), F)
    with pytest.raises(LogError, match=r"a MATLAB object \(timeseries\).*save a timeseries there by s.time = ts.Time"):
        one(path, "ts", time=S)


def test_json_lines_and_entries(tmp_path):
    rows = [
        {"time": t, "imu": {"F": f}, "v": [f, 2 * f], "note": "a"} for t, f in zip(T.tolist(), F.tolist(), strict=True)
    ]
    lines = tmp_path / "log.jsonl"
    lines.write_text("\n".join(map(json.dumps, rows)))
    whole = tmp_path / "log.json"
    whole.write_text(json.dumps({"mass": 0.49, "serial": 10**400, "entries": rows}, indent=1))
    columns = tmp_path / "columns.json"
    columns.write_text(json.dumps({"time": T.tolist(), "imu.F": F.tolist(), "rate": 100}))
    for path in (lines, whole, columns):
        np.testing.assert_array_equal(one(path, "imu.F", time=S), F)
    np.testing.assert_array_equal(one(lines, "v[1]", time=S), 2 * F)
    assert contents(whole).notes[0].startswith("header: mass = 0.49, serial = 1000")
    mass = Column(column="mass", unit="kg", from_header=True)
    assert set(read_log(whole, time=S, channels={"m": mass})["m"]) == {0.49}


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('{"time": 0, "F": 1}\n{"time": 1, "F": "x"}\n', 'line 2: "x" in "F" is not a number'),
        ('{"time": 0, "F": 1}\n{"time": 1, "F": \n', "line 2, column"),
        ('{"entries": [{"time": 0, "F": 1}, {"time": 1, "F": [}]}', "is not valid JSON"),
        ('{"entries": []}', "holds no entries"),
        ('{"entries": 5}', "holds no list of entries"),
        ('{"time": 0, "time": 1, "F": 2}\n{"time": 1}\n', '2 keys of one entry are named "time"'),
        ('{"time": 0, "F": 1e999}\n{"time": 1, "F": 1}\n', "is not finite"),
        ('{"time": [1, 2], "F": [1]}', "differ in length"),
        ('{"schema": "seaopt/fit/2", "notes": ["a"], "findings": []}', "is a result .*seaopt/fit/2.*, and no log"),
        ("[" * 100_000, "nested too deep"),
        ('{"time": ' + "9" * 5000 + "}", "not valid JSON|not finite"),
        ("[{]", "is not valid JSON"),
    ],
)  # fmt: skip
def test_bad_json_says_where(tmp_path, text, words):
    path = tmp_path / "log.json"
    path.write_text(text)
    with pytest.raises(LogError, match=words) as raised:
        read_table(path, time=S, channels={"F": Column(column="F", unit="N")})
    assert "\n" not in str(raised.value)


def test_mdf(tmp_path):
    asammdf = pytest.importorskip("asammdf")
    path = tmp_path / "log.mf4"
    with asammdf.MDF(version="4.10") as file:
        raw = np.arange(N, dtype="i2")
        file.append(
            [asammdf.Signal(F, T, name="F", unit="kN"), asammdf.Signal(raw, T, name="n", conversion={"a": 0.5, "b": 1})]
        )
        file.append([asammdf.Signal(F[::2], T[::2], name="slow", unit="N"),
                     asammdf.Signal(F[::2], T[::2], name="formula", conversion={"formula": "X1*2"})])  # fmt: skip
        file.save(path, overwrite=True)
    table = read_table(path, time="0/time", window_s=(0.5, 1.0))
    np.testing.assert_array_equal(table.signals["F"].values, 1000 * F[50:101])
    np.testing.assert_array_equal(table.signals["n"].values, 0.5 * np.arange(50, 101) + 1)
    np.testing.assert_array_equal(read_log(path, channels={"s": "slow"})["s"], F[::2])
    with pytest.raises(LogError, match="holds text, or a formula"):
        one(path, "formula")


def test_tdms(tmp_path):
    nptdms = pytest.importorskip("nptdms")
    path = tmp_path / "log.tdms"
    wave = {"wf_increment": 0.01, "wf_start_offset": 0.5, "unit_string": "kN"}
    with nptdms.TdmsWriter(path) as writer:
        writer.write_segment([nptdms.ChannelObject("bench", "F", F[:120], properties=wave)])
        writer.write_segment([nptdms.ChannelObject("bench", "F", F[120:], properties=wave)])
        writer.write_segment([nptdms.ChannelObject("slow", "x", F[:5])])
    table = read_table(path, time="bench:time", window_s=(1.0, 2.0))
    np.testing.assert_allclose(table.time, 0.5 + T[50:151])
    np.testing.assert_array_equal(table.signals["bench/F"].values, 1000 * F[50:151])
    with pytest.raises(LogError, match='"slow/x" has no clock of its own'):
        one(path, "slow/x", time="bench:time")


def damaged(path, make):
    """Return a file cut in the middle."""
    make(path)
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    return path


def mat(path):
    import scipy.io

    scipy.io.savemat(path, {"time": T, "F": F}, do_compression=True)


def mdf(path):
    asammdf = pytest.importorskip("asammdf")
    with asammdf.MDF(version="4.10") as file:
        file.append([asammdf.Signal(F, T, name="F", unit="N")])
        file.save(path, overwrite=True)


def tdms(path):
    nptdms = pytest.importorskip("nptdms")
    with nptdms.TdmsWriter(path) as writer:
        writer.write_segment([nptdms.ChannelObject("g", name, F) for name in "ab"])


@pytest.mark.parametrize(
    ("make", "name"),
    [(hdf5, "a.h5"), (mat, "a.mat"), (lambda p: np.savez(p, time=T), "a.npz"), (mdf, "a.mf4"), (tdms, "a.tdms")],
)
def test_cut_files_are_one_line(tmp_path, capfd, make, name):
    path = damaged(tmp_path / name, make)
    with pytest.raises(LogError, match=r"cut off|damaged") as raised:
        read_table(path, time=S)
    assert "\n" not in str(raised.value)
    del raised
    gc.collect()  # what the library says as it goes would be a second line
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize(
    ("content", "name", "words"),
    [
        (b"\x1f\x8b\x08" + b"\0" * 50, "a.csv.gz", "unpack it first"),
        (b"PK\x03\x04" + b"\0" * 50, "a.xlsx", "NPZ"),
        (b"\xd0\xcf\x11\xe0" + b"\0" * 50, "a.xls", "save the sheet as CSV"),
        (b"time,F\n0,1\n", "a.mat", "not a valid MAT file"),
        (bytes(range(256)) * 20, "a.csv", "not a text file"),
        (b"#ROSBAG V1.2\n", "a.bag", "version other than 2.0"),
        (b"\x89MCAP0\r\n" + b"\0" * 100, "a.mcap", "cannot be read as MCAP"),
        (b"TDSm" + b"\0" * 50, "a.tdms", "TDMS"),
        (b"MDF     4.10" + b"\0" * 100, "a.mf4", "MDF"),
        (b"PAR1" + b"\0" * 100 + b"PAR1", "a.parquet", "Parquet"),
        (b"SQLite format 3\0" + b"\0" * 200, "a.db3", "db3"),
    ],
)
def test_junk_is_named(tmp_path, content, name, words):
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(LogError, match=words) as raised:
        read_table(path)
    assert "\n" not in str(raised.value)


def test_a_matrix_inside_a_struct_cannot_claim_more_than_its_bytes(tmp_path):
    def element(kind, data):
        return struct.pack("<II", kind, len(data)) + data + b"\0" * (-len(data) % 8)

    def matrix(kind, dims, *rest):
        flags = element(6, struct.pack("<II", kind, 0))
        return element(14, flags + element(5, struct.pack(f"<{len(dims)}i", *dims)) + b"".join(rest))

    huge = matrix(6, (1 << 30, 1), element(1, b""), element(9, b"\0" * 80))
    keys = element(5, struct.pack("<i", 8)) + element(1, b"F".ljust(8, b"\0"))
    packed = zlib.compress(matrix(2, (1, 1), element(1, b"run"), keys, huge))
    path = tmp_path / "log.mat"
    path.write_bytes(b"MATLAB 5.0 MAT-file".ljust(124) + b"\x00\x01IM" + struct.pack("<II", 15, len(packed)) + packed)
    with pytest.raises(LogError, match="claims 1073741824x1 elements and holds 80 bytes"):
        one(path, "run.F", time=Column(column="run.F", unit="s"))


@pytest.mark.parametrize(
    ("magic", "module", "extra"),
    [
        (b"\x89HDF\r\n\x1a\n", "h5py", "hdf5"),
        (b"#ROSBAG V2.0\n", "rosbags", "ros"),
        (b"\x89MCAP0\r\n", "mcap", "ros"),
        (b"MDF     4.10", "asammdf", "mdf"),
        (b"TDSm", "nptdms", "tdms"),
    ],
)
def test_a_missing_library_names_its_extra(tmp_path, monkeypatch, magic, module, extra):
    path = tmp_path / "log.bin"
    path.write_bytes(magic + b"\0" * 100)
    for name in [name for name in sys.modules if name.split(".")[0] == module]:
        monkeypatch.delitem(sys.modules, name)
    real = builtins.__import__

    def hidden(name, *rest):
        if name.split(".")[0] == module:
            raise ImportError(name)
        return real(name, *rest)

    monkeypatch.setattr(builtins, "__import__", hidden)
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(LogError, match=rf"pip install 'seaopt\[{extra}\]'"):
        read_table(path)


def test_a_library_too_old_is_no_damaged_file(tmp_path):
    import polars as pl

    from seaopt.logs.formats.source import translate_errors

    with pytest.raises(LogError, match="not at fault"), translate_errors(tmp_path / "log.csv", "CSV"):
        pl.read_csv(b"a", an_option_of_the_future=True)


def test_a_library_that_does_not_fit_into_memory_is_no_damaged_file(tmp_path):
    from seaopt.logs.formats.source import translate_errors

    with pytest.raises(LogError, match=r"cannot be loaded.*ulimit"), translate_errors(tmp_path / "log.csv", "CSV"):
        raise NameError("name 'PyLazyFrame' is not defined")


def test_readers_in_threads_leave_warnings_and_logs_of_a_process_as_they_were(tmp_path):
    """The second begins while the first reads, and ends after it."""
    from seaopt.logs.formats.source import translate_errors

    found = logging.root.manager.disable, list(warnings.filters)
    begun, over = threading.Event(), threading.Event()

    def read():
        with translate_errors(tmp_path / "log.csv", "CSV"):
            begun.set()
            assert over.wait(60.0)

    second = threading.Thread(target=read)
    with translate_errors(tmp_path / "log.csv", "CSV"):
        second.start()
        assert begun.wait(60.0)
    over.set()
    second.join()
    assert (logging.root.manager.disable, list(warnings.filters)) == found


def test_an_mcap_topic_of_two_types_is_refused(tmp_path):
    writing = pytest.importorskip("mcap.writer")
    path = tmp_path / "log.mcap"
    with path.open("wb") as stream:
        writer = writing.Writer(stream)
        writer.start()
        for time, kind in enumerate(("Float64", "Int64")):
            definition = f"{kind.lower()} data".encode()
            schema = writer.register_schema(name=f"std_msgs/{kind}", encoding="ros1msg", data=definition)
            channel = writer.register_channel(topic="/a", message_encoding="ros1", schema_id=schema)
            writer.add_message(channel_id=channel, log_time=time, publish_time=time, data=bytes(8))
        writer.finish()
    with pytest.raises(LogError, match="/a carries std_msgs/msg/Float64 and std_msgs/msg/Int64"):
        contents(path)


def test_columns_of_arrays_are_named_by_their_place():
    assert [field.name for field, _ in spread("x", (100, 2), "float64")] == ["x[:,0]", "x[:,1]"]
    assert [field.name for field, _ in spread("x", (2, 9), "int8")] == ["x[0,:]", "x[1,:]"]
    assert [field.name for field, _ in spread("x", (100, 2), "float64", matlab=True)] == ["x(:,1)", "x(:,2)"]


def test_the_time_of_a_structure_is_the_clock_of_its_signals():
    names = ("out.time", "out.signals.values")
    fields = assign_clocks([Field(name=name, kind="float64", length=9) for name in names])
    assert [(field.clock, field.unit) for field in fields] == [("out.time", "s"), ("out.time", None)]


def test_wanted_paths_are_nested():
    assert build_wanted_tree({"a.b[2]": "x", "a.c": "y"}) == {"a": {"b": {2: "x"}, "c": "y"}}
