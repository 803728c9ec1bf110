"""HDF5 and MATLAB 7.3 files: datasets are read by rows and columns; nothing outside the file is followed (h5py)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from seaopt.errors import LogError
from seaopt.logs.formats.simulink import assign_clocks, make_object_field
from seaopt.logs.formats.source import (
    MAX_DEPTH,
    MAX_FIELDS,
    ArraySlice,
    Field,
    Source,
    check_size,
    import_optional,
    open_columns,
    spread,
)

SIGNATURE = b"\x89HDF\r\n\x1a\n"
_UNIT_ATTRIBUTES = ("units", "unit", "Units", "Unit")


def open_hdf5(path: Path) -> Source:
    """List the datasets of an HDF5 file by their paths."""
    return _open(path, "HDF5", _walk_datasets)


def open_mat73(path: Path) -> Source:
    """List the variables of a MATLAB 7.3 file; structs become dotted paths."""
    source = _open(path, "MAT 7.3", _walk_matlab)
    return replace(source, fields=tuple(assign_clocks(source.fields)))


def _open(path: Path, form: str, walk: Any) -> Source:
    h5py = import_optional("h5py", "hdf5", path, form)
    _check_length(path)
    with h5py.File(path, "r") as file:
        return open_columns(path, form, walk(file, path), partial(_load, path))


def _check_length(path: Path) -> None:
    """Refuse a file that is longer or shorter than it says of itself: the library looks at shorter ones alone. A
    superblock (HDF5 File Format Specification, II.A) stands at 0, 512, 1024, ...: it has the address of the file's end
    as the third of the addresses that begin at byte 24 (version 0), 28 (1) or 12 (2 and 3).
    """
    size, at = path.stat().st_size, 0
    with path.open("rb") as stream:
        while at < size:
            stream.seek(at)
            head = stream.read(96)
            if head.startswith(SIGNATURE):
                break
            at = 2 * at or 512
        else:
            return  # the library says what it is
    version = head[8]
    width, begin = (head[9], 12) if version >= 2 else (head[13], 24 + 4 * version)
    end = int.from_bytes(head[begin + 2 * width : begin + 3 * width], "little")
    if size != end:
        raise LogError(
            f"{path}: has {size} bytes and says that it has {end}: it is cut off, damaged, or something was added; "
            "copy it again, or write it anew with h5repack"
        )


Location = tuple[ArraySlice, str | None]  # with the column of a table
Fields = Iterator[tuple[Field, Location]]


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
        yield Field(name=name, kind="data in another file", length=None), (ArraySlice(array=node.name), None)
        return
    dtype = node.dtype
    if dtype.names:  # a table: one field per column
        for part in dtype.names:
            kind = dtype[part].name if not dtype[part].shape else f"array {dtype[part]}"
            yield Field(name=f"{name}.{part}", kind=kind, length=node.size), (ArraySlice(array=node.name), part)
        return
    unit = next((_decode_text(node.attrs[key]) for key in _UNIT_ATTRIBUTES if key in node.attrs), None)
    for field, array_slice in spread(name, node.shape or (), _name_kind(node), unit=unit):
        yield field, (replace(array_slice, array=node.name), None)


def _name_kind(node: Any) -> str:
    dtype = node.dtype
    if dtype.kind in "fiu" and not _is_standard(node.id.get_type()):
        return f"{dtype.name} of no standard form, or damaged"
    return dtype.name if dtype.kind in "fiub" else ("text" if dtype.kind in "SO" else str(dtype))


def _is_standard(stored: Any) -> bool:
    """Tell whether a number is stored as IEEE 754 or as a whole number has it; any other form is converted on reading.
    A type's description has no checksum in most files, and one of another exponent would be read as other numbers.
    """
    from h5py import h5t

    if isinstance(stored, h5t.TypeIntegerID):
        return stored.get_precision() == 8 * stored.get_size() and not stored.get_offset()
    forms = ("IEEE_F16LE", "IEEE_F16BE", "IEEE_F32LE", "IEEE_F32BE", "IEEE_F64LE", "IEEE_F64BE", "NATIVE_LDOUBLE")
    return not isinstance(stored, h5t.TypeFloatID) or any(stored.equal(getattr(h5t, form)) for form in forms)


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
        yield field, (ArraySlice(array=node.name), None)
        return
    shape = tuple(reversed(node.shape or ()))
    for field, array_slice in spread(name, shape, _name_kind(node), matlab=True):
        yield field, (replace(array_slice, array=node.name, axis=1 - array_slice.axis), None)


def _is_struct_array(node: Any) -> bool:
    import h5py

    return (
        isinstance(node, h5py.Dataset) and bool(h5py.check_ref_dtype(node.dtype)) and "MATLAB_class" not in node.attrs
    )


def _load(path: Path, location: Location, rows: slice) -> Any:
    import h5py

    array_slice, part = location
    with h5py.File(path, "r") as file:
        node: Any = file[array_slice.array]
        name = array_slice.array.removeprefix("/")
        check_size(path, int(node.size) * 8, f'"{name}"')
        # Chunks that no filter packs take as much as their numbers do.
        if node.chunks is not None and not node.id.get_create_plist().get_nfilters():
            whole = node.id.get_num_chunks() * int(np.prod(node.chunks)) * node.dtype.itemsize
            if node.id.get_storage_size() != whole:
                raise LogError(
                    f'{path}: "{name}" is stored in another size than it says; the file is damaged, copy it again'
                )
        if node.shape == ():
            return node[()]
        return (
            node.fields(part)[array_slice.index_rows(rows)] if part is not None else node[array_slice.index_rows(rows)]
        )
