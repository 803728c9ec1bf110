"""The page of a fleet: what `seaopt.reporting.page.fleet` shows, from its logs, drift and population."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import polars as pl

from seaopt.fleet.actuators import tabulate_actuators
from seaopt.fleet.cusum import ALLOWANCE
from seaopt.fleet.drift import PER_RUNS, Drift
from seaopt.fleet.history import LABEL, TIME
from seaopt.fleet.population import ALIGN as POPULATION_ALIGN
from seaopt.fleet.population import HEAD as POPULATION_HEAD
from seaopt.fleet.population import Population
from seaopt.fleet.result import ALIGN, HEAD, Fleet, list_cells
from seaopt.fleet.scatter import BETWEEN_HEAD
from seaopt.fleet.worker import FAILED, MET, NOT_MET
from seaopt.formatting import MISSING, format_count, format_number, join_words
from seaopt.reporting.page.fleet import (
    AlarmLine,
    Cell,
    FleetPage,
    PageTable,
    Row,
    VerdictLine,
    draw_trend,
    write_page,
)
from seaopt.units import unit_after

MOST_DRAWN = 300  # actuators with drawings: the worst
MOST_ROWS = 10_000  # actuators in the table of the page
MOST_ALARMS = 50  # written out
REMEDIES = (
    "Take another log of the actuator in the same way, to see that it stays so.",
    "Compare a log from before with the first one named: temperature, mounting, supply and settings of the drive "
    "change values as wear does. seaopt inspect LOG shows a log, seaopt validate PROBLEM LOG scores a fit on it.",
    "Where the new values stay, repair the actuator, or tune and certify with them: its controller is of the old ones.",
    "After a repair start the charts anew: --since with its date, or a name of its own for the actuator.",
)


def write_fleet_page(
    fleet: Fleet,
    drift: Drift,
    path: Path | str,
    *,
    population: Population | None = None,
    title: str = "Fleet",
    files: Sequence[Path | str] = (),
    command: str = "",
) -> Path:
    """Write an HTML page of every actuator, the worst first; it needs no network and no other file.

    Parameters
    ----------
    fleet : Fleet
        Of `fit_fleet`.
    drift : Drift
        Of `find_drift`, which says whose each log is.
    path : path
        The page.
    population : Population, optional
        Of `estimate_population`, whose values are shown then.
    title : str
        Heading of the page.
    files : sequence of path
        What it was made of, besides the logs: the problem file.
    command : str
        What was typed to make it, to be stated.

    Raises
    ------
    FileError
        The folder cannot be written.

    Notes
    -----
    The 300 worst actuators have drawings, of 40 points at most: runs beyond are averaged. The table has 10,000
    actuators; `tabulate_actuators` has all.

    Examples
    --------
    >>> import tempfile
    >>> from seaopt.fleet import find_drift
    >>> rows = pl.DataFrame({"log": ["a.csv"], "unit": ["a"], "status": ["failed"], "reason": ["empty"],
    ...                      "findings": [None], "J": [None], "J_std": [None]})
    >>> fleet = Fleet(rows=rows, units={"J": "kg m^2"}, identity=("unit",), fitted=("J",))
    >>> write_fleet_page(fleet, find_drift(fleet), tempfile.mkdtemp() + "/fleet.html").name
    'fleet.html'

    """
    return write_page(_compose(fleet, drift, population, title), path, files=files, command=command)


def _compose(fleet: Fleet, drift: Drift, population: Population | None, title: str) -> FleetPage:
    """Return what the page shows."""
    table = tabulate_actuators(fleet, drift, population)
    names = fleet.fitted or tuple(fleet.units)
    timed = not drift.missing
    return FleetPage(
        title=title,
        verdicts=_judge(fleet, drift),
        glance=_glance(fleet, drift),
        alarms=tuple(
            AlarmLine(actuator=alarm.actuator, text=alarm.describe(), since=alarm.since, raised=alarm.raised)
            for alarm in drift.alarms[:MOST_ALARMS]
        ),
        more_alarms=max(len(drift.alarms) - MOST_ALARMS, 0),
        remedies=REMEDIES,
        heads=(
            *(["off siblings"] if population else []),
            *(f"{name}{unit_after(fleet.units[name])}" for name in names),
        ),
        rows=_list_rows(table.head(MOST_ROWS), names, drift, population is not None),
        timed=timed,
        table_notes=_note_table(table, timed, population),
        reasons=fleet.reasons,
        tables=_list_tables(fleet, drift, population),
        judged=_explain(drift),
    )


def _judge(fleet: Fleet, drift: Drift) -> tuple[VerdictLine, ...]:
    logs = VerdictLine(
        word="met" if fleet.met else "not met", tone="good" if fleet.met else "bad", text=f"Fleet: {fleet.verdict}"
    )
    if drift.missing:
        return logs, VerdictLine(word="no charts", tone="note", text=f"Drift: {drift.verdict}")
    word, tone = ("alarm", "bad") if drift.alarms else ("steady", "good")
    return logs, VerdictLine(word=word, tone=tone, text=f"Drift: {drift.verdict}")


def _glance(fleet: Fleet, drift: Drift) -> tuple[tuple[str, str, str], ...]:
    counts = fleet.counts
    figures = [
        ("logs", str(len(fleet.rows)), f"{counts[MET]} met"),
        ("not met", str(counts[NOT_MET]), "fitted, and not to be used"),
        ("failed", str(counts[FAILED]), "not fitted"),
        ("actuators", str(drift.actuators), "by " + join_words(drift.history.actuator or ("all logs",))),
    ]
    if not drift.missing:
        alarmed = len({alarm.actuator for alarm in drift.alarms})
        healthy = "not known" if drift.expected is None else format_number(drift.expected, 2)
        figures.append(("with an alarm", str(alarmed), f"{healthy} if all were healthy"))
    return tuple(figures)


def _list_rows(table: pl.DataFrame, names: Sequence[str], drift: Drift, siblings: bool) -> tuple[Row, ...]:
    """Return the rows of the table, with drawings of those that are worst."""
    runs = _group_runs(drift, table["label"].head(MOST_DRAWN).to_list())
    begun = {(alarm.actuator, alarm.parameter): alarm.begun for alarm in drift.alarms}
    rows: list[Row] = []
    for row in table.iter_rows(named=True):
        state, tone = _name_state(row)
        cells = [_show(row["off"], format_number(row["off"], 2))] if siblings else []
        cells += [_show_parameter(row, name, runs.get(row["label"]), begun) for name in names]
        rows.append(
            Row(
                name=row["label"],
                state=state,
                tone=tone,
                logs=row["logs"],
                met=row["met"],
                last=row["last"] or "",
                level=row["level"],
                cells=tuple(cells),
            )
        )
    return tuple(rows)


def _name_state(row: Mapping[str, Any]) -> tuple[str, str]:
    """Return the state of an actuator, and the class of its colour."""
    if row["alarm"]:
        return "alarm", "bad"
    if row["met"] == row["logs"]:
        return "met", "good"
    return ("not met", "bad") if not row["met"] else ("in part", "warning")


def _group_runs(drift: Drift, actuators: Sequence[str]) -> dict[str, pl.DataFrame]:
    """Return the runs of some actuators that a drawing may have."""
    rows = drift.history.rows.filter(
        (pl.col("status") == MET) & pl.col(TIME).is_not_null() & pl.col(LABEL).is_in(actuators)
    )
    return {str(key[0]): part for key, part in rows.partition_by(LABEL, as_dict=True).items()}


def _show(value: float | None, text: str) -> Cell:
    return Cell(text=text, sort="" if value is None else f"{value:.6g}")


def _show_parameter(
    row: Mapping[str, Any], name: str, runs: pl.DataFrame | None, begun: Mapping[tuple[str, str], float]
) -> Cell:
    """Return a value with its std, and its trend where it has one."""
    value, std = row[name], row[f"{name}_std"]
    text = MISSING if value is None else f"{format_number(value)} ± {format_number(std, 2)}"
    change, change_std = row.get(f"{name}_change"), row.get(f"{name}_change_std")
    trend = ""
    if value and change is not None and change_std is not None and math.isfinite(change):
        trend = f"{100 * change / value:+.2g} % ± {format_number(abs(100 * change_std / value), 2)}"
    cell = Cell(text=text, sort=_show(value, text).sort, trend=trend)
    if runs is None:
        return cell
    identified = runs.filter(pl.col(name).is_finite() & pl.col(f"{name}_std").is_finite())
    if len(identified) < 2:
        return cell
    times, values, stds = (identified[column].to_numpy() for column in (TIME, name, f"{name}_std"))
    drawing = draw_trend(times, values, stds, label=f"{name} of {row['label']}", since=begun.get((row["label"], name)))
    return replace(cell, drawing=drawing)


def _note_table(table: pl.DataFrame, timed: bool, population: Population | None) -> tuple[str, ...]:
    """Return what to say below the table."""
    notes: list[str] = []
    if timed:
        notes.append(
            "Chart: the largest of the actuator's charts now, over its threshold; above 1 is an alarm, which stays "
            "when the chart falls again. Below each value: its change from first run to last, by a straight line. "
            "Drawings: values of the runs that are met, each with one std of its fit up and down; shaded from where a "
            "change has begun."
        )
    if population is not None:
        notes.append(
            "Values are of all logs of the actuator, and borrow from the siblings: of short logs they lie nearer to "
            "the mean of the fleet than the fits alone. Off siblings: how far the parameter that differs most lies "
            "from that mean, in stds of the actuators."
        )
    else:
        notes.append(
            "Values are means over all logs of the actuator that are met, weighted by their fits"
            + (" and by what differs from run to run, which their stds allow for." if timed else ".")
        )
    if timed and len(table) > MOST_DRAWN:
        notes.append(f"The {MOST_DRAWN} worst of {len(table)} actuators have drawings.")
    if len(table) > MOST_ROWS:
        notes.append(f"The {MOST_ROWS} worst of {len(table)} actuators are listed; actuators.parquet has all.")
    return tuple(notes)


def _list_tables(fleet: Fleet, drift: Drift, population: Population | None) -> tuple[PageTable, ...]:
    """Return the tables of the parameters: over logs, over actuators, from run to run."""
    tables = [
        PageTable(
            heading="Over the logs that are met",
            heads=tuple(zip(HEAD, ALIGN, strict=True)),
            rows=tuple(list_cells(fleet.spreads)),
        )
    ]
    if population is not None:
        tables.append(
            PageTable(
                heading="Over actuators",
                heads=tuple(zip(POPULATION_HEAD, POPULATION_ALIGN, strict=True)),
                rows=tuple(population.describe()),
                note="Stds beyond those of the fits, by restricted likelihood.",
            )
        )
    if drift.between:
        tables.append(
            PageTable(
                heading="From run to run",
                heads=(("parameter", "<"), *((head, ">") for head in BETWEEN_HEAD)),
                rows=tuple(
                    (f"{name}{unit_after(fleet.units[name])}", *between.describe())
                    for name, between in drift.between.items()
                ),
            )
        )
    return tuple(tables)


def _explain(drift: Drift) -> tuple[str, ...]:
    """Return how drift is told, in sentences."""
    if drift.missing:
        return (f"Drift was {drift.verdict}.",)
    charts = join_words(list(drift.between))
    texts = [
        f"Each actuator has a chart of {charts} (CUSUM of innovations, k = {ALLOWANCE:g}, h = {drift.threshold:.2f}): "
        "it adds up by how much each run lies off the mean of those before it, in stds of its fit and between runs. "
        f"The threshold is where at most {100 * drift.false_alarms:g} % of healthy actuators raise an alarm within "
        f"{PER_RUNS} runs. Of the {drift.actuators} here: {drift.describe_expected()}.",
        f"Time: {drift.history.source}." + (f" Careful: {drift.history.warning}." if drift.history.warning else ""),
    ]
    if drift.left_out:
        total = format_count(len(drift.history.rows), "log")
        texts.append(f"Left out, of {total}: {drift.describe_left_out()}.")
    texts.append(
        "This holds where the runs of a healthy actuator scatter around a mean of its own as those of its siblings do: "
        "as widely, with such tails, and as alike in runs that follow each other, which are estimated over the whole "
        "fleet. A temperature that comes and goes over many runs raises alarms, too."
    )
    return tuple(texts)
