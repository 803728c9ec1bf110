"""The result of a fleet: its table, how many are met, and how its parameters spread."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import PurePath
from typing import Any

import numpy as np
import polars as pl

from seaopt.codec import Key, to_content
from seaopt.estimation.result.findings import GUESS
from seaopt.fleet.worker import FAILED, GAP, MET, NOT_MET
from seaopt.formatting import format_count
from seaopt.problem.problem import name_after
from seaopt.records import Result, Worded, record
from seaopt.signals import VectorN

FLEET_SCHEMA = "seaopt/fleet/1"
SHORT = "short"  # kind of finding of a log that is much shorter than its siblings


@record
class FigureSpread:
    """A parameter or figure over the logs that are met and identify it.

    Parameters
    ----------
    name, unit : str
    logs : int
    median, low, high : float
        Of the values: their median, and what a tenth of them lie below and above.
    std : float
        Median of the stated standard deviations.
    """

    json_keys = (
        *("unit", "logs", "median"),
        Key(field="low", name="p10"),
        Key(field="high", name="p90"),
        Key(field="std", name="median_std"),
    )

    name: str
    unit: str
    logs: int
    median: float
    low: float
    high: float
    std: float


@record(eq=False, repr=False)
class Fleet(Result, Worded):
    """The result of `fit_fleet`; ``print(fleet)`` is a summary.

    Parameters
    ----------
    rows : polars.DataFrame
        A row a log, in order of their paths: log, identity, status ("met", "not met", "failed"), reason, values and
        standard deviations, figures of the outputs, findings, times, hashes.
    units : mapping of name to unit
        Of the columns of parameters and figures.
    identity : tuple of str
        Columns that say whose log it is.
    unchanged : int
        How many were done before.
    fitted : tuple of str
        Which of the units' columns a fit estimates: free parameters, delay and gains; the others follow from these.
    free : tuple of str
        The parameters among them, whose errors' correlations have columns, too.
    drift, population : mapping or None
        What fleet.json says of them, of `read_fleet`; the objects are those of `find_drift`, `estimate_population`.
    """

    rows: pl.DataFrame
    units: Mapping[str, str]
    identity: tuple[str, ...] = ()
    unchanged: int = 0
    fitted: tuple[str, ...] = ()
    free: tuple[str, ...] = ()
    drift: Mapping[str, Any] | None = None
    population: Mapping[str, Any] | None = None

    @property
    def counts(self) -> dict[str, int]:
        """How many logs are met, not met, and failed."""
        counts = Counter(self.rows["status"])
        return {name: counts[name] for name in (MET, NOT_MET, FAILED)}

    @property
    def met(self) -> bool:
        """Whether every log is."""
        return self.counts[MET] == len(self.rows)

    @property
    def verdict(self) -> str:
        """The verdict in one line."""
        counts = self.counts
        if self.met:
            guesses = f", {self.guesses}" if self.guesses else ""
            return f"{format_count(len(self.rows), 'log')}, all met{guesses}"
        bad = [f"{counts[name]} {name}" for name in (NOT_MET, FAILED) if counts[name]]
        return f"{counts[NOT_MET] + counts[FAILED]} of {format_count(len(self.rows), 'log')} not met: {', '.join(bad)}"

    @property
    def guesses(self) -> str:
        """The guesses that its fits rest on, as "on 2 guesses: N_p, l"; empty without guesses."""
        findings = (finding for row in self.rows["findings"].drop_nulls() for finding in row)
        return next((finding["where"] for finding in findings if finding["kind"] == GUESS), "")

    @property
    def short(self) -> tuple[str, ...]:
        """The logs that are much shorter than their siblings."""
        return tuple(log for log, _ in self._list_findings(SHORT))

    @property
    def gaps(self) -> tuple[tuple[str, str], ...]:
        """The logs with gaps, and how many samples each lost, in words."""
        return self._list_findings(GAP)

    def _list_findings(self, kind: str) -> tuple[tuple[str, str], ...]:
        """Return the logs with a finding of a kind, and its text."""
        rows = self.rows.select("log", "findings").drop_nulls().iter_rows()
        return tuple(
            (log, finding["text"]) for log, findings in rows for finding in findings if finding["kind"] == kind
        )

    @property
    def reasons(self) -> tuple[tuple[str, int, str], ...]:
        """Why logs are not met: each reason without what differs from log to log, how many, and one of the logs."""
        bad = self.rows.filter(pl.col("status") != MET)
        return count_reasons(zip(*(bad[name].to_list() for name in ("log", "reason", "findings")), strict=True))

    @property
    def spreads(self) -> tuple[FigureSpread, ...]:
        """How parameters and figures spread over the logs that are met."""
        met = self.rows.filter(pl.col("status") == MET)
        spreads = (_spread(name, unit, met) for name, unit in self.units.items() if name in met.columns)
        return tuple(spread for spread in spreads if spread is not None)

    def to_dict(self) -> dict[str, Any]:
        """Return the content of fleet.json (schema seaopt/fleet/1)."""
        return {
            "schema": FLEET_SCHEMA,
            "met": self.met,
            "guesses": self.guesses,
            "logs": len(self.rows),
            "counts": self.counts,
            "reasons": [{"reason": text, "logs": count, "example": log} for text, count, log in self.reasons],
            "units": dict(self.units),
            "identity": list(self.identity),
            "fitted": list(self.fitted),
            "free": list(self.free),
            "spreads": {spread.name: to_content(spread) for spread in self.spreads},
        }


def count_reasons(
    rows: Iterable[tuple[str, str | None, Sequence[Mapping[str, Any]] | None]],
) -> tuple[tuple[str, int, str], ...]:
    """Return the kinds of reasons, the most frequent first, with how many logs have each and one of them. Reasons of
    one kind of finding at one place are one, whatever their figures; so are errors that differ in the log's name alone.
    """
    counts, examples = Counter[str](), dict[str, tuple[str, str]]()
    for log, reason, findings in rows:
        errors = [finding for finding in findings or () if finding["severity"] == "error"]
        text, name = (reason or "").replace(log, "LOG"), name_after(PurePath(log).stem)
        text = text.replace(f"experiment {name}", "experiment LOG")
        kind = f"{errors[0]['kind']} {errors[0]['where'].removeprefix(name)}" if errors else text
        counts[kind] += 1
        examples.setdefault(kind, (text, log))
    return tuple((examples[kind][0], count, examples[kind][1]) for kind, count in counts.most_common())


def _spread(name: str, unit: str, met: pl.DataFrame) -> FigureSpread | None:
    values, stds = select_known(met, name)
    if not values.size:
        return None
    low, median, high = np.quantile(values, (0.1, 0.5, 0.9)).tolist()
    return FigureSpread(
        name=name, unit=unit, logs=values.size, median=median, low=low, high=high, std=float(np.median(stds))
    )


def select_known(rows: pl.DataFrame, name: str) -> tuple[VectorN, VectorN]:
    """Return the values of a parameter and their standard deviations, of the rows that identify it."""
    values, stds = (rows[column].cast(pl.Float64).to_numpy() for column in (name, f"{name}_std"))
    identified = np.isfinite(values) & np.isfinite(stds)
    return values[identified], stds[identified]
