"""What must give where a law breaks its limits with what it feeds back besides, and no reserve mends that.

Three answers are looked for, each as a law whose draws are looked at: the largest share of what is compensated, and
that of an impedance's stiffness and damping, with which the same law keeps its limits, by bisection; and a lower
bandwidth at which a law that is tuned anew does.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

from seaopt.control import Controller
from seaopt.control.loops.compensation.terms import Compensation
from seaopt.control.loops.outer_loop import OuterLoop
from seaopt.records import record
from seaopt.robustness.certificate.retuning.reserve import Look

HALVINGS = 6
SLOWER = (0.8, 0.65, 0.5, 0.35)  # of the bandwidth asked


@record
class Relief:
    """What would do in place of a law as it was asked for."""

    compensated: float  # share of what is compensated, for the same law; 0 where less does not help, or nothing is
    rendered: float  # the same of the impedance's stiffness and damping
    bandwidth_hz: float | None  # with all of both; None where none of those tried does

    def __str__(self) -> str:
        less = f"{100.0 * self.compensated:.2g} % of what is compensated" if self.compensated else ""
        softer = f"{100.0 * self.rendered:.2g} % of the impedance's stiffness and damping" if self.rendered else ""
        slower = "" if self.bandwidth_hz is None else f"a bandwidth of {self.bandwidth_hz:.3g} Hz"
        answers = ", or with ".join(filter(None, (less, softer, slower)))
        tried = "less compensation, a softer impedance or a lower bandwidth alone does not keep the limits at draws"
        return f"draws keep the limits with {answers}" if answers else tried


def find_relief(
    law: Controller, tune_at: Callable[[float], Controller], look: Callable[[Controller], Mapping[str, Look]]
) -> Relief:
    """Return what would do in place of a law that feeds back more than it was tuned with. `tune_at` makes one of a
    bandwidth in Hz, `look` looks at the draws of one.
    """

    def keeps(tried: Controller) -> bool:
        return tried.met and not any(each.is_over for each in look(tried).values())

    def bisect(shrink: Callable[[float], Controller]) -> float:
        low, high = 0.0, 1.0
        for _ in range(HALVINGS):
            middle = 0.5 * (low + high)
            low, high = (middle, high) if keeps(shrink(middle)) else (low, middle)
        return low

    terms, outer, asked = law.compensation, law.outer, law.spec.bandwidth_hz
    lower = (share * asked for share in SLOWER if share * asked >= law.spec.bandwidth_range_hz[0])
    return Relief(
        compensated=0.0 if terms is None else bisect(lambda share: replace(law, compensation=_scale(terms, share))),
        rendered=0.0 if outer is None else bisect(lambda share: replace(law, outer=_soften(outer, share))),
        bandwidth_hz=next((band for band in lower if keeps(tune_at(band))), None),
    )


def _soften(outer: OuterLoop, share: float) -> OuterLoop:
    return replace(outer, stiffness=share * outer.stiffness, damping=share * outer.damping)


def _scale(terms: Compensation, share: float) -> Compensation:
    """Return terms with a share of friction and gravity."""
    friction, gravity = terms.friction, terms.gravity
    if friction is not None:
        friction = replace(friction, effort=share * friction.effort, fraction=share * friction.fraction)
    if gravity is not None:
        gravity = replace(gravity.scaled(share), fraction=share * gravity.fraction)
    return replace(terms, friction=friction, gravity=gravity)
