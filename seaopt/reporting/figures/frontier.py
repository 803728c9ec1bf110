"""Figures of a sweep: what a bandwidth costs."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from seaopt.control import Frontier
from seaopt.reporting.figures.panel import Panel

if TYPE_CHECKING:
    from matplotlib.axes import Axes

FIGURES = {
    "noise_gain": ("Noise gain", "noise gain [{called.gain}]"),
    "ms": ("Largest Ms of all plants", "Ms [-]"),
    "disturbance": ("What is left of disturbances", "integral of |S| over ln f [-]"),
    "phase_margin_deg": ("Phase margin", "phase margin [deg]"),
    "disk_margin": ("Disk margin", "disk margin [-]"),
    "force_limit_N": ("Largest reference at the bandwidth", "{called.word} [{called.unit}]"),
}

OBJECTIVES = {"disturbance": "disturbance", "noise": "noise_gain"}  # objective: the figure that it is


def frontier_panel(frontier: Frontier, figure: str) -> Panel:
    """Draw one figure of a sweep against bandwidth; bandwidths that keep not every limit are hollow."""
    title, label = FIGURES[figure]
    values = [getattr(row, figure) for row in frontier.rows]

    bars = any(row.free_law is not None and OBJECTIVES[row.free_law.objective] == figure for row in frontier.rows)

    def draw(axes: Sequence[Axes]) -> None:
        from seaopt.reporting.figures.canvas import BLUE, MEASURED, VERMILION

        (axis,) = axes
        known = [
            (row.bandwidth_hz, y, row.feasible) for y, row in zip(values, frontier.rows, strict=True) if y is not None
        ]
        axis.plot([x for x, _, _ in known], [y for _, y, _ in known], color=MEASURED, linewidth=0.8, zorder=1)
        for met, colour, label_ in ((True, BLUE, "every limit met"), (False, VERMILION, "a limit missed")):
            points = [(x, y) for x, y, good in known if good == met]
            if points:
                look: dict[str, Any] = {
                    "color": colour,
                    "markerfacecolor": colour if met else "white",
                    "label": label_,
                    "markersize": 5,
                }
                axis.plot(*zip(*points, strict=True), "o", **look)
        bounds = [
            (row.bandwidth_hz, row.free_law.bound)
            for row in frontier.rows
            if row.free_law is not None
            and row.free_law.bound is not None
            and OBJECTIVES[row.free_law.objective] == figure
        ]
        if bounds:
            axis.plot(*zip(*bounds, strict=True), "_", color=MEASURED, markersize=9, label="any linear law, at best")
        if not known:
            axis.text(0.5, 0.5, "no limit of the command", transform=axis.transAxes, ha="center")
        axis.set_xlabel("bandwidth [Hz]")
        axis.set_ylabel(label.format(called=frontier.mechanics))

    return Panel(
        name=f"frontier_{figure}",
        title=title,
        draw=draw,
        link="bandwidth",
        caption="Of the best controller for each bandwidth; hollow: it misses a limit."
        + (" Bars: the best of all linear laws on the design plant alone." if bars else ""),
    )


def frontier_panels(frontier: Frontier) -> list[Panel]:
    """Return a panel per figure of a sweep."""
    return [frontier_panel(frontier, figure) for figure in FIGURES]
