r"""The ball-screw actuator between two links (Orekhov et al. 2015, Figs. 3 and 4), and its special cases.

The derivation is in `seaopt.plants.actuator`: here a screw is its transmission, and its links are fixed, masses that
slide along x, or pendulums whose lever arms pull along x.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any, Literal

import casadi as ca

from seaopt.plants import parts as part_laws
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
from seaopt.plants.parts import PARTS, Part
from seaopt.plants.plant import Plant
from seaopt.plants.published import ACTUATOR, GRAVITY, link_mass, pendulum
from seaopt.plants.roles import Port, Recipe, Sensing
from seaopt.records import record

LinkKind = Literal["fixed", "mass", "pendulum"]


def _radius(p: Any) -> Any:
    """Return r (2)."""
    return p.l / (2 * math.pi * p.N_p)


def derived_figures(p: Any, *, housing_rides: bool = False) -> dict[str, tuple[Any, str]]:
    """Return r (2), m_k (1), b_m (4), and the natural frequency and damping ratio with both links fixed (13). Where the
    housing rides on link 1 (unlumped, spring at link 2), only M = J/r^2 swings then, not m_k.
    """
    rotor, b_m = SCREW.inertia(p), SCREW.damping(p)
    m_k = p.m_l + rotor
    swinging = rotor if housing_rides else m_k
    return {
        "r": (_radius(p), "m"),
        "m_k": (m_k, "kg"),
        "b_m": (b_m, "N s/m"),
        "natural_frequency_hz": (ca.sqrt(p.k / swinging) / (2 * math.pi), "Hz"),
        "damping_ratio": (b_m / (2 * ca.sqrt(p.k * swinging)), "-"),
    }


SCREW = Transmission(
    coordinate="q",
    rate="qd",
    place_unit="m",
    effort_unit="N",
    direction=-1.0,
    carry=0.0,
    travel=lambda p: 1.0,
    inertia=lambda p: p.J / _radius(p) ** 2,
    damping=lambda p: p.b_r / _radius(p) ** 2,
    per_ampere=lambda p: p.eta * (p.K_tau / _radius(p)),
    sprung=lambda p: p.m_l,
    stiffness="k",
    spring_damping="c_k",
    friction="F_f",
    parameters=ACTUATOR,
    part_parameters=PARTS,
)


@record
class _Build:
    """The choices of which an actuator is built: links, the endings of their names, and whether forces act on them."""

    links: tuple[LinkKind, LinkKind]
    suffixes: tuple[str, str]
    drive: Drive
    spring: Spring
    parts: tuple[Part, ...]
    external: bool = False


def _make_link(kind: LinkKind, number: int, suffix: str) -> Link:
    if kind == "fixed":
        return Link(effort=f"Fe{number}")
    if kind == "mass":
        coordinate, rate, mass = f"x_{number}", f"v_{number}", f"m_{number}"
        return Link(
            coordinate=coordinate,
            rate=rate,
            unit="m",
            position=lambda x, p: getattr(x, coordinate),
            kinetic=lambda x, p: 0.5 * getattr(p, mass) * getattr(x, rate) ** 2,
            effort=f"Fe{number}",
            parameters=(link_mass(number),),
        )
    phi, phid = f"phi{suffix}", f"phid{suffix}"

    def read(p: Any, name: str) -> Any:
        return getattr(p, name + suffix)

    return Link(
        coordinate=phi,
        rate=phid,
        unit="rad",
        position=lambda x, p: read(p, "L_a") * ca.sin(getattr(x, phi)),
        kinetic=lambda x, p: 0.5 * read(p, "I_p") * getattr(x, phid) ** 2,
        potential=lambda x, p: read(p, "m") * p.g * read(p, "L") * (1 - ca.cos(getattr(x, phi))),
        damping=lambda x, p: read(p, "d") * getattr(x, phid),
        effort=f"Fe{number}",
        parameters=tuple(pendulum(suffix)),
    )


def _build_plant(
    name: str,
    links: tuple[LinkKind, LinkKind],
    drive: Drive,
    spring: Spring,
    parts: Sequence[Part],
    sticks: bool,
    *,
    suffixes: tuple[str, str] = ("1", "2"),
    external: bool = False,
) -> Plant:
    """Return the plant of a user's choices."""
    kinds = ("fixed", "mass", "pendulum")
    check_choices(
        ("drive", drive, DRIVES), ("spring", spring, SPRINGS), ("link1", links[0], kinds), ("link2", links[1], kinds)
    )
    part_laws.check_parts(parts)
    build = _Build(links=links, suffixes=suffixes, drive=drive, spring=spring, parts=tuple(parts), external=external)
    plant = _actuator(f"{name}{drive})", build)
    return let_stick(plant) if sticks else plant


def _actuator(name: str, build: _Build) -> Plant:
    """Return the plant of a build."""
    links = tuple(_make_link(build.links[i], i + 1, build.suffixes[i]) for i in (0, 1))
    if "pendulum" in build.links:  # one gravity for both, the last parameter
        links = (links[0], replace(links[1], parameters=(*links[1].parameters, GRAVITY)))
    actuator = Actuator(
        transmission=SCREW, links=(links[0], links[1]), drive=build.drive, spring=build.spring, parts=build.parts
    )
    rides = actuator.housing_rides
    outputs = _list_outputs(build)
    return make_plant(
        actuator,
        name=name,
        outputs=outputs,
        derived=lambda p: derived_figures(p, housing_rides=rides),
        sensing=Sensing(
            regulated=("F1", "F2"),
            motor_position="q",
            motor_speed="qd",
            link_position="x_2" if "x_2" in outputs else None,
        ),
        second_order=None if rides else ("m_k", "b_m"),
        inputs=("Fe1", "Fe2") if build.external else (),
        ports=_ports(name, build),
        recipe=Recipe(parts=build.parts, make=partial(remake, _actuator, name, build)),
    )


def _list_outputs(build: _Build) -> dict[str, tuple[str, Any]]:
    outputs: dict[str, tuple[str, Any]] = {
        "F1": ("N", lambda motion, x: motion.forces[0]),
        "F2": ("N", lambda motion, x: motion.forces[1]),
        "q": ("m", lambda motion, x: x.q),
    }

    def angle(name: str) -> Any:
        return lambda motion, x: getattr(x, name)

    def position(index: int) -> Any:
        return lambda motion, x: motion.places[index]

    for index, (link, suffix) in enumerate(zip(build.links, build.suffixes, strict=True)):
        if link == "pendulum":
            outputs[f"phi{suffix}"] = ("rad", angle(f"phi{suffix}"))
        if link != "fixed":
            outputs[f"x_{index + 1}"] = ("m", position(index))
    return outputs


def _ports(name: str, build: _Build) -> tuple[Port, ...]:
    """Return the ports at link 2 and, where it moves, at link 1."""
    inside = replace(build, parts=tuple(part for part in build.parts if part in part_laws.INSIDE))
    bare = replace(inside, links=("fixed", "mass"), suffixes=("1", "2"), external=True)
    ports: list[Port] = []
    for number, ratio in ((2, 1.0), (1, -1.0)):  # the spring's compression is q + x_2 - x_1
        kind, suffix = build.links[number - 1], build.suffixes[number - 1]
        probe = partial(_actuator, f"port of {name}", bare) if number == 2 else None
        if kind == "fixed":
            ports += [Port(probe=probe)] if probe else []
            continue
        link = _make_link(kind, number, suffix)
        links = (build.links[0], "fixed") if number == 2 else ("fixed", build.links[1])
        ports.append(
            Port(
                motion=f"x_{number}",
                coordinate=link.coordinate,
                rate=link.rate,
                effort=link.effort if build.external else None,
                payload=(f"m_{number}",) if kind == "mass" else (f"I_p{suffix}", f"m{suffix}"),
                held=partial(_actuator, f"{name}, link {number} held", replace(inside, links=links)),
                drive="q",
                ratio=lambda p, ratio=ratio: ratio,
                probe=probe,
            )
        )
    return tuple(ports)


def two_link(
    link1: LinkKind = "fixed",
    link2: LinkKind = "fixed",
    drive: Drive = "unlumped",
    spring: Spring = "link1",
    parts: Sequence[Part] = (),
    sticks: bool = False,
) -> Plant:
    r"""Return the general plant: an actuator between two links, each fixed, a free mass or a pendulum.

    Parameters
    ----------
    link1, link2 : {"fixed", "mass", "pendulum"}
        A mass m_1 (m_2) slides along x; a pendulum's lever arm pulls along x, x = L_a sin(phi), and the names of
        its parameters, states and angle carry the link's number (I_p1, L_a2, phi2).
    drive : {"unlumped", "lumped"}
        The rack and pinion of Orekhov et al. 2015 (Fig. 4b), or the conventional lumped mass (Fig. 4a).
    spring : {"link1", "link2"}
        Between housing and link 1 (the paper), or between ball nut and link 2 (its future work).
    parts : sequence of str
        Effects of a real actuator to add; see `seaopt.plants.parts`.
    sticks : bool
        Whether friction jumps at rest, as `seaopt.plants.let_stick` has it, and is not smoothed.

    Returns
    -------
    Plant
        Inputs I (A) and the external forces Fe1, Fe2 (N, positive along x; on a fixed link the ground carries them;
        any of the three is zero where a log leaves it out). Outputs F1, F2 (N), q (m), and of each moving link
        x_i (m) and phi (rad).

    Raises
    ------
    PlantError
        An option is unknown.

    Notes
    -----
    Spring at link 1, unlumped, with :math:`\delta = q + x_2 - x_1`, :math:`x_l = q + x_2` (5), :math:`M = J/r^2`:

    .. math:: F_1 = k\delta, \quad m_l \ddot x_l = F_2 - F_1, \quad M \ddot q = F_m - b_m \dot q - F_2

    and the links feel +F1 and -F2: :math:`m_1 \ddot x_1 = F_1 + F_{e1}`, :math:`m_2 \ddot x_2 = -F_2 + F_{e2}`,
    :math:`I_p \ddot\varphi = -F_2 L_a \cos\varphi - m g L \sin\varphi - d \dot\varphi`. The other drives and
    springs are in `seaopt.plants.actuator`, with the derivation (Orekhov et al. 2015, Figs. 3, 4 and (1)-(12)).

    Examples
    --------
    >>> plant = two_link(link1="mass", link2="pendulum")
    >>> list(plant.states)
    ['q', 'qd', 'x_1', 'v_1', 'phi2', 'phid2']
    """
    return _build_plant(f"two_link({link1}, {link2}, ", (link1, link2), drive, spring, parts, sticks, external=True)


def high_impedance(
    drive: Drive = "unlumped", spring: Spring = "link1", parts: Sequence[Part] = (), sticks: bool = False
) -> Plant:
    r"""Return the test stand: both links fixed (Orekhov et al. 2015, Fig. 5 and (6)-(15)).

    Parameters
    ----------
    drive, spring, parts, sticks
        As in `two_link`.

    Returns
    -------
    Plant
        Input I (A), outputs F1, F2 (N) and q (m).

    Notes
    -----
    With :math:`F_m = \eta (K_\tau/r) I` (3), spring at link 1:

    .. math:: \frac{F_1}{F_m} = \frac{k}{m_k s^2 + b_m s + k}, \qquad
              \frac{F_2}{F_m} = \frac{m s^2 + k}{m_k s^2 + b_m s + k}

    where m is :math:`m_k` for the lumped drive (6)-(8) and :math:`m_l` for the unlumped one (13)-(15). Spring at
    link 2, unlumped: :math:`F_1 = F_2 = k F_m/(M s^2 + b_m s + k)`, the housing being at rest.

    Examples
    --------
    >>> from seaopt.plants import thor
    >>> model = high_impedance().linearize(thor())
    >>> bool(abs(model.dcgain()[0, 0] - 240.33) < 0.01)  # N/A: K_tau / r
    True
    """
    return _build_plant("high_impedance(", ("fixed", "fixed"), drive, spring, parts, sticks)


def moving_output(
    drive: Drive = "unlumped", spring: Spring = "link1", parts: Sequence[Part] = (), sticks: bool = False
) -> Plant:
    r"""Return the swing phase: link 1 fixed, a pendulum on link 2 (Orekhov et al. 2015, Fig. 8, Sec. III-E).

    Parameters
    ----------
    drive, spring, parts, sticks
        As in `two_link`.

    Returns
    -------
    Plant
        Input I (A), outputs F1, F2 (N), q (m), phi (rad) and x_2 (m); pendulum parameters I_p, m, L, L_a, d, g.

    Notes
    -----
    :math:`x_2 = L_a \sin\varphi`, :math:`I_p \ddot\varphi = -F_2 L_a \cos\varphi - m g L \sin\varphi -
    d \dot\varphi`, and the actuator's equations as in `two_link` with :math:`x_1 = 0`.

    Examples
    --------
    >>> list(moving_output().outputs)
    ['F1', 'F2', 'q', 'phi', 'x_2']
    """
    return _build_plant("moving_output(", ("fixed", "pendulum"), drive, spring, parts, sticks, suffixes=("1", ""))
