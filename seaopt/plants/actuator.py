r"""An actuator between two links: one derivation for the ball screw (Orekhov et al. 2015, Figs. 3 and 4) and the gear.

Derivation
----------
Links, housing and the output of the transmission move along one axis: x along a screw, an angle about a gear. The
motor turns by :math:`\theta` and moves the output against the housing,

.. math:: \sigma (x_o - x_h) = g \theta, \qquad
          \text{screw: } g = r = \frac{l}{2 \pi N_p} \text{ (2)}, \; \sigma = -1, \qquad
          \text{gear: } g = 1/N, \; \sigma = +1

(a screw's positive current pulls the links together, a gear's turns link 2 forwards). The spring of stiffness k sits
between link 1 and the housing ("link1", then :math:`x_o = x_2`) or between the output and link 2 ("link2", then
:math:`x_h = x_1`). Either way it is deflected by what the drive travels less what the links move apart:

.. math:: \delta = g \theta - \sigma (x_2 - x_1), \qquad V = \tfrac12 k \delta^2 .

The unlumped drive has a rotor J and a sprung mass :math:`m_s` on the housing. The axis of a screw is the direction of
its motion, so that moving the housing does not turn the rotor, :math:`\kappa = 0`; a gear's rotor turns about the
housing's own axis and is carried along, :math:`\kappa = 1`. The lumped drive has no rotor: its reflected inertia
:math:`J/g^2` moves as part of the sprung mass, (1):

.. math:: T = \tfrac12 J (\dot\theta + \kappa \dot x_h)^2 + \tfrac12 m_s \dot x_s^2 + T_\mathrm{links}

=========  ============  =============  ====================================================================
drive      spring        m_s            x_s
=========  ============  =============  ====================================================================
unlumped   link 1        m_l            x_h = x_2 - sigma g theta  (the no-slip condition (5): x_l = q + x_2)
lumped     link 1        m_l + J/g^2    x_h = x_2 - sigma g theta  (x_k)
unlumped   link 2        m_l            x_h = x_1                  (the housing rides on link 1)
lumped     link 2        m_l + J/g^2    x_o = x_1 + sigma g theta  (the mirror: the mass hangs on the spring)
=========  ============  =============  ====================================================================

The motor works on :math:`\theta` alone, :math:`Q_\theta = \eta K_\tau I - b_r \dot\theta - F_f(\dot\theta)`; in the
lumped drive this acts between the sprung mass and the far link, in the unlumped one between rotor and housing (of a
screw, which takes no turning moment along x: between the pinion and a virtual ground out of plane). Lagrange's
equations in :math:`\theta` and the links' coordinates give the motion. The links feel :math:`-\sigma F_1` and
:math:`+\sigma F_2`; with the momentum :math:`P = m_s \dot x_s + \kappa J (\dot\theta + \kappa \dot x_h)` of what is
between them

.. math::
    \text{spring at link 1:}\quad F_1 = k\delta,\; F_2 = k\delta - \sigma \dot P \qquad
    \text{spring at link 2:}\quad F_2 = k\delta,\; F_1 = k\delta + \sigma \dot P

The state is :math:`\theta` for a gear and the travel :math:`q = r \theta` for a screw, all of the above divided by r
as often as it takes: :math:`M = J/r^2`, :math:`b_m = b_r/r^2` (4), :math:`F_m = \eta (K_\tau/r) I` (3) and g = 1. With
spring at link 1 this is (9)-(12) and :math:`m_l \ddot x_l = F_2 - F_1`, :math:`M \ddot q = F_m - b_m\dot q - F_2` for
the unlumped drive, and :math:`F_2 = F_m - b_m \dot q` for the lumped one. With a gear, spring at link 2 and link 1 at
rest it is the two-mass drive :math:`J \ddot\theta = \eta K_\tau I - b_r \dot\theta - \tau_s/N`, and the housing pushes
the ground with :math:`-F_1 = -J \ddot\theta - \tau_s`, which the lumped drive makes N times as large,
:math:`-N J \ddot\theta - \tau_s`.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from functools import partial
from types import SimpleNamespace
from typing import Any, Literal

import casadi as ca

from seaopt.errors import PlantError
from seaopt.parameters import Parameter
from seaopt.plants import parts as part_laws
from seaopt.plants.equations.stored_equations import store_function
from seaopt.plants.memo import keep_last
from seaopt.plants.parts import Part
from seaopt.plants.plant import Derived, Plant
from seaopt.plants.roles import (
    Actuation,
    Bristles,
    Expression,
    Friction,
    Mode,
    Port,
    Recipe,
    Sensing,
    SeriesSpring,
    StateExpression,
)
from seaopt.records import record

Drive = Literal["unlumped", "lumped"]
Spring = Literal["link1", "link2"]
SPRING_SLIP = "spring_slip"  # the friction within a spring with hysteresis
BRISTLES, SLIPPING = "z_f", "z_h"  # states: deflections of LuGre's bristles, and of the spring that gives way
DRIVES: tuple[Drive, ...] = ("unlumped", "lumped")
SPRINGS: tuple[Spring, ...] = ("link1", "link2")


def _nothing(x: Any, p: Any) -> Any:
    return ca.SX(0)


@record(eq=False)
class Link:
    """One link: its coordinate and rate (states, if it moves), position along the axis, energies, force of its damper.

    `unit` is the coordinate's, `effort` the input that pushes it along the axis, `parameters` are its own.
    """

    coordinate: str | None = None
    rate: str | None = None
    position: StateExpression = _nothing
    kinetic: StateExpression = _nothing
    potential: StateExpression = _nothing
    damping: StateExpression = _nothing
    unit: str = ""
    effort: str | None = None
    parameters: tuple[Parameter, ...] = ()

    @property
    def moves(self) -> bool:
        """Whether it has a coordinate."""
        return self.coordinate is not None


@record(eq=False)
class Transmission:
    """A screw or a gear, in units of its own coordinate y (q of a screw, theta of a gear's motor)."""

    # coordinate, rate: the states y and dy/dt
    coordinate: str
    rate: str
    # place_unit, effort_unit: along the axis: m and N, or rad and N m
    place_unit: str
    effort_unit: str
    # direction, carry: sigma and kappa
    direction: float
    carry: float
    # travel, inertia, damping, per_ampere, sprung: g, J, b_r and eta K_tau as y sees them, and m_l
    travel: Expression
    inertia: Expression
    damping: Expression
    per_ampere: Expression
    sprung: Expression
    # stiffness, spring_damping: names of the spring's parameters
    stiffness: str
    spring_damping: str
    friction: str  # name of the dry friction
    parameters: tuple[Parameter, ...]  # of motor, transmission and spring
    part_parameters: Mapping[str, tuple[Parameter, ...]]  # what the parts inside add


@record(eq=False)
class Actuator:
    """The chosen parts of the derivation: transmission, links, drive, spring and effects."""

    transmission: Transmission
    links: tuple[Link, Link]
    drive: Drive
    spring: Spring
    parts: tuple[Part, ...]

    @property
    def damped_spring(self) -> bool:
        """Whether the spring has a damper: a part, or among the transmission's own parameters."""
        names = {parameter.name for parameter in self.transmission.parameters}
        return "spring_damping" in self.parts or self.transmission.spring_damping in names

    @property
    def housing_rides(self) -> bool:
        """Whether the housing is link 1's, so that with the links fixed only the rotor swings."""
        return self.drive == "unlumped" and self.spring == "link2"


@record
class EquationsOfMotion:
    """The accelerations and forces of an actuator, as expressions of state, input and parameters.

    Its energy is written down where it is asked for: a spring's may take longer than all the rest.
    """

    rates: Mapping[str, Any]
    forces: tuple[Any, Any]
    places: tuple[Any, Any]
    deflection: Any
    deflection_rate: Any
    spring_force: Any
    energy: Callable[[], Any]


def solve_motion(actuator: Actuator, x: Any, u: Any, p: Any) -> EquationsOfMotion:
    """Return Lagrange's equations of the module docstring, solved for the accelerations."""
    drive, links, parts = actuator.transmission, actuator.links, actuator.parts
    unlumped, screw = actuator.drive == "unlumped", "screw_mode" in parts
    moving = [link for link in links if link.moves]
    names = [(drive.coordinate, drive.rate), *([("s", "sd")] if screw else [])]
    names += [(str(link.coordinate), str(link.rate)) for link in moving]
    y = ca.vertcat(*(getattr(x, coordinate) for coordinate, _ in names))
    yd = ca.vertcat(*(getattr(x, rate) for _, rate in names))

    sigma, travel, inertia = drive.direction, drive.travel(p) * y[0], drive.inertia(p)
    sprung = drive.sprung(p) if unlumped else drive.sprung(p) + inertia / drive.travel(p) ** 2
    stretch = x.s if screw else 0.0
    x_1, x_2 = (link.position(x, p) for link in links)
    if actuator.spring == "link1":
        x_n = x_2 + stretch  # the nut
        x_s = x_h = x_n - sigma * travel
        deflection = travel - sigma * (x_n - x_1)
    elif unlumped:
        x_n = x_1 + sigma * travel + stretch
        x_s = x_h = x_1
        deflection = sigma * (x_n - x_2)
    else:  # the mirror of spring at link 1
        x_n = x_h = x_1 + stretch
        x_s = x_n + sigma * travel
        deflection = travel - sigma * (x_2 - x_n)

    def speed(position: Any) -> Any:
        return ca.jtimes(position, y, yd)

    turning = yd[0] + drive.carry * speed(x_h)
    rotor, nut = inertia if unlumped else 0.0, p.m_n if screw else 0.0
    kinetic = 0.5 * (rotor * turning**2 + sprung * speed(x_s) ** 2 + nut * speed(x_n) ** 2)
    kinetic += links[0].kinetic(x, p) + links[1].kinetic(x, p)
    potential = links[0].potential(x, p) + links[1].potential(x, p)
    stiffness = getattr(p, drive.stiffness)
    tension = part_laws.spring_force(parts, deflection, stiffness, p)
    if actuator.damped_spring:
        tension += getattr(p, drive.spring_damping) * speed(deflection)
    if "hysteresis" in parts:
        tension += getattr(u, SPRING_SLIP)
    bolt = (p.k_b * x.s + p.c_b * x.sd) if screw else 0.0

    # T = yd' H(y) yd / 2, so that H ydd = Q - dV/dy - (dH/dt yd - dT/dy).
    mass, _ = ca.hessian(kinetic, yd)
    gyroscopic = ca.jtimes(ca.gradient(kinetic, yd), y, yd) - ca.gradient(kinetic, y)
    motor = drive.per_ampere(p) * u.I - drive.damping(p) * yd[0] - getattr(u, drive.friction)
    # Along the positions' gradients, not the gradient of a work: a force may depend on the state (a spring outside).
    external = sum(
        (
            getattr(u, link.effort, 0.0) * ca.gradient(position, y)
            for link, position in zip(links, (x_1, x_2), strict=True)
            if link.effort is not None
        ),
        ca.SX(y.numel(), 1),
    )
    damping = ca.vertcat(0.0, *([bolt] if screw else []), *(link.damping(x, p) for link in moving))
    generalised = external - ca.gradient(potential, y) - damping - tension * ca.gradient(deflection, y)
    generalised[0] += motor
    ydd = ca.mtimes(ca.inv_minor(mass), generalised - gyroscopic)

    def thrust(mass: Any, position: Any) -> Any:
        return mass * (ca.jtimes(speed(position), y, yd) + ca.jtimes(position, y, ydd))

    between = sigma * (thrust(sprung, x_s) + drive.carry * rotor * (ydd[0] + thrust(drive.carry, x_h)))
    if actuator.spring == "link1":
        forces = (tension, -bolt if screw else tension - between)
    else:
        forces = (tension + between + (sigma * thrust(nut, x_n) if screw else 0.0), tension)

    def energy() -> Any:
        stored = kinetic + potential + part_laws.spring_energy(parts, deflection, stiffness, p)
        return stored + (0.5 * p.k_b * x.s**2 if screw else 0.0)

    return EquationsOfMotion(
        rates={name: value for k, pair in enumerate(names) for name, value in zip(pair, (yd[k], ydd[k]), strict=True)},
        forces=forces,
        places=(x_1, x_2),
        deflection=deflection,
        deflection_rate=speed(deflection),
        spring_force=tension,
        energy=energy,
    )


def check_choices(*choices: tuple[str, object, tuple[str, ...]]) -> None:
    """Refuse an option that is not among those known (PlantError), each given as (name, choice, known)."""
    for what, choice, valid in choices:
        if choice not in valid:
            raise PlantError(f'{what} = "{choice}" is not known; use ' + " or ".join(f'"{name}"' for name in valid))


def remake(make: Callable[[str, Any], Plant], name: str, build: Any, parts: tuple[Part, ...]) -> Plant:
    """Return the plant that `make` gives with these parts."""
    return make(name, replace(build, parts=parts))


def make_plant(
    actuator: Actuator,
    *,
    name: str,
    outputs: Mapping[str, tuple[str, Callable[[EquationsOfMotion, Any], Any]]],
    derived: Derived,
    sensing: Sensing,
    second_order: tuple[str, str] | None = None,
    inputs: tuple[str, ...] = (),
    ports: tuple[Port, ...] = (),
    recipe: Recipe | None = None,
) -> Plant:
    """Return the plant of an actuator: its equations and roles, then the parts that wrap any plant. `outputs`: what can
    be measured. `derived`, `sensing`, `ports`, `recipe`: as in `Plant`. `second_order`: the derived figures that are
    mass and damping of the second-order response with the links fixed. `inputs`: efforts of the world on the links,
    which a log may leave out.
    """
    drive, parts = actuator.transmission, actuator.parts
    position, effort = drive.place_unit, drive.effort_unit
    pairs = [(drive.coordinate, drive.rate, position)]
    pairs += [("s", "sd", position)] if "screw_mode" in parts else []
    pairs += [(str(link.coordinate), str(link.rate), link.unit) for link in actuator.links if link.moves]
    parameters = [*drive.parameters, *part_laws.parameters(parts, drive.part_parameters)]
    parameters += [parameter for link in actuator.links for parameter in link.parameters]

    states = {state: unit for pair in pairs for state, unit in zip(pair[:2], (pair[2], f"{pair[2]}/s"), strict=True)}
    frictions = _list_frictions(actuator, states, [parameter.name for parameter in parameters])
    bristled = [friction for friction in frictions.values() if friction.bristles is not None]

    solve = keep_last(partial(solve_motion, actuator))  # most of the time of making a plant

    def f(t: Any, x: Any, u: Any, p: Any) -> Mapping[str, Any]:
        slips = {_get_bristles(friction).state: friction.find_rate(x, u, p) for friction in bristled}
        return {**solve(x, u, p).rates, **slips}

    def h(t: Any, x: Any, u: Any, p: Any) -> dict[str, Any]:
        motion = solve(x, u, p)
        return {output: read(motion, x) for output, (_, read) in outputs.items()}

    def energy(x: Any, p: Any) -> Any:
        stored = (
            0.5 * bristles.stiffness(p) * getattr(x, bristles.state) ** 2 for bristles in map(_get_bristles, bristled)
        )
        return solve_motion(actuator, x, _rest(actuator), p).energy() + sum(stored)

    def deflection(x: Any, p: Any) -> Any:
        return solve_motion(actuator, x, _rest(actuator), p).deflection

    plant = Plant(
        name=name,
        states=states | {_get_bristles(friction).state: position for friction in bristled},
        inputs={"I": "A"} | dict.fromkeys(inputs, effort),
        outputs={output: unit for output, (unit, _) in outputs.items()},
        parameters={parameter.name: parameter for parameter in parameters},
        f=f,
        h=h,
        derived=derived,
        optional_inputs=frozenset({"I", *inputs}) if inputs else frozenset(),
        energy=energy if part_laws.stores_in_closed_form(parts) else None,
        actuation=Actuation(
            input="I",
            effort=lambda p: drive.per_ampere(p) / drive.travel(p),
            unit=effort,
            efficiency="eta",
            speed=lambda x, p: drive.travel(p) * getattr(x, drive.rate),
        ),
        sensing=sensing,
        spring=SeriesSpring(
            deflection=deflection,
            unit=position,
            stiffness=drive.stiffness,
            pull=lambda x, p: _find_pull(actuator, x, p),
            mass=second_order[0] if second_order else None,
            damping=second_order[1] if second_order else None,
            damper=drive.spring_damping if actuator.damped_spring else None,
            play="g_b" if "backlash" in parts else None,
        ),
        ports=ports,
        friction=frictions,
        recipe=recipe,
        mode=Mode(name="screw_mode_hz", parameter="m_n", state="s") if "screw_mode" in parts else None,
    )
    return part_laws.wrapped(plant, [part for part in parts if part not in part_laws.INSIDE])


def _rest(actuator: Actuator) -> SimpleNamespace:
    """Return the inputs of an actuator that nothing drives and that does not rub."""
    return SimpleNamespace(**dict.fromkeys(("I", actuator.transmission.friction, SPRING_SLIP), 0.0))


def _find_pull(actuator: Actuator, x: Any, p: Any) -> Any:
    """Return the force of the spring with its damper's, and that of what gives way in it."""
    force = solve_motion(actuator, x, _rest(actuator), p).spring_force
    return force + p.k_h * getattr(x, SLIPPING) if "hysteresis" in actuator.parts else force


def _list_frictions(actuator: Actuator, states: Collection[str], names: Sequence[str]) -> dict[str, Friction]:
    """Return what rubs: the drive, and within a spring with hysteresis what gives way. `states` are those of the
    motion, `names` those of the parameters.
    """
    drive, parts = actuator.transmission, actuator.parts
    slips = (SLIPPING,) if "hysteresis" in parts else ()

    def read_loads(x: Any, u: Any, p: Any) -> Mapping[str, Any]:
        return {"motor": drive.per_ampere(p) * u.I, "output": drive.travel(p) * _find_pull(actuator, x, p)}

    # Stored, it takes expressions for the states, which the derivatives in `solve_motion` do not.
    loads = store_function(read_loads, (*states, *slips), ("I",), names) if "load_friction" in parts else None
    bristles = Bristles(
        state=BRISTLES,
        coordinate=lambda x, p: getattr(x, drive.coordinate),
        stiffness=lambda p: p.sigma_0,
        damping=lambda p: p.sigma_1,
        rate=lambda z, v, p: part_laws.lugre_rate(parts, z, v, p),
    )
    frictions = {
        drive.friction: Friction(
            velocity=lambda x, p: getattr(x, drive.rate),
            force=lambda v, p: part_laws.dry_friction(parts, v, p),
            unit=drive.effort_unit,
            effort=lambda p: 1.0 / drive.travel(p),
            slopes=lambda p: part_laws.bound_friction_slopes(parts, p),
            jump=lambda speed, p: part_laws.friction_level(parts, speed, p),
            smoothing="v_s",
            loads=loads,
            rated=part_laws.LOADS if "load_friction" in parts else {},
            bristles=bristles if "lugre" in parts else None,
        )
    }  # fmt: skip
    if not slips:
        return frictions

    def read_spring(x: Any, p: Any) -> tuple[Any, Any]:
        motion = solve_motion(actuator, x, _rest(actuator), p)
        return motion.deflection, motion.deflection_rate

    spring = store_function(read_spring, states, names)
    within = Bristles(
        state=SLIPPING,
        coordinate=lambda x, p: spring(x, p)[0],
        stiffness=lambda p: p.k_h,
        damping=lambda p: 0.0,
        rate=part_laws.hysteresis_rate,
    )
    return frictions | {
        SPRING_SLIP: Friction(
            velocity=lambda x, p: spring(x, p)[1],
            force=lambda v, p: p.k_h * p.y_h * ca.sign(v),
            unit=drive.effort_unit,
            effort=lambda p: 0.0,  # it is a part of the spring's
            slopes=lambda p: (0.0, 0.0),
            bristles=within,
        )
    }


def _get_bristles(friction: Friction) -> Bristles:
    assert friction.bristles is not None
    return friction.bristles
