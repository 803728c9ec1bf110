"""MATLAB 5 files. Each variable is measured, and its parts are checked against its bytes, before SciPy decodes it.

Layout (MathWorks, "MAT-File Format"): a header of 128 bytes, then elements of type and size; one of type 15 is
compressed; a matrix (14) holds flags, dimensions, name and data, and cells and structs hold matrices.
"""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from seaopt.errors import LogError
from seaopt.logs.formats.simulink import OBJECT, clocked, opaque
from seaopt.logs.formats.source import MAX_FIELDS, Field, Place, Source, by_rows, check_size, spread

HEADER = 128
PEEK = 1 << 16
DEPTH = 32
COMPRESSED, MATRIX = 15, 14
CELL, STRUCT, OBJECT_CLASS, CHAR, SPARSE, OPAQUE = 1, 2, 3, 4, 5, 17
NUMBERS = {6: "float64", 7: "float32", 8: "int8", 9: "uint8", 10: "int16", 11: "uint16", 12: "int32", 13: "uint32",
           14: "int64", 15: "uint64"}  # fmt: skip
WORDS = {CELL: "a cell array", OBJECT_CLASS: OBJECT, CHAR: "text", SPARSE: "a sparse matrix", 16: "a function"}
COMPLEX, LOGICAL = 0x08, 0x02


@dataclass(frozen=True, slots=True, kw_only=True)
class Variable:
    """A variable of the file, by its header."""

    name: str
    kind: int
    flags: int
    dims: tuple[int, ...]
    start: int
    size: int
    unpacked: int
    packed: bool
    owner: str = ""  # class of an object


def open_mat(path: Path) -> Source:
    """List the variables of a MATLAB 5 file; structs become dotted paths."""
    variables = {item.name: item for item in _variables(path) if item.name}
    fields: list[Field] = []
    places: dict[str, tuple[Variable, Place]] = {}
    for item in variables.values():
        for field, place in _fields(path, item):
            fields.append(field)
            places[field.name] = (item, place)
    return Source(
        path=path, format="MAT 5", fields=tuple(clocked(fields)), load=by_rows(partial(_load, path, places))
    )  # fmt: skip


def _fields(path: Path, item: Variable) -> Iterator[tuple[Field, Place]]:
    if item.kind in NUMBERS:
        kind = "complex" if item.flags & COMPLEX else "bool" if item.flags & LOGICAL else NUMBERS[item.kind]
        yield from spread(item.name, item.dims, kind, matlab=True)
    elif item.kind == STRUCT:
        for count, (name, array) in enumerate(_leaves(item.name, _decoded(path, item), 0)):
            if count > MAX_FIELDS:
                break
            yield from spread(
                name, array.shape, array.dtype.name if array.dtype.kind in "fiub" else "text", matlab=True
            )
    elif item.kind == OPAQUE:
        yield opaque(item.name, item.owner), Place(array=item.name)
    else:
        yield Field(name=item.name, kind=WORDS.get(item.kind, "unknown"), length=None), Place(array=item.name)


def _load(path: Path, places: Mapping[str, tuple[Variable, Place]], name: str, rows: slice) -> Any:
    item, place = places[name]
    value = _decoded(path, item)
    if item.kind == STRUCT:
        value = next(array for leaf, array in _leaves(item.name, value, 0) if leaf == place.array)
    return np.atleast_1d(value)[place.cut(rows)]


def _leaves(name: str, value: Any, depth: int) -> Iterator[tuple[str, np.ndarray]]:
    """Return the arrays inside a struct by dotted path; an element of a struct array carries its number."""
    if depth > DEPTH or not isinstance(value, np.ndarray):
        return
    if value.dtype.names:
        for number, element in enumerate(value.ravel(order="F"), start=1):
            label = name if value.size == 1 else f"{name}({number})"
            for key in value.dtype.names:
                yield from _leaves(f"{label}.{key}", element[key], depth + 1)
    elif value.dtype.kind != "O" and value.size:
        yield name, value


def _variables(path: Path) -> Iterator[Variable]:
    """Walk the top-level elements; of a compressed one only the beginning is unpacked."""
    total = 0
    with path.open("rb") as stream:
        head = stream.read(HEADER)
        order = "<" if head[126:128] == b"IM" else ">"
        end = stream.seek(0, io.SEEK_END)
        at = HEADER
        while at + 8 <= end:
            stream.seek(at)
            kind, size = struct.unpack(f"{order}II", stream.read(8))
            if at + 8 + size > end:
                raise LogError(f"{path}: is cut off after {end} bytes; copy or save the file again")
            body = stream.read(min(size, PEEK))
            packed = kind == COMPRESSED
            if packed:
                body = zlib.decompressobj().decompress(body, PEEK)
                kind, unpacked = struct.unpack(f"{order}II", body[:8])
                body = body[8:]
            else:
                unpacked = size
            if kind == MATRIX:
                total += unpacked
                check_size(path, total, "the file")
                yield _header(body, order, start=at + 8, size=size, unpacked=unpacked, packed=packed)
            at += 8 + size


def _header(body: bytes, order: str, *, start: int, size: int, unpacked: int, packed: bool) -> Variable:
    _, flags_at, _, at = _element(body, 0, order)
    word = struct.unpack_from(f"{order}I", body, flags_at)[0]
    kind, flags = word & 0xFF, word >> 8 & 0xFF
    dims: tuple[int, ...] = (1, 1)
    if kind != OPAQUE:  # objects of newer MATLABs have two more names in place of dimensions
        _, dims_at, count, at = _element(body, at, order)
        dims = struct.unpack_from(f"{order}{count // 4}i", body, dims_at)
    texts: list[str] = []
    for _ in range(3 if kind == OPAQUE else 1):
        _, text_at, count, at = _element(body, at, order)
        texts.append(body[text_at : text_at + count].decode("latin-1"))
    return Variable(
        name=texts[0], kind=kind, flags=flags, dims=dims, start=start, size=size, unpacked=unpacked, packed=packed,
        owner=texts[-1],
    )  # fmt: skip


def _element(body: bytes, at: int, order: str) -> tuple[int, int, int, int]:
    """Return type, first byte, size and end of an element; short ones keep their data in the tag."""
    kind, size = struct.unpack_from(f"{order}II", body, at)
    if kind >> 16:
        return kind & 0xFFFF, at + 4, kind >> 16, at + 8
    return kind, at + 8, size, at + 8 + size + (-size % 8)


def _decoded(path: Path, item: Variable) -> Any:
    """Decode one variable from its own bytes, so that it can claim no more than it has."""
    import scipy.io

    with path.open("rb") as stream:
        head = stream.read(HEADER)
        order = "<" if head[126:128] == b"IM" else ">"
        stream.seek(item.start)
        body = stream.read(item.size)
    if item.packed:
        body = zlib.decompressobj().decompress(body, item.unpacked + 8)[8:]
    if len(body) < item.unpacked:
        raise LogError(f'{path}: "{item.name}" is cut off; copy or save the file again')
    _check(path, body, 0, len(body), order, 0)
    whole = io.BytesIO(head + struct.pack(f"{order}II", MATRIX, len(body)) + body)
    return scipy.io.loadmat(whole, variable_names=[item.name], chars_as_strings=False)[item.name]


def _check(path: Path, body: bytes, at: int, stop: int, order: str, depth: int) -> None:
    """Refuse a matrix whose dimensions claim more elements than its bytes can hold, at any depth."""
    if at == stop:
        return  # an empty cell
    _, flags_at, _, after = _element(body, at, order)
    kind = struct.unpack_from(f"{order}I", body, flags_at)[0] & 0xFF
    _, dims_at, count, after = _element(body, after, order)
    dims = struct.unpack_from(f"{order}{count // 4}i", body, dims_at)
    claimed = float(np.prod([max(size, 0) for size in dims], dtype=float))
    if min(dims, default=0) < 0 or claimed > stop - at or depth > DEPTH:
        raise LogError(
            f"{path}: a variable claims {'x'.join(map(str, dims))} elements, more than it holds; is it damaged?"
        )
    if kind not in (CELL, STRUCT, OBJECT_CLASS):
        return
    while after + 8 <= stop:
        inner, start, size, end = _element(body, after, order)
        if inner == MATRIX:
            _check(path, body, start, min(start + size, stop), order, depth + 1)
        after = end
