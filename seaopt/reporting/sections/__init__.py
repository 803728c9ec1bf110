"""The one place where results become words and tables.

Each kind of result has a module in `kinds` that gives its sections and, where it has one, its verdict. `repr`, the
terminal, notebooks, the report and comments in C render what it gives, so that a new row appears in all of them.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

from seaopt.reporting.sections import html, text
from seaopt.reporting.sections.data import Commands, KeyFigure, Section, Verdict

# The module of each kind: found by name, so that a text of one result loads nothing of the others.
KINDS = {
    "Fit": "fit",
    "ModelledOutputs": "prediction",
    "LogComparison": "prediction",
    "Quality": "quality",
    "Responses": "responses",
    "Frontier": "frontier",
    "Controller": "controller",
    "ScheduledController": "schedule",
    "ForceMPC": "mpc",
    "Certificate": "certificate",
    "Verification": "verification",
    "Diagnostics": "advice",
    "Ranking": "advice",
    "Simulated": "simulated",
    "LargeSignal": "simulated",
    "Passivity": "contact",
    "StabilityMap": "contact",
    "Scorecard": "contact",
    "Fleet": "seaopt.fleet.page",
    "Drift": "seaopt.fleet.page",
    "Population": "seaopt.fleet.page",
    "Acceptance": "seaopt.machine.page.page",
    "BringUp": "seaopt.machine.bringup.page",
}


def _find_module(result: object) -> Any:
    name = next((KINDS[kind.__name__] for kind in type(result).__mro__ if kind.__name__ in KINDS), None)
    return None if name is None else import_module(name if "." in name else f"{__name__}.kinds.{name}")


def describe(result: object) -> list[Section]:
    """Return the sections of a result, in the order of a terminal."""
    return _find_module(result).describe(result)


def judge(result: object, commands: Commands | None = None) -> Verdict | None:
    """Return the verdict on a result, with the commands to type next; None for results without a verdict."""
    judged = getattr(_find_module(result), "judge", None)
    return None if judged is None else judged(result, commands or Commands())


def summarise(result: object) -> list[KeyFigure]:
    """Return the figures of a result to see first; none of results without such."""
    summarised = getattr(_find_module(result), "summarise", None)
    return [] if summarised is None else summarised(result)


def write_text(result: object) -> str:
    """Return a result as text of 80 columns: verdict, then all sections but details."""
    verdict = judge(result)
    lines = [] if verdict is None else text.render_verdict(verdict)
    lines += text.render_sections(describe(result))
    return text.join(lines).removeprefix("\n")


def write_html(result: object) -> str:
    """Return a result as HTML, with its main figures where it draws itself."""
    verdict, plot = judge(result), getattr(result, "plot", None)
    parts = [] if verdict is None else [html.render_verdict(verdict)]
    parts += [html.render_section(section) for section in describe(result)]
    return "".join(parts) + ("" if plot is None else plot.to_html())
