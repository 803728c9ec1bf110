"""What is said first: whether each stage is met, and if not, why; the same failure once, with a count."""

from __future__ import annotations

from seaopt.control import Controller, ForceMPC
from seaopt.control.laws.verdict import join_labels
from seaopt.estimation import Fit
from seaopt.formatting import format_count, format_number, join_words
from seaopt.reporting.figures.certificate import label_requirement
from seaopt.robustness import Certificate
from seaopt.robustness.certificate.failures import Failure, group_failures
from seaopt.robustness.verification.verification import Verification

Line = tuple[bool, str]


def label_failure(failure: Failure) -> str:
    """Return what is missed."""
    return f"unstable on {join_words(failure.places)}" if failure.unstable else label_requirement(failure.worst)


def describe_failure(failure: Failure) -> str:
    """Return the figure against its limit, where, and how many more there are."""
    row = failure.worst
    if failure.unstable:
        return label_failure(failure) + failure.consequence
    against = {"≤": "above", "≥": "below"}.get(row.sense, "not")
    others = f" (the worst of {failure.count})" if failure.count > 1 else ""
    size = f"{format_number(row.value)}, {against} {format_number(row.limit)}"
    return f"{label_failure(failure)} {size}{others}: {row.where}"


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
        kinds = [label_failure(one) + (f" ({one.count} times)" if one.count > 1 and not one.unstable else "")
                 for one in group_failures(certificate.requirements)]  # fmt: skip
        return "failed – " + ", ".join(kinds)
    runs = "" if certificate.runs is None else f", {len(certificate.runs.rows)} simulations passed"
    if not draws.samples:
        return f"passed – nothing was uncertain, so that nothing was drawn{runs}"
    return (
        f"passed – {format_count(draws.failures, 'failure')} in {draws.samples} draws, failure probability below "
        f"{draws.failure_probability_bound:.3g}{runs}"
    )
