"""Raw files by their content: each format lists its fields and reads those that are asked for."""

from __future__ import annotations

import shlex
import stat
import sys
from collections.abc import Callable
from importlib import import_module
from pathlib import Path

from seaopt.errors import LogError
from seaopt.logs.formats.mat4 import is_mat4
from seaopt.logs.formats.source import Field, Source, Window, check_count, keep_rows, translate_errors
from seaopt.signals import TARGET_LOG

__all__ = ["Field", "Source", "Window", "keep_rows", "open_source", "sniff"]

# First bytes, module and function that open the format, and its name.
_MAGIC: tuple[tuple[bytes, str, str, str], ...] = (
    (b"\x89HDF\r\n\x1a\n", "hdf5", "open_hdf5", "HDF5"),
    (b"MATLAB 7.3 MAT-file", "hdf5", "open_mat73", "MAT 7.3"),
    (b"MATLAB 5.0 MAT-file", "mat", "open_mat", "MAT 5"),
    (b"PAR1", "parquet", "open_parquet", "Parquet"),
    (b"PK\x03\x04", "arrays", "open_npz", "NPZ"),
    (b"#ROSBAG V2.0\n", "ros", "open_bag", "ROS 1 bag"),
    (b"SQLite format 3\x00", "ros", "open_db3", "ROS 2 db3"),
    (b"\x89MCAP0\r\n", "ros", "open_mcap", "MCAP"),
    (b"MDF     ", "mdf", "open_mdf", "MDF"),
    (b"UnFinMF ", "mdf", "open_mdf", "MDF"),
    (b"TDSm", "tdms", "open_tdms", "TDMS"),
    (TARGET_LOG.encode() + b" ", "arrays", "open_target_log", "a log of the target"),
)
_REFUSED: tuple[tuple[bytes, str], ...] = (
    (b"\x1f\x8b", "is compressed (gzip); unpack it first"),
    (b"BZh", "is compressed (bzip2); unpack it first"),
    (b"\xfd7zXZ\x00", "is compressed (xz); unpack it first"),
    (b"\x28\xb5\x2f\xfd", "is compressed (zstd); unpack it first"),
    (b"7z\xbc\xaf\x27\x1c", "is compressed (7z); unpack it first"),
    (b"\xd0\xcf\x11\xe0", "is an old Office document; save the sheet as CSV"),
    (b"\x93NUMPY", "is one array without names; save the channels with np.savez"),
    (b"TDSh", "is the index of a TDMS file; give the .tdms file"),
    (b"SEALOG", "is a log of the target that this version does not read; install the newest seaopt"),
    (b"#ROSBAG", "is a ROS bag of a version other than 2.0; convert it with rosbag fix"),
    *((b"\x80" + bytes([n]), "is a Python pickle, which could run code; save it as NPZ or CSV") for n in (2, 3, 4, 5)),
)  # fmt: skip
_JSON_NAMES = (".json", ".jsonl", ".ndjson")
_BINARY_NAMES = {".mat": "MAT file of version 4, 5 or 7.3",
                 ".bag": "ROS bag", ".mcap": "MCAP file",
                 ".db3": "ROS 2 bag", ".parquet": "Parquet file", ".npz": "NPZ archive", ".h5": "HDF5 file",
                 ".hdf5": "HDF5 file", ".mf4": "MDF file", ".tdms": "TDMS file",
                 ".sealog": "log of the target"}  # fmt: skip


def open_source(path: Path) -> Source:
    """Open a file by its content and list its fields, without data. Raises LogError: no file, or no known format."""
    module, function, form = sniff(path)
    opener: Callable[[Path], Source] = getattr(import_module(f"seaopt.logs.formats.{module}"), function)
    with translate_errors(path, form):
        source = opener(path)
    check_count(path, source.fields)
    return source


def sniff(path: Path) -> tuple[str, str, str]:
    """Return module, function and name of a file's format, by its first bytes."""
    head = _first_bytes(path)
    for magic, module, function, form in _MAGIC:
        if head.startswith(magic):
            return module, function, form
    if any(head[offset:].startswith(_MAGIC[0][0]) for offset in (512, 1024, 2048)):
        return _MAGIC[0][1:]
    if is_mat4(head):
        return "mat4", "open_mat4", "MAT 4"
    for magic, reason in _REFUSED:
        if head.startswith(magic):
            raise LogError(f"{path}: {reason}")
    suffix = path.suffix.lower()
    if suffix in _BINARY_NAMES:
        raise LogError(
            f"{path}: is not a valid {_BINARY_NAMES[suffix]} although its name says so; check how it was made"
        )
    text = head.removeprefix(b"\xef\xbb\xbf").lstrip()
    if suffix in _JSON_NAMES or text.startswith(b"{") or text.startswith((b"[{", b"[\n")):
        return "json", "open_json", "JSON"
    return "text", "open_text", "CSV"


def _first_bytes(path: Path) -> bytes:
    look, remedy = f"seaopt inspect {shlex.quote(str(path))}", f"check the path: ls {shlex.quote(str(path.parent))}"
    names = sys.getfilesystemencoding()
    if names != "utf-8" and not str(path).isascii():
        remedy = f"names of files are {names} here: set PYTHONUTF8=1 if they are UTF-8, or {remedy}"
    try:
        mode = path.stat().st_mode
        if stat.S_ISDIR(mode):
            raise LogError(f"{path}: is a folder; give a file: seaopt inspect {shlex.quote(str(path / 'NAME.csv'))}")
        if not stat.S_ISREG(mode):
            raise LogError(f"{path}: is a pipe, a device or a socket; give a regular file: seaopt inspect NAME.csv")
        with path.open("rb") as stream:
            head = stream.read(4096)
    except FileNotFoundError as error:
        raise LogError(f"{path}: no such file; {remedy}") from error
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise LogError(f"{path}: cannot be read ({reason}); {remedy}") from error
    if not head.strip(b" \t\r\n"):
        raise LogError(f"{path}: the file is empty; record the log again, then look at it: {look}")
    return head
