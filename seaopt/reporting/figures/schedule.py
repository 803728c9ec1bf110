"""Figures of a schedule: its gains over its variable, and what the law reaches with the variable standing still."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from seaopt.control import ScheduledController
from seaopt.reporting.figures.panel import Panel
from seaopt.robustness import ScheduleCertificate
from seaopt.units import unit_after

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def schedule_panels(schedule: ScheduledController, certificate: ScheduleCertificate | None = None) -> list[Panel]:
    """Return the figures of a schedule: gains, bandwidth, and Ms with what is proved of it."""
    return [gains_panel(schedule), bandwidth_panel(schedule), sensitivity_panel(schedule, certificate)]


def gains_panel(schedule: ScheduledController) -> Panel:
    """Draw every gain over the variable, as a share of its largest."""
    table = schedule.table

    def draw(axes: Sequence[Axes]) -> None:
        from seaopt.reporting.figures.canvas import COLOURS

        (axis,) = axes
        for (name, row), colour in zip(table.gains.items(), COLOURS, strict=False):
            largest = float(np.max(np.abs(row)))
            if largest:
                label = f"{name}, of {largest:.4g}"
                axis.plot(table.points, row / largest, "o-", color=colour, markersize=4, label=label)
        axis.set_xlabel(_label(schedule))
        axis.set_ylabel("gain, of its largest [-]")

    return Panel(
        name="schedule_gains",
        title="Gains over the variable",
        draw=draw,
        link=schedule.over,
        caption="Tuned at the points, interpolated on the lines between them.",
    )


def bandwidth_panel(schedule: ScheduledController) -> Panel:
    """Draw the bandwidth of the schedule over the variable, and that of the law of its fallback alone."""

    def draw(axes: Sequence[Axes]) -> None:
        from seaopt.reporting.figures.canvas import BLUE, MEASURED, VERMILION

        (axis,) = axes
        tuned = zip(schedule.points, schedule.controllers, strict=True)
        reached = [(point, one.achieved.bandwidth_hz) for point, one in tuned]
        reached += [(one.value, one.bandwidth_hz) for one in schedule.between]
        known = sorted((x, y) for x, y in reached if y is not None)
        axis.plot([x for x, _ in known], [y for _, y in known], "o-", color=BLUE, markersize=3, label="schedule")
        others = [(value, measure_alone(schedule, value)) for value in schedule.points]
        axis.plot(
            [x for x, y in others if y],
            [y for _, y in others if y],
            "s--",
            color=VERMILION,
            markersize=3,
            label=f"the law of {schedule.over} = {schedule.fallback:g} everywhere",
        )
        asked = [schedule.asked_hz(x) for x in schedule.points]
        axis.plot(schedule.points, asked, ":", color=MEASURED, label="asked")
        axis.set_ylim(0.0, 1.15 * max([*asked, *(y for _, y in known), *(y or 0.0 for _, y in others)]))
        axis.set_xlabel(_label(schedule))
        axis.set_ylabel("bandwidth [Hz]")

    return Panel(
        name="schedule_bandwidth",
        title="Bandwidth on the design plant",
        draw=draw,
        link=schedule.over,
        caption="With the variable standing still.",
    )


def measure_alone(schedule: ScheduledController, value: float) -> float | None:
    """Return the bandwidth on the design plant at a value of the law of the fallback."""
    law = schedule.controllers[schedule.points.index(schedule.fallback)]
    plant, params = schedule.at(value).design or schedule.design
    return law.close(plant, params).figures().bandwidth_hz


def sensitivity_panel(schedule: ScheduledController, certificate: ScheduleCertificate | None) -> Panel:
    """Draw the largest Ms of all plants over the variable, the worst cases found, and the proved bound."""

    def draw(axes: Sequence[Axes]) -> None:
        from seaopt.reporting.figures.canvas import BLUE, MEASURED, VERMILION

        (axis,) = axes
        if certificate is None:
            rows = [(one.value, one.ms) for one in schedule.between]
        else:
            rows = [(place.value, place.ms) for place in certificate.places]
            worst = [(place.value, place.worst_ms) for place in certificate.places if place.worst_ms is not None]
            axis.plot(*zip(*worst, strict=True), "^", color=VERMILION, markersize=4, label="worst case found")
            proved: dict[tuple[float, float], float] = {}
            for one in certificate.stretches:  # of every plant
                proved[one.low, one.high] = max(proved.get((one.low, one.high), 0.0), one.ms)
            for number, ((low, high), bound) in enumerate(proved.items()):
                label = None if number else "no plant has more, proved of nominal parameters"
                axis.plot([low, high], [bound, bound], color=MEASURED, linewidth=1.2, label=label)
        axis.plot(*zip(*rows, strict=True), "o-", color=BLUE, markersize=3, label="nominal")
        level = schedule.spec.level("max_sensitivity")
        if level is not None:
            axis.axhline(level, color="black", linewidth=0.8, linestyle="--", label="limit")
        axis.set_xlabel(_label(schedule))
        axis.set_ylabel("Ms [-]")

    return Panel(
        name="schedule_ms",
        title="Largest Ms of all plants",
        draw=draw,
        link=schedule.over,
        caption="With the variable standing still, at the points and between them.",
    )


def _label(schedule: ScheduledController) -> str:
    return f"{schedule.over} [{unit_after(schedule.unit).strip() or '-'}]"
