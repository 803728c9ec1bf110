"""What is said first: whether each stage is met, and if not, why; the same failure once, with a count."""

from __future__ import annotations

from collections.abc import Sequence

from seaopt.control import Controller, ForceMPC
from seaopt.control.laws.verdict import join_labels
from seaopt.estimation import Fit
from seaopt.formatting import format_count, format_number
from seaopt.records import record
from seaopt.reporting.figures.certificate import label_requirement, usage_of
from seaopt.robustness import Certificate
from seaopt.robustness.certificate.certificate import Requirement
from seaopt.robustness.verification.verification import Verification

Line = tuple[bool, str]


@record
class Failure:
    """Requirements of one name that are not met: the worst of them, and how many there are."""

    worst: Requirement
    count: int

    @property
    def label(self) -> str:
        """What is missed."""
        return label_requirement(self.worst)

    @property
    def text(self) -> str:
        """The figure against its limit, where, and how many more there are."""
        row, more = self.worst, self.count - 1
        against = {"≤": "above", "≥": "below"}.get(row.sense, "not")
        others = "" if not more else f" (the worst of {self.count})"
        size = f"{format_number(row.value)}, {against} {format_number(row.limit)}"
        return f"{self.label} {size}{others}: {row.where}"


def group_failures(requirements: Sequence[Requirement]) -> list[Failure]:
    """Return what is not met, each kind once with its worst case and its count, the worst first."""
    kinds: dict[str, list[Requirement]] = {}
    for row in requirements:
        if not row.met:
            kinds.setdefault(row.name, []).append(row)
    failures = [
        Failure(worst=max(rows, key=lambda row: usage_of(row) or 0.0), count=len(rows)) for rows in kinds.values()
    ]
    return sorted(failures, key=lambda one: -(usage_of(one.worst) or 0.0))


def verdict(
    fit: Fit | None, controller: Controller | None, certificate: Certificate | None,
    verification: Verification | None = None, mpc: ForceMPC | None = None,
) -> list[Line]:  # fmt: skip
    """Return one line per stage: whether it is met, and what to say."""
    lines: list[Line] = []
    if fit is not None:
        lines.append((fit.met, f"Fit: {fit.verdict}"))
    if controller is not None:
        what = "every limit met" if controller.feasible else "not met: " + join_labels(controller.active_constraints)
        lines.append((controller.feasible, f"Controller at {controller.spec.bandwidth_hz:g} Hz: {what}"))
    if mpc is not None:
        what = "every limit met" if mpc.feasible else f"not met: {join_labels(mpc.broken)}"
        lines.append((mpc.feasible, f"Predictive control at {mpc.spec.bandwidth_hz:g} Hz: {what}"))
    if certificate is not None:
        lines.append((certificate.passed, f"Certificate: {_describe_certificate(certificate)}"))
    if verification is not None:
        failed = dict.fromkeys(f"{row.scenario} on {row.plant}" for row in verification.failures)
        what = "failed – " + ", ".join(failed) if failed else f"{len(verification.rows)} runs passed"
        lines.append((verification.passed, f"Simulation: {what}"))
    return lines


def _describe_certificate(certificate: Certificate) -> str:
    """Return what a certificate says in one line: the bound of its draws, or what it fails on."""
    draws = certificate.monte_carlo
    if not certificate.passed:
        kinds = [f"{one.label}{f' ({one.count} times)' if one.count > 1 else ''}"
                 for one in group_failures(certificate.requirements)]  # fmt: skip
        return "failed – " + ", ".join(kinds)
    runs = "" if certificate.runs is None else f", {len(certificate.runs.rows)} simulations passed"
    if not draws.samples:
        return f"passed – nothing was uncertain, so that nothing was drawn{runs}"
    return (
        f"passed – {format_count(draws.failures, 'failure')} in {draws.samples} draws, failure probability below "
        f"{draws.failure_probability_bound:.3g}{runs}"
    )
