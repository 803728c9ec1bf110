r"""The rotary series elastic actuator: motor, gearbox, spring and link about one axis.

The derivation is in `seaopt.plants.actuator`: here a gear is its transmission, link 1 is the ground, and link 2 the
actuator's link, held, an inertia about the axis, or a pendulum that hangs from it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any, Literal

import casadi as ca

from seaopt.errors import PlantError
from seaopt.parameters import Parameter, declare
from seaopt.plants.actuator import (
    DRIVES,
    SPRINGS,
    Actuator,
    Drive,
    Link,
    Spring,
    Transmission,
    check_choices,
    make_plant,
    remake,
)
from seaopt.plants.friction import let_stick
from seaopt.plants.motor import effects
from seaopt.plants.parts import INSIDE, PARTS, SHARPNESS, Part, check_parts
from seaopt.plants.plant import Plant
from seaopt.plants.published import GRAVITY
from seaopt.plants.roles import Port, Recipe, Sensing
from seaopt.records import record

RotaryLink = Literal["free", "locked", "pendulum"]
LINKS = ("free", "locked", "pendulum")

_DRIVE = (
    declare("J_m", 1e-4, "kg m^2", 1e-15, "motor inertia", (1e-10, 10)),
    declare("b_r", 1e-4, "N m s", 0.0, "motor damping", (0, 100)),
    declare("K_tau", 0.05, "N m/A", 0.0, "motor torque constant", (0.0001, 100)),
    declare("N", 50.0, "-", 1e-9, "gear ratio", (0.02, 10000)),
    declare("k_s", 300.0, "N m/rad", 0.0, "spring stiffness", (0.01, 1e08)),
    declare("c_s", 0.0, "N m s/rad", 0.0, "spring damping", (0, 1e06)),
    declare("eta", 1.0, "-", 0.0, "transmission efficiency", (0.25, 1.25)),
    declare("f_c", 0.0, "N m", 0.0, "Coulomb friction at the motor", (0, 1000)),
    declare("v_s", 1.0, "rad/s", 1e-9, "smoothing speed of f_c, at the motor"),
)
_HOUSING = declare("J_h", 0.0, "kg m^2", 0.0, "housing inertia about the axis", (0, 100000))
_LINK = (
    declare("J_l", 0.1, "kg m^2", 1e-15, "link inertia", (1e-08, 100000)),
    declare("d_l", 0.0, "N m s/rad", 0.0, "link damping", (0, 100000)),
)
_PENDULUM = (
    declare("m", 3.0, "kg", 0.0, "pendulum mass", (0, 10000)),
    declare("L", 0.15, "m", 0.0, "centre of mass to pivot", (0, 10)),
    GRAVITY,
)
_PARTS: dict[str, tuple[Parameter, ...]] = {
    "stribeck": (
        declare("f_s", 0.0, "N m", 0.0, "breakaway friction at the motor"),
        declare("v_st", 10.0, "rad/s", 1e-9, "Stribeck speed, at the motor"),
    ),
    "load_friction": PARTS["load_friction"],
    "load_stribeck": PARTS["load_stribeck"],
    "load_square": tuple(replace(parameter, unit="1/(N m)") for parameter in PARTS["load_square"]),
    "lugre": (
        declare("f_c", 0.02, "N m", 1e-12, "Coulomb friction at the motor", (0, 1000)),
        declare("sigma_0", 5.0, "N m/rad", 0.0, "stiffness of the bristles, at the motor"),
        declare("sigma_1", 0.01, "N m s/rad", 0.0, "damping of the bristles, at the motor"),
    ),
    "hysteresis": (
        declare("k_h", 0.0, "N m/rad", 0.0, "stiffness of the spring that gives way"),
        declare("y_h", 5e-3, "rad", 1e-12, "deflection at which it gives way"),
        SHARPNESS,
    ),
    "backlash": (
        declare("g_b", 5e-4, "rad", 0.0, "half of the play, at the spring", (0, 1)),
        declare("eps_b", 5e-5, "rad", 1e-12, "rounding of the play's corners"),
    ),
    "hardening": (declare("k_3", 0.0, "N m/rad^3", 0.0, "cubic stiffness"),),
    "spring_damping": (),  # c_s is there without it
    **effects.ROTARY_PARTS,
    "deflection_sensor": tuple(replace(parameter, unit="N m/rad") for parameter in PARTS["deflection_sensor"]),
}

_GEAR = Transmission(
    coordinate="theta_m",
    rate="thetad_m",
    place_unit="rad",
    effort_unit="N m",
    direction=1.0,
    carry=1.0,
    travel=lambda p: 1.0 / p.N,
    inertia=lambda p: p.J_m,
    damping=lambda p: p.b_r,
    per_ampere=lambda p: p.eta * p.K_tau,
    sprung=lambda p: 0.0,
    stiffness="k_s",
    spring_damping="c_s",
    friction="tau_f",
    parameters=_DRIVE,
    part_parameters=_PARTS,
)
# With the spring at link 1 the housing hangs on it, so that its own inertia counts.
_HANGING_GEAR = replace(_GEAR, sprung=lambda p: p.J_h, parameters=(*_DRIVE, _HOUSING))
_TURNING = Link(
    coordinate="theta_l",
    rate="thetad_l",
    unit="rad",
    position=lambda x, p: x.theta_l,
    kinetic=lambda x, p: 0.5 * p.J_l * x.thetad_l**2,
    effort="tau_e",
    parameters=_LINK[:1],
)
_FREE = replace(_TURNING, damping=lambda x, p: p.d_l * x.thetad_l, parameters=_LINK)
_LINK_OF = {
    "locked": Link(effort="tau_e"),
    "free": _FREE,
    "pendulum": replace(
        _FREE, potential=lambda x, p: p.m * p.g * p.L * (1 - ca.cos(x.theta_l)), parameters=(*_LINK, *_PENDULUM)
    ),
    "bare": _TURNING,  # of the probe, whose only parameter is its inertia
}
_PAYLOAD = {"free": ("J_l",), "pendulum": ("J_l", "m"), "bare": ("J_l",)}


@record
class _Build:
    """The choices of which an actuator is built."""

    link: str
    drive: Drive
    spring: Spring
    parts: tuple[Part, ...]
    external: bool


def rotary_parameters() -> tuple[Parameter, ...]:
    """Return the parameters that some `rotary` has, with their defaults."""
    return (*(parameter for added in _PARTS.values() for parameter in added), *_DRIVE, _HOUSING, *_LINK, *_PENDULUM)


def rotary(
    link: RotaryLink = "free",
    drive: Drive = "unlumped",
    spring: Spring = "link2",
    parts: Sequence[Part] = (),
    external: bool = False,
    sticks: bool = False,
) -> Plant:
    r"""Return a rotary series elastic actuator: motor, gearbox, spring and link about one axis.

    Parameters
    ----------
    link : {"free", "locked", "pendulum"}
        The link turns freely, is held, or hangs from the axis with its centre of mass at L; J_l is its inertia about
        the axis in every case, the pendulum's m L^2 included.
    drive : {"unlumped", "lumped"}
        The rotor turns N times as fast as the output and about the same axis, or its reflected inertia N^2 J_m turns
        as a mass with the end of the gearbox that hangs on the spring. With the spring at link 2 they move alike and
        differ in the torque on the housing.
    spring : {"link2", "link1"}
        Between gearbox and link, or between housing and ground (a reaction force sensing actuator, whose housing, with
        the inertia J_h, moves on the spring).
    parts : sequence of str
        Effects of a real actuator, friction at the motor (N m, rad/s) and play at the spring (rad); every part of
        `seaopt.plants.parts` but the screw's own mode.
    external : bool
        Whether a torque tau_e (N m) on the link is an input of its own, zero where a log leaves it out.
    sticks : bool
        Whether friction jumps at rest, as `seaopt.plants.let_stick` has it, and is not smoothed.

    Returns
    -------
    Plant
        Input I (A); outputs tau_s (N m, the spring's torque), theta_m, theta_l (rad; no theta_l of a locked link),
        tau_h (N m, the torque on the ground that carries the actuator), deflection (rad), and with the spring at link 1
        tau_l (N m, the torque on the link).

    Raises
    ------
    PlantError
        An option is unknown.

    Notes
    -----
    Spring at link 2, with :math:`\tau_s = k_s(\theta_m/N - \theta_l) + c_s(\dot\theta_m/N - \dot\theta_l)`:

    .. math:: J_m \ddot\theta_m = \eta K_\tau I - b_r \dot\theta_m - f_c \tanh(\dot\theta_m/v_s) - \tau_s/N, \qquad
              J_l \ddot\theta_l = \tau_s - d_l \dot\theta_l - m g L \sin\theta_l + \tau_e

    The housing carries the stator and the gearbox, which turns the torque :math:`\tau_s/N` into :math:`\tau_s`:
    :math:`\tau_h = -J_m \ddot\theta_m - \tau_s`, so that motor, link and housing together conserve angular momentum
    except for d_l and gravity. The unlumped view matters here as in the paper (Orekhov et al. 2015, Sec. V): the lumped
    drive has :math:`\tau_h = -N J_m \ddot\theta_m - \tau_s`.

    With the motor held the link swings at :math:`\sqrt{k_s/J_l}` (the antiresonance of theta_m, and a clamped flexible
    link's frequency); free, both swing at :math:`\sqrt{k_s(1/J_l + 1/(N^2 J_m))}`. N = 1 is the two-mass drive. The
    derivation, and the spring at link 1, are in `seaopt.plants.actuator`.

    Examples
    --------
    >>> import seaopt as so
    >>> plant = so.plants.rotary()
    >>> model = plant.linearize(plant.defaults)
    >>> model.output_labels
    ['tau_s', 'theta_m', 'theta_l', 'tau_h', 'deflection']
    """
    check_choices(("link", link, LINKS), ("drive", drive, DRIVES), ("spring", spring, SPRINGS))
    if not isinstance(external, bool):
        raise PlantError(f"external = {external!r} is not true or false; give one of them")
    check_parts(parts)
    if "screw_mode" in parts:
        raise PlantError('part "screw_mode" is the axial mode of a ball screw; a gear\'s elasticity is part of k_s')
    name = f"rotary({link}, {drive})" if (link, drive) != ("free", "unlumped") else "rotary"
    plant = _actuator(name, _Build(link=link, drive=drive, spring=spring, parts=tuple(parts), external=external))
    return let_stick(plant) if sticks else plant


def _actuator(name: str, build: _Build) -> Plant:
    """Return the plant of choices that are checked; its link may be the probe's bare one."""
    hanging, moves = build.spring == "link1", build.link != "locked"
    actuator = Actuator(
        transmission=_HANGING_GEAR if hanging else _GEAR,
        links=(Link(), _LINK_OF[build.link]),
        drive=build.drive,
        spring=build.spring,
        parts=build.parts,
    )
    outputs: dict[str, tuple[str, Any]] = {
        "tau_s": ("N m", lambda motion, x: motion.spring_force),
        "theta_m": ("rad", lambda motion, x: x.theta_m),
        **({"theta_l": ("rad", lambda motion, x: x.theta_l)} if moves else {}),
        "tau_h": ("N m", lambda motion, x: -motion.forces[0]),
        "deflection": ("rad", lambda motion, x: motion.deflection),
        **({"tau_l": ("N m", lambda motion, x: motion.forces[1])} if hanging else {}),
    }
    return make_plant(
        actuator,
        name=name,
        outputs=outputs,
        derived=partial(_derive_figures, build=build),
        sensing=Sensing(
            regulated=("tau_s", "tau_l") if hanging else ("tau_s",),
            motor_position="theta_m",
            motor_speed="thetad_m",
            link_position="theta_l" if moves else None,
        ),
        second_order=("reflected_inertia", "reflected_damping"),
        inputs=("tau_e",) if build.external else (),
        ports=(_port(name, build),),
        recipe=Recipe(parts=build.parts, make=partial(remake, _actuator, name, build)),
    )


def _derive_figures(p: Any, build: _Build) -> dict[str, tuple[Any, str]]:
    """Return what swings on the spring with the link held, and the frequencies with it free."""
    inertia, damping = p.N**2 * p.J_m, p.N**2 * p.b_r
    if build.spring == "link1":  # a rotor on the housing turns N - 1 times as fast as the housing, backwards
        inertia = p.J_h + ((p.N - 1) ** 2 * p.J_m if build.drive == "unlumped" else inertia)
    figures = {
        "reflected_inertia": (inertia, "kg m^2"),
        "reflected_damping": (damping, "N m s/rad"),
        "natural_frequency_hz": (ca.sqrt(p.k_s / inertia) / (2 * math.pi), "Hz"),
        "damping_ratio": ((damping + p.c_s) / (2 * ca.sqrt(p.k_s * inertia)), "-"),
    }
    if build.spring == "link2" and build.link in ("free", "pendulum"):
        weight = p.m * p.g * p.L if build.link == "pendulum" else 0.0
        figures["antiresonance_hz"] = (ca.sqrt((p.k_s + weight) / p.J_l) / (2 * math.pi), "Hz")
    if build.spring == "link2" and build.link == "free":
        figures["resonance_hz"] = (ca.sqrt(p.k_s * (1 / p.J_l + 1 / inertia)) / (2 * math.pi), "Hz")
    return figures


def _port(name: str, build: _Build) -> Port:
    """Return the port at the link: of a held one only its probe."""
    inside = replace(build, parts=tuple(part for part in build.parts if part in INSIDE))
    probe = partial(_actuator, f"port of {name}", replace(inside, link="bare", external=True))
    if build.link == "locked":
        return Port(probe=probe)
    return Port(
        motion="theta_l",
        coordinate="theta_l",
        rate="thetad_l",
        effort="tau_e" if build.external else None,
        payload=_PAYLOAD[build.link],
        held=partial(_actuator, f"{name}, link held", replace(inside, link="locked")),
        drive="theta_m",
        ratio=lambda p: -p.N,  # the spring's deflection is theta_m/N - theta_l
        probe=probe,
    )
