"""HDF5 and MATLAB 7.3 files: datasets are read by rows and columns; nothing outside the file is followed (h5py)."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

from seaopt.errors import LogError
from seaopt.logs.formats.simulink import clocked, opaque
from seaopt.logs.formats.source import MAX_FIELDS, Field, Place, Source, by_rows, check_size, optional, spread

DEPTH = 32
_UNIT_ATTRIBUTES = ("units", "unit", "Units", "Unit")


def open_hdf5(path: Path) -> Source:
    """List the datasets of an HDF5 file by their paths."""
    return _open(path, "HDF5", _listed)


def open_mat73(path: Path) -> Source:
    """List the variables of a MATLAB 7.3 file; structs become dotted paths."""
    return _open(path, "MAT 7.3", _matlab)


def _open(path: Path, form: str, listed: Any) -> Source:
    h5py = optional("h5py", "hdf5", path, form)
    places: dict[str, tuple[Place, str | None]] = {}
    fields: list[Field] = []
    with h5py.File(path, "r") as file:
        for field, place, part in listed(file, path):
            fields.append(field)
            places[field.name] = (place, part)
            if len(fields) > MAX_FIELDS:
                break
    kept = clocked(fields) if form == "MAT 7.3" else fields
    return Source(path=path, format=form, fields=tuple(kept), load=by_rows(partial(_load, path, form, places)))


Listed = Iterator[tuple[Field, Place, str | None]]


def _listed(file: Any, path: Path, prefix: str = "", depth: int = 0) -> Listed:
    """Walk the groups, hard links only: soft and external ones could lead in circles or out of the file."""
    import h5py

    if depth > DEPTH:
        raise LogError(f"{path}: groups are nested deeper than {DEPTH}; is it a log?")
    for name in file:
        if not isinstance(file.get(name, getlink=True), h5py.HardLink):
            continue
        item = file[name]
        if isinstance(item, h5py.Group):
            yield from _listed(item, path, f"{prefix}{name}/", depth + 1)
        elif isinstance(item, h5py.Dataset):
            yield from _dataset(item, f"{prefix}{name}")


def _dataset(item: Any, name: str) -> Listed:
    if item.external or item.is_virtual:
        yield Field(name=name, kind="data in another file", length=None), Place(array=item.name), None
        return
    dtype = item.dtype
    if dtype.names:  # a table: one field a column
        for part in dtype.names:
            kind = dtype[part].name if not dtype[part].shape else f"array {dtype[part]}"
            found = Field(name=f"{name}.{part}", kind=kind, length=item.size)
            yield found, Place(array=item.name), part
        return
    unit = next((_text(item.attrs[key]) for key in _UNIT_ATTRIBUTES if key in item.attrs), None)
    for field, place in spread(name, item.shape or (), _kind(dtype), unit=unit):
        yield field, Place(array=item.name, index=place.index, axis=place.axis), None


def _kind(dtype: Any) -> str:
    return dtype.name if dtype.kind in "fiub" else ("text" if dtype.kind in "SO" else str(dtype))


def _text(value: Any) -> str | None:
    value = value.decode(errors="replace") if isinstance(value, bytes) else value
    return value if isinstance(value, str) else None


def _matlab(file: Any, path: Path, prefix: str = "", depth: int = 0) -> Listed:
    """Walk variables and structs; MATLAB stores a matrix with its axes turned round."""
    if depth > DEPTH:
        raise LogError(f"{path}: structs are nested deeper than {DEPTH}; is it a log?")
    for name in file:
        if not name.startswith("#"):
            yield from _variable(file.file, file[name], path, f"{prefix}{name}", depth)


def _variable(file: Any, item: Any, path: Path, name: str, depth: int) -> Listed:
    import h5py

    if isinstance(item, h5py.Group):
        if any(_is_struct_array(child) for child in item.values()):
            for key, child in item.items():
                for number, reference in enumerate(child[()].ravel()[:MAX_FIELDS], start=1):
                    yield from _variable(file, file[reference], path, f"{name}({number}).{key}", depth + 1)
        else:
            yield from _matlab(item, path, f"{name}.", depth + 1)
        return
    kind = _text(item.attrs.get("MATLAB_class", b"")) or ""
    if "MATLAB_object_decode" in item.attrs or h5py.check_ref_dtype(item.dtype) or kind in {"char", "cell"}:
        word = {"char": "text", "cell": "a cell array"}.get(kind)
        field = Field(name=name, kind=word, length=None) if word else opaque(name, kind)
        yield field, Place(array=item.name), None
        return
    shape = tuple(reversed(item.shape or ()))
    for field, place in spread(name, shape, _kind(item.dtype), matlab=True):
        yield field, Place(array=item.name, index=place.index, axis=1 - place.axis), None


def _is_struct_array(item: Any) -> bool:
    import h5py

    return (
        isinstance(item, h5py.Dataset) and bool(h5py.check_ref_dtype(item.dtype)) and "MATLAB_class" not in item.attrs
    )


def _load(path: Path, form: str, places: dict[str, tuple[Place, str | None]], name: str, rows: slice) -> Any:
    h5py = optional("h5py", "hdf5", path, form)
    place, part = places[name]
    with h5py.File(path, "r") as file:
        item = file[place.array]
        check_size(path, int(item.size) * 8, f'"{name}"')
        if item.shape == ():
            return item[()]
        return item.fields(part)[place.cut(rows)] if part is not None else item[place.cut(rows)]
