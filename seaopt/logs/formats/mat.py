"""MATLAB 5 files: numbers, and structs of them, straight from the bytes; objects stay closed.

Layout (MathWorks, "MAT-File Format"): a header of 128 bytes, then elements of type and size; one of type 15 is
compressed; a matrix (14) holds flags, dimensions, name and data, and cells and structs hold matrices. Numbers may be
stored in a smaller type than their class. SciPy's reader is not used: a damaged file makes it crash the interpreter.
"""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Shaped

from seaopt.errors import LogError
from seaopt.logs.formats.simulink import OBJECT, clocked, opaque
from seaopt.logs.formats.source import MAX_FIELDS, Field, Place, Source, by_rows, check_size, spread
from seaopt.records import record

HEADER = 128
PEEK = 1 << 16  # bytes that hold a variable's header
DEPTH = 32
COMPRESSED, MATRIX = 15, 14
STRUCT, OPAQUE = 2, 17
NUMBERS = {6: "float64", 7: "float32", 8: "int8", 9: "uint8", 10: "int16", 11: "uint16", 12: "int32", 13: "uint32",
           14: "int64", 15: "uint64"}  # fmt: skip
WORDS = {1: "a cell array", 3: OBJECT, 4: "text", 5: "a sparse matrix", 16: "a function"}
STORED = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
COMPLEX, LOGICAL = 0x08, 0x02


@record
class Variable:
    """A top-level element: where its matrix lies, and how long it is unpacked."""

    start: int
    size: int
    unpacked: int
    packed: bool
    order: str


@record
class Matrix:
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
        if self.kind not in NUMBERS:
            return WORDS.get(self.kind, "unknown")
        return "complex" if self.flags & COMPLEX else "bool" if self.flags & LOGICAL else NUMBERS[self.kind]


Places = Mapping[str, tuple[Variable, Place]]


def open_mat(path: Path) -> Source:
    """List the variables of a MATLAB 5 file; structs become dotted paths."""
    fields: list[Field] = []
    places: dict[str, tuple[Variable, Place]] = {}
    for variable, head in _variables(path):
        matrix = _header(head, 0, variable.order)
        if not matrix.name:
            continue  # MATLAB's own store of objects
        body = _body(path, variable) if matrix.kind == STRUCT else head
        for leaf in _leaves(body, 0, variable.order, matrix.name):
            for field, place in _fields(leaf):
                fields.append(field)
                places[field.name] = (variable, place)
            if len(fields) > MAX_FIELDS:
                break
    return Source(
        path=path, format="MAT 5", fields=tuple(clocked(fields)), load=by_rows(partial(_load, path, places))
    )  # fmt: skip


def _fields(leaf: Matrix) -> list[tuple[Field, Place]]:
    if leaf.kind == OPAQUE:
        return [(opaque(leaf.name, leaf.owner), Place(array=leaf.name))]
    if leaf.kind not in NUMBERS:
        return [(Field(name=leaf.name, kind=leaf.word, length=None), Place(array=leaf.name))]
    return spread(leaf.name, leaf.dims, leaf.word, matlab=True)


def _load(path: Path, places: Places, name: str, rows: slice) -> Any:
    variable, place = places[name]
    body = _body(path, variable)
    top = _header(body, 0, variable.order).name
    leaf = next(leaf for leaf in _leaves(body, 0, variable.order, top) if leaf.name == place.array)
    return _numbers(body, leaf, variable.order)[place.cut(rows)]


def _variables(path: Path) -> Iterator[tuple[Variable, bytes]]:
    """Walk the top-level matrices, each with its first bytes; of a compressed one no more is unpacked."""
    total = 0
    with path.open("rb") as stream:
        order = "<" if stream.read(HEADER)[126:128] == b"IM" else ">"
        end = stream.seek(0, io.SEEK_END)
        at = HEADER
        while at + 8 <= end:
            stream.seek(at)
            kind, size = struct.unpack(f"{order}II", stream.read(8))
            if at + 8 + size > end:
                raise LogError(f"{path}: is cut off after {end} bytes; copy or save the file again")
            head, unpacked = stream.read(min(size, PEEK)), size
            packed = kind == COMPRESSED
            if packed:
                head = zlib.decompressobj().decompress(head, PEEK)
                kind, unpacked = struct.unpack(f"{order}II", head[:8])
                head = head[8:]
            if kind == MATRIX:
                total += unpacked
                check_size(path, total, "the file")
                yield Variable(start=at + 8, size=size, unpacked=unpacked, packed=packed, order=order), head
            at += 8 + size


def _body(path: Path, variable: Variable) -> bytes:
    """Return the bytes of a matrix, unpacked, and no more than it said."""
    with path.open("rb") as stream:
        stream.seek(variable.start)
        body = stream.read(variable.size)
    if variable.packed:
        body = zlib.decompressobj().decompress(body, variable.unpacked + 8)[8:]
    if len(body) < variable.unpacked:
        raise LogError(f"{path}: a variable is cut off; copy or save the file again")
    return body


def _header(body: bytes, at: int, order: str) -> Matrix:
    _, flags_at, _, at = _element(body, at, order)
    word = struct.unpack_from(f"{order}I", body, flags_at)[0]
    kind, flags = word & 0xFF, word >> 8 & 0xFF
    dims: tuple[int, ...] = (1, 1)
    if kind != OPAQUE:  # objects of newer MATLABs have two more names in place of dimensions
        _, dims_at, count, at = _element(body, at, order)
        dims = struct.unpack_from(f"{order}{count // 4}i", body, dims_at)
    if len(dims) < 2 or min(dims) < 0:
        raise ValueError(f"a variable has dimensions {dims}")
    texts: list[str] = []
    for _ in range(3 if kind == OPAQUE else 1):
        _, text_at, count, at = _element(body, at, order)
        texts.append(body[text_at : text_at + count].decode("latin-1"))
    return Matrix(name=texts[0], kind=kind, flags=flags, dims=dims, data=at, owner=texts[-1])


def _element(body: bytes, at: int, order: str) -> tuple[int, int, int, int]:
    """Return type, first byte, size and end of an element; short ones keep their data in the tag."""
    kind, size = struct.unpack_from(f"{order}II", body, at)
    if kind >> 16:
        return kind & 0xFFFF, at + 4, kind >> 16, at + 8
    return kind, at + 8, size, at + 8 + size + (-size % 8)


def _leaves(body: bytes, at: int, order: str, name: str, depth: int = 0) -> Iterator[Matrix]:
    """Return the matrices inside a struct, named by their path; an element of a struct array carries its number."""
    found = _header(body, at, order)
    if depth > DEPTH:
        raise ValueError(f"structs are nested deeper than {DEPTH}")
    if found.kind != STRUCT:
        yield Matrix(name=name, kind=found.kind, flags=found.flags, dims=found.dims, data=found.data, owner=found.owner)
        return
    _, width_at, _, after = _element(body, found.data, order)
    width = struct.unpack_from(f"{order}i", body, width_at)[0]
    _, keys_at, count, after = _element(body, after, order)
    names = body[keys_at : keys_at + count]
    keys = [names[i : i + width].split(b"\0")[0].decode("latin-1") for i in range(0, len(names), max(width, 1))]
    number = 0
    many = max(found.dims) > 1
    while keys and after + 8 <= len(body) and number < np.prod(found.dims, dtype=float):
        number += 1
        for key in keys:
            kind, start, size, end = _element(body, after, order)
            if kind != MATRIX or start + size > len(body):
                raise ValueError(f'field "{key}" of {name} is cut off')
            if size:
                yield from _leaves(
                    body[:end], start, order, f"{name}({number}).{key}" if many else f"{name}.{key}", depth + 1
                )
            after = end


def _numbers(body: bytes, leaf: Matrix, order: str) -> Shaped[np.ndarray, "..."]:
    """Return a matrix of numbers, if its bytes are as many as its dimensions say."""
    kind, start, size, _ = _element(body, leaf.data, order)
    if kind not in STORED:
        raise ValueError(f'"{leaf.name}" is stored as type {kind}, which is no number')
    stored = np.dtype(order + STORED[kind])
    if start + size > len(body) or size // stored.itemsize != np.prod(leaf.dims, dtype=float):
        raise ValueError(f'"{leaf.name}" claims {"x".join(map(str, leaf.dims))} elements and holds {size} bytes')
    return np.frombuffer(body, stored, count=size // stored.itemsize, offset=start).reshape(leaf.dims, order="F")
