"""Figures of a sweep: what a bandwidth costs."""

from __future__ import annotations

from typing import TYPE_CHECKING

from seaopt.control import Frontier
from seaopt.reporting.figures.panel import BLUE, MEASURED, VERMILION, Panel

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
    """Draw one figure of a sweep against bandwidth; bandwidths that do not meet every limit are hollow."""
    title, label = FIGURES[figure]
    rows = [(row, getattr(row, figure)) for row in frontier.rows if getattr(row, figure) is not None]
    free = [(row.bandwidth_hz, row.free_law) for row in frontier.rows if row.free_law is not None]
    free = [(hz, law.bound) for hz, law in free if OBJECTIVES[law.objective] == figure]

    def draw(axis: Axes) -> None:
        axis.plot([row.bandwidth_hz for row, _ in rows], [y for _, y in rows], color=MEASURED, linewidth=0.8, zorder=1)
        for met, colour, face, name in (
            (True, BLUE, BLUE, "every limit met"),
            (False, VERMILION, "white", "a limit missed"),
        ):
            points = [(row.bandwidth_hz, y) for row, y in rows if row.feasible == met]
            if points:
                axis.plot(*zip(*points, strict=True), "o", color=colour, markerfacecolor=face, markersize=5, label=name)
        bounds = [(hz, bound) for hz, bound in free if bound is not None]
        if bounds:
            axis.plot(*zip(*bounds, strict=True), "_", color=MEASURED, markersize=9, label="any linear law, at best")
        if not rows:
            axis.text(0.5, 0.5, "no limit of the command", transform=axis.transAxes, ha="center")

    return Panel(
        name=f"frontier_{figure}",
        title=title,
        draw=draw,
        x="bandwidth [Hz]",
        y=(label.format(called=frontier.mechanics),),
        link="bandwidth",
        caption="The best controller for each bandwidth; hollow: it misses a limit."
        + (" Bars: the best of all linear laws on the design plant alone." if free else ""),
    )


def frontier_panels(frontier: Frontier) -> list[Panel]:
    """Return a panel per figure of a sweep."""
    return [frontier_panel(frontier, figure) for figure in FIGURES]
