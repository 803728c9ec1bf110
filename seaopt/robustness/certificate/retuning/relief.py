"""What must give where a law breaks its limits with what it feeds back besides, and no reserve mends that.

Three answers are looked for, each as a law whose draws are looked at: the largest share of what is compensated, and
that of an impedance's stiffness and damping, with which the same law keeps its limits, by bisection; and a lower
bandwidth at which a law that is tuned anew does. Shares are whole percents, and bandwidths are as they are said.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

from seaopt.control import Controller
from seaopt.control.loops.compensation.terms import Compensation
from seaopt.control.loops.outer_loop import OuterLoop
from seaopt.errors import SeaoptError
from seaopt.formatting import join_words
from seaopt.records import record
from seaopt.robustness.certificate.retuning.reserve import Look

SLOWER = (0.8, 0.65, 0.5, 0.35)  # of the bandwidth asked


@record
class Relief:
    """What would do in place of a law as it was asked for."""

    compensated: float | None  # share of what is compensated, for the same law; 0 where less does not help
    rendered: float | None  # the same of the impedance's stiffness and damping; None where there is none
    bandwidth_hz: float | None  # with all of both; None where none of those tried does
    tried_hz: tuple[float, ...]  # lower bandwidths, tried in this order until one does

    def __str__(self) -> str:
        less = f"{100.0 * self.compensated:.0f} % of what is compensated" if self.compensated else ""
        softer = f"{100.0 * self.rendered:.0f} % of the impedance's stiffness and damping" if self.rendered else ""
        slower = "" if self.bandwidth_hz is None else f"a bandwidth of {self.bandwidth_hz:g} Hz"
        if answers := [each for each in (less, softer, slower) if each]:
            return f"draws keep the limits with {', or with '.join(answers)}"
        tried = ["less compensation"] if self.compensated is not None else []
        tried += ["a softer impedance"] if self.rendered is not None else []
        tried += [f"a bandwidth of {join_words([f'{band:g}' for band in self.tried_hz])} Hz"] if self.tried_hz else []
        return f"draws do not keep the limits with {', or with '.join(tried)} alone"


def find_relief(
    law: Controller, tune_at: Callable[[float], Controller], look: Callable[[Controller], Mapping[str, Look]]
) -> Relief:
    """Return what would do in place of a law that feeds back more than it was tuned with. `tune_at` makes one of a
    bandwidth in Hz, `look` looks at the draws of one.
    """

    def keeps(make: Callable[[float], Controller], at: float) -> bool:
        try:
            tried = make(at)
            return tried.met and not any(each.is_over for each in look(tried).values())
        except SeaoptError:  # there is no such law: of a damping that is critical at a lower bandwidth, say
            return False

    def bisect(shrink: Callable[[float], Controller]) -> float:
        low, high = 0, 100
        while high - low > 1:
            middle = (low + high) // 2
            low, high = (middle, high) if keeps(shrink, middle / 100.0) else (low, middle)
        return low / 100.0

    terms, outer, least = law.compensation, law.outer, law.spec.bandwidth_range_hz[0]
    lower = [float(f"{share * law.spec.bandwidth_hz:.3g}") for share in SLOWER]
    lower = [band for band in lower if band >= least]
    return Relief(
        compensated=None
        if terms is None or (terms.friction is None and terms.gravity is None)
        else bisect(lambda share: replace(law, compensation=_scale(terms, share))),
        rendered=None if outer is None else bisect(lambda share: replace(law, outer=_soften(outer, share))),
        bandwidth_hz=next((band for band in lower if keeps(tune_at, band)), None),
        tried_hz=(*lower,),
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
