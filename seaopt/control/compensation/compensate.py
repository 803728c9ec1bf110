"""A controller that also compensates what is known of its plant, and whether it stays stable with that."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from seaopt.control.compensation.friction import find_motor_friction, find_reading, make_friction_term
from seaopt.control.compensation.gravity import make_gravity_term
from seaopt.control.compensation.ripple import make_ripple_term
from seaopt.control.laws.controller import Controller
from seaopt.control.laws.friction import take_friction_out
from seaopt.control.loops.compensation.ripple_term import CompensateRipple
from seaopt.control.loops.compensation.stability import CompensationMargin, SpeedReading, compensation_margin
from seaopt.control.loops.compensation.terms import CompensateFriction, CompensateGravity, Compensation, FrictionTerm
from seaopt.control.loops.friction_loop import FrictionLoop
from seaopt.errors import ControlError
from seaopt.parameters import ParameterSet
from seaopt.plants import Plant

ENOUGH = 1.5  # times the slope asked for: at the nominal parameters no better multiplier is looked for


def add_compensation(
    controller: Controller,
    *,
    friction: CompensateFriction | None = None,
    gravity: CompensateGravity | None = None,
    ripple: CompensateRipple | None = None,
    link: tuple[Plant, ParameterSet] | None = None,
) -> Controller:
    """Return a controller that also compensates its design plant's friction, its ripple, and the weight of a link.

    The law, its figures and its friction margin stay what they are; what is added acts between the law and the limit
    of the command, in every simulation and in exported code, and is fed back in the figures of a certificate.

    Parameters
    ----------
    controller : Controller
        As tuned or read; it knows its design plant, or the model of what its measured response is of.
    friction : CompensateFriction, optional
        What is asked for friction; left out, none of it is compensated.
    gravity : CompensateGravity, optional
        What is asked for gravity.
    ripple : CompensateRipple, optional
        What is asked for torque ripple and cogging.
    link : (Plant, ParameterSet), optional
        The plant whose link it is; the design plant if left out.

    Raises
    ------
    ControlError
        The controller knows no such plant; no friction is where the motor acts; the reference is that of an outer loop,
        and friction would be compensated from it; nothing is shown to be stable for the measured speed; or the motor's
        position has no revolution.

    Examples
    --------
    >>> import seaopt as so
    >>> from seaopt.control import CompensateFriction, add_compensation
    >>> stand, params = so.plants.high_impedance(), so.plants.thor().update(f_c=50.0)
    >>> controller = so.tune(stand, params, so.ControllerSpec(bandwidth_hz=20, max_sensitivity=1.6))
    >>> round(add_compensation(controller, friction=CompensateFriction(fraction=0.8)).compensation.friction.effort, 6)
    40.0
    """
    model = controller.design or controller.measured_on
    if model is None:
        raise ControlError(
            "compensate: the controller does not know its design plant, whose friction it would compensate; read it "
            "with Controller.from_dict"
        )
    if friction is None and gravity is None and ripple is None:
        return replace(controller, compensation=None)
    added = Compensation(
        sample_time_s=controller.sample_time_s,
        friction=None if friction is None else _meet_friction(controller, *model, friction),
        gravity=None if gravity is None else make_gravity_term(*(link or model), controller.spec.regulated, gravity),
        ripple=None if ripple is None else make_ripple_term(model[0], controller.command.per_effort, ripple),
    )
    return replace(controller, compensation=added)


def _meet_friction(
    controller: Controller, plant: Plant, params: ParameterSet, friction: CompensateFriction
) -> FrictionTerm:
    if friction.source == "reference" and controller.outer is not None:
        raise ControlError(
            'compensate.friction: from = "reference" with [impedance] would be a feedback of the link, for which '
            'stability is not shown; take from = "speed"'
        )
    loop = None
    if friction.source == "speed" and friction.speed is None:
        (loop,) = take_friction_out(controller, plant, [params])
    return make_friction_term(plant, params, controller.spec.regulated, friction, loop)


def find_compensation_margins(
    controller: Controller, plant: Plant, sets: Sequence[ParameterSet], first: str = "", enough: float = 1.0
) -> list[CompensationMargin]:
    """Return how steep a compensation from the measured speed stability is shown for, at sets of parameters.
    `controller`: with a compensation of friction from the measured speed. `plant`: any on which it runs, with its own
    friction. `sets`: all with the same conditions among them. `first`: a multiplier that is tried first. `enough`: a
    margin of so many times what is asked ends the search for a better one.
    """
    term = None if controller.compensation is None else controller.compensation.friction
    assert term is not None
    loops = take_friction_out(controller, plant, sets)
    return [_find_margin(term, plant, params, loop, first, enough) for params, loop in zip(sets, loops, strict=True)]


def _find_margin(
    term: FrictionTerm, plant: Plant, params: ParameterSet, loop: FrictionLoop | None, first: str, enough: float
) -> CompensationMargin:
    def refuse(why: str) -> CompensationMargin:
        return CompensationMargin(slope=0.0, required=term.slope, frequency_hz=0.0, multiplier=why)

    if loop is None:
        return refuse("the plant has no friction to compensate")
    try:
        friction = find_motor_friction(plant, params)
        per_rate = find_reading(plant, params, term.reads, friction)
    except ControlError as error:
        return refuse(str(error))
    # What the law takes for the velocity, of this plant's own.
    velocity = loop.velocity[friction.index] * term.velocity_per_rate / per_rate
    reading = SpeedReading(velocity=velocity, differenced=True)
    return compensation_margin(loop, reading, term.slope, first, enough)
