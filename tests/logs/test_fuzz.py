"""Whatever a file holds, only a SeaoptError comes out."""

from __future__ import annotations

import contextlib
import io
import json

import numpy as np
import pytest
import scipy.io
from hypothesis import given
from hypothesis import strategies as st

from seaopt.errors import SeaoptError
from seaopt.logs import Column, contents, read_table

CELL = st.one_of(
    st.sampled_from(
        ["", "nan", "1", "-2.5", "1e3", "1,5", "inf", "x", '"', "#", "\x00", "µ", "1 2", "[s]", "time [s]", "\x1a"]
    ),
    st.floats(allow_nan=False).map(repr),
    st.text(max_size=5),
)
ROWS = st.lists(st.lists(CELL, max_size=5), max_size=8)
VALUE = st.recursive(
    st.one_of(st.none(), st.booleans(), st.integers(), st.floats(), st.text(max_size=4)),
    lambda inner: st.one_of(st.lists(inner, max_size=3), st.dictionaries(st.text(max_size=3), inner, max_size=3)),
    max_leaves=8,
)
RECORDS = st.lists(st.dictionaries(st.sampled_from(["time", "F", "a.b", ""]), VALUE, max_size=4), max_size=5)


def tried(path):
    """List the file, then read every column by itself, and all together."""
    with contextlib.suppress(SeaoptError):
        read_table(path, time=Column(column="time", unit="s"))
    with contextlib.suppress(SeaoptError):
        for item in contents(path).fields[:3]:
            with contextlib.suppress(SeaoptError):
                read_table(path, time=Column(column=item.name, unit="s"), channels={})


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("fuzz")


@given(rows=ROWS, delimiter=st.sampled_from(",;\t| "), end=st.sampled_from(["\n", "\r\n", "\r"]),
       encoding=st.sampled_from(["utf-8", "utf-16", "utf-8-sig"]))  # fmt: skip
def test_text(folder, rows, delimiter, end, encoding):
    path = folder / "a.csv"
    path.write_bytes(end.join(delimiter.join(row) for row in rows).encode(encoding, errors="replace"))
    tried(path)


@given(records=RECORDS, shape=st.integers(0, 3), cut=st.floats(0.5, 1))
def test_json(folder, records, shape, cut):
    path = folder / "a.json"
    content = [{"entries": records}, records, {"time": records}][shape] if shape < 3 else None
    text = json.dumps(content) if shape < 3 else "\n".join(map(json.dumps, records))
    path.write_text(text[: int(len(text) * cut)])
    tried(path)


@given(
    places=st.lists(st.tuples(st.floats(0, 1), st.integers(0, 255)), max_size=6),
    cut=st.floats(0.3, 1),
    packed=st.booleans(),
)
def test_mat(folder, places, cut, packed):
    stream = io.BytesIO()
    content = {"time": np.arange(9.0), "run": {"F": np.ones((9, 2)), "t": "ab"}, "c": np.array([[1, "a"]], object)}
    scipy.io.savemat(stream, content, do_compression=packed)
    raw = bytearray(stream.getvalue()[: int(len(stream.getvalue()) * cut)])
    for where, value in places:
        raw[20 + int(where * (len(raw) - 21))] = value
    path = folder / "a.mat"
    path.write_bytes(raw)
    tried(path)


@given(
    st.binary(max_size=300),
    st.sampled_from([b"", b"PAR1", b"PK\x03\x04", b"\x89MCAP0\r\n", b"#ROSBAG V2.0\n", b"TDSm"]),
)
def test_junk_behind_a_magic(folder, junk, magic):
    path = folder / "a.bin"
    path.write_bytes(magic + junk)
    tried(path)
