"""Figures that pyplot does not keep, axes with a light grid, scales and legends."""

from __future__ import annotations

import base64
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter, NullLocator

from seaopt.formatting import printable
from seaopt.reporting.drawing import TEXT_AS_TEXT, render_figure
from seaopt.reporting.figures.panel import GRID

WIDTH, HEIGHT = 4.9, 2.5  # inches, of one panel with one axis
TOP, BARE_TOP, BOTTOM, RIGHT, BETWEEN = 0.34, 0.12, 0.48, 0.16, 0.12  # inches, margins of a panel
FEW_DECADES = 2.2  # over which 2 and 5 are ticks, too
MANY_DECADES = 6.0  # over which there are no ticks between them
FONT = 9.0  # points


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
) -> tuple[Axes, ...]:
    """Return axes one above the other, which share x, with this package's grid. Margins are the same on every panel:
    axes stand in line on a sheet, and nothing has to be measured. `heights`: from the top, in heights of a panel,
    margins included. `left`: inches for the tick labels and the label of y. `corner`: inches from the figure's left and
    top edges to the panel's. `title`: leave room for one.
    """
    width, height = figure.get_size_inches()
    top = TOP if title else BARE_TOP
    room = HEIGHT * sum(heights) - top - BOTTOM - BETWEEN * (len(heights) - 1)
    above, axes = corner[1] + top, list[Axes]()
    for share in heights:
        tall = room * share / sum(heights)
        box = np.array([corner[0] + left, height - above - tall, WIDTH - left - RIGHT, tall])
        box /= (width, height, width, height)
        axes.append(figure.add_axes(tuple(box), axes_class=PlainAxes, sharex=axes[0] if axes else None))
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
            axis.legend(
                list(handles.values()),
                list(handles),
                fontsize="small",
                frameon=True,
                framealpha=0.75,
                edgecolor="none",
                borderpad=0.2,
                loc="best",
            )
        shown |= handles.keys()


def take_literally(axes: Iterable[Axes]) -> None:
    r"""Let titles, labels and legends show a channel named "$\foo$" as it is: only numbers at ticks are mathematics."""
    for axis in axes:
        texts = [axis.title, axis.xaxis.label, axis.yaxis.label, *axis.texts]
        texts += [getattr(axis, side) for side in ("_left_title", "_right_title") if hasattr(axis, side)]
        legend = axis.get_legend()
        for text in [*texts, *(legend.get_texts() if legend is not None else [])]:
            text.set_parse_math(False)
            text.set_text(printable(text.get_text()))
