"""Ticks of a drawing that is finished, made of few artists.

Matplotlib keeps five artists for each tick, which took half of the time that drawing a report took. What goes to a file
does not change any more: on each side of its axes one line is the grid, two are the marks, and only the numbers are
artists of their own. Where ticks are, and what they say, is matplotlib's.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import lru_cache
from typing import Any

import numpy as np
from jaxtyping import Bool
from matplotlib.axes import Axes
from matplotlib.axis import Tick, XAxis, YAxis
from matplotlib.font_manager import FontProperties
from matplotlib.lines import Line2D
from matplotlib.markers import TICKDOWN, TICKLEFT
from matplotlib.text import Text
from matplotlib.textpath import text_to_path
from matplotlib.ticker import NullLocator
from matplotlib.transforms import offset_copy

from seaopt.records import record
from seaopt.signals import VectorM, VectorN

GAP = 3.5  # points between a mark and its number, as matplotlib has it
MARK_WIDTH, MINOR_LENGTH, MINOR_WIDTH = 0.8, 2.0, 0.6  # points, likewise
DEPTH = 0.5  # below curves, as ticks are with `set_axisbelow(True)`
ROUNDING = 1e-10  # of a side, that a tick may lie beyond its end


@record(eq=False)
class Side:
    """One side of axes with its ticks: where they are, in data, and what the major ones say."""

    axes: Axes
    name: str  # "x" or "y"
    major: VectorN
    labels: tuple[str, ...]
    minor: VectorM

    @property
    def axis(self) -> Any:
        """The side as matplotlib has it."""
        return self.axes.xaxis if self.name == "x" else self.axes.yaxis

    @property
    def transform(self) -> Any:
        """From data along the side, and a fraction of the axes across it, to the drawing."""
        return self.axes.get_xaxis_transform() if self.name == "x" else self.axes.get_yaxis_transform()

    def add_line(self, along: VectorN, across: VectorN, **look: Any) -> None:
        """Add one line to the axes, below curves."""
        points = (along, across) if self.name == "x" else (across, along)
        self.axes.add_artist(Line2D(*points, transform=self.transform, zorder=DEPTH, **look))


class _Bare:
    """A side without the two ticks that matplotlib makes with it, for their look: a tenth of drawing a report."""

    def reset_ticks(self) -> None:
        """Begin with none."""
        self.majorTicks, self.minorTicks = list[Tick](), list[Tick]()


class _XAxis(_Bare, XAxis):
    pass


class _YAxis(_Bare, YAxis):
    pass


class FinalAxes(Axes):
    """Axes whose ticks `simplify_ticks` replaces before they are drawn."""

    def _init_axis(self) -> None:  # what matplotlib's own projections override
        self.xaxis, self.yaxis = _XAxis(self, clear=False), _YAxis(self, clear=False)
        for name, spine in self.spines.items():
            spine.register_axis(self.xaxis if name in ("top", "bottom") else self.yaxis)

    def clear(self) -> None:
        """Do as `Axes.clear`."""
        super().clear()
        for spine in self.spines.values():
            spine.set_position(("outward", 0.0))  # the default, which else a tick brings about


def simplify_ticks(axes: Iterable[Axes]) -> None:
    """Replace the ticks of finished axes by a few artists that look the same, and no longer follow the limits. Of axes
    that share a side give all or none. The artists have ids, which the script of a page knows: ``xtick_0_grid``,
    ``xtick_0_marks`` and ``xtick_0_3`` on the first axes.
    """
    finished = list(axes)
    for each in finished:
        each.apply_aspect()  # a side's length decides how many ticks it has
    sides = [(number, find_ticks(each, name)) for number, each in enumerate(finished) for name in "xy"]
    for _, side in sides:  # after all are found: axes that share a side share its locators
        side.axis.set_major_locator(NullLocator())
        side.axis.set_minor_locator(NullLocator())
    for number, side in sides:
        _draw_side(side, f"{side.name}tick_{number}")


def find_ticks(axes: Axes, name: str) -> Side:
    """Return a side of axes with the ticks that are in view."""
    axis: Any = axes.xaxis if name == "x" else axes.yaxis
    try:
        major, minor = (np.asarray(each, dtype=float) for each in (axis.get_majorticklocs(), axis.get_minorticklocs()))
    except ValueError:  # a logarithmic side on which nothing is drawn
        return Side(axes=axes, name=name, major=np.empty(0), labels=(), minor=np.empty(0))
    labels, seen = axis.get_major_formatter().format_ticks(major), _in_view(axis, major)
    return Side(
        axes=axes,
        name=name,
        major=major[seen],
        minor=minor[_in_view(axis, minor)],
        labels=tuple(label for label, shown in zip(labels, seen, strict=True) if shown),
    )


def _in_view(axis: Any, values: VectorN) -> Bool[np.ndarray, " n"]:
    """Tell which values lie between the ends of a side."""
    transform = axis.get_transform()
    low, high = np.sort(transform.transform(np.asarray(axis.get_view_interval(), dtype=float)))
    places, room = transform.transform(values), ROUNDING * (high - low)
    return (places >= low - room) & (places <= high + room)


def _draw_side(side: Side, gid: str) -> None:
    """Draw grid, marks and numbers of a side, and move its label beyond the numbers."""
    style = side.axis.get_tick_params(which="major")
    if style.get("gridOn") and side.major.size:
        along = np.column_stack([side.major, side.major, np.full_like(side.major, np.nan)]).ravel()
        across = np.tile([0.0, 1.0, np.nan], side.major.size)
        look = {"color": style["grid_color"], "linewidth": style["grid_linewidth"], "snap": True}
        side.add_line(along, across, gid=f"{gid}_grid", **look)
    length, mark = style["length"], TICKDOWN if side.name == "x" else TICKLEFT
    marks = (("marks", side.major, length, MARK_WIDTH), ("minor", side.minor, MINOR_LENGTH, MINOR_WIDTH))
    for part, places, size, width in marks:
        if places.size and size:
            look = {"marker": mark, "markersize": size, "markeredgewidth": width, "color": "black"}
            side.add_line(places, np.zeros_like(places), linestyle="none", clip_on=False, gid=f"{gid}_{part}", **look)
    if style.get("labelbottom" if side.name == "x" else "labelleft", True):
        _draw_numbers(side, style["labelsize"], length + GAP, gid)


def _draw_numbers(side: Side, size: float, reach: float, gid: str) -> None:
    """Write what the ticks say, so many points from the axes."""
    flat = side.name == "x"
    shift = (0.0, -reach) if flat else (-reach, 0.0)
    transform = offset_copy(side.transform, side.axes.get_figure(root=True), *shift, units="points")
    look: dict[str, Any] = {"ha": "center", "va": "top"} if flat else {"ha": "right", "va": "center_baseline"}
    look |= {"fontsize": size, "transform": transform, "zorder": DEPTH, "clip_on": False}
    for number, (position, label) in enumerate(zip(side.major, side.labels, strict=True)):
        at = (position, 0.0) if flat else (0.0, position)
        side.axes.add_artist(Text(*at, label, gid=f"{gid}_{number}", **look))
    if side.axis.label.get_text() and side.labels:
        taken = line_height(size) if flat else max(text_width(label, size) for label in side.labels)
        side.axis.labelpad += reach + taken


@lru_cache(maxsize=1000)
def text_width(text: str, size: float) -> float:
    """Return the width of a text in points."""
    return text_to_path.get_text_width_height_descent(text, FontProperties(size=size), ismath=False)[0]


@lru_cache(maxsize=10)
def line_height(size: float) -> float:
    """Return the height that matplotlib gives a line of text, in points."""
    return text_to_path.get_text_width_height_descent("lp", FontProperties(size=size), ismath=False)[1]
