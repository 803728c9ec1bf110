"""The parameters of the actuator and its links, with the published values (Orekhov et al. 2015, Table I)."""

from __future__ import annotations

from dataclasses import replace

from seaopt.parameters import Parameter, ParameterSet

ACTUATOR = (
    Parameter(
        name="m_l", value=0.646, unit="kg", min=0.0, description="translational sprung mass", plausible=(0.001, 1000)
    ),
    Parameter(name="k", value=655e3, unit="N/m", min=0.0, description="spring stiffness", plausible=(1000, 1e09)),
    Parameter(name="l", value=0.002, unit="m", min=1e-9, description="ball-screw lead", plausible=(0.0001, 0.2)),
    Parameter(name="N_p", value=3.0, unit="-", min=1e-9, description="pulley reduction", plausible=(0.02, 1000)),
    Parameter(
        name="K_tau", value=0.0255, unit="N m/A", min=0.0, description="motor torque constant", plausible=(0.001, 20)
    ),
    Parameter(
        name="J",
        value=3.31e-6,
        unit="kg m^2",
        min=0.0,
        description="motor and transmission inertia",
        plausible=(1e-09, 1),
    ),
    Parameter(
        name="b_r", value=1.31e-4, unit="N m s", min=0.0, description="rotary viscous damping", plausible=(0, 10)
    ),
    Parameter(name="eta", value=1.0, unit="-", min=0.0, description="transmission efficiency", plausible=(0.25, 1.25)),
    Parameter(
        name="f_c", value=0.0, unit="N", min=0.0, description="Coulomb friction at the screw", plausible=(0, 100000)
    ),
    Parameter(name="v_s", value=1e-3, unit="m/s", min=1e-9, description="smoothing speed of f_c"),
)
PENDULUM = (
    Parameter(
        name="I_p", value=0.36, unit="kg m^2", min=1e-9, description="inertia about the pivot", plausible=(1e-07, 1000)
    ),
    Parameter(name="m", value=4.0, unit="kg", min=0.0, description="pendulum mass", plausible=(0, 10000)),
    Parameter(name="L", value=0.3, unit="m", min=0.0, description="centre of mass to pivot", plausible=(0, 10)),
    Parameter(name="L_a", value=0.0725, unit="m", min=0.0, description="lever arm", plausible=(0, 10)),
    Parameter(name="d", value=0.0, unit="N m s", min=0.0, description="pivot damping", plausible=(0, 10000)),
)
GRAVITY = Parameter(name="g", value=9.81, unit="m/s^2", description="gravity")


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
    return Parameter(name=f"m_{number}", value=10.0, unit="kg", min=1e-9, description=f"mass of link {number}")


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
