"""A sweep of bandwidths in words: a row per bandwidth, which limits are missed at which, and what the columns mean."""

from __future__ import annotations

from seaopt.control import Frontier, ScheduledController
from seaopt.control.frontier.rows import FrontierRow
from seaopt.control.laws.verdict import shorten_blocked
from seaopt.formatting import MISSING, format_number, join_words
from seaopt.reporting.sections.data import Section, Table, mark_met
from seaopt.reporting.sections.kinds.schedule import describe_plants_at_points
from seaopt.units import Mechanics

OBJECTIVES = {"disturbance": "integral of |S| over ln f from 0.1 Hz to the bandwidth", "noise": "noise"}


def describe(frontier: Frontier) -> list[Section]:
    """Return one section: the table, the limits that are missed, the columns."""
    called = frontier.mechanics
    rows = tuple(
        (
            f"{row.bandwidth_hz:g}",
            mark_met(row.met, "yes", "no"),
            format_number(row.noise_gain, 3),
            format_number(row.ms),
            _name_worst(frontier, row),
            format_number(row.sensitivity_bandwidth_hz, 3),
            format_number(row.phase_margin_deg, 3),
            format_number(row.force_limit_N),
            describe_friction_cost(row),
            describe_structure_cost(row),
            format_number(row.disturbance),
        )
        for row in frontier.rows
    )
    limit = f"limit {called.unit}"
    head = ("Hz", "met", "noise", "Ms", "worst on", "|S| Hz", "phase °", limit, "friction", "free law", "disturbance")
    blocked: dict[str, list[str]] = {}
    for row in frontier.rows:
        if row.blocked_by:
            blocked.setdefault(shorten_blocked(row.blocked_by), []).append(f"{row.bandwidth_hz:g}")
    return [
        Section(
            title="Bandwidths",
            part="frontier",
            tables=(Table(head=head, rows=rows, align="><>><>>>>>>", optional=("disturbance",)),),
            remarks=(
                *(f"not met at {join_words(bands)} Hz: {text}" for text, bands in blocked.items()),
                _explain_columns(frontier, called),
                *_describe_plants_at_points(frontier),
            ),
        )
    ]


def _name_worst(frontier: Frontier, row: FrontierRow) -> str:
    """Return the plant with the largest Ms, and of a schedule where."""
    return row.ms_plant if row.ms_place is None else f"{row.ms_plant}, {frontier.over} = {row.ms_place:.4g}"


def _describe_plants_at_points(frontier: Frontier) -> list[str]:
    """Return what a schedule's rows do not say, of the first: all have the same plants."""
    first = frontier.controllers[0] if frontier.controllers else None
    return describe_plants_at_points(first) if isinstance(first, ScheduledController) else []


def _explain_columns(frontier: Frontier, called: Mechanics) -> str:
    free = next((row.free_law for row in frontier.rows if row.free_law is not None), None)
    columns = [
        f"noise: peak of |F_m/noise on the {called.word}|, {called.gain}; Ms: of the worst plant; |S| Hz: below -3 dB "
        "up to this frequency; limit: largest reference at that frequency before the command saturates"
    ]
    if frontier.over is not None:
        columns.append("each of the point, or of the value between points, where it is worst")
    if any(row.without_sticking is not None for row in frontier.rows):
        columns.append("friction: by how much it raises the integral of |S|")
    if free is not None:
        columns.append(
            f"free law: the least {OBJECTIVES[free.objective]} of any linear law on the design plant alone, and by how "
            "much the tuned law exceeds it"
        )
    return "; ".join(columns)


def describe_structure_cost(row: FrontierRow) -> str:
    """Return the value of the objective that a free law has and by how much this is above, or that none is possible."""
    free = row.free_law
    if free is None or free.bound is None:
        return "impossible" if free is not None and free.status == "impossible" else MISSING
    tuned = row.disturbance if free.objective == "disturbance" else row.noise_gain
    above = f" ({100.0 * (tuned / free.bound - 1.0):+.0f} %)" if row.met else ""
    return f"{format_number(free.bound)}{above}"


def describe_friction_cost(row: FrontierRow) -> str:
    """Return by how much friction raises the disturbance, or that it alone makes a bandwidth impossible."""
    alone = row.without_sticking
    if alone is None or not alone.met:
        return MISSING
    return f"{100.0 * (row.disturbance / alone.disturbance - 1.0):+.0f} %" if row.met else "all of it"
