"""Figures that pyplot does not keep, axes with a light grid, scales and legends."""

from __future__ import annotations

import base64
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Bool
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.collections import QuadMesh
from matplotlib.figure import Figure
from matplotlib.legend import Legend
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter, NullLocator
from numpy.lib.stride_tricks import sliding_window_view

from seaopt.formatting import printable
from seaopt.reporting.drawing import TEXT_AS_TEXT, render_figure
from seaopt.reporting.figures.panel import GRID
from seaopt.reporting.figures.ticks import FinalAxes

WIDTH, HEIGHT = 4.9, 2.5  # inches, of one panel with one axis
TOP, BARE_TOP, BOTTOM, RIGHT, BETWEEN = 0.34, 0.12, 0.48, 0.16, 0.12  # inches, margins of a panel
FEW_DECADES = 2.2  # over which 2 and 5 are ticks, too
MANY_DECADES = 6.0  # over which there are no ticks between them
FONT = 9.0  # points
LEGEND: dict[str, Any] = {
    "fontsize": "small", "frameon": True, "framealpha": 0.75, "edgecolor": "none", "borderpad": 0.2,
    "columnspacing": 1.0, "handlelength": 1.7, "handletextpad": 0.6,
}  # fmt: skip
MOST_COLUMNS = 3  # of a legend
CELL, CLEAR = 4.0, 1  # pixels in which a place for a legend is looked for; and cells between it and curves
MOST_STEPS = 1000  # that a piece of a curve is looked at in: longer ones are mostly outside of the axes


class PlainFigure(Figure):
    """A figure that pyplot does not know, so that none stays open; it saves text as text, and notebooks show it."""

    def savefig(self, fname: Any, **options: Any) -> None:
        """Save as matplotlib does, with text that stays text in SVG and PDF."""
        with rc_context(TEXT_AS_TEXT):
            super().savefig(fname, **options)

    def _repr_html_(self) -> str:
        """Return the figure for a notebook, as an image that is a vector drawing."""
        code = base64.b64encode(render_figure(self, "svg")).decode("ascii")
        return f'<img src="data:image/svg+xml;base64,{code}" alt="figure" style="background:white;max-width:100%">'

    def _repr_png_(self) -> bytes:
        """Return the figure as pixels, for what shows a stored notebook and draws no vectors in it."""
        return render_figure(self, "png")


class PlainAxes(Axes):
    """Axes of a plain figure; a notebook shows the figure that they are in."""

    def _repr_html_(self) -> str:
        figure = self.get_figure(root=True)
        return figure._repr_html_() if isinstance(figure, PlainFigure) else ""

    def _repr_png_(self) -> bytes | None:
        figure = self.get_figure(root=True)
        return figure._repr_png_() if isinstance(figure, PlainFigure) else None


def add_axes(
    figure: Figure,
    heights: Sequence[float],
    left: float,
    *,
    corner: tuple[float, float] = (0.0, 0.0),
    title: bool = True,
    final: bool = False,
) -> tuple[Axes, ...]:
    """Return axes one above the other, which share x, with this package's grid. Margins are the same on every panel:
    axes stand in line on a sheet, and nothing has to be measured. `heights`: from the top, in heights of a panel,
    margins included. `left`: inches for the tick labels and the label of y. `corner`: inches from the figure's left and
    top edges to the panel's. `title`: leave room for one. `final`: `simplify_ticks` will replace their ticks.
    """
    width, height = figure.get_size_inches()
    top = TOP if title else BARE_TOP
    room = HEIGHT * sum(heights) - top - BOTTOM - BETWEEN * (len(heights) - 1)
    above, axes = corner[1] + top, list[Axes]()
    kind = FinalAxes if final else PlainAxes
    for share in heights:
        tall = room * share / sum(heights)
        box = np.array([corner[0] + left, height - above - tall, WIDTH - left - RIGHT, tall])
        box /= (width, height, width, height)
        axes.append(figure.add_axes(tuple(box), axes_class=kind, sharex=axes[0] if axes else None))
        above += tall + BETWEEN
    for axis in axes:
        axis.grid(visible=True, color=GRID, linewidth=0.6)
        axis.set_axisbelow(True)
        axis.spines[["top", "right"]].set_visible(False)
        axis.tick_params(labelsize=FONT, length=3, labelbottom=axis is axes[-1])
        for text in (axis.xaxis.label, axis.yaxis.label, axis.yaxis.get_offset_text()):
            text.set_fontsize(FONT)
    return tuple(axes)


def scale_log(axes: Iterable[Axes], side: str = "x") -> None:
    """Make a side logarithmic, with plain numbers at its ticks; call it when what is drawn has its limits."""
    for axis in axes:
        (axis.set_xscale if side == "x" else axis.set_yscale)("log")
        scale = axis.xaxis if side == "x" else axis.yaxis
        low, high = sorted(scale.get_view_interval())
        decades = np.log10(high / low) if low > 0.0 else np.inf
        scale.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if decades < FEW_DECADES else (1.0,), numticks=12))
        scale.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        scale.set_minor_locator(LogLocator(subs=(2.0, 5.0)) if decades < MANY_DECADES else NullLocator())
        scale.set_minor_formatter(NullFormatter())


def label_lines(axis: Axes) -> dict[str, Any]:
    """Return what is labelled on axes, each label once, in the order drawn."""
    handles: dict[str, Any] = {}
    for line, label in zip(*axis.get_legend_handles_labels(), strict=True):
        handles.setdefault(str(label), line)
    return handles


def add_legend(axes: Sequence[Axes]) -> None:
    """Put a legend where there is room, on the first of the axes that has labels which none before it has."""
    shown: set[str] = set()
    if len({label for axis in axes for label in label_lines(axis)}) < 2:  # one curve has its name on the axis
        return
    for axis in axes:
        handles = {label: line for label, line in label_lines(axis).items() if label not in shown}
        if handles:
            draw = partial(axis.legend, list(handles.values()), list(handles), **LEGEND)
            if isinstance(axis.get_figure(root=True), PlainFigure):
                place_legend(axis, draw)
            else:  # which may yet change its size
                draw(loc="best")
        shown |= handles.keys()


def place_legend(axis: Axes, draw: Callable[..., Legend]) -> None:
    """Draw a legend near a corner, in as few columns as hide the least of the curves ("best" tries nine places)."""
    curves, places = _find_curves(axis), list[tuple[int, int, tuple[float, float]]]()
    for columns in range(1, MOST_COLUMNS + 1):
        box = draw(ncols=columns, loc="upper right").get_window_extent()
        tall, wide = (int(np.ceil(length / CELL)) + 2 * CLEAR for length in (box.height, box.width))
        if tall > curves.shape[0] or wide > curves.shape[1]:
            break
        hidden = sliding_window_view(curves, (tall, wide)).sum(axis=(2, 3))
        up, right = np.ogrid[: hidden.shape[0], : hidden.shape[1]]
        down, left = up[::-1], right[:, ::-1]
        away = np.minimum(down, up + 0.5) + np.minimum(left, right + 0.25)  # of a corner; upper right before others
        row, column = np.unravel_index(np.lexsort((away.ravel(), hidden.ravel()))[0], hidden.shape)
        x, y = (float(cell + CLEAR) * CELL for cell in (column, row))
        places.append((int(hidden[row, column]), columns, (x / axis.bbox.width, y / axis.bbox.height)))
        if not places[-1][0]:  # nothing is hidden: more columns cannot be better
            break
    _, columns, loc = min(places, default=(0, 1, "best"))
    draw(ncols=columns, loc=loc)


def _find_curves(axis: Axes) -> Bool[np.ndarray, "rows columns"]:
    """Return in which cells of the axes there are curves, the lowest row first."""
    axis.apply_aspect()
    axis.autoscale_view()
    size = np.ceil(np.array(axis.bbox.size) / CELL).astype(int)
    there = np.zeros(size[::-1], dtype=bool)
    paths = [(line.get_path(), line.get_transform()) for line in axis.lines]
    drawn = (each for each in axis.collections if not isinstance(each, QuadMesh))
    paths += [(path, each.get_transform()) for each in drawn for path in each.get_paths()]
    for path, transform in paths:
        at = (transform.transform(np.asarray(path.vertices)) - axis.bbox.p0) / CELL
        at = at[np.isfinite(at).all(axis=1)]
        steps = np.diff(at, axis=0, append=at[-1:])
        counts = np.clip(np.ceil(2.0 * np.abs(steps).max(axis=1, initial=0.0)), 1, MOST_STEPS).astype(int)
        along = (np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)) / np.repeat(counts, counts)
        cells = np.floor(np.repeat(at, counts, axis=0) + along[:, np.newaxis] * np.repeat(steps, counts, axis=0))
        column, row = cells[((cells >= 0) & (cells < size)).all(axis=1)].astype(int).T
        there[row, column] = True
    return there


def take_literally(axes: Iterable[Axes]) -> None:
    r"""Let titles, labels and legends show a channel named "$\foo$" as it is: only numbers at ticks are mathematics."""
    for axis in axes:
        texts = [axis.title, axis.xaxis.label, axis.yaxis.label, *axis.texts]
        texts += [getattr(axis, side) for side in ("_left_title", "_right_title") if hasattr(axis, side)]
        legend = axis.get_legend()
        for text in [*texts, *(legend.get_texts() if legend is not None else [])]:
            text.set_parse_math(False)
            text.set_text(printable(text.get_text()))
