"""The verdicts on several results together: a design is no better than the fit, and the guesses, that it rests on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from seaopt.control import Controller, ForceMPC, ScheduledController
from seaopt.estimation import Fit
from seaopt.reporting.sections import judge
from seaopt.reporting.sections.data import Reason, Section, Step, Table, Verdict, mark_met
from seaopt.robustness import Certificate, JointTuning
from seaopt.robustness.verification.verification import Verification

UNMET = "on a fit that is not met"


def judge_results(
    *,
    fit: Fit | None = None,
    controller: Controller | ScheduledController | None = None,
    mpc: ForceMPC | None = None,
    certificate: Certificate | None = None,
    verification: Verification | None = None,
    besides: Sequence[object] = (),
    expectations: Sequence[tuple[bool, str]] = (),
) -> list[Verdict]:
    """Return the verdict on each result that there is; a design on a fit that is not met is not met either.

    Parameters
    ----------
    fit, controller, mpc, certificate, verification : optional
        Results, the later ones made with the earlier ones.
    besides : sequence
        Others, which say themselves what they rest on.
    expectations : sequence of (bool, str)
        Of a problem file: whether each is met, and what to say of it.

    Examples
    --------
    >>> import seaopt as so
    >>> controller = so.tune(so.plants.high_impedance(), so.plants.thor(), so.ControllerSpec(bandwidth_hz=30))
    >>> [one.text for one in judge_results(controller=controller)]
    ['Controller: pid on F1, 30 Hz, every limit met']
    """
    designs, others = (
        [verdict for result in results if result is not None and (verdict := judge(result)) is not None]
        for results in ((controller, mpc, certificate, verification), besides)
    )
    if fit is not None and not fit.met:
        designs = [doubt_design(verdict) for verdict in designs]
    judged = [*designs, *others]
    if fit is not None:
        judged = [name_guesses(verdict, fit.guesses) for verdict in (judge(fit), *judged) if verdict is not None]
    return [*judged, *judge_expectations(expectations)]


def name_guesses(verdict: Verdict, guesses: str) -> Verdict:
    """Return the verdict with the guesses that it rests on ("on 2 guesses: N_p, l"), where it is met."""
    return replace(verdict, text=f"{verdict.text}, {guesses}") if verdict.met and guesses else verdict


def judge_joint(joint: JointTuning, *, certified: bool) -> Verdict:
    """Return the verdict on rounds of tuning and certifying. Of limits that no law meets, and where the law is
    `certified` besides, the verdict that follows has the reasons.
    """
    said = joint.met or joint.certificate is None or certified
    reasons = () if said else (Reason(what=joint.explanation),)
    return Verdict(met=joint.met, text=f"Joint tuning: {joint.summary}", reasons=reasons)


def doubt_design(verdict: Verdict, fit: str = "") -> Verdict:
    """Return the verdict on a design as it is where the fit that it was made with is not met. `fit`: the command that
    fits again, where the verdict on the fit is not shown beside it.
    """
    again = (Step(text="fit again, and mend what that names:", copied=(fit,)),) if fit else ()
    return replace(verdict, met=False, text=f"{verdict.text}, {UNMET}", next=(*again, *verdict.next))


def describe_expectations(outcomes: Sequence[tuple[bool, str]]) -> list[Section]:
    """Return the table of what a problem file expects; none where it expects nothing."""
    rows = tuple((mark_met(met), text) for met, text in outcomes)
    table = Table(head=("verdict", "expectation"), rows=rows)
    return [Section(title="Expectations", part="expectations", tables=(table,))] if rows else []


def judge_expectations(outcomes: Sequence[tuple[bool, str]]) -> list[Verdict]:
    """Return the verdict on what a problem file expects, in one line; none where it expects nothing."""
    if not outcomes:
        return []
    unmet = [Reason(what=text) for met, text in outcomes if not met]
    text = f"Expectations: {len(outcomes) - len(unmet)} of {len(outcomes)} met"
    return [Verdict(met=not unmet, text=text, reasons=tuple(unmet))]
