"""Simulated runs in words: their verdict, the worst run of each scenario, what failed and what was not played."""

from __future__ import annotations

import math

from seaopt.formatting import format_count, format_number
from seaopt.reporting.sections.data import Commands, Item, Reason, Section, Table, Verdict, mark_met
from seaopt.robustness.verification.judgement import Outcome
from seaopt.robustness.verification.verification import Verification, describe_witness
from seaopt.units import unit_after


def judge(verification: Verification, commands: Commands) -> Verdict:
    """Return the verdict on simulated runs: each kind of failure once."""
    count, failed = len(verification.rows), verification.failures
    if not failed:
        return Verdict(met=True, text=f"Simulation: {format_count(count, 'run')} passed")
    kinds: dict[str, list[str]] = {}
    for row in failed:
        kinds.setdefault(row.reason, []).append(f"{row.plant}, {row.scenario}")
    reasons = [Reason(what=what, where=places[0], count=len(places)) for what, places in kinds.items()]
    return Verdict(
        met=False, text=f"Simulation: {len(failed)} of {format_count(count, 'run')} failed", reasons=tuple(reasons)
    )


def describe(verification: Verification) -> list[Section]:
    """Return the worst run of each scenario on each plant, the failures, and what was not played."""
    word = verification.mechanics.word
    speeds = ", ".join(f"{name} {value:.0f}" for name, value in verification.real_time_factor.items())
    return [
        Section(
            title="Simulated runs",
            part="simulation",
            sentences=(
                "The controller as exported, sampled, delayed, rounded and limited, on the plants with friction and "
                f"large angles. For each scenario the run that failed, or has the largest {word}, of "
                f"{format_count(len(verification.rows), 'run')}; seed {verification.seed}.",
            ),
            tables=(_tabulate_worst(verification),),
            remarks=(
                *(f"{line}." for line in verification.describe_draws()),
                *(f"{line}." for line in verification.describe_tracking()),
                *([f"Simulated seconds per second: {speeds}."] if speeds else []),
            ),
            items=(
                *(Item(severity="error", text=text) for text in _list_failures(verification)),
                *(
                    Item(severity="note", text=f"not played: {scenario} on {plant}, {reason}")
                    for scenario, plant, reason in verification.skipped
                ),
            ),
        )
    ]


def _tabulate_worst(verification: Verification) -> Table:
    called, command = verification.mechanics, verification.command
    rows = tuple(
        (
            f"{row.plant}, {row.scenario}",
            verification.scenario(row).describe_size(called),
            mark_met(row.met, "passed", "FAILED"),
            f"{row.peak_force_N:.4g}",
            format_number(row.final_error_N, 3),
            format_number(verification.scenario(row).final_error, 3),
            "" if row.overshoot is None else f"{100 * row.overshoot:.3g} %",
            format_number(row.settling_s, 3),
            format_number(row.peak_current_A, 3),
            f"{100 * row.saturated:.3g} %",
            format_number(None if row.peak_angle_rad is None else math.degrees(row.peak_angle_rad), 3),
            format_number(row.peak_energy_J, 3),
            format_number(row.limit_cycle_N, 3),
            format_number(row.limit_cycle_hz),
            row.draw,
        )
        for row in verification.worst()
    )
    unit = called.unit
    head = (
        *("run", "size", "", f"{called.word} {unit}", f"ends off {unit}", f"allowed {unit}", "overshoot", "settles s"),
        *(f"{command.word}{unit_after(command.unit)}", "at limit", "angle deg", "energy J"),
        *(f"limit cycle {unit}", "cycle Hz", "draw"),
    )
    return Table(head=head, rows=rows, align="<<<>>>>>>>>>>><")


def _list_failures(verification: Verification) -> list[str]:
    """Return what failed: the same kind of fault on a plant once, with its first run and a count."""
    kinds: dict[tuple[str, str], list[Outcome]] = {}
    for row in verification.failures:
        kinds.setdefault((row.plant, row.faults[0].kind if row.faults else row.reason), []).append(row)
    return [
        f"{row.plant}, {row.scenario}, draw {row.draw}: {row.reason}{describe_witness(row)}"
        + (f" (and {format_count(len(more), 'more such run')})" if more else "")
        for row, *more in kinds.values()
    ]
