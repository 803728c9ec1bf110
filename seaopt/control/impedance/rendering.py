r"""One impedance rendered at a link: whether it is safe, what would break it, and how far it is what was asked.

Where it is not passive there is an environment that makes the loop oscillate, and it is named: at the frequency where
the condition of `seaopt.control.impedance.sampled_port` fails most, the link's impedance gives more than its damper
takes, and a mass or a spring whose reactance cancels its own is that environment. Its loop's eigenvalues confirm it.
"""

from __future__ import annotations

import math
from dataclasses import asdict, replace
from typing import Any

import numpy as np
from jaxtyping import Complex, Float

from seaopt.control.impedance.link import ControlledLink, find_link
from seaopt.control.impedance.moving_loop import MovingLoop, close_link
from seaopt.control.impedance.region import needed_damper
from seaopt.control.impedance.sampled_port import SampledPort
from seaopt.control.laws.controller import Controller
from seaopt.control.loops.loop import GROWING
from seaopt.control.loops.outer_loop import Impedance, OuterLoop
from seaopt.control.loops.port import hold_response
from seaopt.errors import ControlError, require_type
from seaopt.formatting import format_percent, html_text
from seaopt.parameters import ParameterSet
from seaopt.plants import Plant
from seaopt.records import record
from seaopt.units import Mechanics, mechanics_of

NEAR_AS_ASKED = math.sqrt(2.0)  # 3 dB
BAND_POINTS = 4000
LOWEST_BAND_HZ = 1e-3


@record
class BreakingEnvironment:
    """A passive environment that makes the link oscillate."""

    # inertia, stiffness: added to the link's own: a mass (kg, kg m^2) or a spring (N/m, N m/rad) to the ground, the
    # other is zero
    inertia: float
    stiffness: float
    frequency_hz: float  # of the oscillation
    spectral_radius: float  # of the sampled loop against it, above 1

    def describe(self, called: Mechanics) -> str:
        """Return what it is and what it does, with units."""
        spring, mass = (
            f"a spring of {self.stiffness:.4g} {called.stiffness}",
            f"{self.inertia:.4g} {called.inertia} more",
        )
        return f"{spring if self.stiffness else mass} at the link makes it oscillate at {self.frequency_hz:.4g} Hz"


@record(eq=False)
class Rendering:
    """An impedance as it is rendered.

    Parameters
    ----------
    impedance : Impedance
        What was asked.
    outer : OuterLoop
        What runs.
    passive : bool
        No passive linear environment makes the link unstable.
    needed_damper : float
        The least damper at the link with which it is passive; infinite where none makes it so.
    link_damping : float
        The link's own.
    stable : bool
        Nothing grows with nothing at the link.
    spectral_radius : float
        Of that loop.
    breaking : BreakingEnvironment or None
        Where it is not passive: an environment that makes it oscillate, where one was found.
    worst_hz : float
        Where it is least passive.
    band_hz : (low, high) or None
        Where the impedance, without the link's own, is within 3 dB of what was asked, from the lowest such frequency.
    overshoot : float
        Of the link after a step of x_0, as a share of where it ends; infinite where it is not stable.
    called : Mechanics
        Units and words.
    """

    impedance: Impedance
    outer: OuterLoop
    passive: bool
    needed_damper: float
    link_damping: float
    stable: bool
    spectral_radius: float
    breaking: BreakingEnvironment | None
    worst_hz: float
    band_hz: tuple[float, float] | None
    overshoot: float
    called: Mechanics

    def to_dict(self) -> dict[str, Any]:
        """Return the fields, for JSON; what is infinite is null."""
        return {
            "stiffness": self.impedance.stiffness,
            "damping": self.impedance.damping,
            "velocity_filter_s": self.outer.velocity_filter_s,
            "passive": self.passive,
            "needed_damper": self.needed_damper if math.isfinite(self.needed_damper) else None,
            "link_damping": self.link_damping,
            "stable": self.stable,
            "spectral_radius": self.spectral_radius,
            "breaking": None if self.breaking is None else asdict(self.breaking),
            "worst_hz": self.worst_hz,
            "band_hz": None if self.band_hz is None else list(self.band_hz),
            "overshoot": self.overshoot if math.isfinite(self.overshoot) else None,
            "units": {"stiffness": self.called.stiffness, "damping": self.called.damping},
        }

    def describe(self) -> list[str]:
        """Return what was found, one line each."""
        unit = self.called.damping
        need = f"{self.needed_damper:.4g} {unit}" if math.isfinite(self.needed_damper) else f"none, of any {unit},"
        verdict = "passive" if self.passive else "NOT PASSIVE"
        lines = [f"{verdict}: it takes a damper of {need} at the link, which has {self.link_damping:.4g}"]
        if self.breaking is not None:
            lines.append(self.breaking.describe(self.called))
        if not self.stable:
            lines.append("UNSTABLE with nothing at the link")
        else:
            lines.append(f"a step of the link overshoots by {format_percent(self.overshoot)}")
        if self.band_hz is not None:
            lines.append(f"within 3 dB of what was asked from {self.band_hz[0]:.3g} to {self.band_hz[1]:.3g} Hz")
        return lines

    def __repr__(self) -> str:
        k, d = self.called.stiffness, self.called.damping
        head = f"Impedance of {self.impedance.stiffness:.4g} {k} and {self.impedance.damping:.4g} {d} at the link"
        return "\n".join([head, *(f"  {line}" for line in self.describe())])

    def _repr_html_(self) -> str:
        return html_text(self)


def render(
    controller: Controller,
    plant: Plant,
    parameters: ParameterSet,
    impedance: Impedance,
    *,
    link_damping: float | None = None,
) -> Rendering:
    """Measure an impedance that is rendered at the link, closed around a force loop (`Rendering`).

    Parameters
    ----------
    controller, plant, parameters, link_damping
        As `seaopt.control.passive_region`.
    impedance : Impedance
        Stiffness, damping and the filter of the speed.

    Raises
    ------
    ControlError
        The link does not move, or an argument is out of range.

    Examples
    --------
    >>> import seaopt as so
    >>> knee, values = so.plants.rotary(), so.plants.rotary().defaults.update(N=50.0, k_s=300.0, d_l=1.0)
    >>> spec = so.ControllerSpec(measured="tau_s", bandwidth_hz=20)
    >>> force = so.tune(so.plants.rotary("locked"), values, spec)
    >>> rendering = render(force, knee, values, Impedance(stiffness=40.0, damping=2.0))
    >>> rendering.passive, rendering.stable
    (True, True)
    """
    require_type(impedance, Impedance, "impedance", "give an Impedance", ControlError)
    link = find_link(controller, plant, parameters, link_damping)
    outer, damper = link.outer(impedance), link.load.damping
    port = SampledPort(link=link, velocity_filter_s=outer.velocity_filter_s)
    loop = close_link(link, outer.velocity_filter_s)
    margin, worst = port.worst(impedance, damper, port.angles())
    passive = bool(margin > 0.0) and port.held_stable()
    radius = float(loop.radius(impedance.stiffness, impedance.damping))
    return Rendering(
        impedance=impedance,
        outer=outer,
        passive=passive,
        needed_damper=needed_damper(port, impedance),
        link_damping=damper,
        stable=radius <= GROWING,
        spectral_radius=radius,
        breaking=None if passive else find_breaking(link, outer, port.find_failing_hz(impedance, damper)),
        worst_hz=worst / (2 * np.pi * link.sample_time_s),
        band_hz=_find_band(link, outer),
        overshoot=_find_overshoot(loop, impedance, radius),
        called=mechanics_of(link.port.place_unit),
    )


def add_impedance(
    controller: Controller, plant: Plant, parameters: ParameterSet, impedance: Impedance, *, name: str = ""
) -> Controller:
    """Return the controller with the outer loop that renders an impedance at a plant's link.

    It is stored, certified and exported with its force law.

    Parameters
    ----------
    controller, plant, parameters, impedance
        As `seaopt.control.render`.
    name : str
        Of the plant, among those that are certified; the first whose link moves if left out.

    Raises
    ------
    ControlError
        The link does not move.

    Examples
    --------
    >>> import seaopt as so
    >>> knee, values = so.plants.rotary(), so.plants.rotary().defaults.update(N=50.0, k_s=300.0, d_l=1.0)
    >>> force = so.tune(so.plants.rotary("locked"), values, so.ControllerSpec(measured="tau_s", bandwidth_hz=20))
    >>> add_impedance(force, knee, values, Impedance(stiffness=40.0, damping=2.0)).outer.direction
    1.0
    """
    require_type(impedance, Impedance, "impedance", "give an Impedance", ControlError)
    outer = find_link(controller, plant, parameters).outer(impedance)
    assert plant.port is not None  # else it has no link
    position, direction = str(plant.port.motion), round(outer.direction, 9)
    return replace(controller, outer=replace(outer, plant=name, position=position, direction=direction))


def apparent_impedance(link: ControlledLink, outer: OuterLoop, f: Float[np.ndarray, " m"]) -> Complex[np.ndarray, " m"]:
    """Return F_e/v of the actuator under both loops at frequencies (Hz), without the link and without aliases."""
    response = link.port.response(f)
    reference, feedback = link.law.reference_response(f), link.law.feedback_responses(f)
    s, z = 2j * np.pi * f, np.exp(2j * np.pi * f * link.sample_time_s)
    late = hold_response(f, link.sample_time_s, link.delay_samples)
    commanded = link.direction * reference * (outer.stiffness + outer.damping * outer.difference(z)) / s
    closed = 1.0 + np.sum(link.held().responses(f) * feedback, axis=0)
    motor = -(np.sum(feedback * response.motion_to_read, axis=0) + commanded) * late / closed
    return response.motion_to_port + response.motor_to_port * motor


def find_breaking(
    link: ControlledLink, outer: OuterLoop, frequencies_hz: Float[np.ndarray, " m"]
) -> BreakingEnvironment | None:
    """Return the mass or the spring at the link that makes it oscillate most of those that some frequencies name."""
    load, best = link.load, None
    reactances = -np.imag(apparent_impedance(link, outer, frequencies_hz))
    for frequency, wanted in zip(frequencies_hz, reactances, strict=True):
        omega = 2 * np.pi * float(frequency)
        more = float(wanted) - (omega * load.inertia - load.stiffness / omega)
        inertia, stiffness = (more / omega, 0.0) if more > 0.0 else (0.0, -more * omega)
        whole = replace(load, inertia=load.inertia + inertia, stiffness=load.stiffness + stiffness)
        poles = close_link(link, outer.velocity_filter_s, whole).eigenvalues(outer.stiffness, outer.damping)
        fastest = complex(poles[int(np.argmax(np.abs(poles)))])
        if best is None or abs(fastest) > best.spectral_radius:
            best = BreakingEnvironment(
                inertia=inertia,
                stiffness=stiffness,
                spectral_radius=abs(fastest),
                frequency_hz=float(abs(np.angle(fastest)) / (2 * np.pi * link.sample_time_s)),
            )
    return None if best is None or best.spectral_radius <= GROWING else best


def _find_band(link: ControlledLink, outer: OuterLoop) -> tuple[float, float] | None:
    """Return the band, from the lowest frequency at which the impedance is as asked, within which it stays so."""
    if outer.stiffness == 0.0 and outer.damping == 0.0:
        return None
    f = np.geomspace(LOWEST_BAND_HZ, 0.5 / link.sample_time_s, BAND_POINTS)
    wanted = outer.stiffness / (2j * np.pi * f) + outer.damping
    ratio = np.abs(apparent_impedance(link, outer, f) / wanted)
    near = (ratio < NEAR_AS_ASKED) & (ratio > 1.0 / NEAR_AS_ASKED)
    if not np.any(near):
        return None
    first = int(np.argmax(near))
    end = first + int(np.argmin(np.append(near[first:], False)))
    return float(f[first]), float(f[end - 1])


def _find_overshoot(loop: MovingLoop, impedance: Impedance, radius: float) -> float:
    """Return by how much a step of x_0 overshoots, as a share of where the link ends."""
    if radius > GROWING or not impedance.stiffness > 0.0:
        return np.inf if radius > GROWING else 0.0
    slow = -1.0 / math.log(min(max(radius, math.exp(-1.0)), 1.0 - 1e-5))  # samples of the slowest time constant
    path = loop.step(impedance, min(int(12.0 * slow) + 50, 200_000))
    return max(float(np.max(path) / loop.end(impedance) - 1.0), 0.0)
