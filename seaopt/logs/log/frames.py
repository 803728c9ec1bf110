"""Logs to and from frames of polars and pandas, units in the column names' brackets."""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from seaopt.errors import LogError, suggestion
from seaopt.signals import Recording, VectorN, check_distinct
from seaopt.units import bare_name, header_unit, si_unit

if TYPE_CHECKING:
    import pandas as pd


def add_headers(log: Recording) -> dict[str, VectorN]:
    """Return time and channels under headers that carry the unit: "time [s]", "F1 [N]"."""
    columns = {"time [s]": log.time}
    for name, signal in log.signals.items():
        columns[f"{name} [{signal.unit}]" if signal.unit else name] = signal.values
    return columns


def to_pandas(log: Recording) -> pd.DataFrame:
    """Return a pandas frame of a log. Raises LogError: pandas is not installed."""
    try:
        pandas = importlib.import_module("pandas")
    except ImportError as error:
        raise LogError("pandas is not installed; run: pip install pandas, or use to_polars()") from error
    return pandas.DataFrame({name: values.copy() for name, values in add_headers(log).items()})


def read_frame(
    frame: Any, time: str, channels: Mapping[str, str] | None, units: Mapping[str, str], source: str
) -> tuple[dict[str, VectorN], dict[str, str], tuple[str, ...]]:
    """Return arrays and units by name, and notes, for `Log.from_frame`. Raises LogError: no frame, or a column that is
    missing, not numeric, or given for two channels of one unit.
    """
    columns = [str(name) for name in getattr(frame, "columns", ())]
    if not columns:
        raise LogError(f"{type(frame).__name__} is not a frame with columns; give a polars or pandas DataFrame")
    channels = _all_channels(columns, time) if channels is None else channels
    if "time" in channels:
        raise LogError(f'{source}: a channel is named "time"; rename it, time is the clock')
    chosen = {"time": time} | dict(channels)
    for name, column in chosen.items():
        if column not in columns:
            raise LogError(f'{source}: no column "{column}" for {name}; {suggestion(column, columns)}')
    units = {name: unit for name, column in chosen.items() if (unit := header_unit(column)) is not None} | dict(units)
    notes = check_distinct(
        {name: ((source, column), si_unit(units.get(name, ""))) for name, column in channels.items()}
    )
    return {name: _column(frame, column, source) for name, column in chosen.items()}, units, tuple(notes)


def _all_channels(columns: list[str], time: str) -> dict[str, str]:
    """Return every column but time under its name without the brackets, or with them where two would be alike."""
    bare = [bare_name(column) for column in columns]
    clear = [bare.count(name) == 1 and name != "time" for name in bare]
    named = zip(bare, columns, clear, strict=True)
    return {name if alone else column: column for name, column, alone in named if column != time}


def _column(frame: Any, column: str, source: str) -> VectorN:
    """Return a column as floats: polars turns nulls into NaN, pandas does so when asked."""
    values = frame[column]
    try:
        if hasattr(values, "fill_null"):
            return values.cast(float).fill_null(float("nan")).to_numpy().astype(float)
        return values.to_numpy(dtype=float, na_value=float("nan"))
    except Exception as error:
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise LogError(f'{source}: column "{column}" is not numeric ({reason}); leave it out of channels') from error
