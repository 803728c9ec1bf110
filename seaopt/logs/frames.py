"""Logs to and from frames of polars and pandas, units in the column names' brackets."""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from seaopt.errors import LogError, suggestion
from seaopt.logs.column import bare_name, header_unit
from seaopt.logs.log import Log

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


def from_frame(
    frame: Any,
    *,
    time: str = "time [s]",
    channels: Mapping[str, str] | None = None,
    units: Mapping[str, str] | None = None,
    source: str = "frame",
) -> Log:
    """Build a log from a polars or pandas frame.

    Parameters
    ----------
    frame : polars.DataFrame or pandas.DataFrame
        Columns of numbers; nulls and NaN are missing samples.
    time : str
        Name of the time column.
    channels : mapping of channel name to column name, optional
        Every other column if left out, under its name without the brackets where that is clear.
    units : mapping of channel name to unit, optional
        Of columns without brackets; what has neither is SI already.
    source : str
        A name for messages.

    Raises
    ------
    LogError
        A column is missing or not numeric, or time does not increase.
    UnitError
        A unit is unknown.

    Examples
    --------
    >>> import polars as pl
    >>> log = from_frame(pl.DataFrame({"t [ms]": [0.0, 2.5], "cur [mA]": [100, None]}), time="t [ms]")
    >>> log.time.tolist(), log["cur"].tolist(), log.signal("cur").unit
    ([0.0, 0.0025], [0.1, nan], 'A')

    """
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
    given = {name: unit for name, unit in brackets.items() if unit is not None} | dict(units or {})
    arrays = {name: _column(frame, column, source) for name, column in wanted.items()}
    return Log.from_arrays(units=given, source=source, **arrays)


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
