"""MATLAB 4 files, which old data acquisition and `save -v4` write: matrices one after the other, without a mark.

Each has five whole numbers (type, rows, columns, whether complex, length of the name), its name, and its numbers
column by column (MathWorks, "MAT-File Format", level 4). The type is 1000 M + 10 P + T: M the order of bytes, P how a
number is stored, T numbers, text or a sparse matrix.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from seaopt.errors import LogError
from seaopt.logs.formats.source import ArraySlice, Field, Source, open_columns, spread
from seaopt.records import record

HEADER = 20  # bytes
MAX_NAME = 64
STORED = ("f8", "f4", "i4", "i2", "u2", "u1")
KINDS = ("float64", "float32", "int32", "int16", "uint16", "uint8")
OTHER = {1: "text", 2: "a sparse matrix"}


@record
class Matrix:
    """A variable: where its numbers begin, and how they are stored."""

    name: str
    shape: tuple[int, int]
    stored: str
    kind: str
    start: int
    end: int


def is_mat4(head: bytes) -> bool:
    """Tell whether a file begins as a MATLAB 4 file does."""
    try:
        matrix = _read_header(head, 0)
    except (ValueError, struct.error):
        return False
    return matrix.name.isidentifier() and matrix.name.isascii()


def open_mat4(path: Path) -> Source:
    """List the variables of a MATLAB 4 file."""
    return open_columns(path, "MAT 4", _walk_columns(path), partial(_load, path))


def _walk_columns(path: Path) -> Iterator[tuple[Field, tuple[Matrix, ArraySlice]]]:
    size, at = path.stat().st_size, 0
    with path.open("rb") as stream:
        while at < size:
            stream.seek(at)
            matrix = _read_header(stream.read(HEADER + MAX_NAME), at)
            if matrix.end > size:
                raise LogError(f"{path}: is cut off after {size} bytes; copy or save the file again")
            if matrix.kind in KINDS:
                for field, array_slice in spread(matrix.name, matrix.shape, matrix.kind, matlab=True):
                    yield field, (matrix, array_slice)
            else:
                yield Field(name=matrix.name, kind=matrix.kind, length=None), (matrix, ArraySlice(array=matrix.name))
            at = matrix.end


def _load(path: Path, location: tuple[Matrix, ArraySlice], rows: slice) -> Any:
    matrix, array_slice = location
    count = matrix.shape[0] * matrix.shape[1]
    numbers = np.fromfile(path, matrix.stored, count=count, offset=matrix.start)
    if numbers.size < count:
        raise LogError(f"{path}: variable {matrix.name} is cut off; copy or save the file again")
    return numbers.reshape(matrix.shape, order="F")[array_slice.index_rows(rows)]


def _read_header(head: bytes, at: int) -> Matrix:
    """Return the variable whose header is the first of some bytes, which stand at `at` in the file."""
    order = "<" if struct.unpack_from("<i", head)[0] in range(100) else ">"
    code, rows, columns, imaginary, length = struct.unpack_from(f"{order}5i", head)
    machine, coded = divmod(code, 1000)
    stored, what = divmod(coded, 10)
    valid = machine == (order == ">") and stored < len(STORED) and what in (0, 1, 2) and imaginary in (0, 1)
    if not valid or min(rows, columns) < 0 or not 1 < length <= MAX_NAME or len(head) < HEADER + length:
        raise ValueError(f"what stands at byte {at} is not the header of a variable")
    name = head[HEADER : HEADER + length]
    if name[-1:] != b"\0":
        raise ValueError(f"the name at byte {at + HEADER} does not end")
    start = at + HEADER + length
    dtype = np.dtype(order + STORED[stored])
    kind = "complex" if imaginary else OTHER[what] if what else KINDS[stored]
    return Matrix(
        name=name[:-1].decode("latin-1"),
        shape=(rows, columns),
        stored=dtype.str,
        kind=kind,
        start=start,
        end=start + rows * columns * dtype.itemsize * (1 + imaginary),
    )
