r"""An actuator between two links: the paper's general model (Orekhov et al. 2015, Figs. 3 and 4).

Derivation
----------
The drive shortens or lengthens the actuator by :math:`q` and the spring of stiffness :math:`k` sits in series with
it, so that for either spring placement its compression is

.. math:: \delta = q + x_2 - x_1, \qquad V = \tfrac12 k \delta^2 .

The unlumped rack-and-pinion drive has rotary inertia :math:`M = J/r^2` that only :math:`\dot q` turns, and a sprung
mass :math:`m_l` that moves along x with :math:`x_s`; the lumped drive has no rotary part and :math:`m_k = m_l + M`
(1) as its sprung mass:

.. math:: T = \tfrac12 M \dot q^2 + \tfrac12 m_s \dot x_s^2 + T_\mathrm{links}

=========  ============  ===========  =======================================================
drive      spring        m_s          x_s
=========  ============  ===========  =======================================================
unlumped   link 1        m_l          q + x_2     (the no-slip condition (5): x_l = q + x_2)
lumped     link 1        m_k          q + x_2     (x_k)
unlumped   link 2        m_l          x_1         (the housing rides on link 1)
lumped     link 2        m_k          x_1 - q     (the mirror: the mass hangs on the spring)
=========  ============  ===========  =======================================================

The motor works on :math:`q` alone, :math:`Q_q = F_m - b_m \dot q - f_c \tanh(\dot q / v_s)` with
:math:`F_m = \eta (K_\tau / r) I` (3); in the lumped drive this force acts between the sprung mass and the far link,
in the unlumped one between the pinion and a virtual ground out of plane. Lagrange's equations in :math:`q` and the
links' coordinates give the motion. The forces that the links feel, +F1 on link 1 and -F2 on link 2, follow:

.. math::
    \text{spring at link 1:}\quad F_1 = k\delta,\; F_2 = k\delta + m_s \ddot x_s \qquad
    \text{spring at link 2:}\quad F_2 = k\delta,\; F_1 = k\delta - m_s \ddot x_s

With spring at link 1 this is (9)-(12) and :math:`m_l \ddot x_l = F_2 - F_1`, :math:`M \ddot q = F_m - b_m\dot q - F_2`
for the unlumped drive, and :math:`F_2 = F_m - b_m \dot q` for the lumped one.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from types import SimpleNamespace
from typing import Any, Literal

import casadi as ca

from seaopt.errors import PlantError
from seaopt.plants import parts as part_laws
from seaopt.plants.parts import Part
from seaopt.plants.plant import Plant
from seaopt.plants.published import ACTUATOR, GRAVITY, link_mass, pendulum
from seaopt.plants.roles import Actuation, Friction, Mode, Port, Sensing, SeriesSpring
from seaopt.records import record

AT_REST = SimpleNamespace(I=0.0, F_f=0.0)  # inputs and friction
Drive = Literal["unlumped", "lumped"]
Spring = Literal["link1", "link2"]
Link = Literal["fixed", "mass", "pendulum"]


def _drive_figures(p: Any) -> tuple[Any, Any, Any]:
    """Return r (2), M = J/r^2 and b_m (4)."""
    r = p.l / (2 * math.pi * p.N_p)
    return r, p.J / r**2, p.b_r / r**2


def derived_figures(p: Any, *, housing_rides: bool = False) -> dict[str, tuple[Any, str]]:
    """Return r (2), m_k (1), b_m (4), and the natural frequency and damping ratio with both links fixed (13).

    Where the housing rides on link 1 (unlumped, spring at link 2), only M = J/r^2 swings then, not m_k.
    """
    r, rotary, b_m = _drive_figures(p)
    m_k = p.m_l + rotary
    swinging = rotary if housing_rides else m_k
    return {
        "r": (r, "m"),
        "m_k": (m_k, "kg"),
        "b_m": (b_m, "N s/m"),
        "natural_frequency_hz": (ca.sqrt(p.k / swinging) / (2 * math.pi), "Hz"),
        "damping_ratio": (b_m / (2 * ca.sqrt(p.k * swinging)), "-"),
    }


def effort_per_current(p: Any) -> Any:
    """Return F_m of one ampere (3), N/A."""
    return p.eta * (p.K_tau / _drive_figures(p)[0])


@record
class _LinkModel:
    """One link: its coordinate (if it moves), position along x, energies and generalised force."""

    coordinate: Any
    rate: Any
    position: Any
    kinetic: Any
    potential: Any
    damping: Any


def _link_model(kind: Link, index: int, suffix: str, x: Any, p: Any) -> _LinkModel:
    if kind == "fixed":
        zero = ca.SX(0)
        return _LinkModel(coordinate=None, rate=None, position=zero, kinetic=zero, potential=zero, damping=zero)
    if kind == "mass":
        y, rate = getattr(x, f"x_{index}"), getattr(x, f"v_{index}")
        mass = getattr(p, f"m_{index}")
        zero = ca.SX(0)
        kinetic = 0.5 * mass * rate**2
        return _LinkModel(coordinate=y, rate=rate, position=y, kinetic=kinetic, potential=zero, damping=zero)
    phi, rate = getattr(x, f"phi{suffix}"), getattr(x, f"phid{suffix}")
    inertia, mass, length, arm, damping = (getattr(p, f"{name}{suffix}") for name in ("I_p", "m", "L", "L_a", "d"))
    return _LinkModel(
        coordinate=phi,
        rate=rate,
        position=arm * ca.sin(phi),
        kinetic=0.5 * inertia * rate**2,
        potential=mass * p.g * length * (1 - ca.cos(phi)),
        damping=damping * rate,
    )


@record
class _Motion:
    """The accelerations and forces of the actuator, as expressions of state, input and parameters."""

    rates: list[tuple[Any, Any]]
    forces: tuple[Any, Any]
    links: tuple[_LinkModel, _LinkModel]
    compression: Any
    energy: Any


@record
class _Build:
    """What kind of actuator is built: its links with the endings of their names, drive, spring and parts."""

    links: tuple[Link, Link]
    suffixes: tuple[str, str]
    drive: Drive
    spring: Spring
    parts: tuple[Part, ...]


def _motion(x: Any, u: Any, p: Any, build: _Build) -> _Motion:
    """Lagrange's equations of the module docstring."""
    links = tuple(_link_model(build.links[i], i + 1, build.suffixes[i], x, p) for i in (0, 1))
    _, rotary, b_m = _drive_figures(p)
    unlumped, screw = build.drive == "unlumped", "screw_mode" in build.parts
    moving = [link for link in links if link.coordinate is not None]
    y = ca.vertcat(x.q, *([x.s] if screw else []), *(link.coordinate for link in moving))
    yd = ca.vertcat(x.qd, *([x.sd] if screw else []), *(link.rate for link in moving))

    sprung = p.m_l if unlumped else p.m_l + rotary
    rotary = rotary if unlumped else 0.0
    stretch = x.s if screw else 0.0
    x_1, x_2 = links[0].position, links[1].position
    if build.spring == "link1":
        x_n = x_2 + stretch  # the nut
        x_s, compression = x.q + x_n, x.q + x_n - x_1
    elif unlumped:
        x_n = x_1 - x.q + stretch
        x_s, compression = x_1, x_2 - x_n
    else:  # the mirror of spring at link 1
        x_n = x_1 + stretch
        x_s, compression = x_n - x.q, x_2 - x_n + x.q

    def speed(position: Any) -> Any:
        return ca.jtimes(position, y, yd)

    nut = p.m_n if screw else 0.0
    kinetic = 0.5 * (rotary * x.qd**2 + sprung * speed(x_s) ** 2 + nut * speed(x_n) ** 2)
    kinetic += links[0].kinetic + links[1].kinetic
    potential = links[0].potential + links[1].potential
    tension = part_laws.spring_force(build.parts, compression, speed(compression), p)
    bolt = (p.k_b * x.s + p.c_b * x.sd) if screw else 0.0

    # T = yd' H(y) yd / 2, so that H ydd = Q - dV/dy - (dH/dt yd - dT/dy).
    inertia, _ = ca.hessian(kinetic, yd)
    gyroscopic = ca.jtimes(ca.gradient(kinetic, yd), y, yd) - ca.gradient(kinetic, y)
    motor = effort_per_current(p) * u.I - b_m * x.qd - u.F_f
    # Along the positions' gradients, not the gradient of a work: a force may depend on the state (a spring outside).
    external = getattr(u, "Fe1", 0.0) * ca.gradient(x_1, y) + getattr(u, "Fe2", 0.0) * ca.gradient(x_2, y)
    damping = ca.vertcat(0.0, *([bolt] if screw else []), *(link.damping for link in moving))
    generalised = external - ca.gradient(potential, y) - damping - tension * ca.gradient(compression, y)
    generalised[0] += motor
    ydd = ca.mtimes(ca.inv_minor(inertia), generalised - gyroscopic)

    def thrust(mass: Any, position: Any) -> Any:
        return mass * (ca.jtimes(speed(position), y, yd) + ca.jtimes(position, y, ydd))

    if build.spring == "link1":
        forces = (tension, -bolt if screw else tension + thrust(sprung, x_s))
    else:
        forces = (tension - thrust(sprung, x_s) - (thrust(nut, x_n) if screw else 0.0), tension)
    stored = kinetic + potential + part_laws.spring_energy(build.parts, compression, p)
    return _Motion(
        rates=[(yd[i], ydd[i]) for i in range(y.numel())], forces=forces, links=(links[0], links[1]),
        compression=compression, energy=stored + (0.5 * p.k_b * x.s**2 if screw else 0.0),
    )  # fmt: skip


def _as_tuple(parts: Sequence[Part]) -> tuple[Part, ...]:
    part_laws.check_parts(parts)
    return tuple(parts)


def _check_build(build: _Build) -> _Build:
    for what, choice, known in (
        ("drive", build.drive, ("unlumped", "lumped")),
        ("spring", build.spring, ("link1", "link2")),
        ("link1", build.links[0], ("fixed", "mass", "pendulum")),
        ("link2", build.links[1], ("fixed", "mass", "pendulum")),
    ):
        if choice not in known:
            raise PlantError(f'{what} = "{choice}" is not known; use ' + " or ".join(f'"{name}"' for name in known))
    part_laws.check_parts(build.parts)
    return build


def _actuator(name: str, build: _Build, external: bool) -> Plant:
    """Return the plant of a build: its own states and parameters, then the parts that wrap any plant."""
    _check_build(build)
    states = {"q": "m", "qd": "m/s"} | ({"s": "m", "sd": "m/s"} if "screw_mode" in build.parts else {})
    outputs = {"F1": "N", "F2": "N", "q": "m"}
    parameters = [*ACTUATOR, *part_laws.parameters(build.parts)]
    for number, (link, suffix) in enumerate(zip(build.links, build.suffixes, strict=True), start=1):
        if link == "mass":
            states |= {f"x_{number}": "m", f"v_{number}": "m/s"}
            parameters.append(link_mass(number))
        if link == "pendulum":
            states |= {f"phi{suffix}": "rad", f"phid{suffix}": "rad/s"}
            outputs |= {f"phi{suffix}": "rad"}
            parameters += pendulum(suffix)
        if link != "fixed":
            outputs[f"x_{number}"] = "m"
    if "pendulum" in build.links:
        parameters.append(GRAVITY)

    def f(t: Any, x: Any, u: Any, p: Any) -> dict[str, Any]:
        flat = [rate for pair in _motion(x, u, p, build).rates for rate in pair]
        return dict(zip(states, flat, strict=True))

    def h(t: Any, x: Any, u: Any, p: Any) -> dict[str, Any]:
        result = _motion(x, u, p, build)
        values = {"F1": result.forces[0], "F2": result.forces[1], "q": x.q}
        for number, link in enumerate(result.links, start=1):
            values |= {f"x_{number}": link.position, f"phi{build.suffixes[number - 1]}": link.coordinate}
        return {name: values[name] for name in outputs}

    def energy(x: Any, p: Any) -> Any:
        return _motion(x, AT_REST, p, build).energy

    def deflection(x: Any, p: Any) -> Any:
        return _motion(x, AT_REST, p, build).compression

    housing_rides = build.drive == "unlumped" and build.spring == "link2"
    plant = Plant(
        name=name,
        states=states,
        inputs={"I": "A"} | ({"Fe1": "N", "Fe2": "N"} if external else {}),
        outputs=outputs,
        parameters={parameter.name: parameter for parameter in parameters},
        f=f,
        h=h,
        derived=lambda p: derived_figures(p, housing_rides=housing_rides),
        optional_inputs=frozenset({"I", "Fe1", "Fe2"}) if external else frozenset(),
        energy=energy if part_laws.stores_in_closed_form(build.parts) else None,
        actuation=Actuation(input="I", effort=effort_per_current, unit="N", efficiency="eta"),
        sensing=Sensing(
            regulated=("F1", "F2"),
            motor_position="q",
            motor_speed="qd",
            link_position="x_2" if "x_2" in outputs else None,
        ),
        spring=SeriesSpring(
            deflection=deflection,
            unit="m",
            stiffness="k",
            mass=None if housing_rides else "m_k",
            damping=None if housing_rides else "b_m",
        ),
        ports=_ports(name, build, external),
        friction={
            "F_f": Friction(
                velocity=lambda x, p: x.qd,
                force=lambda v, p: part_laws.dry_friction(build.parts, v, p),
                unit="N",
                slopes=lambda p: part_laws.bound_friction_slopes(build.parts, p),
                jump=lambda speed, p: part_laws.friction_level(build.parts, speed, p),
                smoothing="v_s",
            )
        },
        mode=Mode(name="screw_mode_hz", parameter="m_n", state="s") if "screw_mode" in build.parts else None,
    )
    return part_laws.wrapped(plant, [part for part in build.parts if part not in part_laws.INSIDE])


def _ports(name: str, build: _Build, external: bool) -> tuple[Port, ...]:
    """Return the ports at link 2 and, where it moves, at link 1."""
    inside = tuple(part for part in build.parts if part in part_laws.INSIDE)
    bare = replace(build, links=("fixed", "mass"), suffixes=("1", "2"), parts=inside)
    ports: list[Port] = []
    for number, ratio in ((2, 1.0), (1, -1.0)):  # the spring's compression is q + x_2 - x_1
        link, suffix = build.links[number - 1], build.suffixes[number - 1]
        links = (build.links[0], "fixed") if number == 2 else ("fixed", build.links[1])
        probe = partial(_actuator, f"port of {name}", bare, external=True) if number == 2 else None
        if link == "fixed":
            ports += [Port(probe=probe)] if number == 2 else []
            continue
        mass = link == "mass"
        ports.append(
            Port(
                motion=f"x_{number}",
                coordinate=f"x_{number}" if mass else f"phi{suffix}",
                rate=f"v_{number}" if mass else f"phid{suffix}",
                effort=f"Fe{number}" if external else None,
                payload=(f"m_{number}",) if mass else (f"I_p{suffix}", f"m{suffix}"),
                held=partial(
                    _actuator, f"{name}, link {number} held", replace(build, links=links, parts=inside), external
                ),
                drive="q",
                ratio=lambda p, ratio=ratio: ratio,
                probe=probe,
            )
        )
    return tuple(ports)


def two_link(
    link1: Link = "fixed",
    link2: Link = "fixed",
    drive: Drive = "unlumped",
    spring: Spring = "link1",
    parts: Sequence[Part] = (),
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
    springs are in `seaopt.plants.two_link`, with the derivation (Orekhov et al. 2015, Figs. 3, 4 and (1)-(12)).

    Examples
    --------
    >>> plant = two_link(link1="mass", link2="pendulum")
    >>> list(plant.states)
    ['q', 'qd', 'x_1', 'v_1', 'phi2', 'phid2']

    """
    build = _Build(links=(link1, link2), suffixes=("1", "2"), drive=drive, spring=spring, parts=_as_tuple(parts))
    return _actuator(f"two_link({link1}, {link2}, {drive})", build, external=True)


def high_impedance(drive: Drive = "unlumped", spring: Spring = "link1", parts: Sequence[Part] = ()) -> Plant:
    r"""Return the test stand: both links fixed (Orekhov et al. 2015, Fig. 5 and (6)-(15)).

    Parameters
    ----------
    drive, spring, parts
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
    build = _Build(links=("fixed", "fixed"), suffixes=("1", "2"), drive=drive, spring=spring, parts=_as_tuple(parts))
    return _actuator(f"high_impedance({drive})", build, external=False)


def moving_output(drive: Drive = "unlumped", spring: Spring = "link1", parts: Sequence[Part] = ()) -> Plant:
    r"""Return the swing phase: link 1 fixed, a pendulum on link 2 (Orekhov et al. 2015, Fig. 8, Sec. III-E).

    Parameters
    ----------
    drive, spring, parts
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
    build = _Build(links=("fixed", "pendulum"), suffixes=("1", ""), drive=drive, spring=spring, parts=_as_tuple(parts))
    return _actuator(f"moving_output({drive})", build, external=False)
