"""MATLAB 5 files: numbers, and structs of them, straight from the bytes; objects stay closed.

The layout (MathWorks, "MAT-File Format"): a header of 128 bytes, then elements of type and size; one of type 15 is
compressed; a matrix (14) holds flags, dimensions, name and data, and cells and structs hold matrices. Numbers may be
stored in a smaller type than their class. SciPy's reader is not used: a damaged file makes it crash the interpreter.
"""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Shaped

from seaopt.errors import LogError
from seaopt.logs.formats.simulink import OBJECT, assign_clocks, make_object_field
from seaopt.logs.formats.source import MAX_DEPTH, ArraySlice, Field, Source, check_size, open_columns, spread
from seaopt.records import record

HEADER_BYTES = 128
PEEK_BYTES = 1 << 16  # bytes that hold a variable's header
COMPRESSED, MATRIX = 15, 14
STRUCT, OPAQUE = 2, 17
NUMBER_CLASSES = {
    6: "float64", 7: "float32", 8: "int8", 9: "uint8", 10: "int16", 11: "uint16", 12: "int32", 13: "uint32",
    14: "int64", 15: "uint64",
}  # fmt: skip
OTHER_CLASSES = {1: "a cell array", 3: OBJECT, 4: "text", 5: "a sparse matrix", 16: "a function"}
STORED_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
COMPLEX, LOGICAL = 0x08, 0x02


@record
class StoredVariable:
    """A top-level element: where its matrix lies, and how long it is unpacked."""

    start: int
    size: int
    unpacked: int
    packed: bool
    order: str


@record
class MatrixHeader:
    """The header of a matrix; `data` is where what follows it begins."""

    name: str
    kind: int
    flags: int
    dims: tuple[int, ...]
    data: int
    owner: str = ""  # class of an object

    @property
    def word(self) -> str:
        """Kind of its elements."""
        if self.kind not in NUMBER_CLASSES:
            return OTHER_CLASSES.get(self.kind, "unknown")
        return "complex" if self.flags & COMPLEX else "bool" if self.flags & LOGICAL else NUMBER_CLASSES[self.kind]


MatrixPlace = tuple[StoredVariable, MatrixHeader, ArraySlice]


def open_mat(path: Path) -> Source:
    """List the variables of a MATLAB 5 file; structs become dotted paths."""
    source = open_columns(path, "MAT 5", _walk_columns(path), partial(_load, path))
    return replace(source, fields=tuple(assign_clocks(source.fields)))


def _walk_columns(path: Path) -> Iterator[tuple[Field, MatrixPlace]]:
    for variable, head in _walk_variables(path):
        matrix = _read_header(head, 0, variable.order)
        if not matrix.name:
            continue  # MATLAB's own store of objects
        body = _read_body(path, variable) if matrix.kind == STRUCT else head
        for leaf in _walk_leaves(body, 0, variable.order, matrix.name):
            if leaf.kind in NUMBER_CLASSES:
                columns = spread(leaf.name, leaf.dims, leaf.word, matlab=True)
            elif leaf.kind == OPAQUE:
                columns = [(make_object_field(leaf.name, leaf.owner), ArraySlice(array=leaf.name))]
            else:
                columns = [(Field(name=leaf.name, kind=leaf.word, length=None), ArraySlice(array=leaf.name))]
            for field, array_slice in columns:
                yield field, (variable, leaf, array_slice)


def _load(path: Path, location: MatrixPlace, rows: slice) -> Any:
    variable, leaf, array_slice = location
    return _read_numbers(_read_body(path, variable), leaf, variable.order)[array_slice.index_rows(rows)]


def _walk_variables(path: Path) -> Iterator[tuple[StoredVariable, bytes]]:
    """Walk the top-level matrices, each with its first bytes; of a compressed one no more is unpacked."""
    total = 0
    with path.open("rb") as stream:
        order = "<" if stream.read(HEADER_BYTES)[126:128] == b"IM" else ">"
        end = stream.seek(0, io.SEEK_END)
        at = HEADER_BYTES
        while at + 8 <= end:
            stream.seek(at)
            kind, size = struct.unpack(f"{order}II", stream.read(8))
            if at + 8 + size > end:
                raise LogError(f"{path}: is cut off after {end} bytes; copy or save the file again")
            head, unpacked = stream.read(min(size, PEEK_BYTES)), size
            packed = kind == COMPRESSED
            if packed:
                head = zlib.decompressobj().decompress(head, PEEK_BYTES)
                kind, unpacked = struct.unpack(f"{order}II", head[:8])
                head = head[8:]
            if kind == MATRIX:
                total += unpacked
                check_size(path, total, "the file")
                yield StoredVariable(start=at + 8, size=size, unpacked=unpacked, packed=packed, order=order), head
            at += 8 + size
        if at != end:
            raise LogError(f"{path}: has {end - at} bytes behind its last variable; copy or save the file again")


def _read_body(path: Path, variable: StoredVariable) -> bytes:
    """Return the bytes of a matrix, unpacked to the end, where the checksum is, and as many as it said."""
    with path.open("rb") as stream:
        stream.seek(variable.start)
        body = stream.read(variable.size)
    if variable.packed:
        stream = zlib.decompressobj()
        body = stream.decompress(body, variable.unpacked + 9)[8:]  # one more, so that the checksum is looked at
        if not stream.eof or stream.unused_data:
            raise LogError(f"{path}: a compressed variable does not end where it says; copy or save the file again")
    if len(body) != variable.unpacked:
        raise LogError(f"{path}: a variable is cut off; copy or save the file again")
    return body


def _read_header(body: bytes, at: int, order: str) -> MatrixHeader:
    _, flags_at, _, at = _read_element(body, at, order)
    word = struct.unpack_from(f"{order}I", body, flags_at)[0]
    kind, flags = word & 0xFF, word >> 8 & 0xFF
    dims: tuple[int, ...] = (1, 1)
    if kind != OPAQUE:  # objects of newer MATLABs have two more names in place of dimensions
        _, dims_at, count, at = _read_element(body, at, order)
        dims = struct.unpack_from(f"{order}{count // 4}i", body, dims_at)
    if len(dims) < 2 or min(dims) < 0:
        raise ValueError(f"a variable has dimensions {dims}")
    texts: list[str] = []
    for _ in range(3 if kind == OPAQUE else 1):
        _, text_at, count, at = _read_element(body, at, order)
        texts.append(body[text_at : text_at + count].decode("latin-1"))
    return MatrixHeader(name=texts[0], kind=kind, flags=flags, dims=dims, data=at, owner=texts[-1])


def _read_element(body: bytes, at: int, order: str) -> tuple[int, int, int, int]:
    """Return type, first byte, size and end of an element; short ones keep their data in the tag."""
    kind, size = struct.unpack_from(f"{order}II", body, at)
    if kind >> 16:
        return kind & 0xFFFF, at + 4, kind >> 16, at + 8
    return kind, at + 8, size, at + 8 + size + (-size % 8)


def _walk_leaves(body: bytes, at: int, order: str, name: str, depth: int = 0) -> Iterator[MatrixHeader]:
    """Return the matrices inside a struct, named by their path; an element of a struct array carries its number."""
    matrix = _read_header(body, at, order)
    if depth > MAX_DEPTH:
        raise ValueError(f"structs are nested deeper than {MAX_DEPTH}")
    if matrix.kind != STRUCT:
        yield replace(matrix, name=name)
        return
    _, width_at, _, after = _read_element(body, matrix.data, order)
    width = struct.unpack_from(f"{order}i", body, width_at)[0]
    _, keys_at, count, after = _read_element(body, after, order)
    names = body[keys_at : keys_at + count]
    keys = [names[i : i + width].split(b"\0")[0].decode("latin-1") for i in range(0, len(names), max(width, 1))]
    number = 0
    many = max(matrix.dims) > 1
    while keys and after + 8 <= len(body) and number < np.prod(matrix.dims, dtype=float):
        number += 1
        for key in keys:
            kind, start, size, end = _read_element(body, after, order)
            if kind != MATRIX or start + size > len(body):
                raise ValueError(f'field "{key}" of {name} is cut off')
            if size:
                yield from _walk_leaves(
                    body[:end], start, order, f"{name}({number}).{key}" if many else f"{name}.{key}", depth + 1
                )
            after = end


def _read_numbers(body: bytes, leaf: MatrixHeader, order: str) -> Shaped[np.ndarray, "..."]:
    """Return a matrix of numbers, if its bytes are as many as its dimensions say."""
    kind, start, size, _ = _read_element(body, leaf.data, order)
    if kind not in STORED_TYPES:
        raise ValueError(f'"{leaf.name}" is stored as type {kind}, which is not a number')
    stored, declared = np.dtype(order + STORED_TYPES[kind]), np.dtype(NUMBER_CLASSES[leaf.kind])
    if stored.newbyteorder("=") != declared and not (stored.itemsize < declared.itemsize and stored.kind in "iu"):
        raise ValueError(f'"{leaf.name}" is of {declared} and stored as {stored}, which is no smaller whole number')
    if start + size > len(body) or size // stored.itemsize != np.prod(leaf.dims, dtype=float):
        raise ValueError(f'"{leaf.name}" claims {"x".join(map(str, leaf.dims))} elements and holds {size} bytes')
    return np.frombuffer(body, stored, count=size // stored.itemsize, offset=start).reshape(leaf.dims, order="F")
