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


@pytest.mark.parametrize("options", [{}, {"use_chunking": False, "enable_data_crcs": True}])
def test_a_flipped_bit_of_an_mcap_is_never_another_number(tmp_path, options):
    path = tmp_path / "log.mcap"
    write_mcap(path, **options)
    content, expected = path.read_bytes(), read(path)
    np.testing.assert_allclose(expected[-1], FORCE)
    rng, refused = np.random.default_rng(1), 0
    places = rng.choice(len(content), size=150, replace=False)
    for place in places.tolist():
        damaged = bytearray(content)
        damaged[place] ^= 1 << int(rng.integers(8))
        path.write_bytes(damaged)
        try:
            np.testing.assert_array_equal(read(path), expected)
        except SeaoptError:
            refused += 1
    assert refused > 100


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
