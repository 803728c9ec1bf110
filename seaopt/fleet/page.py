"""A fleet, its drift and its population in words: sections for print, terminal and notebook, and the page."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import polars as pl

from seaopt.fleet.actuators import tabulate_actuators
from seaopt.fleet.cusum import ALLOWANCE
from seaopt.fleet.drift import PER_RUNS, Drift
from seaopt.fleet.history import LABEL, TIME
from seaopt.fleet.population import Population
from seaopt.fleet.result import Fleet
from seaopt.fleet.scatter import BETWEEN_HEAD
from seaopt.fleet.worker import FAILED, MET, NOT_MET
from seaopt.formatting import MISSING, format_count, format_number, format_percent, join_words
from seaopt.reporting.page.fleet import ActuatorTable, Cell, Row, draw_trend, write_page
from seaopt.reporting.sections.data import (
    Commands,
    Item,
    KeyFigure,
    Mark,
    Reason,
    Section,
    Step,
    Table,
    Verdict,
    mark_met,
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
REPAIR = "mend what failed, then type the same command: only that is fitted again"
REFIT = "what is not met is fitted again when its log or the problem changes; a changed problem fits every log anew"


def judge(result: Fleet | Drift | Population, commands: Commands) -> Verdict | None:
    """Return the verdict on a fleet or its drift; None where no drift was looked for."""
    if isinstance(result, Fleet):
        reasons = tuple(Reason(what=f"{text} ({log})", count=count) for text, count, log in result.reasons)
        advice = {REPAIR: result.counts[FAILED], REFIT: result.counts[NOT_MET]} if commands.fit else {}
        advised = tuple(Step(text=text) for text, count in advice.items() if count)
        return Verdict(met=result.met, text=f"Fleet: {result.verdict}", reasons=reasons, next=advised)
    if isinstance(result, Population) or result.missing:
        return None
    reasons = tuple(Reason(what=alarm.actuator, where=alarm.describe()) for alarm in result.alarms)
    text = f"Drift: {result.verdict}"
    return Verdict(met=not result.alarms, words=("steady", "alarm"), text=text, reasons=reasons)


def describe(result: Fleet | Drift | Population) -> list[Section]:
    """Return how parameters spread over logs, over actuators, or from run to run, and how drift is told."""
    sections: dict[str, Callable[[Any], list[Section]]] = {
        "Fleet": _describe_fleet,
        "Drift": _describe_drift,
        "Population": _describe_population,
    }
    return sections[type(result).__name__](result)


def summarise(result: Fleet | Drift | Population) -> list[KeyFigure]:
    """Return how many logs are met and failed, or how many actuators raise an alarm."""
    if isinstance(result, Fleet):
        counts = result.counts
        return [
            KeyFigure(name="logs", value=str(len(result.rows)), against=f"{counts[MET]} met"),
            KeyFigure(name="not met", value=str(counts[NOT_MET]), against="fitted, and not to be used"),
            KeyFigure(name="failed", value=str(counts[FAILED]), against="not fitted"),
        ]
    if isinstance(result, Population):
        return []
    by = f"by {join_words(result.history.actuator or ('all logs',))}"
    figures = [KeyFigure(name="actuators", value=str(result.actuators), against=by)]
    if not result.missing:
        alarmed = len({alarm.actuator for alarm in result.alarms})
        healthy = "not known" if result.expected is None else format_number(result.expected, 2)
        against = f"{healthy} if all were healthy"
        figures.append(KeyFigure(name="with an alarm", value=str(alarmed), against=against))
    return figures


def _describe_fleet(fleet: Fleet) -> list[Section]:
    rows = tuple(
        (
            spread.name,
            spread.unit,
            str(spread.logs),
            *map(format_number, (spread.median, spread.low, spread.high, spread.std)),
        )
        for spread in fleet.spreads
    )
    head = ("parameter", "unit", "logs", "median", "10 %", "90 %", "std of a fit")
    aside = f"{format_count(len(fleet.rows), 'log')}, {fleet.unchanged} done before"
    tables = (Table(label="Over the logs that are met", head=head, rows=rows, align="<<>>>>>"),)
    return [Section(title="Fleet", aside=aside, part="parameters", tables=tables)]


def _describe_population(population: Population) -> list[Section]:
    head = ("parameter", "unit", "mean", "std of actuators", "std of runs")
    counts = (len(population.table), "actuator"), (int(population.table["logs"].sum()), "log")
    return [
        Section(
            title="Population",
            aside=", ".join(format_count(*count) for count in counts),
            part="parameters",
            tables=(Table(head=head, rows=tuple(population.describe()), align="<<>>>"),),
            remarks=("Standard deviations beyond those of the fits, by restricted likelihood.",),
        )
    ]


def _describe_drift(drift: Drift) -> list[Section]:
    if drift.missing:
        return [Section(title="How drift is told", part="judged", sentences=(f"Drift was {drift.verdict}.",))]
    units = dict(drift.table.select("parameter", "unit").unique().iter_rows())
    rows = tuple((f"{name}{unit_after(units[name])}", *spread.describe()) for name, spread in drift.between.items())
    warning = f" Careful: {drift.history.warning}." if drift.history.warning else ""
    texts = [
        f"Each actuator has a chart of {join_words(list(drift.between))} (CUSUM of innovations, k = {ALLOWANCE:g}, h = "
        f"{drift.threshold:.2f}). It adds up how far each run lies from the mean of those before it, in standard "
        "deviations of its fit and between runs. The threshold is set so that at most "
        f"{format_percent(drift.false_alarms)} of healthy actuators raise an alarm within {PER_RUNS} runs. Of the "
        f"{drift.actuators} here: {drift.describe_expected()}.",
        f"Time: {drift.history.source}.{warning}",
    ]
    if drift.left_out:
        texts.append(f"Left out, of {format_count(len(drift.history.rows), 'log')}: {drift.describe_left_out()}.")
    texts.append(
        "This holds where the runs of a healthy actuator scatter about its own mean as those of its siblings do: as "
        "widely, with the same tails, and as alike in runs that follow each other. All three are estimated over the "
        "whole fleet. A temperature that comes and goes over many runs raises alarms, too."
    )
    tables = (Table(head=("parameter", *BETWEEN_HEAD), rows=rows, align="<>>>>"),)
    return [
        Section(title="From run to run", part="parameters", tables=tables),
        Section(title="How drift is told", part="judged", sentences=tuple(texts)),
    ]


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
    table = tabulate_actuators(fleet, drift, population)
    names, timed = fleet.fitted or tuple(fleet.units), not drift.missing
    drift_mark = Mark(text="alarm", style="bad") if drift.alarms else Mark(text="steady", style="good")
    return write_page(
        path,
        title=title,
        verdicts=(
            (mark_met(fleet.met), f"Fleet: {fleet.verdict}"),
            (drift_mark if timed else Mark(text="no charts", style="note"), f"Drift: {drift.verdict}"),
        ),
        glance=[*summarise(fleet), *summarise(drift)],
        table=ActuatorTable(
            heads=(
                *(["off siblings"] if population else []),
                *(f"{name}{unit_after(fleet.units[name])}" for name in names),
            ),
            rows=_list_rows(table.head(MOST_ROWS), names, drift, population is not None),
            timed=timed,
            notes=_note_table(table, timed, population),
        ),
        sections=[
            *_list_alarms(drift),
            *_list_reasons(fleet),
            *describe(fleet),
            *(describe(population) if population is not None else ()),
            *describe(drift),
        ],
        files=files,
        command=command,
    )


def _list_alarms(drift: Drift) -> list[Section]:
    """Return the alarms that are written out, how many are not, and what to do about them."""
    if not drift.alarms:
        return []
    items = tuple(
        Item(
            severity="error",
            text=f"{alarm.actuator}: {alarm.describe()}. First in {alarm.since}, certain with {alarm.raised}.",
        )
        for alarm in drift.alarms[:MOST_ALARMS]
    )
    more = len(drift.alarms) - MOST_ALARMS
    remarks = (f"And {more} more, of actuators in the table below.",) if more > 0 else ()
    return [
        Section(title="Parameters that have changed", part="alarms", remarks=remarks, items=items),
        Section(title="What to do", part="alarms", sentences=REMEDIES),
    ]


def _list_reasons(fleet: Fleet) -> list[Section]:
    rows = tuple((str(count), text, log) for text, count, log in fleet.reasons)
    remark = (
        "Mend what failed, or take it out, and type the same command: only what is new, changed or failed is fitted. "
        "seaopt inspect LOG shows what is wrong with one."
    )
    table = Table(head=("logs", "why", "one of them"), rows=rows, align="><<")
    return [Section(title="Reasons", part="reasons", tables=(table,), remarks=(remark,))] if rows else []


def _list_rows(table: pl.DataFrame, names: Sequence[str], drift: Drift, siblings: bool) -> tuple[Row, ...]:
    """Return the rows of the table, with drawings of those that are worst."""
    runs = _group_runs(drift, table["label"].head(MOST_DRAWN).to_list())
    begun = {(alarm.actuator, alarm.parameter): alarm.begun for alarm in drift.alarms}
    rows: list[Row] = []
    for row in table.iter_rows(named=True):
        cells = [_show(row["off"], format_number(row["off"], 2))] if siblings else []
        cells += [_show_parameter(row, name, runs.get(row["label"]), begun) for name in names]
        shared = {key: row[key] for key in ("logs", "met", "level")}
        rows.append(
            Row(name=row["label"], state=_name_state(row), last=row["last"] or "", cells=tuple(cells), **shared)
        )
    return tuple(rows)


def _name_state(row: Mapping[str, Any]) -> Mark:
    """Return the state of an actuator."""
    if row["alarm"]:
        return Mark(text="alarm", style="bad")
    if row["met"] == row["logs"]:
        return Mark(text="met", style="good")
    return Mark(text="in part", style="warning") if row["met"] else Mark(text="not met", style="bad")


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
        trend = f"{format_percent(change / value, 2, '+')} ± {format_number(abs(100 * change_std / value), 2)}"
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
