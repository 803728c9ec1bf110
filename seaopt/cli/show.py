"""How results look on a terminal: the verdict with its reasons, then one screen of figures in tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from seaopt.cli.terminal import Terminal
from seaopt.problem import Problem
from seaopt.reporting.sections import describe
from seaopt.reporting.sections.data import Verdict
from seaopt.reporting.sections.text import Most, render_sections, render_verdict

MOST_ROWS = 14  # of a table; --verbose prints them all
MOST_NOTES = 4
SCREEN, ALL = Most(rows=MOST_ROWS, reasons=8, items=MOST_NOTES, screen=True), Most(folded=True)

SHOWN = ("frf", "sweep", "fit", "tune", "certify")
SIMULATED = (
    "simulation_NAME.csv: the plant with the values of [parameters], sensors ideal",
    "virtual_NAME.csv: the log of a virtual experiment, with its truth, noise and offsets, as a fit reads it",
)


def show_results(
    console: Terminal, stage: str, results: Mapping[str, Any], problem: Problem, *, verbose: bool = False
) -> None:
    """Print what the results of a stage have to say: a screen of figures, or all of it."""
    if stage == "simulate":
        for line in SIMULATED[: 2 if any(table.virtual for table in problem.table.experiment) else 1]:
            console.wrap(line)
        for run in results[stage].values() if verbose else ():
            console.say(repr(run))
    shown: list[object] = [results[stage]] if stage in SHOWN else []
    if stage == "fit":
        shown += results.get("scores", ())
    if stage == "tune":
        shown += [results["mpc"]] if problem.mpc is not None else []
        if verbose and "joint" in results:
            console.say(repr(results["joint"]))
    for result in shown:
        show_sections(console, result, verbose=verbose or stage == "sweep")


def show_verdicts(console: Terminal, verdicts: Sequence[Verdict], *, verbose: bool = False) -> None:
    """Print a line per stage, below it what is not met, and what to type next."""
    for verdict in verdicts:
        console.write(render_verdict(verdict, console.width, ALL if verbose else SCREEN))


def show_sections(console: Terminal, result: object, *, verbose: bool = False) -> None:
    """Print what a result has to say, on a screen or all of it."""
    console.write(render_sections(describe(result), console.width, ALL if verbose else SCREEN))
