"""Simulated runs in words: their verdict."""

from __future__ import annotations

from seaopt.formatting import format_count
from seaopt.reporting.sections.data import Commands, Reason, Verdict
from seaopt.robustness.verification.verification import Verification


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
