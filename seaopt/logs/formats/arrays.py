"""Files that NumPy reads by itself: archives of arrays (no pickled objects, sizes checked before anything is unpacked),
and logs that the C beside an exported law writes (`seaopt.control.deploy.target`).
"""

from __future__ import annotations

import json
import zipfile
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from seaopt.errors import LogError
from seaopt.formatting import format_count
from seaopt.logs.formats.source import ArraySlice, Field, Source, check_size, make_row_loader, spread
from seaopt.signals import TARGET_LOG

HEADS = [("tick", "<u4"), ("lost", "<u2"), ("status", "<u2")]  # of a row of the target
LOST_FOR_MORE, WORST_STATUS = 65535, 2
FARTHEST = 255  # ticks from one row to the next, beyond those that the rows tell, in most rows of a log
LONGEST_HEADER = 1 << 16
RECORD_AGAIN = "record it again, draining whole rows from one context"


def open_npz(path: Path) -> Source:
    """List the arrays of an NPZ archive."""
    places: dict[str, ArraySlice] = {}
    fields: list[Field] = []
    with zipfile.ZipFile(path) as archive:
        members = [member for member in archive.infolist() if member.filename.endswith(".npy")]
        if not members:
            raise LogError(f"{path}: is a ZIP archive without NumPy arrays; unpack it, and save a sheet as CSV")
        check_size(path, sum(member.file_size for member in members), "the archive")
        for member in members:
            with archive.open(member) as stream:
                shape, dtype = _read_header(stream)
            name = member.filename.removesuffix(".npy")
            if dtype.hasobject:
                fields.append(Field(name=name, kind="Python objects", length=None))
                continue
            if int(np.prod(shape, dtype=float)) * dtype.itemsize > member.file_size:
                raise LogError(f"{path}: array {name} is cut off; save the archive again")
            for field, array_slice in spread(name, shape, dtype.name):
                fields.append(field)
                places[field.name] = array_slice
    return Source(path=path, format="NPZ", fields=tuple(fields), load=make_row_loader(partial(_load, path, places)))


def _read_header(stream: Any) -> tuple[tuple[int, ...], np.dtype[Any]]:
    """Return shape and type of an array, from its header alone."""
    version = np.lib.format.read_magic(stream)
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, _, dtype = read(stream)
    return shape, dtype


def _load(path: Path, places: dict[str, ArraySlice], name: str, rows: slice) -> Any:
    array_slice = places[name]
    with zipfile.ZipFile(path) as archive, archive.open(f"{array_slice.array}.npy") as stream:
        array = np.lib.format.read_array(stream, allow_pickle=False)
        if stream.read(1):  # to the end, where the checksum is looked at
            raise LogError(f"{path}: array {array_slice.array} is longer than it says; save the archive again")
    return np.atleast_1d(array)[array_slice.index_rows(rows)]


def open_target_log(path: Path) -> Source:
    """List the channels of a log that was drained on the target. Raises LogError: it is cut off in its header, or bytes
    are missing between its rows.
    """
    with path.open("rb") as stream:
        line = stream.readline(LONGEST_HEADER)
    try:
        header = json.loads(line.removeprefix(TARGET_LOG.encode()))
        names = [str(name) for name, _ in header["channels"]]
        units = [None if unit is None else str(unit) for _, unit in header["channels"]]
        period, law = float(header["sample_time_s"]), str(header["hash"])
        layout = np.dtype([*HEADS, *((f"channel {k}", {"float64": "<f8", "float32": "<f4"}[header["real"]])
                                     for k in range(len(names)))])  # fmt: skip
    except (ValueError, KeyError, TypeError) as error:
        raise LogError(
            f"{path}: its header is cut off or damaged; a log begins with NAME_log_header as it is in the C"
        ) from error
    try:
        rows, notes = _read_rows(path, layout, len(line))
    except LogError as error:
        rows, notes = _read_behind_zero(path, layout, len(line), error)
    ticks = np.concatenate([[0], np.cumsum(np.diff(rows["tick"]).astype(np.int64))]) + int(rows["tick"][0])
    columns = {"time": period * ticks} | {name: rows[f"channel {k}"] for k, name in enumerate(names)}
    if np.any(rows["status"]):  # one that is 0 throughout would look like a wire that is off
        columns["status"] = rows["status"]
    stated = dict(zip(names, units, strict=True)) | {"time": "s", "status": "-"}
    fields = tuple(
        Field(name=name, kind=values.dtype.name, length=len(rows), unit=stated[name], clock="time")
        for name, values in columns.items()
    )
    load = make_row_loader(lambda name, where: columns[name][where])
    return Source(path=path, format="a log of the target", fields=fields, load=load, notes=tuple(notes), law=law)


def _read_rows(path: Path, layout: np.dtype[Any], first: int) -> tuple[Any, list[str]]:
    """Return the rows from a byte on, and what is to be said of them."""
    size = path.stat().st_size - first
    count, surplus = divmod(size, layout.itemsize)
    if count < 1:
        raise LogError(f"{path}: has a header and no whole row of {layout.itemsize} bytes; drain the ring into it")
    check_size(path, size, "the log")
    rows = np.fromfile(path, dtype=layout, offset=first, count=count)
    notes = _check_rows(path, rows, first, layout.itemsize)
    if surplus:
        notes.append(f"its last row is cut off and left out: {surplus} of {layout.itemsize} bytes are there")
    return rows, notes


def _read_behind_zero(path: Path, layout: np.dtype[Any], first: int, error: LogError) -> tuple[Any, list[str]]:
    """Return the rows behind a header that was written with the zero at its end. Raises `error`: it was not."""
    with path.open("rb") as stream:
        stream.seek(first)
        if stream.read(1) != b"\0":
            raise error
    try:
        rows, notes = _read_rows(path, layout, first + 1)
    except LogError:
        raise error from None
    return rows, [*notes, "the zero behind its header is left out; write NAME_LOG_HEADER_BYTES bytes of the header"]


def _check_rows(path: Path, rows: Any, first: int, size: int) -> list[str]:
    """Return what is to be said of rows that are missing; refuse those that are none."""
    steps, lost = np.diff(rows["tick"]).astype(np.int64), rows["lost"][1:].astype(np.int64)  # a tick ends at 2^32
    further = (steps == 1 + lost) | ((steps > 1 + lost) & (steps < 1 << 31))
    wrong = np.flatnonzero(~further | (rows["status"][1:] > WORST_STATUS))
    if wrong.size or rows["status"][0] > WORST_STATUS:
        k = int(wrong[0]) + 1 if wrong.size else 0
        raise LogError(
            f"{path}: row {k} (byte {first + k * size}) does not follow the one before: bytes are missing, or two logs "
            f"are in one file; {RECORD_AGAIN}"
        )
    far = np.flatnonzero((steps > FARTHEST + lost) & (lost < LOST_FOR_MORE))
    if 2 * far.size > steps.size:  # as of ticks that are read a byte or more too early
        k = int(far[0]) + 1
        raise LogError(
            f"{path}: row {k} (byte {first + k * size}) is {steps[k - 1]} ticks after the one before, and most are far "
            f"from theirs: bytes are missing, or too many, between header and rows; {RECORD_AGAIN}"
        )
    notes: list[str] = []
    full, gone = lost > 0, (steps > 1 + lost) & (lost < LOST_FOR_MORE)
    if np.any(full):
        missed = int(np.sum(np.where(lost < LOST_FOR_MORE, lost, steps - 1)))
        notes.append(
            f"the ring was full {format_count(int(np.sum(full)), 'time')}: {format_count(missed, 'tick')} were not "
            "logged; drain it more often, or give it more rows"
        )
    if np.any(gone):
        missed = int(np.sum((steps - 1 - lost)[gone]))
        notes.append(f"{format_count(missed, 'row')} that the ring had are not in the file; {RECORD_AGAIN}")
    return notes
