"""HDF5 and MATLAB 7.3 files: datasets are read by rows and columns; nothing outside the file is followed (h5py)."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

from seaopt.errors import LogError
from seaopt.logs.formats.simulink import assign_clocks, make_object_field
from seaopt.logs.formats.source import (
    MAX_DEPTH,
    MAX_FIELDS,
    Field,
    Place,
    Source,
    check_size,
    import_optional,
    make_row_loader,
    spread,
)

_UNIT_ATTRIBUTES = ("units", "unit", "Units", "Unit")


def open_hdf5(path: Path) -> Source:
    """List the datasets of an HDF5 file by their paths."""
    return _open(path, "HDF5", _walk_datasets)


def open_mat73(path: Path) -> Source:
    """List the variables of a MATLAB 7.3 file; structs become dotted paths."""
    return _open(path, "MAT 7.3", _walk_matlab)


def _open(path: Path, form: str, walk: Any) -> Source:
    h5py = import_optional("h5py", "hdf5", path, form)
    places: dict[str, tuple[Place, str | None]] = {}
    fields: list[Field] = []
    with h5py.File(path, "r") as file:
        for field, place, part in walk(file, path):
            fields.append(field)
            places[field.name] = (place, part)
            if len(fields) > MAX_FIELDS:
                break
    kept = assign_clocks(fields) if form == "MAT 7.3" else fields
    return Source(path=path, format=form, fields=tuple(kept), load=make_row_loader(partial(_load, path, form, places)))


Fields = Iterator[tuple[Field, Place, str | None]]


def _walk_datasets(file: Any, path: Path, prefix: str = "", depth: int = 0) -> Fields:
    """Walk the groups, hard links only: soft and external ones could lead in circles or out of the file."""
    import h5py

    if depth > MAX_DEPTH:
        raise LogError(f"{path}: groups are nested deeper than {MAX_DEPTH}; is it a log?")
    for name in file:
        if not isinstance(file.get(name, getlink=True), h5py.HardLink):
            continue
        node = file[name]
        if isinstance(node, h5py.Group):
            yield from _walk_datasets(node, path, f"{prefix}{name}/", depth + 1)
        elif isinstance(node, h5py.Dataset):
            yield from _list_dataset(node, f"{prefix}{name}")


def _list_dataset(node: Any, name: str) -> Fields:
    if node.external or node.is_virtual:
        yield Field(name=name, kind="data in another file", length=None), Place(array=node.name), None
        return
    dtype = node.dtype
    if dtype.names:  # a table: one field per column
        for part in dtype.names:
            kind = dtype[part].name if not dtype[part].shape else f"array {dtype[part]}"
            field = Field(name=f"{name}.{part}", kind=kind, length=node.size)
            yield field, Place(array=node.name), part
        return
    unit = next((_decode_text(node.attrs[key]) for key in _UNIT_ATTRIBUTES if key in node.attrs), None)
    for field, place in spread(name, node.shape or (), _name_kind(dtype), unit=unit):
        yield field, Place(array=node.name, index=place.index, axis=place.axis), None


def _name_kind(dtype: Any) -> str:
    return dtype.name if dtype.kind in "fiub" else ("text" if dtype.kind in "SO" else str(dtype))


def _decode_text(value: Any) -> str | None:
    value = value.decode(errors="replace") if isinstance(value, bytes) else value
    return value if isinstance(value, str) else None


def _walk_matlab(file: Any, path: Path, prefix: str = "", depth: int = 0) -> Fields:
    """Walk variables and structs; MATLAB stores a matrix with its axes turned round."""
    if depth > MAX_DEPTH:
        raise LogError(f"{path}: structs are nested deeper than {MAX_DEPTH}; is it a log?")
    for name in file:
        if not name.startswith("#"):
            yield from _walk_variable(file.file, file[name], path, f"{prefix}{name}", depth)


def _walk_variable(file: Any, node: Any, path: Path, name: str, depth: int) -> Fields:
    import h5py

    if isinstance(node, h5py.Group):
        # A struct array keeps, per field, references to the values of its elements.
        if any(_is_struct_array(child) for child in node.values()):
            for key, child in node.items():
                for number, reference in enumerate(child[()].ravel()[:MAX_FIELDS], start=1):
                    yield from _walk_variable(file, file[reference], path, f"{name}({number}).{key}", depth + 1)
        else:
            yield from _walk_matlab(node, path, f"{name}.", depth + 1)
        return
    kind = _decode_text(node.attrs.get("MATLAB_class", b"")) or ""
    if "MATLAB_object_decode" in node.attrs or h5py.check_ref_dtype(node.dtype) or kind in {"char", "cell"}:
        word = {"char": "text", "cell": "a cell array"}.get(kind)
        field = Field(name=name, kind=word, length=None) if word else make_object_field(name, kind)
        yield field, Place(array=node.name), None
        return
    shape = tuple(reversed(node.shape or ()))
    for field, place in spread(name, shape, _name_kind(node.dtype), matlab=True):
        yield field, Place(array=node.name, index=place.index, axis=1 - place.axis), None


def _is_struct_array(node: Any) -> bool:
    import h5py

    return (
        isinstance(node, h5py.Dataset) and bool(h5py.check_ref_dtype(node.dtype)) and "MATLAB_class" not in node.attrs
    )


def _load(path: Path, form: str, places: dict[str, tuple[Place, str | None]], name: str, rows: slice) -> Any:
    h5py = import_optional("h5py", "hdf5", path, form)
    place, part = places[name]
    with h5py.File(path, "r") as file:
        node = file[place.array]
        check_size(path, int(node.size) * 8, f'"{name}"')
        if node.shape == ():
            return node[()]
        return node.fields(part)[place.index_rows(rows)] if part is not None else node[place.index_rows(rows)]
