r"""What real actuators do beside their model, around any plant that states the roles that it takes.

Parts of `seaopt.plants.parts`; each is nothing where its parameters are zero:

``droop``
    The torque of a motor whose iron saturates: the current I makes what :math:`I (1 - a_i I^2)` would, up to where that
    is largest, and no more beyond. It takes the actuation's role.
``falling_torque``
    Less torque the faster the motor turns, as of a supply that sags or a drive near its voltage: the current I makes
    what :math:`I \max(1 - a_v |v|, 0)` would at rest, v the speed on
    which the actuation's effort works: behind the gear, or the nut's.
``friction_drift``
    Friction changes while a log is recorded, as grease warms up: after :math:`t` seconds dry friction is
    :math:`1 - w_c s` of what it was, but never less than nothing, and damping :math:`b_t s` more, with
    :math:`s = (1 - e^{-r_t t}) / r_t`, which is t where r_t is zero: what warms up settles. The time is an input of its
    own, `elapsed`, which a log need not have: it is then counted from the log's beginning, and is zero wherever a
    controller is designed, so that a fit's values are those at the beginning.
``friction_direction``
    Friction differs between the two directions: :math:`f_a + b_a |v|` is added, so that dry friction is
    :math:`f_c \pm f_a` and damping :math:`b \pm b_a`.
``back_driving``
    A transmission rubs by a share of the spring's effort that is larger where the motor drives the spring than where
    the spring drives the motor, by :math:`2 d_e`: the motor feels :math:`1 + d_e` of that effort. Half of what both
    have in common is ``load_friction``'s c_e. Where inertia, friction and efficiency are free no log tells it: all of
    them times :math:`1 + d_e` move alike.
``cogging``
    A force on the motor that its position alone decides, :math:`a_g \sin(n_g \theta) + b_g \cos(n_g \theta)`, of
    magnets that meet slots, or of balls that meet a groove. Where a log has the position, a fit takes it from there: a
    simulated one that is off by a wave has a minimum of its own. The phase is then that of the encoder's zero. Linear
    loops see no slope of it where the motor slides, and stuck a spring of what of it friction does not hold.
``stand``
    What holds the spring gives, :math:`c_t` per unit of its effort, so that spring and stand are in series:
    :math:`k/(1 + k c_t)` is what a held link feels.
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
from seaopt.plants.plant import Plant, extend, refuse_clash
from seaopt.plants.roles import Friction, Reading, SeriesSpring, change_ports, put_behind, with_values
from seaopt.units import LINEAR, ROTARY, Mechanics, mechanics_of

ELAPSED = "elapsed"  # the input that is the time since a log's beginning
AMPERE = "A"
STRAIGHT_DRIFT = 1e-4  # of what has settled: less of it bends a drift by as little
STRAIGHT = 1e-12  # 1/A^2: a torque constant that droops less does not droop at all


def _fall_parameters(effort: Mechanics) -> tuple[Parameter, ...]:
    return (declare("a_v", 0.0, f"s/{effort.position}", -math.inf, "share of torque that is lost, over the speed"),)


def _drift_parameters(effort: Mechanics) -> tuple[Parameter, ...]:
    return (
        declare("w_c", 0.0, "1/s", -math.inf, "share of dry friction that is lost per second, at first"),
        declare("b_t", 0.0, effort.stiffness, -math.inf, "damping that a second adds, at first"),
        declare("r_t", 0.0, "1/s", 0.0, "rate at which the change settles"),
    )


def _direction_parameters(effort: Mechanics) -> tuple[Parameter, ...]:
    return (
        declare("f_a", 0.0, effort.unit, -math.inf, "dry friction forwards, less that of both directions"),
        declare("b_a", 0.0, effort.damping, -math.inf, "damping forwards, less that of both directions"),
    )


def _cogging_parameters(effort: Mechanics) -> tuple[Parameter, ...]:
    return (
        declare("a_g", 0.0, effort.unit, -math.inf, "cogging, sine of the motor's position"),
        declare("b_g", 0.0, effort.unit, -math.inf, "cogging, cosine of the motor's position"),
        declare("n_g", 6.0, f"rad/{effort.position}", 0.0, "phase of cogging over the motor's position"),
    )


def _stand_parameters(effort: Mechanics) -> tuple[Parameter, ...]:
    return (declare("c_t", 0.0, f"{effort.position}/({effort.unit})", 0.0, "compliance of the stand"),)


BACK_DRIVING = declare("d_e", 0.0, "-", -0.9, "share of the spring's effort lost driving, less driven")
PARTS: dict[str, tuple[Parameter, ...]] = {
    "droop": (declare("a_i", 0.0, "1/A^2", 0.0, "share of torque that is lost, over the current's square"),),
    "falling_torque": _fall_parameters(LINEAR),
    "friction_drift": _drift_parameters(LINEAR),
    "friction_direction": _direction_parameters(LINEAR),
    "back_driving": (BACK_DRIVING,),
    "cogging": _cogging_parameters(LINEAR),
    "stand": _stand_parameters(LINEAR),
}
ROTARY_PARTS: dict[str, tuple[Parameter, ...]] = {
    "falling_torque": _fall_parameters(ROTARY),
    "friction_drift": _drift_parameters(ROTARY),
    "friction_direction": _direction_parameters(ROTARY),
    "cogging": _cogging_parameters(ROTARY),
    "stand": _stand_parameters(ROTARY),
}


def let_droop(plant: Plant) -> Plant:
    """Return a plant whose motor saturates. Raises PlantError: its actuation is not a current."""
    actuation = plant.actuation
    if actuation is None or plant.inputs[actuation.input] != AMPERE:
        raise PlantError(
            'part "droop" takes the motor\'s current; give the role actuation = '
            "Actuation(input, effort) with an input in A",
            plant=plant.name,
        )
    current = actuation.input

    def saturate(x: Any, u: Any, p: Any) -> SimpleNamespace:
        largest = 1.0 / ca.sqrt(3.0 * ca.fmax(p.a_i, STRAIGHT))
        ampere = ca.fmin(ca.fmax(getattr(u, current), -largest), largest)
        return with_values(u, {current: ampere * (1.0 - p.a_i * ampere**2)})

    friction = put_behind(plant.friction, saturate)
    return _change(plant, "droop", PARTS["droop"], saturate, let_droop, friction=friction)


def let_torque_fall(plant: Plant) -> Plant:
    """Return a plant whose motor is weaker the faster it turns. Raises PlantError: its actuation states no speed."""
    actuation = plant.actuation
    if actuation is None or actuation.speed is None:
        raise PlantError(
            'part "falling_torque" needs the speed on which the motor works; give the role '
            "actuation = Actuation(input, effort, speed=lambda x, p: ...)",
            plant=plant.name,
        )
    name, speed = actuation.input, actuation.speed

    def weaken(x: Any, u: Any, p: Any) -> SimpleNamespace:
        return with_values(u, {name: getattr(u, name) * ca.fmax(1.0 - p.a_v * ca.fabs(speed(x, p)), 0.0)})

    parameters = _fall_parameters(mechanics_of(actuation.unit))
    friction = put_behind(plant.friction, weaken)
    return _change(plant, "falling_torque", parameters, weaken, let_torque_fall, friction=friction)


def let_friction_drift(plant: Plant) -> Plant:
    """Return a plant whose friction changes with time. Raises PlantError: it has none, or has such a part."""
    name, friction = _find_friction(plant, "friction_drift")
    force, jump, loads = friction.force, friction.jump, friction.loads
    refuse_clash(plant, "friction_drift", (ELAPSED,))

    def settle(elapsed: Any, p: Any) -> Any:
        settled = p.r_t * elapsed
        straight = ca.fabs(settled) < STRAIGHT_DRIFT
        some = ca.if_else(straight, 1.0, settled)
        return elapsed * ca.if_else(straight, 1.0 - 0.5 * settled, (1.0 - ca.exp(-some)) / some)

    def fall(p: Any) -> Any:
        return ca.fmax(1.0 - p.w_c * settle(getattr(p, ELAPSED), p), 0.0)

    def read_loads(x: Any, u: Any, p: Any) -> Mapping[str, Any]:
        return {**({} if loads is None else loads(x, u, p)), ELAPSED: getattr(u, ELAPSED)}

    def damp(x: Any, u: Any, p: Any) -> SimpleNamespace:
        return with_values(
            u, {name: getattr(u, name) + p.b_t * settle(getattr(u, ELAPSED), p) * friction.velocity(x, p)}
        )

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


def let_back_driving_differ(plant: Plant) -> Plant:
    """Return a plant that is driven back against less friction. Raises PlantError: no friction, or no spring."""
    name, friction = _find_friction(plant, "back_driving")
    spring, stiffness = _find_spring(plant, "back_driving")

    def push(x: Any, u: Any, p: Any) -> SimpleNamespace:
        pull = getattr(p, stiffness) * spring.deflection(x, p) if spring.pull is None else spring.pull(x, p)
        return with_values(u, {name: getattr(u, name) + p.d_e * pull / friction.effort(p)})

    return _change(plant, "back_driving", (BACK_DRIVING,), push, let_back_driving_differ)


def let_cog(plant: Plant) -> Plant:
    """Return a plant whose motor cogs. Raises PlantError: it has no friction, or no position of the motor."""
    name, friction = _find_friction(plant, "cogging")
    position = plant.sensing.motor_position if plant.sensing is not None else None
    if position is None or position not in plant.states:
        raise PlantError(
            'part "cogging" needs a state that is the motor\'s position; give the role '
            "sensing = Sensing(regulated, motor_position=...)",
            plant=plant.name,
        )

    read = f"{position}_read"
    refuse_clash(plant, "cogging", (read,))

    def push(x: Any, u: Any, p: Any) -> SimpleNamespace:
        phase = p.n_g * getattr(u, read)
        return with_values(u, {name: getattr(u, name) + p.a_g * ca.sin(phase) + p.b_g * ca.cos(phase)})

    followed = {**plant.followed, read: Reading(state=position, wave="n_g", sizes=("a_g", "b_g"), friction=name)}
    parameters = _cogging_parameters(mechanics_of(friction.unit))
    return _change(plant, "cogging", parameters, push, let_cog, followed=followed)


def let_stand_give(plant: Plant) -> Plant:
    """Return a plant on a stand that gives. Raises PlantError: its link moves, or it has no stiffness."""
    if plant.moves:
        raise PlantError('part "stand" holds a link, and this one moves; leave it out', plant=plant.name)
    spring, stiffness = _find_spring(plant, "stand")
    derived, energy = plant.derived, plant.energy

    def soften(p: Any) -> SimpleNamespace:
        k = getattr(p, stiffness)
        return with_values(p, {stiffness: k / (1.0 + k * p.c_t)})

    def feel(friction: Friction) -> Friction:
        loads = friction.loads
        return friction if loads is None else replace(friction, loads=lambda x, u, p: loads(x, u, soften(p)))

    return _change(
        plant,
        "stand",
        _stand_parameters(mechanics_of(spring.unit)),
        lambda x, u, p: u,
        let_stand_give,
        soften,
        derived=None if derived is None else lambda p: derived(soften(p)),
        energy=None if energy is None else lambda x, p: energy(x, soften(p)),
        friction={name: feel(friction) for name, friction in plant.friction.items()},
    )


def _find_spring(plant: Plant, part: str) -> tuple[SeriesSpring, str]:
    """Return a plant's spring, and the parameter that is its stiffness."""
    spring = plant.spring
    if spring is None or spring.stiffness is None:
        raise PlantError(
            f'part "{part}" needs the stiffness of its spring; give the role '
            "spring = SeriesSpring(deflection, unit, stiffness=...)",
            plant=plant.name,
        )
    return spring, spring.stiffness


def _find_friction(plant: Plant, part: str) -> tuple[str, Friction]:
    """Return name and role of the friction that a part changes: the first without bristles."""
    for name, friction in plant.friction.items():
        if friction.bristles is None:
            return name, friction
    raise PlantError(
        f'part "{part}" changes a friction without bristles, and there is none; declare it where '
        "the plant is made: friction={NAME: Friction(...)}",
        plant=plant.name,
    )


def _change(
    plant: Plant,
    part: str,
    parameters: tuple[Parameter, ...],
    find_inputs: Callable[[Any, Any, Any], SimpleNamespace],
    change: Callable[[Plant], Plant],
    find_parameters: Callable[[Any], Any] = lambda p: p,
    **fields: Any,
) -> Plant:
    """Return a plant that sees other inputs and friction forces than it is given, a function of (x, u, p), and other
    parameters, one of p. `change` makes the same of the plants of its ports; `fields` are what else is another.
    """
    refuse_clash(plant, part, [parameter.name for parameter in parameters])
    return extend(
        plant,
        find_inputs=find_inputs,
        find_parameters=find_parameters,
        added=parameters,
        name=f"{plant.name} with {part}",
        ports=change_ports(plant.ports, change),
        **fields,
    )
