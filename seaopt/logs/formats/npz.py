"""NumPy archives: arrays only, no pickled objects, sizes checked before anything is unpacked."""

from __future__ import annotations

import zipfile
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from seaopt.errors import LogError
from seaopt.logs.formats.source import Field, Place, Source, check_size, make_row_loader, spread


def open_npz(path: Path) -> Source:
    """List the arrays of an NPZ archive."""
    places: dict[str, Place] = {}
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
            for field, place in spread(name, shape, dtype.name):
                fields.append(field)
                places[field.name] = place
    return Source(path=path, format="NPZ", fields=tuple(fields), load=make_row_loader(partial(_load, path, places)))


def _read_header(stream: Any) -> tuple[tuple[int, ...], np.dtype[Any]]:
    """Return shape and type of an array, from its header alone."""
    version = np.lib.format.read_magic(stream)
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, _, dtype = read(stream)
    return shape, dtype


def _load(path: Path, places: dict[str, Place], name: str, rows: slice) -> Any:
    place = places[name]
    with zipfile.ZipFile(path) as archive, archive.open(f"{place.array}.npy") as stream:
        array = np.lib.format.read_array(stream, allow_pickle=False)
        if stream.read(1):  # to the end, where the checksum is looked at
            raise LogError(f"{path}: array {place.array} is longer than it says; save the archive again")
    return np.atleast_1d(array)[place.index_rows(rows)]
