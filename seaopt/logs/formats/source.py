"""The source that every format reader returns: the fields of a file, and the data of chosen fields."""

from __future__ import annotations

import logging
import re
import threading
import warnings
from collections.abc import Callable, Generator, Iterable, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import field, replace
from importlib import import_module
from itertools import islice
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Float

from seaopt.errors import LogError, SeaoptError, suggestion
from seaopt.records import record
from seaopt.signals import VectorN

# What one file may unfold to in memory: archives are checked before they are unpacked.
MAX_UNPACKED = 8 << 30
_NUMBER_KIND = re.compile(r"bool|u?int\d+|float\d+")
_WRONG_CALL = re.compile(r"unexpected keyword argument|required positional argument|module '[\w.]+' has no attribute")
MAX_FIELDS = 100_000
MAX_PARTS = 256  # columns of one matrix, or elements of one array, that get a name each
MAX_DEPTH = 32  # of groups, structs, objects or messages inside one another

Location = TypeVar("Location")
Where = Mapping[str, str | float]  # column to the value that its rows have
Loaded = dict[str, Float[np.ndarray, " _"]]


@record
class Field:
    """One column of a file."""

    name: str  # its header or path, as `Column(column=...)` takes it
    kind: str  # type of its numbers, such as "float64"; "text" or another word where it holds no numbers
    length: int | None  # samples; None where the format tells it only on reading
    unit: str | None = None  # as the file says it
    clock: str | None = None  # name of the field that is its clock, where the format says so
    remedy: str = "choose another column"  # where it holds no numbers
    header: str | None = None  # its header where that is not its name, because other columns have it too
    position: int | None = None  # number of its column, from 1, where that is not its place among the fields

    @property
    def numeric(self) -> bool:
        """Whether it holds numbers."""
        return _NUMBER_KIND.fullmatch(self.kind) is not None


@record
class Window:
    """Samples of which the clock lies between start and stop, both in the clock's own unit."""

    clock: str
    start: float
    stop: float


@record
class Source:
    """A file that has been opened and listed."""

    path: Path
    format: str  # its name, for messages
    fields: tuple[Field, ...]
    # Of (names, window): float arrays by name, for fields that share a clock. With a window it may return more samples
    # than lie in it, but the same ones for every name.
    load: Callable[[Sequence[str], Window | None], Loaded]
    notes: tuple[str, ...] = ()  # what was found on listing
    # what the header says besides columns: number and unit by name
    constants: Mapping[str, tuple[float, str | None]] = field(default_factory=dict[str, tuple[float, str | None]])
    # Of (names, where): as `load`, of the rows in which columns, of text too, have given values.
    load_where: Callable[[Sequence[str], Where], Loaded] | None = None
    rows: str = ""  # which rows are read, where not all are
    law: str = ""  # hash of the law that it says it was taken under

    def read(self, names: Sequence[str], window: Window | None = None) -> Loaded:
        """Return the data of fields that share a clock. Raises LogError: damage, or a cell that is not a number."""
        with translate_errors(self.path, self.format):
            return self.load(list(dict.fromkeys(names)), window)


def keep_rows(source: Source, where: Where) -> Source:
    """Return a source of the rows in which columns have given values: one signal of a table of (name, value, time).
    Raises LogError: a column is not there, or (outside text files) holds no numbers.
    """
    rows = ", ".join(f"{name} = {value}" for name, value in where.items())
    listed = {field.name: field for field in source.fields}
    for name, value in where.items():
        if name not in listed:
            raise LogError(f'{source.path}: no column "{name}" for where; {suggestion(name, listed)}')
        if source.load_where is None and (isinstance(value, str) or not listed[name].numeric):
            raise LogError(
                f'{source.path}: where {name} = "{value}" compares text, which {source.format} files do not allow; '
                "save the table as CSV"
            )

    def load(names: Sequence[str], window: Window | None) -> Loaded:
        if source.load_where is not None:
            columns = source.load_where(names, where)
        else:
            every = source.load(list(dict.fromkeys([*names, *where])), window)
            kept = np.all([every[name] == value for name, value in where.items()], axis=0)
            columns = {name: every[name][kept] for name in names}
        if not all(values.size for values in columns.values()):
            raise LogError(f"{source.path}: no row has {rows}; check the value, or window_s")
        return columns

    fields = tuple(replace(field, length=None) for field in source.fields)
    return replace(source, fields=fields, load=load, load_where=None, rows=rows)


def make_row_loader(load: Callable[[str, slice], Any]) -> Callable[[Sequence[str], Window | None], Loaded]:
    """Return the `load` of a source whose fields can be read by name and rows."""

    def load_column(name: str, rows: slice) -> Float[np.ndarray, " _"]:
        return np.array(load(name, rows), dtype=float).reshape(-1)

    def load_columns(names: Sequence[str], window: Window | None) -> Loaded:
        rows = slice(None) if window is None else find_rows(load_column(window.clock, slice(None)), window)
        return {name: load_column(name, rows) for name in names}

    return load_columns


def open_columns(
    path: Path, form: str, columns: Iterable[tuple[Field, Location]], load: Callable[[Location, slice], Any]
) -> Source:
    """Return a source of columns; `load` returns the rows of the column at a location."""
    listed = list(islice(columns, MAX_FIELDS + 1))  # one more than allowed, so that the file is refused
    locations = {field.name: location for field, location in listed}
    return Source(
        path=path,
        format=form,
        fields=tuple(field for field, _ in listed),
        load=make_row_loader(lambda name, rows: load(locations[name], rows)),
    )


def find_rows(clock: VectorN, window: Window) -> slice:
    """Return the rows from the first to the last sample inside the window."""
    inside = np.flatnonzero((clock >= window.start) & (clock <= window.stop))
    return slice(int(inside[0]), int(inside[-1]) + 1) if inside.size else slice(0, 0)


@record
class ArraySlice:
    """Where a field's samples are: an array, and one row or column of it (all of it where `index` is None)."""

    array: str
    index: int | None = None
    axis: int = 1

    def index_rows(self, rows: slice) -> tuple[slice | int, ...]:
        """Return what to index the array with."""
        if self.index is None:
            return (rows,)
        return (rows, self.index) if self.axis == 1 else (self.index, rows)


def spread(
    name: str, shape: Sequence[int], kind: str, *, matlab: bool = False, unit: str | None = None
) -> list[tuple[Field, ArraySlice]]:
    """Return the fields of an array: a vector is one, a matrix one per column (or row, if it has fewer of them)."""
    sizes = [int(size) for size in shape]
    long = [size for size in sizes if size != 1]
    if len(long) <= 1 and len(sizes) <= 2:
        length = long[0] if long else 1
        axis = 0 if len(sizes) == 2 and sizes[0] == 1 else 1
        array_slice = ArraySlice(array=name) if len(sizes) < 2 else ArraySlice(array=name, index=0, axis=axis)
        return [(Field(name=name, kind=kind, length=length, unit=unit), array_slice)]
    if len(sizes) != 2 or min(sizes) > MAX_PARTS:
        return [
            (Field(name=name, kind=f"{kind} array of {'x'.join(map(str, sizes))}", length=None), ArraySlice(array=name))
        ]
    axis = 1 if sizes[1] <= sizes[0] else 0
    brackets = "({})" if matlab else "[{}]"
    parts: list[tuple[Field, ArraySlice]] = []
    for index in range(sizes[axis]):
        number = str(index + 1 if matlab else index)
        label = name + brackets.format(f":,{number}" if axis == 1 else f"{number},:")
        array_slice = ArraySlice(array=name, index=index, axis=axis)
        parts.append((Field(name=label, kind=kind, length=sizes[1 - axis], unit=unit), array_slice))
    return parts


class _Silence:
    """No warnings and logs of a process while any of its threads reads; both as they were after the last. (Were each
    thread to put back what it found, one that begins while another reads would leave them off for good.)
    """

    def __init__(self) -> None:
        self.lock, self.readers, self.undo = threading.RLock(), 0, ExitStack()

    def __enter__(self) -> None:
        with self.lock:
            self.readers += 1
            if self.readers == 1:
                self.undo.callback(logging.disable, logging.root.manager.disable)
                self.undo.enter_context(warnings.catch_warnings())
                logging.disable(logging.CRITICAL)
                warnings.simplefilter("ignore")

    def __exit__(self, *_: object) -> None:
        with self.lock:
            self.readers -= 1
            if not self.readers:
                self.undo.close()


_SILENCE = _Silence()


@contextmanager
def translate_errors(path: Path, form: str) -> Generator[None]:
    """Turn whatever a library raises on a damaged file into a LogError of one line; its warnings and logs are muted."""
    try:
        with _SILENCE:
            yield
    except SeaoptError:
        raise
    except MemoryError as error:
        raise LogError(f"{path}: does not fit in memory as {form}; read fewer columns or a shorter window_s") from error
    except BaseException as error:
        if not isinstance(error, Exception) and type(error).__name__ != "PanicException":
            raise  # an interrupt; a panic of polars is no Exception, but a damaged file all the same
        if _WRONG_CALL.search(str(error)):
            raise LogError(
                f"{path}: the library that reads {form} is not one that seaopt works with ({summarise_error(error)}); "
                "the file is not at fault, run pip install --upgrade seaopt"
            ) from error
        if isinstance(error, ImportError | NameError):  # of Polars, whose runtime did not fit into the address space
            raise LogError(
                f"{path}: the library that reads {form} cannot be loaded ({summarise_error(error)}); "
                "give it more memory (ulimit -v), or install seaopt again"
            ) from error
        raise LogError(
            f"{path}: cannot be read as {form} ({summarise_error(error)}); the file may be cut off or damaged, "
            "copy or record it again"
        ) from error


def summarise_error(error: BaseException) -> str:
    """Return an error's text on one short line."""
    text = " ".join(str(error).split()) or type(error).__name__
    return text if len(text) <= 160 else text[:157] + "..."


def import_optional(module: str, extra: str, path: Path, form: str) -> Any:
    """Import an optional library. Raises LogError: it is not installed; the message names the extra."""
    try:
        with _SILENCE:
            return import_module(module)
    except ImportError as error:
        raise LogError(f"{path}: reading {form} needs an extra library; pip install 'seaopt[{extra}]'") from error


def check_size(path: Path, size: int, what: str) -> None:
    """Refuse what would unfold beyond the limit."""
    if size > MAX_UNPACKED:
        raise LogError(
            f"{path}: {what} unpacks to {size / 2**30:.1f} GiB, more than {MAX_UNPACKED >> 30} GiB; cut the file into "
            "shorter ones"
        )


def check_count(path: Path, fields: Sequence[Field] | Mapping[str, Any]) -> None:
    """Refuse a file of absurdly many fields."""
    if len(fields) > MAX_FIELDS:
        raise LogError(f"{path}: holds more than {MAX_FIELDS} columns; is it a log?")
