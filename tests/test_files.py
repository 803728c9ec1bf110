"""Files that are whole or absent: their mode, their names, and what is said where they cannot be written."""

from __future__ import annotations

import json
import os
import stat

import pytest

from seaopt.errors import FileError
from seaopt.files import check_content, digest_content, parse_file, write_bytes


@pytest.mark.parametrize("umask", [0o022, 0o077])
def test_a_file_gets_the_mode_of_the_umask_which_nobody_changes(tmp_path, umask, monkeypatch):
    before = os.umask(umask)
    try:
        with monkeypatch.context() as context:
            context.setattr(os, "umask", lambda mask: pytest.fail("the umask is that of all threads"))
            path = write_bytes(tmp_path / "fit.json", b"{}")
    finally:
        os.umask(before)
    assert stat.S_IMODE(path.stat().st_mode) == 0o666 & ~umask
    assert path.read_bytes() == b"{}" and list(tmp_path.iterdir()) == [path]


def test_a_name_as_long_as_the_system_allows_is_written(tmp_path):
    assert write_bytes(tmp_path / ("n" * 255), b"x").read_bytes() == b"x"


@pytest.mark.parametrize("name", ["n" * 256, "a\0b", "below/file"])
def test_what_cannot_be_written_is_named_and_leaves_nothing(tmp_path, name):
    (tmp_path / "below").write_bytes(b"")
    with pytest.raises(FileError, match="cannot be written"):
        write_bytes(tmp_path / name, b"x")
    assert [path.name for path in tmp_path.iterdir()] == ["below"]


@pytest.mark.parametrize("value", [-(2**63), 2**63 - 1, True])
def test_integers_of_64_bits_are_read(value):
    check_content({"seed": [value]})


@pytest.mark.parametrize("value", [-(2**63) - 1, 2**63])
def test_integers_of_more_are_refused(value):
    with pytest.raises(ValueError, match="an integer has 64 bits, and 63 beside its sign are the most"):
        check_content({"seed": [value]})


def test_a_number_of_too_many_digits_is_refused_without_advice_to_programmers(tmp_path):
    path = tmp_path / "fit.json"
    path.write_text('{"seed": ' + 5000 * "1" + "}")
    with pytest.raises(FileError, match=r"not valid JSON \(Exceeds the limit [^;]*5000 digits\); correct that place"):
        parse_file(path, json.loads, "JSON", remedy="run it again")


def test_the_clock_has_no_part_in_a_digest():
    assert digest_content({"met": True, "provenance": {"wall_s": 1.0}}) == digest_content({"met": True})
    assert digest_content({"met": True}) != digest_content({"met": False})
