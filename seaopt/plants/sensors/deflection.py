r"""Sensors that compute what they read from encoders on either side of the spring.

``deflection_sensor``, a part around any plant that has a spring: the torque (force) that firmware makes of two encoders
and a constant of its own,

.. math:: \tau_d = k_n \delta, \qquad \delta = \theta_m/N - \theta_l \quad (q + x_2 - x_1 \text{ of a screw}),

beside the spring's own effort, which a load cell reads. The two differ in all that is parallel to the spring or in
series with it: the damping c_s makes :math:`\tau_s = (k_s + c_s s)\,\delta`, which leads :math:`\tau_d` by
:math:`c_s/k_s` seconds at low frequencies; play is in :math:`\delta`, hardening is not in k_n, and where k_n is not the
spring's stiffness the reading is wrong by their ratio.

Errors of the encoders are errors of what is computed from them: by :math:`\partial\tau_d/\partial\theta_m = k_n/N` and
:math:`\partial\tau_d/\partial\theta_l = -k_n`.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import casadi as ca

from seaopt.errors import PlantError
from seaopt.parameters import Parameter, declare
from seaopt.plants.plant import CompletedParameters, Plant, extend, name_parameters
from seaopt.plants.roles import Sensing, change_ports
from seaopt.units import ROTARY

NOMINAL = "k_n"
# Of a screw; whoever has such a sensor states the constant that it multiplies by: a plant has no default for it.
PARTS: dict[str, tuple[Parameter, ...]] = {
    "deflection_sensor": (declare(NOMINAL, 655e3, "N/m", 0.0, "stiffness that the sensor assumes"),)
}


def read_deflection(plant: Plant) -> Plant:
    """Return a plant with one more output, tau_d or F_d: what two encoders make of the spring's deflection. Raises
    PlantError: the plant states no spring, or not what is regulated, or has such an output.
    """
    spring, sensing = plant.spring, plant.sensing
    if spring is None or sensing is None or not sensing.regulated:
        missing = "spring = SeriesSpring(deflection, unit)" if spring is None else "sensing = Sensing(regulated=...)"
        raise PlantError(f'part "deflection_sensor" needs the role {missing}; give it', plant=plant.name)
    unit = plant.outputs[sensing.regulated[0]]
    name = "tau_d" if unit == ROTARY.unit else "F_d"
    if name in plant.outputs or NOMINAL in plant.parameters:
        raise PlantError(f'part "deflection_sensor" has {name} and {NOMINAL}, which it has, too', plant=plant.name)
    deflection = spring.deflection
    return extend(
        plant,
        readings=lambda t, x, u, p: {name: getattr(p, NOMINAL) * deflection(x, p)},
        name=f"{plant.name} with deflection_sensor",
        outputs={**plant.outputs, name: unit},
        parameters={**plant.parameters, NOMINAL: f"{unit}/{spring.unit}"},
        sensing=replace(sensing, regulated=(*sensing.regulated, name), from_encoders=(*sensing.from_encoders, name)),
        ports=change_ports(plant.ports, read_deflection),
    )


def weigh_encoders(plant: Plant, output: str) -> dict[str, Any]:
    """Return how much an output moves with what each encoder reads: {output or state that is read: expression of p}.
    Empty where the output is not computed from encoders. Behind a delay or a load cell these are the weights inside.
    """
    sensing, port = plant.sensing, plant.port
    if sensing is None or output not in sensing.from_encoders:
        return {}
    p = name_parameters(plant, plant.p)
    if output in sensing.weights:
        return dict(sensing.weights[output](p))
    position = sensing.motor_position
    if position is None or position not in plant.states:
        return {}
    motor = list(plant.states).index(position)
    slope = ca.simplify(ca.jacobian(plant.output[list(plant.outputs).index(output)], plant.x[motor]))
    weights: dict[str, Any] = {position: slope}
    if port is not None and port.motion is not None and port.drive == position:
        weights[port.motion] = ca.simplify(slope * port.ratio(p))
    return weights


def find_scale(plant: Plant, params: CompletedParameters, output: str) -> float | None:
    """Return how many times the spring's own effort a reading of encoders is as the motor moves from rest; None where
    the output is none, or passes a filter.
    """
    sensing = plant.sensing
    if sensing is None or output not in sensing.from_encoders or sensing.motor_position not in plant.states:
        return None
    motor, names = list(plant.states).index(str(sensing.motor_position)), list(plant.outputs)
    rows = [names.index(name) for name in (output, sensing.regulated[0])]
    slopes = ca.densify(ca.jacobian(plant.output, plant.x[motor])[rows])
    at_rest = ca.Function("slopes", plant.symbols, [slopes])
    reading, deflection = at_rest(0.0, 0.0, 0.0, params.vector).full().ravel().tolist()
    return reading / deflection if reading and deflection else None


def keep_weights(plant: Plant) -> Sensing | None:
    """Return the sensing of a plant whose outputs pass a filter, behind which their slopes are not the encoders'."""
    sensing = plant.sensing
    if sensing is None or not sensing.from_encoders:
        return sensing
    inside = {output: partial(_weigh_inside, plant, output) for output in sensing.from_encoders}
    return replace(sensing, weights={**inside, **sensing.weights})


def _weigh_inside(plant: Plant, output: str, p: Any) -> dict[str, Any]:
    weights = weigh_encoders(plant, output)
    if not weights:
        return {}
    stack = ca.Function("weights", [plant.p], [ca.densify(ca.vertcat(*weights.values()))])
    values = stack(ca.vertcat(*(getattr(p, name) for name in plant.parameters)))
    return dict(zip(weights, ca.vertsplit(values), strict=True))


def evaluate_weights(plant: Plant, params: CompletedParameters, output: str) -> dict[str, float]:
    """Return the numbers of `weigh_encoders`."""
    weights = weigh_encoders(plant, output)
    values = ca.Function("weights", [plant.p], [ca.vertcat(*weights.values())])(params.vector) if weights else None
    return {} if values is None else dict(zip(weights, values.full().ravel().tolist(), strict=True))
