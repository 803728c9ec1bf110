"""The stiffness and damping that may be rendered: a map of where no passive environment destabilises the link."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from seaopt.control.impedance.critical_damping import CriticalImpedances, scan_critical
from seaopt.control.impedance.link import ControlledLink, find_link
from seaopt.control.impedance.moving_loop import close_link
from seaopt.control.impedance.sampled_port import Angles, PortTerms, SampledPort
from seaopt.control.laws.controller import Controller
from seaopt.control.loops.loop import GROWING
from seaopt.control.loops.outer_loop import Impedance
from seaopt.errors import ControlError
from seaopt.formatting import html_text
from seaopt.parameters import ParameterSet
from seaopt.plants import Plant
from seaopt.records import PlotAccessor, record
from seaopt.units import Mechanics, mechanics_of

MAP_POINTS = 100
MOST_POINTS = 1000
COARSE_STIFFNESS = np.concatenate([[0.0], np.geomspace(1e-4, 10.0, 60)])  # of the stiffness scale
COARSE_DAMPING = np.concatenate([-np.geomspace(1e2, 1e-4, 60), [0.0], np.geomspace(1e-4, 1e2, 60)])  # of the damping's
ROOM = 0.25  # beside the region, of its size
EDGE_STEPS, EDGE_POINTS = 30, 201
LEAST_DAMPER, MOST_DAMPER = 1e-6, 1e3  # of the damping scale, looked at for the one that is needed
DAMPER_ROUNDS, DAMPER_PRECISION = 2, 1e-5

Grid = tuple[float, float]


@record(eq=False)
class ImpedanceRegion:
    """Where stiffness and damping rendered at the link are safe against every passive linear environment.

    Parameters
    ----------
    stiffness, damping : arrays, shapes (k,) and (d,)
        The grid: K_v in N/m and D_v in N s/m; N m/rad and N m s/rad of a link that turns.
    margin : array, shape (k, d)
        What is left of the damping, `PortTerms.margin`, least over all angles; positive where it is passive.
    free_radius : array, shape (k, d)
        Largest magnitude of the loop's eigenvalues with nothing at the link.
    held_stable : bool
        Whether the force loop is stable with the link held; nothing is passive without that.
    stiffest : Impedance or None
        The largest stiffness that is passive, at the damping that allows it; None where nothing is.
    spring : float or None
        The actuator's own stiffness, where the plant names it.
    link_damping : float
        The damper at the link that takes energy between the samples; the link's own as a rule.
    velocity_filter_s : float
        T_v.
    critical : CriticalImpedances
        The critically damped ones.
    called : Mechanics
        Units and words.
    """

    plot = PlotAccessor()

    stiffness: Float[np.ndarray, " k"]
    damping: Float[np.ndarray, " d"]
    margin: Float[np.ndarray, "k d"]
    free_radius: Float[np.ndarray, "k d"]
    held_stable: bool
    stiffest: Impedance | None
    spring: float | None
    link_damping: float
    velocity_filter_s: float
    critical: CriticalImpedances
    called: Mechanics

    @property
    def passive(self) -> Bool[np.ndarray, "k d"]:
        """Whether no passive environment makes the link unstable, at each pair of the grid."""
        return (self.margin > 0.0) & self.held_stable

    @property
    def stable(self) -> Bool[np.ndarray, "k d"]:
        """Whether nothing grows with nothing at the link."""
        return self.free_radius <= GROWING

    def to_dict(self) -> dict[str, Any]:
        """Return a summary, for JSON."""
        stiffest = self.stiffest
        return {
            "held_stable": self.held_stable,
            "stiffest": None if stiffest is None else {"stiffness": stiffest.stiffness, "damping": stiffest.damping},
            "spring": self.spring,
            "link_damping": self.link_damping,
            "velocity_filter_s": self.velocity_filter_s,
            "units": {"stiffness": self.called.stiffness, "damping": self.called.damping},
            "range": {"stiffness": _ends(self.stiffness), "damping": _ends(self.damping)},
            "passive_share": float(np.mean(self.passive)),
            "stable_share": float(np.mean(self.stable)),
            "critical_stiffness": _ends(self.critical.stiffness) if self.critical.stiffness.size else None,
        }

    def describe(self) -> list[str]:
        """Return what was found, one line each."""
        k, d = self.called.stiffness, self.called.damping
        if not self.held_stable:
            return ["nothing is passive: the force loop is UNSTABLE with the link held"]
        if self.link_damping == 0.0 and self.stiffest is None:
            return [f"nothing is passive: nothing at the link takes energy between the samples (no damper, 0 {d})"]
        if self.stiffest is None:
            return [f"nothing is passive with a damper of {self.link_damping:.4g} {d} at the link"]
        most = self.stiffest
        share = "" if self.spring is None else f", {most.stiffness / self.spring:.2g} of the spring's"
        lines = [
            f"passive up to {most.stiffness:.4g} {k}{share}, there with a damping of {most.damping:.4g} {d}; "
            f"the link's own damper is {self.link_damping:.4g} {d}"
        ]
        if self.critical.stiffness.size:
            low, high = _ends(self.critical.stiffness)
            lines.append(f"critically damped from {low:.4g} to {high:.4g} {k}")
        return lines

    def __repr__(self) -> str:
        return "\n".join(["Impedance at the link", *(f"  {line}" for line in self.describe())])

    def _repr_html_(self) -> str:
        return html_text(self) + self.plot.to_html()


def passive_region(
    controller: Controller,
    plant: Plant,
    parameters: ParameterSet,
    *,
    stiffness: Grid | None = None,
    damping: Grid | None = None,
    velocity_filter_s: float | None = None,
    link_damping: float | None = None,
    points: int = MAP_POINTS,
) -> ImpedanceRegion:
    """Map which stiffness and damping may be rendered at the link around a force loop (`ImpedanceRegion`).

    Parameters
    ----------
    controller : Controller
        Tuned, or a law of one's own (`seaopt.assess`).
    plant, parameters
        The actuator with its link, which moves; linearised at rest, sliding where it has friction.
    stiffness, damping : (low, high), optional
        Ranges of K_v (N/m or N m/rad) and D_v (N s/m or N m s/rad); about the passive region if left out.
    velocity_filter_s : float, optional
        T_v of the speed; one sample if left out.
    link_damping : float, optional
        The damper at the link, in place of its own.
    points : int
        Of the grid in each direction.

    Raises
    ------
    ControlError
        A range is empty, the link does not move, or an argument is out of range.

    Examples
    --------
    >>> import seaopt as so
    >>> knee, values = so.plants.rotary(), so.plants.rotary().defaults.update(N=50.0, k_s=300.0, d_l=1.0)
    >>> spec = so.ControllerSpec(measured="tau_s", bandwidth_hz=20)
    >>> region = passive_region(so.tune(so.plants.rotary("locked"), values, spec), knee, values, points=20)
    >>> region.margin.shape, region.stiffest.stiffness > 0
    ((20, 20), True)
    """
    link = find_link(controller, plant, parameters, link_damping)
    if isinstance(points, bool) or not 2 <= points <= MOST_POINTS:
        raise ControlError(f"points = {points!r} is not a size of the grid; give 2 to {MOST_POINTS}")
    filter_s = link.speed_filter(velocity_filter_s).velocity_filter_s
    port = SampledPort(link=link, velocity_filter_s=filter_s)
    held_stable = port.held_stable()
    terms = port.terms(port.angles(), link.load.damping)
    spring = None
    if plant.spring is not None and plant.spring.stiffness is not None:
        spring = plant.complete(parameters)[plant.spring.stiffness].value
    scales = _find_scales(link, spring)
    box = _find_box(terms, scales) if held_stable else None
    about = box or (None, None)
    k = np.linspace(*_choose_range("stiffness", stiffness, about[0], scales[0]), points)
    d = np.linspace(*_choose_range("damping", damping, about[1], scales[1]), points)
    k_all, d_all = (part.ravel() for part in np.meshgrid(k, d, indexing="ij"))
    return ImpedanceRegion(
        stiffness=k,
        damping=d,
        margin=terms.least(k_all, d_all).reshape(points, points),
        free_radius=close_link(link, filter_s).radius(k_all, d_all).reshape(points, points),
        held_stable=held_stable,
        stiffest=None if box is None else _find_stiffest(port, terms.theta, box),
        spring=spring,
        link_damping=link.load.damping,
        velocity_filter_s=filter_s,
        critical=scan_critical(link, filter_s),
        called=mechanics_of(link.port.place_unit),
    )


def needed_damper(port: SampledPort, impedance: Impedance) -> float:
    """Return the least damper at the link with which an impedance is passive; infinite where none makes it so. More of
    it leaves the world less to choose from, so that what is passive with one is so with a larger one.
    """
    if not port.held_stable():
        return np.inf
    scale, theta, high = _find_scales(port.link, None)[1], port.angles(), np.inf
    for _ in range(DAMPER_ROUNDS):
        high = _bisect_damper(port.terms(theta, 0.0), impedance, LEAST_DAMPER * scale, MOST_DAMPER * scale)
        if not np.isfinite(high):
            return high
        theta = np.union1d(theta, port.refine(impedance, high, theta))
    return high


def _bisect_damper(at: PortTerms, impedance: Impedance, low: float, high: float) -> float:
    """Return the least damper between two with which an impedance is passive at some angles; infinite beyond them."""

    def holds(damper: float) -> bool:
        return bool(np.min(replace(at, damper=damper).margin_of(impedance)) > 0.0)

    if not holds(high):
        return np.inf
    if holds(low):
        return low
    while high / low > 1.0 + DAMPER_PRECISION:
        middle = float(np.sqrt(low * high))
        low, high = (low, middle) if holds(middle) else (middle, high)
    return high


def _find_scales(link: ControlledLink, spring: float | None) -> tuple[float, float]:
    """Return a stiffness and a damping of the size of what is rendered: the spring's, or that of 10 Hz on the link."""
    stiffness = spring or link.load.inertia * (2 * np.pi * 10.0) ** 2
    return stiffness, 2.0 * float(np.sqrt(stiffness * link.load.inertia))


def _find_box(terms: PortTerms, scales: tuple[float, float]) -> tuple[Grid, Grid] | None:
    """Return the ends of the passive region in stiffness and damping, to a grid's grain; None where it is empty."""
    k, d = scales[0] * COARSE_STIFFNESS, scales[1] * COARSE_DAMPING
    ends: list[Grid] = []
    for _ in range(3):
        k_all, d_all = (part.ravel() for part in np.meshgrid(k, d, indexing="ij"))
        passive = (terms.least(k_all, d_all) > 0.0).reshape(k.size, d.size)
        rows, columns = np.flatnonzero(passive.any(axis=1)), np.flatnonzero(passive.any(axis=0))
        if not rows.size:
            return None
        ends = [
            (float(axis[max(at[0] - 1, 0)]), float(axis[min(at[-1] + 1, axis.size - 1)]))
            for axis, at in ((k, rows), (d, columns))
        ]
        k, d = (np.linspace(low, high, 61) for low, high in ends)
    return ends[0], ends[1]


def _find_stiffest(port: SampledPort, theta: Angles, box: tuple[Grid, Grid]) -> Impedance | None:
    """Return the passive impedance of the largest stiffness, by bisection, looked at between the angles too."""
    d = np.linspace(*box[1], EDGE_POINTS)
    about: Impedance | None = None
    for _ in range(2):
        low, high, about = 0.0, box[0][1] * (1.0 + ROOM), None
        terms = port.terms(theta, port.link.load.damping)
        for _ in range(EDGE_STEPS):
            middle = 0.5 * (low + high)
            margin = terms.least(np.full(d.size, middle), d)
            best = int(np.argmax(margin))
            if margin[best] > 0.0:
                low = middle
                about = Impedance(stiffness=middle, damping=float(d[best]), velocity_filter_s=port.velocity_filter_s)
            else:
                high = middle
        if about is None:
            return None
        theta = np.union1d(theta, port.refine(about, port.link.load.damping, theta))
        width = d[1] - d[0]
        d = np.linspace(about.damping - 5 * width, about.damping + 5 * width, EDGE_POINTS)
    return about


def _choose_range(name: str, stated: Grid | None, about: Grid | None, scale: float) -> Grid:
    """Return the ends of an axis of the map: as given, about the region, or by its scale."""
    if stated is not None:
        low, high = (float(end) for end in stated)
        if not (np.isfinite(low) and np.isfinite(high) and low < high and (name != "stiffness" or low >= 0.0)):
            raise ControlError(f"{name} = ({low:g}, {high:g}) is not a range; give low < high")
        return low, high
    low, high = about if about is not None else (0.0, 0.2 * scale)
    room = ROOM * (high - low)
    return (0.0, high + room) if name == "stiffness" else (low - room, high + room)


def _ends(values: Float[np.ndarray, " n"]) -> list[float]:
    return [float(values[0]), float(values[-1])]
