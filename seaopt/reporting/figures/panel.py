"""A panel: one figure by itself, on the axes that it is given or on its own; and several of them on one sheet."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, Any

from seaopt.errors import SeaoptError
from seaopt.records import record

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from seaopt.reporting.figures.canvas import PlainFigure

SHEET_COLUMNS = 2
LEFT, NAMES_LEFT = 0.78, 1.75  # inches beside axes with numbers, and with names


@record(eq=False)
class Panel:
    """What draws one figure.

    Parameters
    ----------
    name : str
        For files; unique on a page.
    title : str
    draw : callable
        Draws on as many axes as there are `heights`; curves that are to be in a legend have labels.
    heights : tuple of float
        Of the axes from the top, in heights of a panel; they share x.
    caption : str
        One or two sentences: what is drawn, and what to see.
    link : str
        Panels with the same text are zoomed together along x.
    left : float
        Inches for the tick labels and the label of y.
    hover : "x", "point" or ""
        What a page reads under the pointer: every curve at one x, the nearest point, or nothing, without zoom.

    """

    name: str
    title: str
    draw: Callable[[Sequence[Axes]], None]
    heights: tuple[float, ...] = (1.0,)
    caption: str = ""
    link: str = ""
    left: float = LEFT
    hover: str = "x"


def fill_panel(panel: Panel, axes: Sequence[Axes], *, bare: bool = False) -> None:
    """Draw a panel on axes; a bare one without title and legend, for a page that has its own."""
    from seaopt.reporting.figures.canvas import FONT, add_legend, take_literally

    panel.draw(axes)
    if not bare:
        axes[0].set_title(panel.title, loc="left", fontsize=FONT + 1, y=1.0)  # told where, nothing is measured
        add_legend(axes)
    take_literally(axes)


def draw_panel(panel: Panel, ax: Axes | Sequence[Axes] | None = None, *, bare: bool = False) -> Any:
    """Draw a panel and return its Axes, or its Figure where it has several.

    Parameters
    ----------
    panel : Panel
        What to draw.
    ax : Axes, or sequence of Axes, optional
        As many as the panel has; on a figure of its own if left out.
    bare : bool
        Leave out title and legend.

    Raises
    ------
    SeaoptError
        `ax` are not as many axes as the panel has.

    """
    from matplotlib.axes import Axes

    from seaopt.reporting.figures.canvas import HEIGHT, WIDTH, add_axes, new_figure

    count = len(panel.heights)
    if ax is None:
        figure = new_figure(WIDTH, HEIGHT * sum(panel.heights))
        axes = add_axes(figure, panel.heights, panel.left, title=not bare)
    else:
        axes = tuple(ax) if isinstance(ax, Iterable) else (ax,)
    if len(axes) != count or not all(isinstance(axis, Axes) for axis in axes):
        what = "one Axes" if count == 1 else f"a sequence of {count} Axes"
        raise SeaoptError(f"ax = {str(ax)[:60]} does not fit the figure {panel.name}; give {what}, or leave it out")
    fill_panel(panel, axes, bare=bare)
    return axes[0] if count == 1 else axes[0].get_figure(root=True)


def compose_sheet(panels: Sequence[Panel], columns: int = SHEET_COLUMNS) -> PlainFigure:
    """Draw panels on one figure, row by row, each as high as the highest of its row."""
    from seaopt.reporting.figures.canvas import HEIGHT, WIDTH, add_axes, new_figure

    columns = min(columns, len(panels))
    rows = [panels[start : start + columns] for start in range(0, len(panels), columns)]
    tall = [max(sum(panel.heights) for panel in row) for row in rows]
    figure = new_figure(WIDTH * columns, HEIGHT * sum(tall))
    for number, row in enumerate(rows):
        for column, panel in enumerate(row):
            corner = (WIDTH * column, HEIGHT * sum(tall[:number]))
            fill_panel(panel, add_axes(figure, panel.heights, panel.left, corner=corner))
    return figure
