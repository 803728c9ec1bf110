"""The table of a fleet's actuators: their logs, values, trends and alarms, a row each."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import polars as pl

from seaopt.files import write_bytes
from seaopt.fleet.drift import Between, Drift
from seaopt.fleet.history import LABEL, TIME, format_time
from seaopt.fleet.population import Population
from seaopt.fleet.result import Fleet
from seaopt.fleet.worker import FAILED, MET, NOT_MET

TAKEN = ("label", "logs", "met", "not_met", "failed", "last", "alarm", "alarms", "level", "off")
TRENDS = ("slope", "slope_std", "change", "change_std", "level")


def tabulate_actuators(fleet: Fleet, drift: Drift, population: Population | None = None) -> pl.DataFrame:
    """Return a row for each actuator, those with alarms first, then those with logs that are not met.

    Parameters
    ----------
    fleet : Fleet
        Of `fit_fleet`.
    drift : Drift
        Of `find_drift`, which says whose each log is.
    population : Population, optional
        Of `estimate_population`; its values stand in place of plain means, and `off` is how far the parameter that
        differs most lies from the mean of the actuators, in their standard deviations.

    Returns
    -------
    polars.DataFrame
        Columns label (the identity in one text), those of the identity, logs, met, not_met, failed, last (time),
        alarm, alarms (in words), level (the largest chart over its threshold), off; of each parameter NAME and NAME_std
        (weighted means of the logs that are met, where there is no population; the std is of the fits and, where drift
        tells it, of what differs from run to run), then NAME_slope, NAME_change and NAME_level with their stds.

    Examples
    --------
    >>> from seaopt.fleet import find_drift
    >>> rows = pl.DataFrame({"log": ["a.csv", "b.csv"], "unit": ["a", "b"], "status": ["met", "failed"],
    ...                      "J": [2e-6, None], "J_std": [1e-8, None]})
    >>> fleet = Fleet(rows=rows, units={"J": "kg m^2"}, identity=("unit",), fitted=("J",))
    >>> tabulate_actuators(fleet, find_drift(fleet)).select("label", "met", "failed", "J").rows()
    [('b', 0, 1, None), ('a', 1, 0, 2e-06)]
    """
    names = fleet.fitted or tuple(fleet.units)
    statuses = {"met": MET, "not_met": NOT_MET, "failed": FAILED}
    history = drift.history
    identity = [name for name in history.actuator if name not in TAKEN]
    counted = history.rows.group_by(LABEL, maintain_order=True).agg(
        *(pl.col(name).first() for name in identity),
        pl.len().alias("logs"),
        *((pl.col("status") == status).sum().alias(name) for name, status in statuses.items()),
        pl.col(TIME).max(),
        *(column for name in names for column in _average(name, drift.between.get(name))),
    )
    table = counted.rename({LABEL: "label"}).with_columns(
        pl.col(TIME).map_elements(lambda time: format_time(time, history.unit), return_dtype=pl.String).alias("last")
    )
    table = table.drop(TIME).join(_list_alarms(drift), on="label", how="left", maintain_order="left")
    table = table.with_columns(pl.col("alarm").fill_null(value=False))
    table = _add_trends(table, drift)
    if population is not None:
        table = _add_population(table, population)
    order = ["alarm", (pl.col("logs") > pl.col("met")).alias("bad"), pl.col("level").fill_null(0.0)]
    table = table.sort(order, descending=True, maintain_order=True)
    first = ["label", *identity, "logs", *statuses, "last", "alarm", "alarms", "level"]
    return table.select(*first, pl.exclude(first))


def write_actuators(table: pl.DataFrame, path: Path | str) -> Path:
    """Write a table as a Parquet file, whole or not at all.

    Parameters
    ----------
    table : polars.DataFrame
        Of `tabulate_actuators`.
    path : path
        The file.

    Raises
    ------
    FileError
        The folder cannot be written.
    """
    import io

    content = io.BytesIO()
    table.write_parquet(content)
    return write_bytes(path, content.getvalue())


def _average(name: str, between: Between | None) -> tuple[pl.Expr, pl.Expr]:
    """Return the mean of a parameter over logs that are met, weighted by fits and spread between runs, and its std."""
    value, std = (pl.col(column).cast(pl.Float64) for column in (name, f"{name}_std"))
    identified = (pl.col("status") == MET) & value.is_finite() & (std > 0.0)
    weights = 1.0 / (std.filter(identified) ** 2 + (between.std**2 if between else 0.0))
    total = weights.sum()
    some = total > 0.0
    mean = (value.filter(identified) * weights).sum() / total
    return pl.when(some).then(mean).alias(name), pl.when(some).then(total**-0.5).alias(f"{name}_std")


def _list_alarms(drift: Drift) -> pl.DataFrame:
    """Return each actuator's alarms in words."""
    words: dict[str, list[str]] = {}
    for alarm in drift.alarms:
        words.setdefault(alarm.actuator, []).append(alarm.describe())
    content: dict[str, Any] = {"label": list(words), "alarms": ["; ".join(texts) for texts in words.values()]}
    schema = {"label": pl.String, "alarms": pl.String}
    return pl.DataFrame(content, schema=schema).with_columns(pl.lit(value=True).alias("alarm"))


def _add_trends(table: pl.DataFrame, drift: Drift) -> pl.DataFrame:
    """Return the table with the trends of each parameter, and the largest of the charts."""
    if drift.table.is_empty():
        return table.with_columns(pl.lit(None, dtype=pl.Float64).alias("level"))
    label = pl.col("actuator").alias("label")
    worst = drift.table.group_by(label).agg(pl.col("level").max())
    table = table.join(worst, on="label", how="left", maintain_order="left")
    for name in drift.between:
        trends = drift.table.filter(pl.col("parameter") == name)
        trends = trends.select(label, *(pl.col(column).alias(f"{name}_{column}") for column in TRENDS))
        table = table.join(trends, on="label", how="left", maintain_order="left")
    return table


def _add_population(table: pl.DataFrame, population: Population) -> pl.DataFrame:
    """Return the table with the values that borrow from the siblings, where there are such."""
    off = [
        (pl.col(name).log() if logarithmic else pl.col(name)) - mean
        for name, logarithmic, mean in zip(population.names, population.logarithmic, population.mean, strict=True)
    ]
    stds = [float(population.between[k, k]) ** 0.5 for k in range(len(off))]
    furthest = pl.max_horizontal((distance / std).abs() for distance, std in zip(off, stds, strict=True))
    values = population.table.drop("logs").rename({"actuator": "label"}).with_columns(furthest.alias("off"))
    both = [name for name in values.columns if name in table.columns and name != "label"]
    table = table.join(values, on="label", how="left", maintain_order="left", suffix=":siblings")
    return table.with_columns(pl.coalesce(f"{name}:siblings", name).alias(name) for name in both).drop(
        [f"{name}:siblings" for name in both]
    )
