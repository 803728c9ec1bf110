"""Parquet: columns and row groups are read as they are needed (polars)."""

from __future__ import annotations

import os
import sys
from collections.abc import Generator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from seaopt.errors import LogError
from seaopt.files import check_name
from seaopt.logs.formats.source import Field, Source, Window
from seaopt.signals import VectorN
from seaopt.units import header_unit

if TYPE_CHECKING:
    import polars as pl

STDERR = 2


def open_parquet(path: Path) -> Source:
    """List the columns of a Parquet file."""
    import polars as pl

    check_name(path, "Polars cannot open it: rename the file, or its folder", LogError)
    with _silence_panics():
        frame = pl.scan_parquet(path, glob=False)
        length = int(frame.select(pl.len()).collect().item())
        fields = tuple(_make_field(name, dtype, length) for name, dtype in frame.collect_schema().items())
    return Source(path=path, format="Parquet", fields=fields, load=partial(_load, path))


@contextmanager
def _silence_panics() -> Generator[None]:
    """Keep what polars' own threads write of a damaged file, a hundred lines of Rust, off stderr; it raises as well."""
    try:
        sys.stderr.flush()
        kept = os.dup(STDERR)
    except (OSError, ValueError, AttributeError):  # there is none
        yield
        return
    try:
        with open(os.devnull, "wb") as nowhere:  # noqa: PTH123
            os.dup2(nowhere.fileno(), STDERR)
        yield
    finally:
        os.dup2(kept, STDERR)
        os.close(kept)


def _make_field(name: str, dtype: pl.DataType, length: int) -> Field:
    if dtype.is_temporal():  # seconds, counted from 1970 or from zero
        counted = str(dtype).startswith(("Datetime", "Duration"))
        return Field(name=name, kind="float64" if counted else str(dtype), length=length, unit="s")
    kind = "bool" if str(dtype) == "Boolean" else str(dtype).lower()
    return Field(name=name, kind=kind, length=length, unit=header_unit(name))


def _load(path: Path, names: Sequence[str], window: Window | None) -> dict[str, VectorN]:
    import polars as pl

    with _silence_panics():
        frame = pl.scan_parquet(path, glob=False)
        schema = frame.collect_schema()
        if window is not None:
            clock = _select_number(window.clock, schema[window.clock])
            frame = frame.filter(clock.is_between(window.start, window.stop))
        columns = frame.select(_select_number(name, schema[name]).alias(name) for name in names).collect()
    return {name: np.array(columns[name].to_numpy(), dtype=float) for name in names}


def _select_number(name: str, dtype: Any) -> pl.Expr:
    import polars as pl

    column = pl.col(name)
    if str(dtype).startswith("Datetime"):
        return column.dt.timestamp("us").cast(pl.Float64) * 1e-6
    if str(dtype).startswith("Duration"):
        return column.dt.total_nanoseconds().cast(pl.Float64) * 1e-9
    return column if dtype.is_numeric() and not dtype.is_decimal() else column.cast(pl.Float64)
