"""Compensation of torque ripple from a plant: which output is the motor's position, and in which unit its effort is."""

from __future__ import annotations

import math

from seaopt.control.compensation.friction import find_motor_position
from seaopt.control.loops.compensation.ripple_term import CompensateRipple, RippleTerm
from seaopt.errors import ControlError
from seaopt.plants import Plant


def make_ripple_term(plant: Plant, per_effort: float, spec: CompensateRipple) -> RippleTerm:
    """Return the compensation of ripple over a plant's motor position. `plant`: any whose motor position is an output.
    `per_effort`: the command for one unit of effort. `asked`: coefficients in the command's unit. Raises ControlError:
    no output is the motor's position, or it is not in rad and no period is given.
    """
    reads = find_motor_position(plant, "ripple")
    unit = plant.outputs[reads]
    period = spec.period if spec.period is not None or unit != "rad" else 2.0 * math.pi
    if period is None:
        raise ControlError(
            f"compensate.ripple: {reads} of {plant.name} is in {unit}, of which no revolution is known; give what it "
            "moves in one: ripple = { period = 0.002, ... }"
        )
    cos, sin = (tuple(spec.fraction * value / per_effort for value in values) for values in (spec.cos, spec.sin))
    return RippleTerm(
        cycles=spec.cycles, cos=cos, sin=sin, period=period, reads=reads, unit=unit, fraction=spec.fraction
    )
