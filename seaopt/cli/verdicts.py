"""The verdict of each stage for the terminal: one line, then what is not met, each once, and what to type next."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

from seaopt.control import Controller
from seaopt.control.laws.limits import BY_REQUIREMENT
from seaopt.control.laws.verdict import join_labels
from seaopt.estimation import Fit
from seaopt.estimation.result.findings import FitFinding
from seaopt.formatting import format_count, format_number
from seaopt.records import record
from seaopt.robustness import Certificate
from seaopt.robustness.certificate.failures import Failure, group_failures

FROM_DRAWS = ("monte_carlo_failures", "worst_case", "max_failure_probability")
DELAY_ROOM = 5.0  # times a delay that was found, up to which it may go
SWEEP_SPREAD = (0.6, 1.6)  # of the bandwidth asked, that a sweep for another one spans
REMEDIES = {
    **dict.fromkeys(FROM_DRAWS, "retune = 4 in [robustness] tunes for the worst cases, too"),
    "step_overshoot": "lower max_reference_peak in [controller]",
    "step_settling_s": "another bandwidth_hz in [controller], or a sample_rate_hz that is higher",
    "steady_error": "another bandwidth_hz in [controller], or a sample_rate_hz that is higher",
    "sustained_oscillation": "a lower bandwidth_hz, or min_friction_margin in [controller]",
    "impedance_stable": "less stiffness, or more damping, in [impedance]",
    "impedance_damper": "other stiffness, damping or velocity_filter_s in [impedance], inside the region of the report",
    "limit_cycle": "a lower bandwidth_hz, or min_friction_margin in [controller]",
}


@record
class Reason:
    """One thing that is not met; of `count` places it is in, `where` is the worst."""

    what: str
    where: str
    count: int = 1


@record
class StageVerdict:
    """Whether a stage is met, in one line; why not; and the commands, or lines of the file, that come next."""

    met: bool
    text: str
    reasons: tuple[Reason, ...] = ()
    next: tuple[str, ...] = ()


def judge_fit(fit: Fit, again: str) -> StageVerdict:
    """Return the verdict on a fit; `again` is the command that fits."""
    size = f"{fit.samples} samples"
    percents = [one.fit_percent for row in fit.outputs.values() for one in row.values()]
    if fit.met:
        ends = list(dict.fromkeys(f"{end:.1f}" for end in (min(percents), max(percents)))) if percents else []
        return StageVerdict(met=True, text=f"Fit: converged, {size}, outputs fit to {' to '.join(ends)} %")
    status = "" if fit.status == "converged" else f"{fit.status.replace('_', ' ')}, "
    errors = [(one.text, one.where) for one in fit.errors]
    if fit.status != "converged" and not any(fit.message in text for text, _ in errors):
        errors.insert(0, (fit.message, ""))
    reasons = _group(errors)
    return StageVerdict(
        met=False, text=f"Fit: {status}{size}, {format_count(len(reasons), 'reason')} why it is not met",
        reasons=tuple(reasons), next=(*_list_cures(fit.errors), f"correct the file, then type {again}"),
    )  # fmt: skip


def _list_cures(errors: Sequence[FitFinding]) -> tuple[str, ...]:
    """Return the lines to write for the likely cause that is named first."""
    cause = next((one for one in errors if one.kind == "cause" and one.preferred), None)
    if cause is None:
        return ()
    return tuple(filter(None, (spell_cure(name, value) for name, (value, _) in cause.preferred.items())))


def spell_cure(name: str, value: float) -> str:
    """Return the line of a problem file that frees what a log would have otherwise; "" where there is no such line.

    Examples
    --------
    >>> spell_cure("chirp.delay_s", 0.004), spell_cure("f_c", 12.0)
    ('delay_s = { value = 0.004, free = true, max = 0.02 } in the [[experiment]] chirp', 'f_c = { value = 12, free = true } in [parameters]')

    """  # noqa: E501
    *of, own = name.split(".")
    if not of:
        return f"{own} = {{ value = {value:.4g}, free = true }} in [parameters]"
    if own == "delay_s" and value > 0.0:
        longest = DELAY_ROOM * value
        return f"delay_s = {{ value = {value:.4g}, free = true, max = {longest:.2g} }} in the [[experiment]] {of[0]}"
    return ""


def judge_controller(controller: Controller, sweep: str) -> StageVerdict:
    """Return the verdict on a tuned controller; `sweep` is the command that tunes at a range of bandwidths."""
    spec = controller.spec
    name = f"Controller: {controller.structure} on {spec.regulated}, {spec.bandwidth_hz:g} Hz"
    if controller.feasible:
        on = " on measured points" if controller.design is None else ""
        return StageVerdict(met=True, text=f"{name}, every limit met{on}")
    blocked = controller.blocked_by or (join_labels(controller.active_constraints),)
    reasons = [Reason(what=text, where="") for text in blocked]
    return StageVerdict(
        met=False, text=f"{name}, {format_count(len(reasons), 'limit')} not met", reasons=tuple(reasons),
        next=_advise_bandwidth(controller, sweep),
    )  # fmt: skip


def _advise_bandwidth(controller: Controller, sweep: str) -> tuple[str, ...]:
    """Return the line of the file with a bandwidth that is possible, or how to look for what is."""
    possible, asked = controller.possible, controller.spec.bandwidth_hz
    look = f"{sweep} {_range_about(asked)}"
    if possible is None:
        return (f"to see what other bandwidths cost type {look}",)
    text = str(possible)
    if possible.nearest_hz:
        nearest = min(possible.nearest_hz, key=lambda hz: abs(hz - asked))
        return (text, f"bandwidth_hz = {nearest:.4g} in [controller], or to see what each costs type {look}")
    return (text, f"raise max_sensitivity, or max_noise_gain, in [controller]; to see what each costs type {look}")


def _range_about(asked: float) -> str:
    low, high = (factor * asked for factor in SWEEP_SPREAD)
    step = max(float(f"{(high - low) / 6:.1g}"), 0.1)
    return f"{step * math.floor(low / step):.4g}:{step * math.ceil(high / step):.4g}:{step:.4g}"


def judge_certificate(certificate: Certificate, again: str, sweep: str) -> StageVerdict:
    """Return the verdict on a certificate; the commands are those that run it again, and tune at other bandwidths."""
    draws = certificate.monte_carlo
    if certificate.passed:
        runs = "" if certificate.runs is None else f", {len(certificate.runs.rows)} simulated runs passed"
        bound = f", failure probability below {draws.failure_probability_bound:.2g}" if draws.samples else ""
        text = f"Certificate: passed, {draws.failures} failures in {draws.samples} draws{bound}{runs}"
        return StageVerdict(met=True, text=text)
    broken = [row for row in certificate.requirements if not row.met]
    reasons = [explain_failure(one) for one in group_failures(broken)]
    remedies = [_advise(row.name) for row in broken]
    first = next((text for text in remedies if text), "")
    command = f"type {again}" if not first else f"{first}; then type {again}"
    return StageVerdict(
        met=False, text=f"Certificate: failed, {len(broken)} of {len(certificate.requirements)} requirements not met",
        reasons=tuple(reasons),
        next=(command, f"to see what other bandwidths cost type {sweep} "
              f"{_range_about(certificate.controller.spec.bandwidth_hz)}"),
    )  # fmt: skip


def _advise(name: str) -> str:
    return BY_REQUIREMENT[name].remedy if name in BY_REQUIREMENT else REMEDIES.get(name, "")


def explain_failure(failure: Failure) -> Reason:
    """Return what a certificate fails on, by its worst case."""
    row = failure.worst
    if failure.unstable:
        what = f"unstable on {', '.join(failure.places)}"
        return Reason(what=what, where=f"tune with that plant in robust_to{failure.consequence}")
    value, limit = format_number(row.value, 4), format_number(row.limit, 4)
    return Reason(what=f"{row.name} {value}, limit {row.sense} {limit}", where=row.where, count=failure.count)


def _group(pairs: Iterable[tuple[str, str]]) -> list[Reason]:
    """Return each text once, with the places that it is said of."""
    places: dict[str, list[str]] = {}
    for text, where in pairs:
        places.setdefault(text, []).append(where)
    return [
        Reason(what=", ".join(dict.fromkeys(filter(None, where[:3]))) or "the fit", where=text, count=len(where))
        for text, where in places.items()
    ]
