"""The page of a fleet: every actuator in a table that sorts, its trends as small drawings, alarms and what to do."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from pathlib import Path

import numpy as np
from jaxtyping import Float
from markupsafe import Markup

from seaopt.files import write_text
from seaopt.formatting import format_number, printable
from seaopt.records import record
from seaopt.reporting.page.provenance import describe_provenance
from seaopt.reporting.page.render import render_template

WIDTH, HEIGHT, EDGE = 132.0, 30.0, 3.0  # of a drawing, in its units
MOST_POINTS = 40  # of a drawing; runs beyond are averaged, those that follow each other
MOST_DIGITS = 1  # of coordinates


@record
class VerdictLine:
    """A verdict: a word, the class of its colour ("good", "bad", "note"), and a line."""

    word: str
    tone: str
    text: str


@record
class AlarmLine:
    """An alarm in words, and the logs where it began and was sure."""

    actuator: str
    text: str
    since: str
    raised: str


@record
class Cell:
    """A value of the table: its text, what it is sorted by, its trend in words, and its drawing, if there are such."""

    text: str
    sort: str
    trend: str = ""
    drawing: Markup = Markup("")


@record
class Row:
    """An actuator: its state, with the class of its colour, its logs, the last one's time, its chart, its values."""

    name: str
    state: str
    tone: str
    logs: int
    met: int
    last: str
    level: float | None
    cells: tuple[Cell, ...]


@record
class PageTable:
    """A table with its heading: titles of columns with "<" or ">", rows of texts."""

    heading: str
    heads: tuple[tuple[str, str], ...]
    rows: tuple[Sequence[str], ...]
    note: str = ""


@record
class FleetPage:
    """What the page of a fleet shows.

    Parameters
    ----------
    title : str
    verdicts : tuple of VerdictLine
    glance : tuple of (name, figure, what it is compared with)
    alarms, more_alarms, remedies
        Alarms that are written out, how many are not, and what to do about them.
    heads : tuple of str
        Titles of the columns of values.
    rows : tuple of Row
        The worst first.
    timed : bool
        Whether actuators have a history, and so a last time and a chart.
    table_notes, judged : tuple of str
        What to say below the table, and of how drift is told.
    reasons : tuple of (reason, count, a log)
        Why logs are not met.
    tables : tuple of PageTable
        Of the parameters.

    """

    title: str
    verdicts: tuple[VerdictLine, ...]
    glance: tuple[tuple[str, str, str], ...]
    alarms: tuple[AlarmLine, ...]
    more_alarms: int
    remedies: tuple[str, ...]
    heads: tuple[str, ...]
    rows: tuple[Row, ...]
    timed: bool
    table_notes: tuple[str, ...]
    reasons: tuple[tuple[str, int, str], ...]
    tables: tuple[PageTable, ...]
    judged: tuple[str, ...]


def write_page(page: FleetPage, path: Path | str, *, files: Sequence[Path | str] = (), command: str = "") -> Path:
    """Write a page that needs no network and no other file.

    Parameters
    ----------
    page : FleetPage
        What it shows.
    path : path
        The file.
    files : sequence of path
        What it was made of, besides the logs: named with their hashes.
    command : str
        What was typed to make it.

    Raises
    ------
    FileError
        The folder cannot be written.

    """
    provenance = describe_provenance((), files, command)
    html = render_template("fleet.html.jinja", page=page, title=page.title, provenance=provenance)
    return write_text(Path(path), html)


def draw_trend(
    times: Float[np.ndarray, " n"],
    values: Float[np.ndarray, " n"],
    stds: Float[np.ndarray, " n"],
    *,
    label: str,
    since: float | None = None,
) -> Markup:
    """Return values over time as a small SVG: points joined by a line, one std up and down, and where a change began.

    Parameters
    ----------
    times, values, stds : array
        Of at least two runs, in order of time.
    label : str
        What is read out.
    since : float, optional
        Time from which on the drawing is marked.

    Examples
    --------
    >>> run = np.arange(3.0)
    >>> draw_trend(run, run**2, 0.1 + 0 * run, label="J of the knee")[:60]
    Markup('<svg class="trend" viewBox="0 0 132 30" role="img" aria-labe')

    """
    at, level, spread = _average(times, values, stds)
    low, high = float(np.min(level - spread)), float(np.max(level + spread))
    first, last = float(at[0]), float(at[-1])

    def across(time: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        return EDGE + (WIDTH - 2 * EDGE) * (time - first) / ((last - first) or 1.0)

    def down(value: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        return HEIGHT - EDGE - (HEIGHT - 2 * EDGE) * (value - low) / ((high - low) or 1.0)

    x = across(at)
    bars = "".join(
        f"M{_digits(place)} {_digits(top)}V{_digits(bottom)}"
        for place, top, bottom in zip(x, down(level + spread), down(level - spread), strict=True)
    )
    line = "L".join(f"{_digits(place)} {_digits(height)}" for place, height in zip(x, down(level), strict=True))
    mark = ""
    if since is not None:
        start = float(np.clip(across(np.array([since]))[0], EDGE, WIDTH - EDGE))
        mark = f'<rect class="changed" x="{_digits(start)}" width="{_digits(WIDTH - start)}" height="{HEIGHT:g}"/>'
    ends = f"{label}, {format_number(values[0])} to {format_number(values[-1])} in {values.size} runs"
    return Markup(  # noqa: S704  (numbers, and a text that is escaped)
        f'<svg class="trend" viewBox="0 0 {WIDTH:g} {HEIGHT:g}" role="img" aria-label="{escape(printable(ends))}">'
        f'{mark}<path class="bars" d="{bars}"/><path class="line" d="M{line}"/></svg>'
    )


def _average(
    times: Float[np.ndarray, " n"], values: Float[np.ndarray, " n"], stds: Float[np.ndarray, " n"]
) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, " m"], Float[np.ndarray, " m"]]:
    """Return no more than `MOST_POINTS` points: means of runs that follow each other, of about as many each."""
    if values.size <= MOST_POINTS:
        return times, values, stds
    parts = np.array_split(np.arange(values.size), MOST_POINTS)
    spread = np.array([np.sqrt(np.mean(stds[part] ** 2) / part.size) for part in parts])
    return np.array([times[part].mean() for part in parts]), np.array([values[part].mean() for part in parts]), spread


def _digits(coordinate: float) -> str:
    return f"{coordinate:.{MOST_DIGITS}f}".removesuffix(".0")
