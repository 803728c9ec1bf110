"""The parameters of the actuator and its links, with the published values (Orekhov et al. 2015, Table I)."""

from __future__ import annotations

import math
from dataclasses import replace

from seaopt.parameters import Parameter, ParameterSet, declare

ACTUATOR = (
    declare("m_l", 0.646, "kg", 0.0, "translational sprung mass", (0.001, 1000)),
    declare("k", 655e3, "N/m", 0.0, "spring stiffness", (1000, 1e09)),
    declare("l", 0.002, "m", 1e-9, "ball-screw lead", (0.0001, 0.2)),
    declare("N_p", 3.0, "-", 1e-9, "pulley reduction", (0.02, 1000)),
    declare("K_tau", 0.0255, "N m/A", 0.0, "motor torque constant", (0.001, 20)),
    declare("J", 3.31e-6, "kg m^2", 0.0, "motor and transmission inertia", (1e-09, 1)),
    declare("b_r", 1.31e-4, "N m s", 0.0, "rotary viscous damping", (0, 10)),
    declare("eta", 1.0, "-", 0.0, "transmission efficiency", (0.25, 1.25)),
    declare("f_c", 0.0, "N", 0.0, "Coulomb friction at the screw", (0, 100000)),
    declare("v_s", 1e-3, "m/s", 1e-9, "smoothing speed of f_c"),
)
PENDULUM = (
    declare("I_p", 0.36, "kg m^2", 1e-9, "inertia about the pivot", (1e-07, 1000)),
    declare("m", 4.0, "kg", 0.0, "pendulum mass", (0, 10000)),
    declare("L", 0.3, "m", 0.0, "centre of mass to pivot", (0, 10)),
    declare("L_a", 0.0725, "m", 0.0, "lever arm", (0, 10)),
    declare("d", 0.0, "N m s", 0.0, "pivot damping", (0, 10000)),
)
GRAVITY = declare("g", 9.81, "m/s^2", -math.inf, "gravity")


def all_parameters() -> list[Parameter]:
    """Return every parameter that some `two_link`, `high_impedance` or `moving_output` has."""
    links = [parameter for suffix in ("", "1", "2") for parameter in pendulum(suffix)]
    masses = [link_mass(number) for number in (1, 2)]
    return [*ACTUATOR, *links, *masses, GRAVITY]


def pendulum(suffix: str) -> list[Parameter]:
    """Return the parameters of a link that swings, their names ending in its number."""
    return [replace(parameter, name=f"{parameter.name}{suffix}") for parameter in PENDULUM]


def link_mass(number: int) -> Parameter:
    """Return the mass of a link that slides."""
    return declare(f"m_{number}", 10.0, "kg", 1e-9, f"mass of link {number}")


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
    return ParameterSet((*ACTUATOR, *PENDULUM, GRAVITY))
