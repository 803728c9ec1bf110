"""The page of a fleet: every actuator in a table that sorts, its trends as small drawings, alarms and what to do."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from html import escape
from pathlib import Path

import numpy as np
from markupsafe import Markup

from seaopt.files import write_text
from seaopt.formatting import format_number, printable
from seaopt.records import record
from seaopt.reporting.page.provenance import describe_provenance
from seaopt.reporting.page.render import render_parts, render_template
from seaopt.reporting.sections.data import KeyFigure, Mark, Section
from seaopt.signals import VectorM, VectorN

WIDTH, HEIGHT, EDGE = 132.0, 30.0, 3.0  # of a drawing, in its units
MOST_POINTS = 40  # of a drawing; runs beyond are averaged, those that follow each other
MOST_DIGITS = 1  # of coordinates
PARTS = {
    "alarms": "Alarms",
    "actuators": "Actuators",
    "reasons": "Logs that are not met",
    "parameters": "Parameters",
    "judged": "How drift is told",
    "provenance": "Provenance",
}


@record
class Cell:
    """A value of the table: its text, the key it is sorted by, its trend in words, and its drawing."""

    text: str
    sort: str
    trend: str = ""
    drawing: Markup = Markup("")


@record
class Row:
    """An actuator: its state, its logs, the last one's time, its chart, its values."""

    name: str
    state: Mark
    logs: int
    met: int
    last: str
    level: float | None
    cells: tuple[Cell, ...]


@record
class ActuatorTable:
    """The table of the actuators, the worst first, with the titles of the columns of values."""

    heads: tuple[str, ...]
    rows: tuple[Row, ...]
    timed: bool  # whether actuators have a history, and so a last time and a chart
    notes: tuple[str, ...]  # below the table


def write_page(
    path: Path | str,
    *,
    title: str,
    verdicts: Iterable[tuple[Mark, str]],
    glance: Iterable[KeyFigure],
    table: ActuatorTable,
    sections: Sequence[Section],
    files: Sequence[Path | str] = (),
    command: str = "",
) -> Path:
    """Write a page that needs no network and no other file; sections stand in their `PARTS`. `glance`: figures to see
    first. `files`, `command`: what it was made of, besides the logs, and what was typed to make it. Raises FileError:
    the folder cannot be written.
    """
    html = render_template(
        "fleet.html.jinja",
        title=title,
        parts=PARTS,
        verdicts=verdicts,
        glance=glance,
        table=table,
        described=render_parts([*sections, describe_provenance((), files, command)], PARTS),
    )
    return write_text(Path(path), html)


def draw_trend(times: VectorN, values: VectorN, stds: VectorN, *, label: str, since: float | None = None) -> Markup:
    """Return values over time as a small SVG: points joined by a line, one std up and down, and where a change began.
    `times`: in order, of at least two runs. `label`: what a screen reader says. `since`: from when on it is shaded.
    """
    at, level, spread = _average(times, values, stds)
    low, high = float(np.min(level - spread)), float(np.max(level + spread))
    first, last = float(at[0]), float(at[-1])

    def across(time: VectorN) -> VectorN:
        return EDGE + (WIDTH - 2 * EDGE) * (time - first) / ((last - first) or 1.0)

    def down(value: VectorN) -> VectorN:
        return HEIGHT - EDGE - (HEIGHT - 2 * EDGE) * (value - low) / ((high - low) or 1.0)

    x = across(at)
    bars = "".join(
        f"M{_digits(left)} {_digits(top)}V{_digits(bottom)}"
        for left, top, bottom in zip(x, down(level + spread), down(level - spread), strict=True)
    )
    line = "L".join(f"{_digits(left)} {_digits(height)}" for left, height in zip(x, down(level), strict=True))
    mark = ""
    if since is not None:
        start = float(np.clip(across(np.array([since]))[0], EDGE, WIDTH - EDGE))
        mark = f'<rect class="changed" x="{_digits(start)}" width="{_digits(WIDTH - start)}" height="{HEIGHT:g}"/>'
    ends = f"{label}, {format_number(values[0])} to {format_number(values[-1])} in {values.size} runs"
    return Markup(  # noqa: S704  (numbers, and a text that is escaped)
        f'<svg class="trend" viewBox="0 0 {WIDTH:g} {HEIGHT:g}" role="img" aria-label="{escape(printable(ends))}">'
        f'{mark}<path class="bars" d="{bars}"/><path class="line" d="M{line}"/></svg>'
    )


def _average(times: VectorN, values: VectorN, stds: VectorN) -> tuple[VectorM, VectorM, VectorM]:
    """Return no more than `MOST_POINTS` points: means of runs that follow each other, of about as many each."""
    if values.size <= MOST_POINTS:
        return times, values, stds
    parts = np.array_split(np.arange(values.size), MOST_POINTS)
    spread = np.array([np.sqrt(np.mean(stds[part] ** 2) / part.size) for part in parts])
    return np.array([times[part].mean() for part in parts]), np.array([values[part].mean() for part in parts]), spread


def _digits(coordinate: float) -> str:
    return f"{coordinate:.{MOST_DIGITS}f}".removesuffix(".0")
