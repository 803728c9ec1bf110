"""The certificate of a schedule in words: its verdict, and the figures at every value of the variable."""

from __future__ import annotations

from seaopt.formatting import format_count
from seaopt.reporting.sections.data import Commands, Section, Table, Verdict, list_notes
from seaopt.reporting.sections.kinds.certificate import advise, explain_failure
from seaopt.robustness import ScheduleCertificate
from seaopt.robustness.certificate.requirement import group_failures
from seaopt.units import unit_after


def judge(certificate: ScheduleCertificate, commands: Commands) -> Verdict:
    """Return the verdict on a schedule's certificate, with its assumption."""
    draws = certificate.monte_carlo
    if certificate.met:
        drawn = (
            f"{format_count(draws.failures, 'failure')} in {draws.samples} draws"
            if draws.samples
            else "nothing was uncertain, so that nothing was drawn"
        )
        rate = f"{certificate.fastest:.3g} {certificate.rate_unit}"
        swept = f"; {certificate.schedule.over} up to {rate} in sweeps" if certificate.sweeps else ""
        still = f"{certificate.schedule.over} standing still"
        return Verdict(met=True, text=f"Certificate: passed with {still}, {drawn}{swept}")
    broken = [row for row in certificate.requirements if not row.met]
    laws, models = certificate.schedule.controllers, certificate.places[0].models
    reasons = tuple(explain_failure(failure, *laws, models=models) for failure in group_failures(broken))
    command = f"type {commands.certify}" if commands.certify else "tune again"
    remedies = (row.remedy or advise(row, *laws, models=models) for row in broken)
    change = next((text for text in remedies if text), "raise reserve, or add points")
    return Verdict(
        met=False,
        text=f"Certificate: failed, {len(broken)} of {len(certificate.requirements)} requirements not met",
        reasons=reasons,
        next=(certificate.schedule.remedy or f"{change}; then {command}",),
    )


def describe(certificate: ScheduleCertificate) -> list[Section]:
    """Return the figures at every value of the schedule's variable, the draws, and the findings."""
    rows: list[tuple[str, ...]] = []
    for value, place in zip(certificate.values, certificate.places, strict=True):
        rows.append(
            (
                f"{value:.4g}",
                "point" if value in certificate.schedule.points else "between",
                f"{max(figures.ms for figures in place.plants.values()):.3f}",
                f"{max(figures.mt for figures in place.plants.values()):.3f}",
                f"{max(case.ms for case in place.worst.values()):.3f}",
                f"{place.monte_carlo.failures} of {place.monte_carlo.samples}",
            )
        )
    variable = f"{certificate.schedule.over}{unit_after(certificate.schedule.unit)}"
    head = (variable, "", "Ms", "Mt", "worst Ms", "draws that fail")
    return [
        Section(
            title="What is certified",
            aside=certificate.monte_carlo.count_text,
            part="schedule",
            tables=(Table(head=head, rows=tuple(rows), align="><>>>>"),),
            remarks=(f"{certificate.monte_carlo}.",),
        ),
        *list_notes("the schedule's certificate", certificate.notes),
    ]
