r"""What real actuators do beside their model, around any plant that states the roles that it takes.

Parts of `seaopt.plants.parts`; each is nothing where its parameters are zero:

``droop``
    The torque of a motor whose iron saturates: the current I makes what :math:`I (1 - a_i I^2)` would, up to where that
    is largest, and no more beyond. It takes the actuation's role.
``friction_drift``
    Friction changes while a log is recorded, as grease warms up: after :math:`t` seconds dry friction is
    :math:`1 - w_c t` of what it was, but never less than nothing, and damping :math:`b_t t` more. The time is an input
    of its own, `elapsed`, which a log need not have: it is then counted from the log's beginning, and is zero wherever
    a controller is designed, so that a fit's values are those at the beginning.
``friction_direction``
    Friction differs between the two directions: :math:`f_a + b_a |v|` is added, so that dry friction is
    :math:`f_c \pm f_a` and damping :math:`b \pm b_a`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import casadi as ca

from seaopt.errors import PlantError
from seaopt.parameters import Parameter, declare
from seaopt.plants.friction import bound_slopes
from seaopt.plants.plant import Plant, refuse_clash
from seaopt.plants.roles import Friction, change_ports, put_behind, with_values
from seaopt.units import LINEAR, ROTARY, Mechanics, mechanics_of

ELAPSED = "elapsed"  # the input that is the time since a log's beginning
AMPERE = "A"
STRAIGHT = 1e-12  # 1/A^2: a torque constant that droops less does not droop at all


def _drift_parameters(effort: Mechanics) -> tuple[Parameter, ...]:
    return (
        declare("w_c", 0.0, "1/s", -math.inf, "share of dry friction that is lost per second"),
        declare("b_t", 0.0, effort.stiffness, -math.inf, "damping that a second adds"),
    )


def _direction_parameters(effort: Mechanics) -> tuple[Parameter, ...]:
    return (
        declare("f_a", 0.0, effort.unit, -math.inf, "dry friction forwards, less that of both directions"),
        declare("b_a", 0.0, effort.damping, -math.inf, "damping forwards, less that of both directions"),
    )


PARTS: dict[str, tuple[Parameter, ...]] = {
    "droop": (declare("a_i", 0.0, "1/A^2", 0.0, "share of torque that is lost, over the current's square"),),
    "friction_drift": _drift_parameters(LINEAR),
    "friction_direction": _direction_parameters(LINEAR),
}
ROTARY_PARTS: dict[str, tuple[Parameter, ...]] = {
    "friction_drift": _drift_parameters(ROTARY),
    "friction_direction": _direction_parameters(ROTARY),
}


def let_droop(plant: Plant) -> Plant:
    """Return a plant whose motor saturates. Raises PlantError: its actuation is not a current."""
    actuation = plant.actuation
    if actuation is None or plant.inputs[actuation.input] != AMPERE:
        raise PlantError(
            f'plant {plant.name}: part "droop" takes the motor\'s current; give the role actuation = '
            "Actuation(input, effort) with an input in A"
        )
    current = actuation.input

    def saturate(x: Any, u: Any, p: Any) -> SimpleNamespace:
        largest = 1.0 / ca.sqrt(3.0 * ca.fmax(p.a_i, STRAIGHT))
        ampere = ca.fmin(ca.fmax(getattr(u, current), -largest), largest)
        return with_values(u, {current: ampere * (1.0 - p.a_i * ampere**2)})

    friction = put_behind(plant.friction, saturate)
    return _change(plant, "droop", PARTS["droop"], saturate, let_droop, friction=friction)


def let_friction_drift(plant: Plant) -> Plant:
    """Return a plant whose friction changes with time. Raises PlantError: it has none, or has such a part."""
    name, friction = _find_friction(plant, "friction_drift")
    force, jump, loads = friction.force, friction.jump, friction.loads
    refuse_clash(plant, "friction_drift", (ELAPSED,))

    def fall(p: Any) -> Any:
        return ca.fmax(1.0 - p.w_c * getattr(p, ELAPSED), 0.0)

    def read_loads(x: Any, u: Any, p: Any) -> Mapping[str, Any]:
        return {**({} if loads is None else loads(x, u, p)), ELAPSED: getattr(u, ELAPSED)}

    def damp(x: Any, u: Any, p: Any) -> SimpleNamespace:
        return with_values(u, {name: getattr(u, name) + p.b_t * getattr(u, ELAPSED) * friction.velocity(x, p)})

    drifting = replace(
        friction,
        force=lambda v, p: fall(p) * force(v, p),
        jump=None if jump is None else lambda speed, p: fall(p) * jump(speed, p),
        loads=read_loads,
        rated={**friction.rated, ELAPSED: 0.0},
    )
    return _change(
        plant,
        "friction_drift",
        _drift_parameters(mechanics_of(friction.unit)),
        damp,
        let_friction_drift,
        inputs={**plant.inputs, ELAPSED: "s"},
        optional_inputs=plant.optional_inputs | {ELAPSED},
        friction={**plant.friction, name: drifting},
        clock=ELAPSED,
    )


def let_friction_differ(plant: Plant) -> Plant:
    """Return a plant whose friction differs by direction. Raises PlantError: it has none, or has such a part."""
    name, friction = _find_friction(plant, "friction_direction")

    def push(x: Any, u: Any, p: Any) -> SimpleNamespace:
        return with_values(u, {name: getattr(u, name) + p.f_a + p.b_a * ca.fabs(friction.velocity(x, p))})

    def bound(p: Any) -> tuple[Any, Any]:
        flattest, steepest = bound_slopes(friction, p)
        return flattest - ca.fabs(p.b_a), steepest + ca.fabs(p.b_a)

    return _change(
        plant,
        "friction_direction",
        _direction_parameters(mechanics_of(friction.unit)),
        push,
        let_friction_differ,
        friction={**plant.friction, name: replace(friction, slopes=bound)},
    )


def _find_friction(plant: Plant, part: str) -> tuple[str, Friction]:
    """Return name and role of the friction that a part changes: the first without bristles."""
    for name, friction in plant.friction.items():
        if friction.bristles is None:
            return name, friction
    raise PlantError(
        f'plant {plant.name}: part "{part}" changes a friction without bristles, and there is none; declare it where '
        "the plant is made: friction={NAME: Friction(...)}"
    )


def _change(
    plant: Plant,
    part: str,
    parameters: tuple[Parameter, ...],
    find_inputs: Callable[[Any, Any, Any], SimpleNamespace],
    change: Callable[[Plant], Plant],
    **fields: Any,
) -> Plant:
    """Return a plant that sees other inputs and friction forces than it is given, a function of (x, u, p). `change`
    makes the same of the plants of its ports; `fields` are what else is another.
    """
    refuse_clash(plant, part, [parameter.name for parameter in parameters])

    def f(t: Any, x: Any, u: Any, p: Any) -> Mapping[str, Any]:
        return plant.f(t, x, find_inputs(x, u, p), p)

    def h(t: Any, x: Any, u: Any, p: Any) -> Mapping[str, Any]:
        return plant.h(t, x, find_inputs(x, u, p), p)

    added = {parameter.name: parameter for parameter in parameters}
    return replace(
        plant,
        name=f"{plant.name} with {part}",
        f=f,
        h=h,
        parameters={**plant.parameters, **added},
        ports=change_ports(plant.ports, change),
        **fields,
    )
