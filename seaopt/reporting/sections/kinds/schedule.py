"""A schedule in words: its verdict, and the gains and figures at every point."""

from __future__ import annotations

from seaopt.control import ScheduledController
from seaopt.control.laws.command import name_gain_units
from seaopt.formatting import format_count, format_number
from seaopt.reporting.sections.data import Commands, Reason, Section, Step, Table, Verdict, list_notes, mark_met
from seaopt.reporting.sections.kinds.controller import describe_surroundings
from seaopt.units import unit_after


def judge(schedule: ScheduledController, commands: Commands) -> Verdict:
    """Return the verdict on a schedule."""
    bands = sorted({f"{band:g}" for band in schedule.bandwidths_hz}, key=float)
    name = (
        f"Schedule: {schedule.spec.structure} on {schedule.spec.regulated} over {schedule.over} = "
        f"{schedule.points[0]:g} to {schedule.points[-1]:g}, {format_count(len(schedule.points), 'point')}, "
        f"{' to '.join(dict.fromkeys((bands[0], bands[-1])))} Hz"
    )
    if schedule.met:
        return Verdict(met=True, text=f"{name}, every limit met at the points and between them")
    reasons = tuple(Reason(what=text) for text in schedule.broken)
    return Verdict(
        met=False,
        text=f"{name}, {format_count(len(reasons), 'limit')} not met",
        reasons=reasons,
        next=(Step(text=schedule.remedy),),
    )


def describe(schedule: ScheduledController) -> list[Section]:
    """Return the gains and figures at every point, what was found between them, and the findings."""
    spec = schedule.spec
    units, names = name_gain_units(schedule.command), list(schedule.controllers[0].gains)
    gains = tuple(f"{name}{unit_after(units[name]) if name in units else ''}" for name in names)
    head = (f"{schedule.over}{unit_after(schedule.unit)}", *gains, "bandwidth Hz", "Ms", "Mt", "limits")
    rows = tuple(
        (
            f"{point:g}",
            *(f"{controller.gains[name]:.4g}" for name in names),
            format_number(controller.achieved.bandwidth_hz, missing="none"),
            f"{controller.achieved.ms:.3f}",
            f"{controller.achieved.mt:.3f}",
            mark_met(controller.met),
        )
        for point, controller in zip(schedule.points, schedule.controllers, strict=True)
    )
    return [
        Section(
            title="Schedule",
            aside=f"{spec.structure} on {spec.regulated} over {schedule.over} at {spec.sample_rate_hz:g} Hz, "
            f"{schedule.controllers[0].delays}",
            part="schedule",
            sentences=("The gains are interpolated between the points.",),
            tables=(Table(label="Gains at the points", head=head, rows=rows, align=">" * (len(head) - 1) + "<"),),
            remarks=(
                _describe_between(schedule),
                *describe_plants_at_points(schedule),
                *describe_surroundings(schedule.controllers[0]),
            ),
        ),
        *list_notes("the schedule", schedule.notes),
    ]


def _describe_between(schedule: ScheduledController) -> str:
    bands = [figures.bandwidth_hz or 0.0 for figures in schedule.between]
    if not bands:
        return "Nothing was computed between the points."
    return (
        f"Between the points, at {format_count(len(bands), 'value')}: bandwidth {min(bands):.4g} to {max(bands):.4g} "
        f"Hz, Ms up to {max(figures.ms for figures in schedule.between):.3f}, Mt up to "
        f"{max(figures.mt for figures in schedule.between):.3f}."
    )


def describe_plants_at_points(schedule: ScheduledController) -> list[str]:
    """Return that draws and other plants say nothing between the points; nothing where there are none."""
    names = list(schedule.plants_at_points)
    if not names:
        return []
    more = f" and {format_count(len(names) - 1, 'more plant')}" if len(names) > 1 else ""
    return [f"Not judged between the points, only at them: {names[0]}{more}; a certificate draws there too."]
