r"""A force-controlled actuator and the link that it moves, as linear models, for what is rendered at that link.

The port is the actuator without its link (`seaopt.control.loops.port`); the link itself is a load on it,

.. math:: Z_l(s) = m s + d + k/s,

with what gravity does in k. It is read off the plant whose link moves, by no parameter's name: with :math:`F = G_{11}
F_m + G_{12} v` and :math:`F_e = G_{21} F_m + G_{22} v` of the port, a motor force moves the free link by
:math:`x = G_x F_m`, so that :math:`Z_l = -G_{21}/(s G_x) - G_{22}`.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from seaopt.control.laws.controller import Controller
from seaopt.control.loops.law import Law
from seaopt.control.loops.outer_loop import Impedance, OuterLoop
from seaopt.control.loops.port import PortModel, port_of
from seaopt.control.loops.sampled_plant import DigitalPlant, linearise_sets
from seaopt.control.systems.resolvent import Resolvent
from seaopt.errors import ControlError
from seaopt.parameters import ParameterSet
from seaopt.plants import Plant
from seaopt.plants.friction import take_sliding
from seaopt.records import record

LOAD_HZ = (0.05, 0.7, 3.0, 20.0, 70.0)  # where the link's impedance is read
LOAD_ROUNDING = 1e-5  # share of the impedance there, within which it is a mass, a damper and a spring
STATIC_HZ = 1e-5  # where the effort on the link per measured effort is read


@record
class Load:
    """What hangs on the port: inertia (kg or kg m^2), damper and spring."""

    inertia: float
    damping: float = 0.0
    stiffness: float = 0.0


@record(eq=False)
class ControlledLink:
    """An actuator under force control, and the link that it moves."""

    port: PortModel  # the actuator without its link, sliding where it has friction
    load: Load  # the link
    law: Law  # the force law
    delay_samples: int  # of the law
    direction: float  # the measured effort per effort on the link at rest

    @property
    def sample_time_s(self) -> float:
        """The law's period."""
        return self.law.sample_time_s

    def held(self) -> DigitalPlant:
        """Return the sampled plant from motor force to what is measured with the link held."""
        return self.port.hold_link(self.sample_time_s, self.delay_samples)

    def speed_filter(self, velocity_filter_s: float | None) -> OuterLoop:
        """Return an outer loop without gains, which only filters its speed; over one sample if left out."""
        return self.outer(Impedance(stiffness=0.0, damping=0.0, velocity_filter_s=velocity_filter_s))

    def outer(self, impedance: Impedance) -> OuterLoop:
        """Return the outer loop that renders an impedance here."""
        return OuterLoop(
            stiffness=impedance.stiffness,
            damping=impedance.damping,
            direction=self.direction,
            velocity_filter_s=impedance.filter_for(self.sample_time_s),
            sample_time_s=self.sample_time_s,
            place_unit=self.port.place_unit,
        )


def find_link(
    controller: Controller, plant: Plant, params: ParameterSet, link_damping: float | None = None
) -> ControlledLink:
    """Return the link of a plant under a controller, linearised at rest, sliding where it has friction. `link_damping`:
    the damper at the link, in place of its own. Raises ControlError: the link is held, the plant has no port, the link
    is not a mass on a spring and a damper, or the damper is negative.
    """
    if link_damping is not None and not 0.0 <= link_damping < np.inf:
        raise ControlError(f"link_damping = {link_damping:g} is not a damper; give zero or more")
    if plant.port is None or plant.port.motion is None:
        raise ControlError(
            f"plant {plant.name} holds its link, so that no impedance can be rendered there; give a plant whose link "
            'moves: moving_output, two_link or rotary(link="free")'
        )
    measured, per_effort = controller.spec.regulated, controller.command.per_effort
    params = controller.delay(params)
    sliding = take_sliding(plant, params)
    port = port_of(sliding, params, controller.signals, per_effort)
    linear, _ = linearise_sets(sliding, [sliding.complete(params)], str(plant.port.motion), per_effort)
    static = port.response(np.array([STATIC_HZ]))
    ratio = complex(static.motor_to_port[0] / static.motor_to_read[0, 0])
    if not (np.isfinite(ratio) and abs(ratio.real) > 1e-6 and abs(ratio.imag) < 1e-3 * abs(ratio.real)):
        raise ControlError(
            f"{measured} of plant {plant.name} does not tell the effort on the link at rest; measure an output that "
            "does"
        )
    load = _read_load(port, linear, plant.name)
    return ControlledLink(
        port=port,
        load=load if link_damping is None else replace(load, damping=float(link_damping)),
        law=controller.law,
        delay_samples=controller.compute_delay_samples,
        direction=-1.0 / ratio.real,
    )


def _read_load(port: PortModel, linear: tuple[Float[np.ndarray, "..."], ...], name: str) -> Load:
    """Return the link's inertia, damper and spring, by least squares over a few frequencies."""
    a, b, c, _ = (part[0] for part in linear)
    f = np.array(LOAD_HZ)
    s = 2j * np.pi * f
    response = port.response(f)
    drive = response.motor_to_port * np.exp(s * port.delay_s)  # `linear` has no delay
    moved = Resolvent.of(a, b[:, None], c).respond(s)[0, 0]
    whole = -drive / (s * moved)
    size = np.abs(whole)
    terms = np.column_stack([s, np.ones_like(s), 1.0 / s]) / size[:, None]
    load = (whole - response.motion_to_port) / size
    rows, wanted = np.vstack([terms.real, terms.imag]), np.concatenate([load.real, load.imag])
    scale = np.linalg.norm(rows, axis=0)
    coefficients = np.linalg.lstsq(rows / scale, wanted, rcond=None)[0] / scale
    if np.max(np.abs(rows @ coefficients - wanted)) > LOAD_ROUNDING:
        raise ControlError(
            f"the link of plant {name} is no mass on a spring and a damper (a second elasticity behind the port); "
            "an impedance is rendered at a rigid link"
        )
    small = LOAD_ROUNDING * np.max(np.abs(wanted)) / scale
    inertia, damping, stiffness = map(float, np.where(np.abs(coefficients) > small, coefficients, 0.0))
    return Load(inertia=inertia, damping=damping, stiffness=stiffness)
