r"""The loop held against something: mass, spring and damper on the plant's port, its other links held.

.. math:: F_{e2} = -k_e x_2 - d_e \dot x_2, \qquad m_2 \ddot x_2 = -F_2 + F_{e2}

The plant with its environment is sampled exactly and closed with hold, delay and law: the eigenvalues decide, and there
is no approximation but the linearisation. A port that is passive at every frequency cannot be made unstable by any such
environment (Colgate, Hogan, Int. J. Control 48(1), 1988); where it is not, an undamped environment that swings there
is made to grow, and d_e above -Re Z holds it. The passive band takes the sampled loop for time-invariant (the images of
sampling are left out); this map does not, so that the two can part near the Nyquist frequency.
"""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from seaopt.control import Controller
from seaopt.control.loops.loop import GROWING
from seaopt.control.loops.port import bare_port, probe_of
from seaopt.errors import ControlError
from seaopt.formatting import html_text
from seaopt.parameters import Parameter, ParameterSet
from seaopt.plants import Plant
from seaopt.records import record
from seaopt.robustness.uncertainty.batch import batch_figures

MASSES_KG = (0.1, 1000.0)
STIFFNESSES_N_PER_M = (1e1, 1e8)
DAMPINGS_N_S_PER_M = (0.0, 10.0, 100.0, 1000.0)
POINTS = 25
BISECTIONS = 30
SPRING = Parameter(name="k_e", value=0.0, unit="N/m", min=0.0, description="stiffness of the environment")
DAMPER = Parameter(name="d_e", value=0.0, unit="N s/m", min=0.0, description="damping of the environment")


@record
class Environment:
    """A mass m_2 (kg) on link 2, tied to the ground by k_e (N/m) and d_e (N s/m), and what the loop does there.

    Parameters
    ----------
    m_2, k_e, d_e : float
    spectral_radius : float
        Largest magnitude of the closed loop's eigenvalues.
    frequency_hz : float
        Of that eigenvalue.
    doubling_s : float or None
        Time in which what grows doubles; None if nothing does.

    """

    m_2: float
    k_e: float
    d_e: float
    spectral_radius: float
    frequency_hz: float
    doubling_s: float | None


@record(eq=False)
class StabilityMap:
    """Where the loop is stable against an environment.

    Parameters
    ----------
    mass, stiffness, damping : arrays, shapes (m,), (k,) and (d,)
        The grid: kg, N/m, N s/m.
    spectral_radius : array, shape (d, m, k)
    boundary : tuple of arrays, shape (n, 2), one a damping
        Points (kg, N/m) of the edge of the stable region, each between two neighbours of the grid, by bisection.
    worst : Environment
        Of the grid: the fastest growth, or the least decay.
    fixed_stable : bool
        With link 2 fixed.

    """

    mass: Float[np.ndarray, " m"]
    stiffness: Float[np.ndarray, " k"]
    damping: Float[np.ndarray, " d"]
    spectral_radius: Float[np.ndarray, "d m k"]
    boundary: tuple[Float[np.ndarray, "_ 2"], ...]
    worst: Environment
    fixed_stable: bool

    @property
    def stable(self) -> Bool[np.ndarray, "d m k"]:
        """Which environments of the grid the loop is stable against: nothing grows (`GROWING` of the loop's module)."""
        return self.spectral_radius <= GROWING

    @property
    def everywhere(self) -> bool:
        """Stable against every environment of the grid, and with the link fixed."""
        return bool(np.all(self.stable)) and self.fixed_stable

    def to_dict(self) -> dict[str, Any]:
        """Return the map in short, for robustness.json."""
        return {
            "stable_everywhere": self.everywhere,
            "fixed_stable": self.fixed_stable,
            "range": {
                "m_2": [float(self.mass[0]), float(self.mass[-1])],
                "k_e": [float(self.stiffness[0]), float(self.stiffness[-1])],
                "d_e": [float(item) for item in self.damping],
            },
            "stable_share": [float(np.mean(item)) for item in self.stable],
            "worst": {name: getattr(self.worst, name) for name in Environment.__dataclass_fields__},
        }

    def __repr__(self) -> str:
        verdict = "stable" if self.everywhere else "NOT STABLE everywhere"
        lines = [
            f"Coupled stability at link 2: {verdict}, masses of {self.mass[0]:.3g} to {self.mass[-1]:.3g} kg on "
            f"springs of {self.stiffness[0]:.3g} to {self.stiffness[-1]:.3g} N/m"
        ]
        for damping, stable in zip(self.damping, self.stable, strict=True):
            lines.append(f"  damper {damping:g} N s/m: stable in {np.count_nonzero(stable)} of {stable.size}")
        w = self.worst
        growth = "which dies out" if w.doubling_s is None else f"which doubles in {w.doubling_s:.3g} s"
        lines.append(
            f"  worst: {w.m_2:.4g} kg, {w.k_e:.4g} N/m, {w.d_e:.4g} N s/m, at {w.frequency_hz:.4g} Hz, {growth}"
        )
        return "\n".join([*lines, f"  link 2 fixed: {'stable' if self.fixed_stable else 'NOT STABLE'}"])

    _repr_html_ = html_text


def against_environment(plant: Plant) -> Plant:
    """Return a plant's probe with an environment on its inertia: parameters k_e and d_e besides its own.

    Raises
    ------
    ControlError
        The plant says nothing of a port.

    """
    probe = probe_of(plant)
    port = bare_port(probe)
    command, unit = next(iter(probe.inputs.items()))

    def pulled(x: Any, u: Any, p: Any) -> Any:
        force = -p.k_e * getattr(x, port.coordinate) - p.d_e * getattr(x, port.rate)
        return SimpleNamespace(**(dict.fromkeys(probe.inputs, 0.0) | vars(u) | {port.effort: force}))

    return Plant(
        name=f"{plant.name} against an environment",
        states=probe.states,
        inputs={command: unit},
        outputs=probe.outputs,
        parameters={**probe.parameters, "k_e": SPRING, "d_e": DAMPER},
        f=lambda t, x, u, p: probe.f(t, x, pulled(x, u, p), p),
        h=lambda t, x, u, p: probe.h(t, x, pulled(x, u, p), p),
        friction=probe.friction,
        ports=(replace(probe.ports[0], effort=None),),
    )


def coupled_stability(
    controller: Controller,
    plant: Plant,
    parameters: ParameterSet,
    *,
    masses_kg: tuple[float, float] = MASSES_KG,
    stiffnesses_N_per_m: tuple[float, float] = STIFFNESSES_N_PER_M,
    dampings_N_s_per_m: tuple[float, ...] = DAMPINGS_N_S_PER_M,
    points: int = POINTS,
) -> StabilityMap:
    """Map where a controller is stable against a mass on a spring and a damper at link 2.

    Parameters
    ----------
    controller : Controller
        The law.
    plant, parameters
        The actuator; what its own link 2 does is left out, the environment's mass stands for it.
    masses_kg, stiffnesses_N_per_m : (low, high)
        Ranges, logarithmic. A mass of none at all is not among them: there the actuator's own moves freely.
    dampings_N_s_per_m : tuple of float
        A map is drawn for each.
    points : int
        Of the grid, in each direction.

    Returns
    -------
    StabilityMap

    Raises
    ------
    ControlError
        A range is empty, or the plant has no port.

    Examples
    --------
    >>> import seaopt as so
    >>> stand, thor = so.plants.high_impedance(), so.plants.thor()
    >>> controller = so.tune(stand, thor, so.ControllerSpec(bandwidth_hz=30, max_sensitivity=1.6))
    >>> found = coupled_stability(controller, stand, thor, dampings_N_s_per_m=(100.0,), points=5)
    >>> found.spectral_radius.shape, found.fixed_stable
    ((1, 5, 5), True)

    """
    _check(masses_kg, stiffnesses_N_per_m, dampings_N_s_per_m, points)
    coupled = against_environment(plant)
    mass, stiffness = (np.geomspace(*ends, points) for ends in (masses_kg, stiffnesses_N_per_m))
    damping = np.array(dampings_N_s_per_m, dtype=float)
    d, m, k = np.meshgrid(damping, mass, stiffness, indexing="ij")
    radius = _radii(controller, coupled, parameters, m.ravel(), k.ravel(), d.ravel()).reshape(d.shape)
    at = np.unravel_index(int(np.argmax(radius)), radius.shape)
    return StabilityMap(
        mass=mass, stiffness=stiffness, damping=damping, spectral_radius=radius,
        boundary=tuple(
            _boundary(controller, coupled, parameters, mass, stiffness, float(each), stable)
            for each, stable in zip(damping, radius <= GROWING, strict=True)
        ),
        worst=environment(controller, coupled, parameters, float(m[at]), float(k[at]), float(d[at])),
        fixed_stable=_fixed(controller, coupled, parameters),
    )  # fmt: skip


def environment(
    controller: Controller, coupled: Plant, parameters: ParameterSet, m_2: float, k_e: float, d_e: float
) -> Environment:
    """Return what the loop does against one environment, `coupled` being a plant of `against_environment`."""
    values = coupled.complete(parameters).update(**{_inertia(coupled): m_2, "k_e": k_e, "d_e": d_e})
    poles = controller.close(coupled, values).eigenvalues()
    largest = poles[int(np.argmax(np.abs(poles)))]
    radius, period = float(abs(largest)), controller.sample_time_s
    return Environment(
        m_2=m_2, k_e=k_e, d_e=d_e, spectral_radius=radius,
        frequency_hz=float(abs(np.angle(largest)) / (2 * np.pi * period)),
        doubling_s=math.log(2.0) * period / math.log(radius) if radius > GROWING else None,
    )  # fmt: skip


def _check(
    masses: tuple[float, float], stiffnesses: tuple[float, float], dampings: tuple[float, ...], points: int
) -> None:
    for name, (low, high) in (("masses_kg", masses), ("stiffnesses_N_per_m", stiffnesses)):
        if not 0.0 < low < high < math.inf:
            raise ControlError(f"{name} = ({low:g}, {high:g}) is not a range; give 0 < low < high")
    if not dampings or not all(0.0 <= item < math.inf for item in dampings):
        raise ControlError(f"dampings_N_s_per_m = {dampings} are no dampings; give at least one, zero or more")
    if points < 2:
        raise ControlError(f"points = {points} is no grid; give 2 or more")


def _inertia(coupled: Plant) -> str:
    """Return the name of the parameter that is the inertia on the port."""
    return coupled.ports[0].payload[0]


def _radii(
    controller: Controller, coupled: Plant, parameters: ParameterSet, m: Float[np.ndarray, " n"],
    k: Float[np.ndarray, " n"], d: Float[np.ndarray, " n"],
) -> Float[np.ndarray, " n"]:  # fmt: skip
    """Return the spectral radii against n environments."""
    draws = {_inertia(coupled): m, "k_e": k, "d_e": d}
    return batch_figures(controller, coupled, coupled.complete(parameters), draws, peaks=False).spectral_radius


def _fixed(controller: Controller, coupled: Plant, parameters: ParameterSet) -> bool:
    """Tell whether the loop is stable with the link fixed: what a mass of 1e9 kg on the ground is to it."""
    values = coupled.complete(parameters).update(**{_inertia(coupled): 1e9, "k_e": 1e12, "d_e": 1e9})
    return bool(np.max(np.abs(controller.close(coupled, values).eigenvalues())) <= GROWING)


def _boundary(
    controller: Controller, coupled: Plant, parameters: ParameterSet, mass: Float[np.ndarray, " m"],
    stiffness: Float[np.ndarray, " k"], damping: float, stable: Bool[np.ndarray, "m k"],
) -> Float[np.ndarray, "_ 2"]:  # fmt: skip
    """Return points between neighbours of the grid of which one alone is stable, by bisection in logarithms."""
    grid = np.stack(np.meshgrid(np.log(mass), np.log(stiffness), indexing="ij"), axis=-1)
    ends: list[tuple[Any, Any]] = []
    for axis in (0, 1):
        first, second = (np.take(stable, range(i, stable.shape[axis] - 1 + i), axis=axis) for i in (0, 1))
        left, right = (np.take(grid, range(i, stable.shape[axis] - 1 + i), axis=axis) for i in (0, 1))
        for inside, a, b in ((first & ~second, left, right), (second & ~first, right, left)):
            ends.append((a[inside], b[inside]))
    kept, lost = (np.concatenate([pair[i] for pair in ends]) for i in (0, 1))
    for _ in range(BISECTIONS if len(kept) else 0):
        middle = 0.5 * (kept + lost)
        at = np.exp(middle)
        good = _radii(controller, coupled, parameters, at[:, 0], at[:, 1], np.full(len(at), damping)) <= GROWING
        kept, lost = np.where(good[:, None], middle, kept), np.where(good[:, None], lost, middle)
    return np.exp(0.5 * (kept + lost))
