"""Sources whose columns are listed with where each lies in the file, and read one by one."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from itertools import islice
from pathlib import Path
from typing import Any, TypeVar

from seaopt.logs.formats.source import MAX_FIELDS, Field, Source, make_row_loader

Location = TypeVar("Location")


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
