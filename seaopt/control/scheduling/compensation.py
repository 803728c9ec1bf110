"""What a schedule compensates: terms of one shape at all points, whose coefficients are interpolated as gains are."""

from __future__ import annotations

from dataclasses import replace

from seaopt.control.compensation.compensate import add_compensation
from seaopt.control.loops.compensation.ripple_term import CompensateRipple
from seaopt.control.loops.compensation.terms import CompensateFriction, CompensateGravity, Compensation
from seaopt.control.scheduling.scheduled_controller import ScheduledController, make_table, place_variable
from seaopt.parameters import ParameterSet
from seaopt.plants import Plant


def compensate_schedule(
    schedule: ScheduledController,
    *,
    friction: CompensateFriction | None = None,
    gravity: CompensateGravity | None = None,
    ripple: CompensateRipple | None = None,
    link: tuple[Plant, ParameterSet] | None = None,
) -> ScheduledController:
    """Return a schedule that also compensates friction, ripple, and the weight of a link, as the plant has them there.

    Parameters
    ----------
    schedule : ScheduledController
        As tuned or read.
    friction, gravity, ripple, link
        As of `seaopt.control.add_compensation`, at each point; between the points their coefficients are interpolated.
        Friction has its full size from the largest speed that a point asks for: what is shown to be stable for a
        steeper compensation is so for one that is flatter.

    Raises
    ------
    ControlError
        As `add_compensation`; or terms differ from point to point in more than their coefficients.
    """
    controllers = [
        add_compensation(
            controller,
            friction=friction,
            gravity=gravity,
            ripple=ripple,
            link=None if link is None else (link[0], place_variable(*link, schedule.over, point)),
        )
        for point, controller in zip(schedule.points, schedule.controllers, strict=True)
    ]
    terms = [each.compensation for each in controllers if each.compensation is not None]
    speed = max((term.friction.speed for term in terms if term.friction is not None), default=0.0)
    longest = max((len(term.gravity.coefficients) for term in terms if term.gravity is not None), default=0)
    made = [_fit_terms(each.compensation, speed, longest) for each in controllers]
    controllers = [replace(each, compensation=term) for each, term in zip(controllers, made, strict=True)]
    make_table(schedule.over, schedule.unit, schedule.points, tuple(controllers))  # refuses terms that are not alike
    return replace(schedule, controllers=tuple(controllers))


def _fit_terms(terms: Compensation | None, speed: float, longest: int) -> Compensation | None:
    """Return terms with a speed of friction and as many coefficients of gravity."""
    if terms is None:
        return None
    friction, gravity = terms.friction, terms.gravity
    if friction is not None:
        friction = replace(friction, speed=speed)
    if gravity is not None:
        more = longest - len(gravity.coefficients)
        gravity = replace(gravity, coefficients=(*gravity.coefficients, *[0.0] * more))
    return replace(terms, friction=friction, gravity=gravity)
