r"""Stability of the loop against an environment: mass, spring and damper on the plant's port, its other links held.

On a port that turns the mass is an inertia (kg m^2), and spring and damper are N m/rad and N m s/rad.

.. math:: F_{e2} = -k_e x_2 - d_e \dot x_2, \qquad m_2 \ddot x_2 = -F_2 + F_{e2}

The plant with its environment is sampled exactly and closed with hold, delay and law. Its eigenvalues decide on
stability; the only approximation is the linearisation. A port that is passive at every frequency is stable against any
such environment (Colgate, Hogan, Int. J. Control 48(1), 1988); where it is not, oscillations of an undamped environment
grow, and a d_e above -Re Z damps them. The passive band treats the sampled loop as time-invariant (the images of
sampling are left out); this map does not, so that the two can differ near the Nyquist frequency.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Bool, Float

from seaopt.codec import to_content
from seaopt.control import Controller
from seaopt.control.loops.loop import GROWING
from seaopt.control.loops.port import bare_port, probe_of
from seaopt.errors import ControlError
from seaopt.parameters import Parameter, ParameterSet
from seaopt.plants import CompletedParameters, Plant
from seaopt.plants.friction import take_sliding
from seaopt.records import PlotAccessor, Worded, record
from seaopt.robustness.uncertainty.batch import batch_figures
from seaopt.robustness.uncertainty.draws import Column
from seaopt.units import LINEAR, ROTARY, Mechanics, mechanics_of

Value = TypeVar("Value", float, Column)

MASSES = {LINEAR: (0.1, 1000.0), ROTARY: (1e-4, 10.0)}
STIFFNESSES = {LINEAR: (1e1, 1e8), ROTARY: (1e-2, 1e6)}
DAMPINGS: Mapping[Mechanics, tuple[float, ...]] = {LINEAR: (0.0, 10.0, 100.0, 1000.0), ROTARY: (0.0, 0.01, 0.1, 1.0)}
MAP_POINTS = 25
EDGE_BISECTIONS = 30
SPRING = Parameter(name="environment_stiffness", value=0.0, unit=LINEAR.stiffness, min=0.0, description="k_e")
DAMPER = Parameter(name="environment_damping", value=0.0, unit=LINEAR.damping, min=0.0, description="d_e")


@record
class Environment:
    """A mass m_2 on link 2, tied to the ground by k_e and d_e, and the loop against it, in the map's units."""

    m_2: float
    k_e: float
    d_e: float
    spectral_radius: float  # the largest of the closed loop's eigenvalues
    frequency_hz: float  # of that eigenvalue
    doubling_s: float | None  # time in which the oscillation doubles; None if it does not grow


@record(eq=False, repr=False)
class StabilityMap(Worded):
    """Where the loop is stable against an environment.

    Parameters
    ----------
    mass, stiffness, damping : arrays, shapes (m,), (k,) and (d,)
        The grid: kg, N/m, N s/m, or kg m^2, N m/rad, N m s/rad.
    spectral_radius : array, shape (d, m, k)
    boundary : tuple of arrays, shape (n, 2), one per damping
        Points (mass, stiffness) of the edge of the stable region, each between two neighbours of the grid, by
        bisection.
    worst : Environment
        The environment of the grid with the fastest growth, or the least decay.
    fixed_stable : bool
        Whether the loop is stable with the link fixed.
    called : Mechanics
        Units and words of what is on the port.
    """

    plot = PlotAccessor()

    mass: Float[np.ndarray, " m"]
    stiffness: Float[np.ndarray, " k"]
    damping: Float[np.ndarray, " d"]
    spectral_radius: Float[np.ndarray, "d m k"]
    boundary: tuple[Float[np.ndarray, "_ 2"], ...]
    worst: Environment
    fixed_stable: bool
    called: Mechanics = LINEAR

    @property
    def stable(self) -> Bool[np.ndarray, "d m k"]:
        """Whether nothing grows (`GROWING` of the loop's module) against each environment of the grid."""
        return self.spectral_radius <= GROWING

    @property
    def everywhere(self) -> bool:
        """Whether the loop is stable against every environment of the grid, and with the link fixed."""
        return bool(np.all(self.stable)) and self.fixed_stable

    def to_dict(self) -> dict[str, Any]:
        """Return a summary of the map, for robustness.json."""
        return {
            "stable_everywhere": self.everywhere,
            "fixed_stable": self.fixed_stable,
            "units": {"m_2": self.called.inertia, "k_e": self.called.stiffness, "d_e": self.called.damping},
            "range": {
                "m_2": [float(self.mass[0]), float(self.mass[-1])],
                "k_e": [float(self.stiffness[0]), float(self.stiffness[-1])],
                "d_e": self.damping.tolist(),
            },
            "stable_share": [float(np.mean(stable)) for stable in self.stable],
            "worst": to_content(self.worst),
        }


def attach_environment(plant: Plant) -> Plant:
    """Return a plant's probe with an environment on its inertia; its last two parameters are k_e and d_e. Their names
    are `SPRING`'s and `DAMPER`'s, with underscores as long as the probe has the same name.
    """
    probe = probe_of(plant)
    effort, coordinate, rate, _ = bare_port(probe)
    command, unit = next(iter(probe.inputs.items()))
    taken = {*probe.states, *probe.inputs, *probe.parameters, *probe.friction}
    called = mechanics_of(probe.states[coordinate])
    spring, damper = (
        _rename(replace(parameter, unit=unit), taken)
        for parameter, unit in ((SPRING, called.stiffness), (DAMPER, called.damping))
    )

    def pull(x: Any, u: Any, p: Any) -> Any:
        force = -getattr(p, spring.name) * getattr(x, coordinate)
        force -= getattr(p, damper.name) * getattr(x, rate)
        return SimpleNamespace(**(dict.fromkeys(probe.inputs, 0.0) | vars(u) | {effort: force}))

    return Plant(
        name=f"{plant.name} against an environment",
        states=probe.states,
        inputs={command: unit},
        outputs=probe.outputs,
        parameters={**probe.parameters, spring.name: spring, damper.name: damper},
        f=lambda t, x, u, p: probe.f(t, x, pull(x, u, p), p),
        h=lambda t, x, u, p: probe.h(t, x, pull(x, u, p), p),
        friction=probe.friction,
        followed=probe.followed,
        ports=(replace(probe.ports[0], effort=None),),
        drive_offset_s=plant.drive_offset_s,
    )


def _rename(parameter: Parameter, taken: set[str]) -> Parameter:
    """Return a parameter under a name that is not taken."""
    while parameter.name in taken:
        parameter = replace(parameter, name=f"{parameter.name}_")
    return parameter


def coupled_stability(
    controller: Controller,
    plant: Plant,
    parameters: ParameterSet,
    *,
    masses_kg: tuple[float, float] | None = None,
    stiffnesses_N_per_m: tuple[float, float] | None = None,
    dampings_N_s_per_m: tuple[float, ...] | None = None,
    points: int = MAP_POINTS,
) -> StabilityMap:
    """Map where a controller is stable against a mass on a spring and a damper at link 2 (`StabilityMap`).

    Parameters
    ----------
    controller : Controller
        The law.
    plant, parameters
        The actuator, sliding where it has friction; the environment's mass replaces its own link 2.
    masses_kg, stiffnesses_N_per_m : (low, high), optional
        Ranges, logarithmic; kg m^2 and N m/rad of a port that turns. They exclude zero mass, where the actuator's own
        link moves freely. `MASSES` and `STIFFNESSES` if left out.
    dampings_N_s_per_m : tuple of float, optional
        Each has a map of its own; N m s/rad of a port that turns. `DAMPINGS` if left out.
    points : int
        Points of the grid in each direction.

    Raises
    ------
    ControlError
        A range is empty, or the plant has no port.

    Examples
    --------
    >>> import seaopt as so
    >>> stand, thor = so.plants.high_impedance(), so.plants.thor()
    >>> controller = so.tune(stand, thor, so.ControllerSpec(bandwidth_hz=30, max_sensitivity=1.6))
    >>> stability = coupled_stability(controller, stand, thor, dampings_N_s_per_m=(100.0,), points=5)
    >>> stability.spectral_radius.shape, stability.fixed_stable
    ((1, 5, 5), True)
    """
    coupled = attach_environment(take_sliding(plant, parameters))
    values, called = _take_bare(coupled, parameters), mechanics_of(coupled.states[str(coupled.ports[0].coordinate)])
    masses = MASSES[called] if masses_kg is None else masses_kg
    stiffnesses = STIFFNESSES[called] if stiffnesses_N_per_m is None else stiffnesses_N_per_m
    dampings = DAMPINGS[called] if dampings_N_s_per_m is None else dampings_N_s_per_m
    _check_grid(masses, stiffnesses, dampings, points)
    mass, stiffness = (np.geomspace(*ends, points) for ends in (masses, stiffnesses))
    damping = np.array(dampings, dtype=float)
    d, m, k = (axis.ravel() for axis in np.meshgrid(damping, mass, stiffness, indexing="ij"))
    flat = _compute_radii(controller, coupled, values, m, k, d)
    worst, radius = int(np.argmax(flat)), flat.reshape(damping.size, points, points)
    return StabilityMap(
        mass=mass,
        stiffness=stiffness,
        damping=damping,
        spectral_radius=radius,
        boundary=tuple(
            _find_boundary(controller, coupled, values, mass, stiffness, float(value), stable)
            for value, stable in zip(damping, radius <= GROWING, strict=True)
        ),
        worst=close_on_environment(controller, coupled, values, float(m[worst]), float(k[worst]), float(d[worst])),
        # A mass of 1e9 kg on the ground stands for a link that is fixed.
        fixed_stable=close_on_environment(controller, coupled, values, 1e9, 1e12, 1e9).spectral_radius <= GROWING,
        called=called,
    )


def _take_bare(coupled: Plant, parameters: ParameterSet) -> CompletedParameters:
    """Return a coupled plant's values; the inertia on its port is the environment's, without the link's own bounds."""
    (name,) = coupled.ports[0].payload
    bare = Parameter(name=name, value=1.0, unit=coupled.parameter_unit(name))
    stated = parameters.given if isinstance(parameters, CompletedParameters) else parameters
    return coupled.complete(stated.with_parameters(bare)).drop_conditions()


def close_on_environment(
    controller: Controller, coupled: Plant, parameters: CompletedParameters, m_2: float, k_e: float, d_e: float
) -> Environment:
    """Return the loop against one environment, `coupled` being a plant of `attach_environment`."""
    values = parameters.update(**_name_values(coupled, m_2, k_e, d_e))
    poles = controller.close(coupled, values).eigenvalues()
    largest = poles[int(np.argmax(np.abs(poles)))]
    radius, period = float(abs(largest)), controller.sample_time_s
    return Environment(
        m_2=m_2,
        k_e=k_e,
        d_e=d_e,
        spectral_radius=radius,
        frequency_hz=float(abs(np.angle(largest)) / (2 * np.pi * period)),
        doubling_s=math.log(2.0) * period / math.log(radius) if radius > GROWING else None,
    )


def _check_grid(
    masses: tuple[float, float], stiffnesses: tuple[float, float], dampings: tuple[float, ...], points: int
) -> None:
    for name, (low, high) in (("masses_kg", masses), ("stiffnesses_N_per_m", stiffnesses)):
        if not 0.0 < low < high < math.inf:
            raise ControlError(f"{name} = ({low:g}, {high:g}) is not a range; give 0 < low < high")
    if not dampings or not all(0.0 <= damping < math.inf for damping in dampings):
        raise ControlError(f"dampings_N_s_per_m = {dampings} are not dampings; give at least one, zero or more")
    if points < 2:
        raise ControlError(f"points = {points} is too few for a grid; give 2 or more")


def _name_values(coupled: Plant, mass: Value, stiffness: Value, damping: Value) -> dict[str, Value]:
    """Return an environment's values under the names of the plant's parameters."""
    *_, spring, damper = coupled.parameters
    return {coupled.ports[0].payload[0]: mass, spring: stiffness, damper: damping}


def _compute_radii(
    controller: Controller, coupled: Plant, parameters: CompletedParameters, m: Column, k: Column, d: Column
) -> Column:
    """Return the spectral radii against n environments."""
    draws = _name_values(coupled, m, k, d)
    return batch_figures(controller, coupled, parameters, draws, peaks=False).spectral_radius


def _find_boundary(
    controller: Controller,
    coupled: Plant,
    parameters: CompletedParameters,
    mass: Float[np.ndarray, " m"],
    stiffness: Float[np.ndarray, " k"],
    damping: float,
    stable: Bool[np.ndarray, "m k"],
) -> Float[np.ndarray, "_ 2"]:
    """Return points of the edge between neighbours of the grid, one of them stable, by bisection in logarithms."""
    grid = np.stack(np.meshgrid(np.log(mass), np.log(stiffness), indexing="ij"), axis=-1)
    below, above, left, right = np.s_[:-1], np.s_[1:], np.s_[:, :-1], np.s_[:, 1:]
    ends: list[tuple[Any, Any]] = []
    for inner, outer in ((below, above), (above, below), (left, right), (right, left)):
        edge = stable[inner] & ~stable[outer]
        ends.append((grid[inner][edge], grid[outer][edge]))
    good, bad = (np.concatenate(points) for points in zip(*ends, strict=True))
    for _ in range(EDGE_BISECTIONS if len(good) else 0):
        middle = 0.5 * (good + bad)
        at = np.exp(middle)
        radius = _compute_radii(controller, coupled, parameters, at[:, 0], at[:, 1], np.full(len(at), damping))
        stays = (radius <= GROWING)[:, None]
        good, bad = np.where(stays, middle, good), np.where(stays, bad, middle)
    return np.exp(0.5 * (good + bad))
