"""Simulated runs in words: their verdict, the worst run of each scenario, what failed and what was not played."""

from __future__ import annotations

import math
from collections.abc import Iterator

from seaopt.formatting import format_count, format_number, format_percent, format_values
from seaopt.reporting.sections.data import Commands, Item, KeyFigure, Reason, Section, Table, Verdict, mark_met
from seaopt.robustness.verification.judgement import NOMINAL, Outcome
from seaopt.robustness.verification.verification import Verification
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


def summarise(verification: Verification) -> list[KeyFigure]:
    """Return how many runs failed."""
    failed = f"{len(verification.failures)} of {len(verification.rows)}"
    return [KeyFigure(name="runs failed", value=failed, against="simulated, nonlinear")]


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
                *_list_draws(verification),
                *(f"{line}." for line in describe_tracking(verification)),
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
            "" if row.overshoot is None else format_percent(row.overshoot),
            format_number(row.settling_s, 3),
            format_number(row.peak_command, 3),
            format_percent(row.saturated),
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
        f"{row.plant}, {row.scenario}, draw {row.draw}: {row.reason}"
        + "".join(f"; {name} = {value:.6g}" for name, value in row.parameters.items())
        + (f" (and {format_count(len(more), 'more such run')})" if more else "")
        for row, *more in kinds.values()
    ]


def _list_draws(verification: Verification) -> Iterator[str]:
    """Yield where each draw differs from nominal."""
    rows = {(row.plant, row.draw): row for row in verification.rows if row.draw != NOMINAL}
    for row in rows.values():
        yield f"Draw {row.draw} on {row.plant}: {format_values(row.parameters, 6, NOMINAL)}."


def describe_drawings(verification: Verification, plant: str) -> str:
    """Return what the colours in the figures of a plant's runs mean, and which part of a run they show."""
    rows = [row for row in verification.worst() if row.plant == plant]
    meanings = {
        "Grey: link 2 is held.": any(phase.held for row in rows for phase in verification.scenario(row).phases),
        "Of a run that passed the end of the last phase is left out, as its title says.": any(row.met for row in rows),
        "A run that failed is drawn whole, the judged window in yellow.": not all(row.met for row in rows),
    }
    return " ".join(text for text, applies in meanings.items() if applies)


def describe_tracking(verification: Verification) -> Iterator[str]:
    """Yield a line per plant whose moving output keeps the force from following slow references."""
    for name, band in verification.follows_hz.items():
        if not verification.rigs[name].plant.moves:
            continue
        if band is None:
            yield f"{name} tracks no reference within 3 dB: the swinging output prevents it"
        elif band[0] > 0.0:
            yield (
                f"{name} tracks references between {band[0]:.3g} and {band[1]:.3g} Hz (within 3 dB); below that the "
                "swinging output prevents it"
            )


def describe_steps(verification: Verification) -> Iterator[str]:
    """Yield a line per plant on which steps are judged: the worst that its user sees of them."""
    for plant in verification.rigs:
        rows = [row for row in verification.rows if row.plant == plant and row.settling_s is not None]
        if not rows:
            continue
        over, more = (
            max((row.overshoot or 0.0 for row in rows if row.overshoot_by_limit is by_limit), default=0.0)
            for by_limit in (False, True)
        )
        limited = f" ({format_percent(more)} where the current limit makes it)" if more else ""
        slowest = max(row.settling_s or 0.0 for row in rows)
        sizes = [verification.scenario(row).phases[-1].force_N for row in rows]
        settled = f"settled after {slowest:.3g} s" if math.isfinite(slowest) else "NOT settled"
        ends = " to ".join(dict.fromkeys(f"{size:.4g}" for size in (min(sizes), max(sizes))))
        unit = verification.command.reference_unit
        yield f"steps on {plant}, {ends} {unit}: overshoot up to {format_percent(over)}{limited}, {settled}"
