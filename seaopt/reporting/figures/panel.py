"""A panel: one figure by itself, on the axes that it is given or on its own; and several of them on one sheet."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from seaopt.errors import SeaoptError
from seaopt.records import record

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from seaopt.reporting.figures.canvas import PlainFigure

# Colours of Okabe and Ito (Color Universal Design, 2008), which people with any colour vision tell apart.
BLUE, VERMILION, GREEN, PINK, ORANGE, SKY = "#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9"
COLOURS = (BLUE, VERMILION, GREEN, PINK, ORANGE, SKY)
MEASURED, LIMIT, GRID, BAND = "#767676", "#444444", "#e4e4e4", "#c9d0d8"
SHEET_COLUMNS = 2
LEFT, NAMES_LEFT = 0.78, 1.75  # inches beside axes with numbers, and with names


@record(eq=False)
class Panel:
    """A function that draws one figure, with the labels and scales of its axes."""

    name: str  # for files; unique on a page
    title: str
    draw: Callable[..., None]  # called with one axis for each of `heights`; curves with a label are in the legend
    x: str = ""  # label below the last axis, and of y beside each
    y: tuple[str, ...] = ()
    rows: Sequence[str] = ()  # names in place of numbers along y, from the top
    log: str = ""  # logarithmic sides: "x" or "xy"
    tight: bool = False  # no space left and right of the curves
    heights: tuple[float, ...] = (1.0,)  # of the axes from the top, in heights of a panel; they share x
    caption: str = ""  # one or two sentences: what is drawn, and what to see
    link: str = ""  # panels with the same text are zoomed together along x
    left: float = LEFT  # inches for the tick labels and the label of y
    hover: str = "x"  # what a page reads under the pointer: every curve at one x, the nearest "point", or nothing: ""


frequency_panel = partial(Panel, x="frequency [Hz]", log="x", link="frequency")


def draw_level(
    axis: Axes, level: float | None, label: str, *, style: str = "--", side: str = "y", decibel: bool = False
) -> None:
    """Draw a limit across the axis, where there is one, and where it is on `side`; "{:g}" in a label is the limit."""
    if level is not None:
        line = axis.axhline if side == "y" else axis.axvline
        position = to_decibel(level) if decibel else level
        line(position, color=LIMIT, linestyle=style, linewidth=0.9, label=label.format(level))


def to_decibel(values: Any) -> Any:
    """Return the size of complex numbers in dB."""
    return 20 * np.log10(np.maximum(np.abs(values), 1e-12))


def fill_panel(panel: Panel, axes: Sequence[Axes], *, bare: bool = False) -> None:
    """Draw a panel on axes; a bare one without title and legend, for a page that has its own."""
    from seaopt.reporting.figures.canvas import FONT, add_legend, scale_log, take_literally

    if panel.rows:
        axes[0].set_yticks(range(len(panel.rows))[::-1], list(panel.rows))
        axes[0].set_ylim(-0.6, len(panel.rows) - 0.4)
        axes[0].grid(visible=False, axis="y")
    panel.draw(*axes)
    for axis in axes if panel.tight else ():
        axis.margins(x=0.0)
    for side in panel.log:
        scale_log(axes, side)
    axes[-1].set_xlabel(panel.x)
    for axis, label in zip(axes, panel.y, strict=False):
        axis.set_ylabel(label)
    if not bare:
        axes[0].set_title(panel.title, loc="left", fontsize=FONT + 1, y=1.0)  # told where, nothing is measured
        add_legend(axes)
    take_literally(axes)


def draw_panel(panel: Panel, ax: Axes | Sequence[Axes] | None = None, *, bare: bool = False) -> Any:
    """Draw a panel, on a new figure or on as many axes as it has, and return its Axes, or its Figure if several."""
    from matplotlib.axes import Axes

    from seaopt.reporting.figures.canvas import HEIGHT, WIDTH, PlainFigure, add_axes

    count = len(panel.heights)
    if ax is None:
        figure = PlainFigure(figsize=(WIDTH, HEIGHT * sum(panel.heights)))
        axes = add_axes(figure, panel.heights, panel.left, title=not bare, final=bare)
    else:
        axes = tuple(ax) if isinstance(ax, Iterable) else (ax,)
    if len(axes) != count or not all(isinstance(axis, Axes) for axis in axes):
        what = "one Axes" if count == 1 else f"a sequence of {count} Axes"
        raise SeaoptError(f"ax = {str(ax)[:60]} does not fit the figure {panel.name}; give {what}, or leave it out")
    fill_panel(panel, axes, bare=bare)
    return axes[0] if count == 1 else axes[0].get_figure(root=True)


def compose_sheet(panels: Sequence[Panel], columns: int = SHEET_COLUMNS, *, final: bool = False) -> PlainFigure:
    """Draw panels on one figure, row by row, each as high as the highest of its row; a final one is to be written."""
    from seaopt.reporting.figures.canvas import HEIGHT, WIDTH, PlainFigure, add_axes

    columns = min(columns, len(panels))
    rows = [panels[start : start + columns] for start in range(0, len(panels), columns)]
    tall = [max(sum(panel.heights) for panel in row) for row in rows]
    figure = PlainFigure(figsize=(WIDTH * columns, HEIGHT * sum(tall)))
    for number, row in enumerate(rows):
        for column, panel in enumerate(row):
            corner = (WIDTH * column, HEIGHT * sum(tall[:number]))
            fill_panel(panel, add_axes(figure, panel.heights, panel.left, corner=corner, final=final))
    return figure
