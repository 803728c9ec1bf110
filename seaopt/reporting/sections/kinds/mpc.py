"""Predictive control in words: its verdict, the limits it plans within, and its loop while no limit is active."""

from __future__ import annotations

from seaopt.control import ForceMPC
from seaopt.control.laws.verdict import join_limits
from seaopt.formatting import format_count, format_number
from seaopt.reporting.sections.data import Commands, Reason, Section, Table, Verdict, list_notes, mark_met, show_limit
from seaopt.units import unit_after


def judge(mpc: ForceMPC, commands: Commands) -> Verdict:
    """Return the verdict on a predictive controller: the limits of its loop while no limit of its plan is active."""
    name = f"Predictive control: {mpc.measured}, {mpc.spec.bandwidth_hz:g} Hz"
    if mpc.met:
        return Verdict(met=True, text=f"{name}, every limit met")
    return Verdict(
        met=False,
        text=f"{name}, {format_count(len(mpc.broken), 'limit')} not met: {join_limits(mpc.broken)}",
        reasons=(Reason(what=mpc.explanation),),
    )


def describe(mpc: ForceMPC) -> list[Section]:
    """Return the limits of the plan, the loop's limits with what was achieved, and the findings."""
    spec, unit = mpc.spec, mpc.design[0].outputs[mpc.spec.measured]
    slew, per_second = spec.slew_asked, f"{unit_after(mpc.actuation.unit) or ' 1'}/s"
    limits = mpc.actuation.show(mpc.command_limit) + ("" if slew is None else f", {slew:g}{per_second}")
    bounds = [
        f"{name} within {low:g} and {high:g} {mpc.kalman.units[mpc.kalman.names.index(name)]}".rstrip()
        for name, (low, high) in spec.bounds.items()
    ]
    loops = {loop.name: loop for loop in mpc.measured_loops}
    rows = tuple(
        (
            verdict.plant,
            verdict.limit.label,
            format_number(verdict.value),
            show_limit(verdict.limit.symbol, verdict.allowed, verdict.limit.tolerance),
            loops[verdict.plant].unit(verdict.limit),
            mark_met(verdict.met),
        )
        for verdict in mpc.verdicts
    )
    head = ("plant", "limit", "achieved", "asked", "unit", "")
    table = Table(label="Limits of predictive control", head=head, rows=rows, align="<<>><<")
    return [
        Section(
            title="Predictive control",
            aside=f"{spec.measured} of {mpc.design[0].name} at {spec.sample_rate_hz:g} Hz, {mpc.delays}",
            part="mpc",
            sentences=(
                f"Plans within {limits}, enough to hold {mpc.static_gain * mpc.command_limit:.4g} {unit}; horizon "
                f"{1e3 * spec.horizon_s:g} ms, {mpc.prediction.knots.size} moves.",
                *bounds,
            ),
            tables=(table,),
            remarks=(
                f"The figures hold while no limit of the {mpc.actuation.word} is active.",
                f"Bandwidth {format_number(mpc.achieved.bandwidth_hz, missing='none')} Hz, asked "
                f"{spec.bandwidth_hz:g} Hz.",
                # the margins of each loop of the design plant: with friction sliding and stuck
                *(
                    f"{loop.name}: bandwidth {format_number(loop.figures.bandwidth_hz, missing='none')} Hz, "
                    f"{loop.figures.describe_peaks()}; {loop.figures.describe_margins()}."
                    for loop in mpc.measured_loops
                ),
            ),
        ),
        *list_notes("predictive control", mpc.notes),
    ]
