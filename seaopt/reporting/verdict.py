"""The verdict of each stage, for terminal and report alike: one line, why not, each once, and what comes next."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace

from seaopt.control import Controller, ForceMPC, ScheduledController
from seaopt.control.laws.limits import BY_REQUIREMENT
from seaopt.control.laws.verdict import join_labels
from seaopt.estimation import Fit
from seaopt.estimation.result.findings import FitFinding
from seaopt.formatting import format_count, format_number
from seaopt.records import record
from seaopt.robustness import Certificate, ScheduleCertificate
from seaopt.robustness.certificate.certificate import NO_MODEL
from seaopt.robustness.certificate.failures import Failure, group_failures
from seaopt.robustness.certificate.scheduled import MOTION_RATE
from seaopt.robustness.verification.verification import Verification

UNMET = "on a fit that is not met"
FROM_DRAWS = ("monte_carlo_failures", "worst_case", "max_failure_probability")
RESOLVED = 2.0  # standard deviations by which a value differs from zero, to be proposed
DELAY_ROOM = 5.0  # times a delay that was found, up to which it may go
MOST_PLACES = 3  # that a reason names
SWEEP_SPREAD = (0.6, 1.6)  # of the bandwidth asked, that a sweep for another one spans
RETUNE = "retune = 4 in [robustness] tunes for the worst cases, too"
REPLAN = "a lower bandwidth_hz in [controller], or narrower ranges in [robustness]"  # what plans is not tuned again
REMEDIES = {
    **dict.fromkeys(FROM_DRAWS, RETUNE),
    "step_overshoot": "lower max_reference_peak in [controller]",
    "step_settling_s": "another bandwidth_hz in [controller], or a sample_rate_hz that is higher",
    "steady_error": "another bandwidth_hz in [controller], or a sample_rate_hz that is higher",
    "sustained_oscillation": "a lower bandwidth_hz, or min_friction_margin in [controller]",
    "impedance_stable": "less stiffness, or more damping, in [impedance]",
    "impedance_rest": "less stiffness, or more damping, in [impedance]",
    "impedance_draws": "less stiffness, or more damping, in [impedance]",
    "impedance_damper": "other stiffness, damping or velocity_filter_s in [impedance], inside the region of the report",
    "gravity_compensation": "a smaller fraction of gravity in compensate of [controller], or an [impedance]",
    "ripple_compensation": "a smaller fraction of ripple, or fewer of its cycles, in compensate of [controller]",
    "friction_compensation": 'from = "reference", a larger speed or a smaller fraction in compensate of [controller]',
    "constrained_failure_probability": "more constrained_runs in [robustness]",
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


def judge_results(
    *,
    fit: Fit | None = None,
    controller: Controller | ScheduledController | None = None,
    mpc: ForceMPC | None = None,
    certificate: Certificate | ScheduleCertificate | None = None,
    verification: Verification | None = None,
    expectations: Sequence[tuple[bool, str]] = (),
) -> list[StageVerdict]:
    """Return the verdict on each result that there is; a design on a fit that is not met is not met either.

    Parameters
    ----------
    fit, controller, mpc, certificate, verification : optional
        Results, the later ones made with the earlier ones.
    expectations : sequence of (bool, str)
        Of a problem file: whether each is met, and what to say of it.

    Examples
    --------
    >>> import seaopt as so
    >>> controller = so.tune(so.plants.high_impedance(), so.plants.thor(), so.ControllerSpec(bandwidth_hz=30))
    >>> [one.text for one in judge_results(controller=controller)]
    ['Controller: pid on F1, 30 Hz, every limit met']

    """
    designs: list[StageVerdict] = []
    if controller is not None:
        scheduled = isinstance(controller, ScheduledController)
        designs.append(judge_schedule(controller) if scheduled else judge_controller(controller))
    if mpc is not None:
        designs.append(judge_mpc(mpc))
    if certificate is not None:
        swept = isinstance(certificate, ScheduleCertificate)
        designs.append(judge_schedule_certificate(certificate) if swept else judge_certificate(certificate))
    if verification is not None:
        designs.append(_judge_verification(verification))
    first = [] if fit is None else [judge_fit(fit)]
    sound = fit is None or fit.met
    judged = [*first, *(designs if sound else map(doubt_design, designs))]
    guesses = "" if fit is None else fit.guesses
    return [*(name_guesses(one, guesses) for one in judged), *judge_expectations(expectations)]


def name_guesses(verdict: StageVerdict, guesses: str) -> StageVerdict:
    """Return the verdict with the guesses that it rests on ("on 2 guesses: N_p, l"), where it is met."""
    return replace(verdict, text=f"{verdict.text}, {guesses}") if verdict.met and guesses else verdict


def doubt_design(verdict: StageVerdict) -> StageVerdict:
    """Return the verdict on a design as it is where the fit that it was made with is not met."""
    return replace(verdict, met=False, text=f"{verdict.text}, {UNMET}")


def judge_expectations(outcomes: Sequence[tuple[bool, str]]) -> list[StageVerdict]:
    """Return the verdict on what a problem file expects, in one line; none where it expects nothing."""
    if not outcomes:
        return []
    unmet = [Reason(what=text, where="") for met, text in outcomes if not met]
    text = f"Expectations: {len(outcomes) - len(unmet)} of {len(outcomes)} met"
    return [StageVerdict(met=not unmet, text=text, reasons=tuple(unmet))]


def judge_fit(fit: Fit, again: str = "") -> StageVerdict:
    """Return the verdict on a fit; `again` is the command that fits, where there is one."""
    size = f"{fit.samples} samples"
    percents = [one.fit_percent for row in fit.outputs.values() for one in row.values()]
    if fit.met:
        ends = list(dict.fromkeys(f"{end:.1f}" for end in (min(percents), max(percents)))) if percents else []
        outputs = f", outputs fit to {' to '.join(ends)} %" if ends else ""
        return StageVerdict(met=True, text=f"Fit: converged, {size}{outputs}")
    status = "" if fit.status == "converged" else f"{fit.status.replace('_', ' ')}, "
    errors = [(one.text, one.where) for one in fit.errors]
    if fit.status != "converged" and not any(fit.message in text for text, _ in errors):
        errors.insert(0, (fit.message, ""))
    reasons, cures = _group(errors), "; or ".join(_list_cures(fit.errors))
    return StageVerdict(
        met=False, text=f"Fit: {status}{size}, {format_count(len(reasons), 'reason')} why it is not met",
        reasons=tuple(reasons), next=(*([cures] if cures else []), f"correct the file, then type {again}"),
    )  # fmt: skip


def _list_cures(errors: Sequence[FitFinding]) -> tuple[str, ...]:
    """Return the lines to write for the likely cause that is named first.

    What is not told from zero is not to be freed: a search for how sharp friction is takes long and ends nowhere.
    """
    cause = next((one for one in errors if one.kind == "cause" and one.preferred), None)
    if cause is None:
        return ()
    apart = {name: value for name, (value, std) in cause.preferred.items() if abs(value) > RESOLVED * std}
    return tuple(filter(None, (spell_cure(name, value) for name, value in apart.items())))


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


def judge_controller(controller: Controller, sweep: str = "") -> StageVerdict:
    """Return the verdict on a controller; `sweep` is the command that tunes at a range of bandwidths, if there is."""
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


def judge_schedule(schedule: ScheduledController) -> StageVerdict:
    """Return the verdict on a schedule."""
    bands = sorted({f"{band:g}" for band in schedule.bandwidths_hz}, key=float)
    name = (
        f"Schedule: {schedule.spec.structure} on {schedule.spec.regulated} over {schedule.over} = "
        f"{schedule.points[0]:g} to {schedule.points[-1]:g}, {format_count(len(schedule.points), 'point')}, "
        f"{' to '.join(dict.fromkeys((bands[0], bands[-1])))} Hz"
    )
    if schedule.feasible:
        return StageVerdict(met=True, text=f"{name}, every limit met at the points and between them")
    reasons = tuple(Reason(what=text, where="") for text in schedule.broken)
    return StageVerdict(
        met=False, text=f"{name}, {format_count(len(reasons), 'limit')} not met", reasons=reasons,
        next=(schedule.remedy,),
    )  # fmt: skip


def judge_schedule_certificate(certificate: ScheduleCertificate, again: str = "") -> StageVerdict:
    """Return the verdict on a schedule's certificate, with its assumption; `again` is the command that repeats it."""
    draws = certificate.monte_carlo
    if certificate.passed:
        drawn = (
            f"{format_count(draws.failures, 'failure')} in {draws.samples} draws"
            if draws.samples else "nothing was uncertain, so that nothing was drawn"
        )  # fmt: skip
        rate = f"{certificate.fastest:.3g} {certificate.rate_unit}"
        swept = f"; {certificate.schedule.over} up to {rate} in sweeps" if certificate.sweeps else ""
        still = f"{certificate.schedule.over} standing still"
        return StageVerdict(met=True, text=f"Certificate: passed with {still}, {drawn}{swept}")
    broken = [row for row in certificate.requirements if not row.met]
    reasons = tuple(explain_failure(one) for one in group_failures(broken))
    command = f"type {again}" if again else "tune again"
    slow = all(row.name == MOTION_RATE and row.value > 0.0 for row in broken)  # 0 where it rings or departs
    change = "ask a smaller min_rate, or allow more current" if slow else "raise reserve, or add points"
    return StageVerdict(
        met=False, text=f"Certificate: failed, {len(broken)} of {len(certificate.requirements)} requirements not met",
        reasons=reasons, next=(certificate.schedule.remedy or f"{change}; then {command}",),
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


def judge_mpc(mpc: ForceMPC) -> StageVerdict:
    """Return the verdict on a predictive controller: the limits of its loop while none of its plan is active."""
    name = f"Predictive control: {mpc.measured}, {mpc.spec.bandwidth_hz:g} Hz"
    if mpc.feasible:
        return StageVerdict(met=True, text=f"{name}, every limit met")
    return StageVerdict(
        met=False, text=f"{name}, {format_count(len(mpc.broken), 'limit')} not met",
        reasons=(Reason(what=mpc.explanation, where=""),),
    )  # fmt: skip


def _judge_verification(verification: Verification) -> StageVerdict:
    count, failed = len(verification.rows), verification.failures
    if not failed:
        return StageVerdict(met=True, text=f"Simulation: {format_count(count, 'run')} passed")
    kinds: dict[str, list[str]] = {}
    for row in failed:
        kinds.setdefault(row.reason, []).append(f"{row.plant}, {row.scenario}")
    reasons = [Reason(what=what, where=places[0], count=len(places)) for what, places in kinds.items()]
    return StageVerdict(
        met=False, text=f"Simulation: {len(failed)} of {format_count(count, 'run')} failed", reasons=tuple(reasons)
    )


def judge_certificate(certificate: Certificate, again: str = "", sweep: str = "") -> StageVerdict:
    """Return the verdict on a certificate; the commands, if any, run it again and tune at other bandwidths."""
    draws = certificate.monte_carlo
    if certificate.passed:
        runs = "" if certificate.runs is None else f", {len(certificate.runs.rows)} simulated runs passed"
        if not certificate.models:
            return StageVerdict(met=True, text=f"Certificate: passed, {NO_MODEL}")
        if not draws.samples:
            text = f"Certificate: passed, nothing was uncertain, so that nothing was drawn{runs}"
            return StageVerdict(met=True, text=text, next=_advise_ranges(certificate) if again else ())
        bound = f", failure probability below {draws.failure_probability_bound:.2g}"
        text = f"Certificate: passed, {format_count(draws.failures, 'failure')} in {draws.samples} draws{bound}{runs}"
        return StageVerdict(met=True, text=text)
    broken = [row for row in certificate.requirements if not row.met]
    reasons = [explain_failure(one) for one in group_failures(broken)]
    remedies = [_advise(row.name) for row in broken]
    if certificate.constrained is not None:
        remedies = [certificate.constrained.remedy, *(REPLAN if text == RETUNE else text for text in remedies)]
    first = next((text for text in remedies if text), "")
    command = f"type {again}" if not first else f"{first}; then type {again}"
    near, swept = _range_about(certificate.controller.spec.bandwidth_hz), certificate.constrained is None
    return StageVerdict(
        met=False, text=f"Certificate: failed, {len(broken)} of {len(certificate.requirements)} requirements not met",
        reasons=tuple(reasons),
        next=(command, *([f"to see what other bandwidths cost type {sweep} {near}"] if swept else ())),
    )  # fmt: skip


def _advise_ranges(certificate: Certificate) -> tuple[str, ...]:
    """Return the line of the file that makes something uncertain: a tenth about the first parameter that is not 0."""
    for plant in certificate.linear_models.values():
        for name in plant.parameters:
            value = certificate.parameters[name].value if name in certificate.parameters else 0.0
            if value:
                low, high = sorted((0.9 * value, 1.1 * value))
                return (f"to certify what is not known well add parameters = {{ {name} = [{low:.3g}, {high:.3g}] }} "
                        "to [robustness]",)  # fmt: skip
    return ()


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
    reasons: list[Reason] = []
    for text, where in places.items():
        named = list(dict.fromkeys(filter(None, where)))
        what = ", ".join(named[:MOST_PLACES]) or "the fit"
        reasons.append(Reason(what=what, where=text, count=1 + len(named[MOST_PLACES:])))
    return reasons
