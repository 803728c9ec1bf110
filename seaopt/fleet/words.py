"""A fleet, its drift and its population in words: verdicts and sections for terminal, notebook and page."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from seaopt.fleet.cusum import ALLOWANCE
from seaopt.fleet.drift import PER_RUNS, Drift
from seaopt.fleet.population import Population
from seaopt.fleet.result import Fleet
from seaopt.fleet.scatter import BETWEEN_HEAD
from seaopt.fleet.worker import FAILED, NOT_MET
from seaopt.formatting import format_count, format_number, join_words
from seaopt.reporting.sections.data import Commands, Reason, Section, Table, Verdict
from seaopt.units import unit_after

if TYPE_CHECKING:
    from collections.abc import Callable

REPAIR = "mend what failed, then type the same command: only that is fitted again"
REFIT = "what is not met is fitted again when its log or the problem changes; a changed problem fits every log anew"


def judge(result: Fleet | Drift | Population, commands: Commands) -> Verdict | None:
    """Return the verdict on a fleet or its drift; None where no drift was looked for."""
    if isinstance(result, Fleet):
        reasons = tuple(Reason(what=f"{text} ({log})", count=count) for text, count, log in result.reasons)
        advice = {REPAIR: result.counts[FAILED], REFIT: result.counts[NOT_MET]} if commands.fit else {}
        advised = tuple(text for text, count in advice.items() if count)
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
        f"deviations of its fit and between runs. The threshold is set so that at most {100 * drift.false_alarms:g} % "
        f"of healthy actuators raise an alarm within {PER_RUNS} runs. Of the {drift.actuators} here: "
        f"{drift.describe_expected()}.",
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
