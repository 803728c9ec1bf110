"""Figures of a schedule: its gains over its variable, and what the law reaches with the variable standing still."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from seaopt.control import ScheduledController
from seaopt.reporting.figures.fit import label_channel
from seaopt.reporting.figures.panel import BLUE, COLOURS, MEASURED, VERMILION, Panel, draw_level
from seaopt.robustness import Certificate

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def schedule_panels(schedule: ScheduledController, certificate: Certificate | None = None) -> list[Panel]:
    """Return the figures of a schedule: gains, bandwidth, and Ms with what is proved of it."""
    panel = partial(Panel, x=label_channel(schedule.over, schedule.unit), link=schedule.over)
    return [
        panel(
            name="schedule_gains",
            title="Gains over the variable",
            draw=partial(_draw_gains, schedule),
            y=("gain, of its largest [-]",),
            caption="Tuned at the points, interpolated on the lines between them.",
        ),
        panel(
            name="schedule_bandwidth",
            title="Bandwidth on the design plant",
            draw=partial(_draw_bandwidth, schedule),
            y=("bandwidth [Hz]",),
            caption="With the variable standing still.",
        ),
        panel(
            name="schedule_ms",
            title="Largest Ms of all plants",
            draw=partial(_draw_sensitivity, schedule, certificate),
            y=("Ms [-]",),
            caption="With the variable standing still, at the points and between them.",
        ),
    ]


def _draw_gains(schedule: ScheduledController, axis: Axes) -> None:
    """Draw every gain as a share of its largest."""
    for (name, row), colour in zip(schedule.table.gains.items(), COLOURS, strict=False):
        largest = float(np.max(np.abs(row)))
        if largest:
            label = f"{name}, of {largest:.4g}"
            axis.plot(schedule.table.points, row / largest, "o-", color=colour, markersize=4, label=label)


def _draw_bandwidth(schedule: ScheduledController, axis: Axes) -> None:
    """Draw the bandwidth of the schedule, and that of the law of its fallback alone."""
    tuned = zip(schedule.points, schedule.controllers, strict=True)
    reached = [(point, controller.achieved.bandwidth_hz) for point, controller in tuned]
    reached += [(figures.value, figures.bandwidth_hz) for figures in schedule.between]
    fallback = schedule.controllers[schedule.points.index(schedule.fallback)]
    plants = [(value, schedule.at(value).design or schedule.design) for value in schedule.points]
    alone = [(value, fallback.close(*plant).figures().bandwidth_hz) for value, plant in plants]
    curves = [sorted((x, y) for x, y in curve if y) for curve in (reached, alone)]
    labels = "schedule", f"the law of {schedule.over} = {schedule.fallback:g} everywhere"
    for curve, style, colour, label in zip(curves, ("o-", "s--"), (BLUE, VERMILION), labels, strict=True):
        axis.plot([x for x, _ in curve], [y for _, y in curve], style, color=colour, markersize=3, label=label)
    wanted_hz = [schedule.asked_hz(x) for x in schedule.points]
    axis.plot(schedule.points, wanted_hz, ":", color=MEASURED, label="asked")
    axis.set_ylim(0.0, 1.15 * max([*wanted_hz, *(y for curve in curves for _, y in curve)]))


def _draw_sensitivity(schedule: ScheduledController, certificate: Certificate | None, axis: Axes) -> None:
    """Draw the largest Ms of all plants, the worst cases found, and the proved bound."""
    if certificate is None:
        rows = [(each.value, each.ms) for each in schedule.between]
    else:
        places = list(zip(certificate.values, certificate.places, strict=True))
        rows = [(value, max(loop.ms for loop in each.plants.values())) for value, each in places]
        worst = [(value, max(case.ms for case in each.worst.values())) for value, each in places]
        axis.plot(*zip(*worst, strict=True), "^", color=VERMILION, markersize=4, label="worst case found")
        proved: dict[tuple[float, float], float] = {}
        for stretch in certificate.stretches:  # of every plant
            ends = stretch.low, stretch.high
            proved[ends] = max(proved.get(ends, 0.0), stretch.ms)
        for number, (ends, bound) in enumerate(proved.items()):
            label = None if number else "no plant has more, proved of nominal parameters"
            axis.plot(ends, [bound, bound], color=MEASURED, linewidth=1.2, label=label)
    axis.plot(*zip(*rows, strict=True), "o-", color=BLUE, markersize=3, label="nominal")
    draw_level(axis, schedule.spec.level("max_sensitivity"), "limit")
