"""Logs to and from frames of polars and pandas, units in the column names' brackets."""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from seaopt.errors import LogError, suggestion
from seaopt.logs.column import bare_name, header_unit
from seaopt.logs.log import Log
from seaopt.logs.select import check_apart
from seaopt.units import si_unit

if TYPE_CHECKING:
    import pandas as pd
    import polars as pl


def headed(log: Log) -> dict[str, Float[np.ndarray, " n"]]:
    """Return time and channels under headers that carry the unit: "time [s]", "F1 [N]"."""
    columns = {"time [s]": log.time}
    for name, signal in log.signals.items():
        columns[f"{name} [{signal.unit}]" if signal.unit else name] = signal.values
    return columns


def to_polars(log: Log) -> pl.DataFrame:
    """Return a polars frame of a log.

    Examples
    --------
    >>> log = Log.from_arrays(time=[0.0, 0.1], F1=[1.0, 2.0], units={"F1": "kN"})
    >>> to_polars(log).columns
    ['time [s]', 'F1 [N]']

    """
    import polars as pl

    return pl.DataFrame(headed(log))


def to_pandas(log: Log) -> pd.DataFrame:
    """Return a pandas frame of a log.

    Raises
    ------
    LogError
        pandas is not installed.

    """
    try:
        pandas = importlib.import_module("pandas")
    except ImportError as error:
        raise LogError("pandas is not installed; run: pip install pandas, or use to_polars()") from error
    return pandas.DataFrame({name: values.copy() for name, values in headed(log).items()})


def from_frame(frame: Any, time: str, channels: Mapping[str, str] | None, units: Mapping[str, str], source: str) -> Log:
    """Build a log from a frame: see `Log.from_frame`."""
    columns = [str(name) for name in getattr(frame, "columns", ())]
    if not columns:
        raise LogError(f"{type(frame).__name__} is no frame with columns; give a polars or pandas DataFrame")
    if channels is None:
        bare = [bare_name(column) for column in columns]
        clear = [bare.count(name) == 1 and name != "time" for name in bare]
        pairs = [(name if alone else full, full) for name, full, alone in zip(bare, columns, clear, strict=True)]
        channels = {name: column for name, column in pairs if column != time}
    if "time" in channels:
        raise LogError(f'{source}: a channel is named "time"; rename it, time is the clock')
    wanted = {"time": time} | dict(channels)
    for name, column in wanted.items():
        if column not in columns:
            raise LogError(f'{source}: no column "{column}" for {name}; {suggestion(column, columns)}')
    brackets = {name: header_unit(column) for name, column in wanted.items()}
    given = {name: unit for name, unit in brackets.items() if unit is not None} | dict(units)
    notes = check_apart({name: ((source, column), si_unit(given.get(name, ""))) for name, column in channels.items()})
    arrays = {name: _column(frame, column, source) for name, column in wanted.items()}
    return replace(Log.from_arrays(units=given, source=source, **arrays), notes=tuple(notes))


def _column(frame: Any, column: str, source: str) -> Float[np.ndarray, " n"]:
    """Return a column as floats: polars turns nulls into NaN, pandas does so when asked."""
    values = frame[column]
    try:
        if hasattr(values, "fill_null"):
            return values.cast(float).fill_null(float("nan")).to_numpy().astype(float)
        return values.to_numpy(dtype=float, na_value=float("nan"))
    except Exception as error:
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise LogError(f'{source}: column "{column}" is not numeric ({reason}); leave it out of channels') from error
