"""The frontier's figure: what a bandwidth costs."""

from __future__ import annotations

from typing import Any

from matplotlib.figure import Figure

from seaopt.control import Frontier

MET, MISSED = "#0072b2", "#d55e00"
PANELS = (
    ("noise_gain", "noise gain [{called.gain}]"),
    ("ms", "largest Ms of all plants"),
    ("disturbance", "disturbance: integral of |S| over ln f"),
    ("phase_margin_deg", "phase margin [deg]"),
    ("disk_margin", "disk margin"),
    ("force_limit_N", "largest {called.word} at the bandwidth [{called.unit}]"),
)


def frontier_figure(frontier: Frontier) -> Figure:
    """Draw each figure of a sweep against bandwidth; bandwidths that keep not every limit are hollow."""
    figure = Figure(figsize=(9.0, 4.8), layout="constrained")
    axes: Any = figure.subplots(2, 3, sharex=True)
    f = [row.bandwidth_hz for row in frontier.rows]
    for axis, (name, title) in zip(axes.ravel(), PANELS, strict=True):
        values = [getattr(row, name) for row in frontier.rows]
        shown = [(x, y, row.feasible) for x, y, row in zip(f, values, frontier.rows, strict=True) if y is not None]
        axis.set_title(title.format(called=frontier.mechanics), fontsize="medium")
        axis.grid(visible=True, color="#e4e4e4", linewidth=0.5)
        axis.spines[["top", "right"]].set_visible(False)
        axis.plot([x for x, _, _ in shown], [y for _, y, _ in shown], color="#b0b0b0", linewidth=1.0, zorder=1)
        for met, colour, face, label in (
            (True, MET, MET, "every limit met"),
            (False, MISSED, "white", "a limit missed"),
        ):
            points = [(x, y) for x, y, good in shown if good == met]
            if points:
                look: dict[str, Any] = {"color": colour, "markerfacecolor": face, "label": label, "markersize": 5}
                axis.plot(*zip(*points, strict=True), "o", **look)
        if not shown:
            axis.text(0.5, 0.5, "no limit of the command", transform=axis.transAxes, ha="center", color="#767676")
    for axis in axes[1]:
        axis.set_xlabel("bandwidth [Hz]")
    handles: dict[str, Any] = {}
    for axis in axes.ravel():
        handles |= {str(label): line for line, label in zip(*axis.get_legend_handles_labels(), strict=True)}
    figure.legend(list(handles.values()), list(handles), loc="outside upper left", frameon=False, ncols=2)
    return figure
