"""Compensation of friction from a plant: its size, and what velocity at the friction a reading or a reference means.

Only friction that acts where the motor's effort does can be met by it: whose effect on the states is parallel to the
command's. Its size is the least that the curve falls to at speed, so that Stribeck's peak and what a load adds are left
to the feedback, and no more than asked is compensated anywhere.
"""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
from jaxtyping import Float

from seaopt.control.loops.compensation.stability import SpeedReading, compensation_margin
from seaopt.control.loops.compensation.terms import CompensateFriction, FrictionTerm
from seaopt.control.loops.drift import take_linear
from seaopt.control.loops.friction_loop import FrictionLoop
from seaopt.control.loops.sampled_plant import find_rest
from seaopt.errors import ControlError
from seaopt.parameters import ParameterSet
from seaopt.plants import CompletedParameters, Plant, state_space
from seaopt.plants.friction import SAMPLED_SPEEDS, SLIDING, SMOOTHED, friction_matrices, friction_states
from seaopt.plants.roles import Friction
from seaopt.records import record

PARALLEL = 1e-6  # to which effects of friction and of the motor are alike
SAFETY = 2.0  # the slope that stability is shown for, over the one that is taken
LINEAR_SPEEDS = {"N": "m/s", "N m": "rad/s"}  # of a friction force and of a torque


@record(eq=False)
class MotorFriction:
    """The friction that the motor's effort can meet."""

    name: str  # of the plant's friction
    index: int  # among its frictions
    level: float  # Coulomb friction as an effort at the spring, N or N m
    smoothing: float | None  # the speed over which the plant smooths it
    unit: str  # of its velocity


def find_motor_friction(plant: Plant, params: ParameterSet) -> MotorFriction:
    """Return the friction where the motor's effort acts. Raises ControlError: none, or nothing at these values."""
    values = plant.complete(params)
    x, u = find_rest(plant, values)
    on_states = np.array(friction_matrices(plant)(x, u, values.vector)[0]) if plant.friction else np.zeros((1, 0))
    motor = state_space(friction_states(plant)[SLIDING], values)[1][:, 0] if plant.friction else np.zeros(1)
    for index, (name, friction) in enumerate(plant.friction.items()):
        column = on_states[:, index]
        if np.any(column) and _is_parallel(column, motor):
            level = _find_level(friction, values)
            if level > 0.0:
                smoothing = None if friction.smoothing is None else values[friction.smoothing].value
                unit = LINEAR_SPEEDS.get(friction.unit, f"{friction.unit} 1/s")
                return MotorFriction(name=name, index=index, level=level, smoothing=smoothing, unit=unit)
    raise ControlError(
        f"compensate.friction: {plant.name} has no Coulomb friction at the motor to compensate at these values; give "
        "the plant f_c, or leave friction out of compensate"
    )


def _find_level(friction: Friction, values: CompletedParameters) -> float:
    """Return the least of a curve beyond its smoothing, without load, as an effort at the spring."""
    p = values.by_attribute
    unloaded = SimpleNamespace(**vars(p), **dict.fromkeys(friction.rated, 0.0))
    slowest = SMOOTHED * values[friction.smoothing].value if friction.smoothing is not None else 0.0
    speeds = [float(speed) for speed in SAMPLED_SPEEDS if speed > slowest] or [SMOOTHED * slowest]
    return abs(float(friction.effort(p))) * min(float(friction.force(speed, unloaded)) for speed in speeds)


def _is_parallel(first: Float[np.ndarray, " n"], second: Float[np.ndarray, " n"]) -> bool:
    """Tell whether two vectors have one direction or its opposite."""
    length = float(np.linalg.norm(second))
    if not length:
        return False
    along = float(first @ second) / length**2
    return bool(np.linalg.norm(first - along * second) <= PARALLEL * np.linalg.norm(first))


def make_friction_term(
    plant: Plant, params: ParameterSet, regulated: str, spec: CompensateFriction, loop: FrictionLoop | None
) -> FrictionTerm:
    """Return the compensation of a design plant's friction. `plant`, `params`: the design plant and its parameters.
    `regulated`: the output that the reference is of. `loop`: the design plant's, for the smoothing of the measured
    speed; unused of the reference's. Raises ControlError: no friction is where the motor acts, no output is the motor's
    position, the reference asks for no velocity at rest, or stability is shown for no smoothing at all.
    """
    friction = find_motor_friction(plant, params)
    effort = spec.fraction * friction.level
    reads = ""
    if spec.source == "reference":
        velocity, speed = (
            find_velocity_per_rate(plant, params, regulated, friction.name),
            spec.speed or friction.smoothing,
        )
    else:
        reads = find_motor_position(plant, "friction", 'take from = "reference", or ')
        velocity = find_reading(plant, params, reads, friction)
        speed = spec.speed or _choose_speed(friction, effort, loop)
    if speed is None:
        raise ControlError(
            f"compensate.friction: the friction {friction.name} of {plant.name} states no smoothing; give the speed at "
            "which the compensation has its full size: compensate = { friction = { speed = 0.001 } }"
        )
    return FrictionTerm(
        effort=effort,
        speed=speed,
        speed_unit=friction.unit,
        fraction=spec.fraction,
        source=spec.source,
        reads=reads,
        velocity_per_rate=velocity,
    )


def _choose_speed(friction: MotorFriction, effort: float, loop: FrictionLoop | None) -> float:
    """Return the plant's own smoothing, or twice what stability is shown for where that is more."""
    smoothing = friction.smoothing or 0.0
    if loop is None:
        return smoothing
    reading = SpeedReading(velocity=loop.velocity[friction.index], differenced=True)
    margin = compensation_margin(loop, reading, effort / smoothing if smoothing else 1.0)
    if not margin.slope:
        raise ControlError(
            "compensate.friction: no compensation from the measured speed is shown to be stable on the design plant "
            f'({margin.multiplier}); take from = "reference", or state the speed over which it rises yourself'
        )
    return max(smoothing, SAFETY * effort / margin.slope)


def find_motor_position(plant: Plant, wanted: str, otherwise: str = "") -> str:
    """Return the output that is the motor's position; `wanted` and `otherwise` are for the ControlError without one."""
    position = plant.sensing.motor_position if plant.sensing is not None else None
    if position is None or position not in plant.outputs:
        raise ControlError(
            f"compensate.{wanted}: {plant.name} has no output that is the motor's position; {otherwise}"
            "give the plant one: sensing = Sensing(regulated, motor_position=...)"
        )
    return position


def find_reading(plant: Plant, params: ParameterSet, output: str, friction: MotorFriction) -> float:
    """Return the velocity at a friction per rate of an output. Raises ControlError: the two move differently."""
    values = plant.complete(params)
    x, u = find_rest(plant, values)
    velocity = np.array(friction_matrices(plant)(x, u, values.vector)[2])[friction.index]
    a, _, c, _ = state_space(friction_states(plant)[SLIDING], values)
    rate = c[list(plant.outputs).index(output)] @ a
    if not _is_parallel(velocity, rate):
        raise ControlError(
            f"compensate.friction: {output} of {plant.name} does not move as its friction {friction.name} does; take "
            'from = "reference"'
        )
    return float(velocity @ rate / (rate @ rate))


def find_velocity_per_rate(plant: Plant, params: ParameterSet, regulated: str, name: str) -> float:
    r"""Return the velocity at a friction per rate of the regulated output, slowly and with the link held. With the
    plant :math:`\dot x = A x + b u`, y = c x and the velocity v x, slowly
    :math:`v x / \dot y = v A^{-2} b / (c A^{-1} b)`: of a spring k between motor and link it is 1/k and the gear.
    Raises ControlError: the plant with its link held has no stiffness, or its friction does not move.
    """
    locked = plant
    while locked.port is not None and locked.port.held is not None:
        locked = locked.port.held()
    locked = take_linear(locked, regulated)
    values = locked.complete(params)
    a, b, c, _ = state_space(friction_states(locked)[SLIDING], values)
    x, u = find_rest(locked, values)
    try:
        first = np.linalg.solve(a, b[:, 0])
        velocity = np.array(friction_matrices(locked)(x, u, values.vector)[2])[list(locked.friction).index(name)]
        ratio = float(velocity @ np.linalg.solve(a, first) / (c[list(locked.outputs).index(regulated)] @ first))
    except (np.linalg.LinAlgError, ValueError, ZeroDivisionError):
        ratio = np.nan
    if not np.isfinite(ratio) or ratio == 0.0:
        raise ControlError(
            f"compensate.friction: the reference of {regulated} asks for no velocity at the friction {name} of "
            f'{plant.name} with its link held; take from = "speed"'
        )
    return ratio
