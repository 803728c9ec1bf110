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
from dataclasses import dataclass, replace
from typing import Any, Literal

import casadi as ca

from seaopt.errors import PlantError
from seaopt.parameters import Parameter, ParameterSet
from seaopt.plants.plant import Plant

Drive = Literal["unlumped", "lumped"]
Spring = Literal["link1", "link2"]
Link = Literal["fixed", "mass", "pendulum"]

_ACTUATOR = (
    Parameter(name="m_l", value=0.646, unit="kg", min=0.0, description="translational sprung mass"),
    Parameter(name="k", value=655e3, unit="N/m", min=0.0, description="spring stiffness"),
    Parameter(name="l", value=0.002, unit="m", min=0.0, description="ball-screw lead"),
    Parameter(name="N_p", value=3.0, unit="-", min=0.0, description="pulley reduction"),
    Parameter(name="K_tau", value=0.0255, unit="N m/A", min=0.0, description="motor torque constant"),
    Parameter(name="J", value=3.31e-6, unit="kg m^2", min=0.0, description="motor and transmission inertia"),
    Parameter(name="b_r", value=1.31e-4, unit="N m s", min=0.0, description="rotary viscous damping"),
    Parameter(name="eta", value=1.0, unit="-", min=0.0, description="transmission efficiency"),
    Parameter(name="f_c", value=0.0, unit="N", min=0.0, description="Coulomb friction at the screw"),
    Parameter(name="v_s", value=1e-3, unit="m/s", min=1e-9, description="smoothing speed of f_c"),
)
_PENDULUM = (
    Parameter(name="I_p", value=0.36, unit="kg m^2", min=0.0, description="inertia about the pivot"),
    Parameter(name="m", value=4.0, unit="kg", min=0.0, description="pendulum mass"),
    Parameter(name="L", value=0.3, unit="m", min=0.0, description="centre of mass to pivot"),
    Parameter(name="L_a", value=0.0725, unit="m", min=0.0, description="lever arm"),
    Parameter(name="d", value=0.0, unit="N m s", min=0.0, description="pivot damping"),
)
_GRAVITY = Parameter(name="g", value=9.81, unit="m/s^2", description="gravity")


def thor() -> ParameterSet:
    """Return the published parameters of the THOR linear SEA (Orekhov et al. 2015, Table I), none free.

    The pendulum's are those of the paper's second experiment with the 4 kg weight as a point mass at 0.300 m; the
    paper gives neither the link's inertia nor its damping.

    Examples
    --------
    >>> params = thor()
    >>> params["k"].value, params["J"].value
    (655000.0, 3.31e-06)

    """
    return ParameterSet((*_ACTUATOR, *_PENDULUM, _GRAVITY))


def _drive_figures(p: Any) -> tuple[Any, Any, Any]:
    """Return r (2), M = J/r^2 and b_m (4)."""
    r = p.l / (2 * math.pi * p.N_p)
    return r, p.J / r**2, p.b_r / r**2


def derived_figures(p: Any) -> dict[str, tuple[Any, str]]:
    """Return r (2), m_k (1), b_m (4) and the natural frequency and damping ratio of (13), with units."""
    r, rotary, b_m = _drive_figures(p)
    m_k = p.m_l + rotary
    return {
        "r": (r, "m"),
        "m_k": (m_k, "kg"),
        "b_m": (b_m, "N s/m"),
        "natural_frequency_hz": (ca.sqrt(p.k / m_k) / (2 * math.pi), "Hz"),
        "damping_ratio": (b_m / (2 * ca.sqrt(p.k * m_k)), "-"),
    }


@dataclass(frozen=True, slots=True, kw_only=True)
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


@dataclass(frozen=True, slots=True, kw_only=True)
class _Motion:
    """The accelerations and forces of the actuator, as expressions of state, input and parameters."""

    rates: list[tuple[Any, Any]]
    forces: tuple[Any, Any]
    links: tuple[_LinkModel, _LinkModel]


def _motion(x: Any, u: Any, p: Any, links: tuple[_LinkModel, _LinkModel], drive: Drive, spring: Spring) -> _Motion:
    """Lagrange's equations of the module docstring."""
    r, rotary, b_m = _drive_figures(p)
    moving = [link for link in links if link.coordinate is not None]
    y = ca.vertcat(x.q, *(link.coordinate for link in moving))
    yd = ca.vertcat(x.qd, *(link.rate for link in moving))

    sprung = p.m_l if drive == "unlumped" else p.m_l + rotary
    rotary = rotary if drive == "unlumped" else 0.0
    x_1, x_2 = links[0].position, links[1].position
    x_s = x.q + x_2 if spring == "link1" else (x_1 if drive == "unlumped" else x_1 - x.q)
    compression = x.q + x_2 - x_1

    # T = yd' H(y) yd / 2, so that H ydd = Q - dV/dy - (dH/dt yd - dT/dy).
    speed_s = ca.jtimes(x_s, y, yd)
    kinetic = 0.5 * rotary * x.qd**2 + 0.5 * sprung * speed_s**2 + links[0].kinetic + links[1].kinetic
    potential = 0.5 * p.k * compression**2 + links[0].potential + links[1].potential
    inertia, _ = ca.hessian(kinetic, yd)
    momentum = ca.gradient(kinetic, yd)
    gyroscopic = ca.jtimes(momentum, y, yd) - ca.gradient(kinetic, y)

    motor = p.eta * (p.K_tau / r) * u.I - b_m * x.qd - p.f_c * ca.tanh(x.qd / p.v_s)
    external = getattr(u, "Fe1", 0.0) * x_1 + getattr(u, "Fe2", 0.0) * x_2
    damping = ca.vertcat(0.0, *(link.damping for link in moving))
    generalised = ca.gradient(external, y) - damping
    generalised[0] += motor
    ydd = ca.mtimes(ca.inv_minor(inertia), generalised - ca.gradient(potential, y) - gyroscopic)

    tension = p.k * compression
    thrust = sprung * (ca.jtimes(speed_s, y, yd) + ca.jtimes(x_s, y, ydd))
    forces = (tension, tension + thrust) if spring == "link1" else (tension - thrust, tension)
    return _Motion(rates=[(yd[i], ydd[i]) for i in range(y.numel())], forces=forces, links=links)


def _pendulum_parameters(suffix: str) -> list[Parameter]:
    return [replace(item, name=f"{item.name}{suffix}") for item in _PENDULUM]


def _build(name: str, links: tuple[Link, Link], suffixes: tuple[str, str], drive: Drive, spring: Spring,
           external: bool) -> Plant:  # fmt: skip
    """Return the plant; `suffixes` is what the names of each link's pendulum end with."""
    if drive not in ("unlumped", "lumped"):
        raise PlantError(f'drive = "{drive}" is not known; use "unlumped" or "lumped"')
    if spring not in ("link1", "link2"):
        raise PlantError(f'spring = "{spring}" is not known; use "link1" or "link2"')
    for number, link in enumerate(links, start=1):
        if link not in ("fixed", "mass", "pendulum"):
            raise PlantError(f'link{number} = "{link}" is not known; use "fixed", "mass" or "pendulum"')

    states = {"q": "m", "qd": "m/s"}
    outputs = {"F1": "N", "F2": "N", "q": "m"}
    parameters = list(_ACTUATOR)
    for number, (link, suffix) in enumerate(zip(links, suffixes, strict=True), start=1):
        if link == "mass":
            states |= {f"x_{number}": "m", f"v_{number}": "m/s"}
            parameters.append(Parameter(name=f"m_{number}", value=10.0, unit="kg", min=0.0, description="link mass"))
        if link == "pendulum":
            states |= {f"phi{suffix}": "rad", f"phid{suffix}": "rad/s"}
            outputs |= {f"phi{suffix}": "rad"}
            parameters += _pendulum_parameters(suffix)
        if link != "fixed":
            outputs[f"x_{number}"] = "m"
    if "pendulum" in links:
        parameters.append(_GRAVITY)

    def motion(x: Any, u: Any, p: Any) -> _Motion:
        first, second = (_link_model(links[i], i + 1, suffixes[i], x, p) for i in (0, 1))
        return _motion(x, u, p, (first, second), drive, spring)

    def f(t: Any, x: Any, u: Any, p: Any) -> dict[str, Any]:
        flat = [item for pair in motion(x, u, p).rates for item in pair]
        return dict(zip(states, flat, strict=True))

    def h(t: Any, x: Any, u: Any, p: Any) -> dict[str, Any]:
        result = motion(x, u, p)
        values = {"F1": result.forces[0], "F2": result.forces[1], "q": x.q}
        for number, link in enumerate(result.links, start=1):
            values |= {f"x_{number}": link.position, f"phi{suffixes[number - 1]}": link.coordinate}
        return {name: values[name] for name in outputs}

    return Plant(
        name=name,
        states=states,
        inputs={"I": "A"} | ({"Fe1": "N", "Fe2": "N"} if external else {}),
        outputs=outputs,
        parameters={item.name: item for item in parameters},
        f=f,
        h=h,
        derived=derived_figures,
        optional_inputs=frozenset({"Fe1", "Fe2"}) if external else frozenset(),
    )


def two_link(
    link1: Link = "fixed", link2: Link = "fixed", drive: Drive = "unlumped", spring: Spring = "link1"
) -> Plant:
    """Return the general plant: an actuator between two links, each fixed, a free mass or a pendulum.

    Parameters
    ----------
    link1, link2 : {"fixed", "mass", "pendulum"}
        A mass m_1 (m_2) slides along x; a pendulum's lever arm pulls along x, x = L_a sin(phi), and the names of
        its parameters, states and angle carry the link's number (I_p1, L_a2, phi2).
    drive : {"unlumped", "lumped"}
        The rack and pinion of Orekhov et al. 2015 (Fig. 4b), or the conventional lumped mass (Fig. 4a).
    spring : {"link1", "link2"}
        Between housing and link 1 (the paper), or between ball nut and link 2 (its future work).

    Returns
    -------
    Plant
        Inputs I (A) and the external forces Fe1, Fe2 (N, positive along x; on a fixed link the ground takes them;
        zero where a log leaves them out). Outputs F1, F2 (N), q (m), and of each moving link x_i (m) and phi (rad).

    Notes
    -----
    The equations are derived in `seaopt.plants.two_link`; they reduce to (6)-(8) and (13)-(15) of the paper.

    Examples
    --------
    >>> plant = two_link(link1="mass", link2="pendulum")
    >>> list(plant.states)
    ['q', 'qd', 'x_1', 'v_1', 'phi2', 'phid2']

    """
    return _build(f"two_link({link1}, {link2}, {drive})", (link1, link2), ("1", "2"), drive, spring, True)


def high_impedance(drive: Drive = "unlumped", spring: Spring = "link1") -> Plant:
    """Return the test stand: both links fixed (Orekhov et al. 2015, Fig. 5 and (6)-(15)).

    Parameters
    ----------
    drive, spring
        As in `two_link`.

    Returns
    -------
    Plant
        Input I (A), outputs F1, F2 (N) and q (m).

    Examples
    --------
    >>> model = high_impedance().linearize(thor())
    >>> bool(abs(model.dcgain()[0, 0] - 240.33) < 0.01)  # N/A: K_tau / r
    True

    """
    return _build(f"high_impedance({drive})", ("fixed", "fixed"), ("1", "2"), drive, spring, False)


def moving_output(drive: Drive = "unlumped", spring: Spring = "link1") -> Plant:
    """Return the swing phase: link 1 fixed, a pendulum on link 2 (Orekhov et al. 2015, Fig. 8, Sec. III-E).

    Parameters
    ----------
    drive, spring
        As in `two_link`.

    Returns
    -------
    Plant
        Input I (A), outputs F1, F2 (N), q (m), phi (rad) and x_2 (m); pendulum parameters I_p, m, L, L_a, d, g.

    Examples
    --------
    >>> list(moving_output().outputs)
    ['F1', 'F2', 'q', 'phi', 'x_2']

    """
    return _build(f"moving_output({drive})", ("fixed", "pendulum"), ("1", ""), drive, spring, False)
