r"""What the terms of a law feed back, closed around each plant, for figures of the linear loop as it is exported.

A compensation of gravity adds :math:`\gamma G(x)` of the link's position to the law's reference, one of friction
:math:`c_k = \gamma F_c\, \mathrm{sat}(v_k / v_0)` of the motor's measured speed to its effort. In small motions each is
one more signal that the law reads: the plant has it as an output, linearised where each case and each draw rests, and
the law a column for it,

.. math:: u = C_r (F_\mathrm{ref} + w) - C_y y + (1 - q)\, s, \qquad w = \gamma G(x), \quad
          s = \frac{\gamma F_c}{v_0} \frac{g\,\theta}{T_s} .

With a weight the impedance's outer loop is closed, too: it may be what holds a weightless link. Without one the figures
are of the force loop, which the tuner places; what the outer loop does is asked by its passivity. Friction is
compensated in full where the plant is stuck; where it slides both it and its compensation have their full size and no
slope. All of a weight compensated leaves a link neutral, on the edge of stability: it is closed with `SHORT` less.

Where nothing holds the link the motor's place drifts, and its difference does not. There the plant has a state
:math:`\dot m = \dot\theta - (\epsilon / T_s) m` for it, of which the law reads

.. math:: m_k - e^{-\epsilon} m_{k-1} = \int_0^{T_s} e^{-\epsilon (1 - t / T_s)}\, \dot\theta\, dt,

the difference to a share of :math:`\epsilon / 2`; its own eigenvalue :math:`e^{-\epsilon}` is in nothing that is read.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np

from seaopt.control.laws.controller import Controller
from seaopt.control.loops.compensation.terms import Compensation, compensate
from seaopt.control.loops.drift import leave_out_drift
from seaopt.control.loops.law import Law
from seaopt.control.loops.loop import Loop
from seaopt.control.running.outer_run import enclose
from seaopt.parameters import ParameterSet
from seaopt.plants import Plant
from seaopt.plants.friction import SLIDING, friction_states, name_states
from seaopt.plants.memo import memo

WEIGHT, AGAINST = "weight compensated", "friction compensated"  # outputs: of the link's position, of the motor's
SHORT = 1e-4  # of a weight that is compensated whole
TURNED, FORGOTTEN = "motor_turned", 1e-4  # a state, of the motor's place, and how much of it is forgotten in a period


def split_states(
    controller: Controller, plants: Mapping[str, Plant], params: ParameterSet, varied: Collection[str] = ()
) -> dict[str, Plant]:
    """Return what `split_friction` does, each plant with what the controller's terms feed back of it."""
    terms, split = controller.compensation, dict[str, Plant]()
    for label, (name, state) in name_states(plants, params, varied).items():
        plant = friction_states(plants[name])[state] if state else plants[name]
        split[label] = plant if terms is None else _show_terms(plant, terms, controller.signals, state != SLIDING)
    return split


@memo
def _show_terms(plant: Plant, terms: Compensation, signals: tuple[str, ...], stands: bool) -> Plant:
    """Return a plant with outputs of what terms feed back of it; the plant itself where they feed back nothing."""
    gravity, friction, units, forgets = terms.gravity, terms.friction, dict[str, str](), False
    if gravity is not None and {gravity.reads, *signals} <= plant.outputs.keys():
        units[WEIGHT] = plant.outputs[signals[0]]
        gravity = gravity.scaled(1.0 - SHORT) if gravity.fraction == 1.0 else gravity
    if friction is not None and stands and friction.reads in plant.outputs:
        units[AGAINST] = plant.outputs[friction.reads]
        forgets = friction.reads not in leave_out_drift(plant, signals).outputs
    if not units:
        return plant

    def h(t: Any, x: Any, u: Any, p: Any) -> Mapping[str, Any]:
        read, shown = plant.h(t, x, u, p), dict[str, Any]()
        if WEIGHT in units and gravity is not None:
            weight = Compensation(sample_time_s=terms.sample_time_s, gravity=gravity)
            shown[WEIGHT] = compensate(weight.shape, weight.numbers, (), 0.0, [read[gravity.reads]], ca)[0]
        if AGAINST in units and friction is not None:
            turned = getattr(x, TURNED) if forgets else read[friction.reads]
            shown[AGAINST] = friction.effort * friction.share_per_step(terms.sample_time_s) * turned
        return {**read, **shown}

    if friction is not None and forgets:
        plant = _add_turned(plant, friction.reads, FORGOTTEN / terms.sample_time_s)
    return replace(plant, h=h, outputs={**plant.outputs, **units})


def _add_turned(plant: Plant, output: str, rate: float) -> Plant:
    """Return a plant with a state that moves as an output does and forgets at a rate (1/s) where it is."""
    at = plant.output[list(plant.outputs).index(output)]
    speed = ca.Function("speed", [*plant.symbols], [ca.jtimes(at, plant.x, plant.dynamics)])

    def f(t: Any, x: Any, u: Any, p: Any) -> dict[str, Any]:
        vectors = (
            ca.vertcat(*(getattr(space, name) for name in names))
            for space, names in ((x, plant.states), (u, plant.inputs), (p, plant.parameters))
        )
        return {**plant.f(t, x, u, p), TURNED: speed(t, *vectors) - rate * getattr(x, TURNED)}

    return replace(plant, f=f, states={**plant.states, TURNED: plant.outputs[output]})


def shows_terms(plant: Plant) -> bool:
    """Tell whether a plant of `split_states` has outputs of what terms feed back of it."""
    return not {WEIGHT, AGAINST}.isdisjoint(plant.outputs)


def close_whole(controller: Controller, plant: Plant, params: ParameterSet) -> Loop:
    """Return the loop of a controller around a plant of `split_states`, with what its terms feed back of it."""
    return close_terms(controller, plant).close(plant, params)


def close_terms(controller: Controller, plant: Plant) -> Controller:
    """Return a controller whose law reads what its terms feed back of a plant of `split_states`, and with a weight its
    outer loop; the controller itself where they feed back nothing. Its reference is the force law's.
    """
    if not shows_terms(plant):
        return controller
    law, signals, force = controller.law, controller.signals, controller.law
    if WEIGHT in plant.outputs:
        law, signals = enclose(controller, plant)
        n, b, d = force.c.size, law.b.copy(), law.d.copy()
        b[:n, 0], d[0] = force.b[:, 0], force.d[0]
        law, signals = replace(law, b=np.column_stack([b, b[:, 0]]), d=np.append(d, d[0])), (*signals, WEIGHT)
    if AGAINST in plant.outputs:
        n, columns = law.b.shape
        a, b = np.zeros((n + 1, n + 1)), np.zeros((n + 1, columns + 1))
        a[:n, :n], b[:n, :columns], b[n, columns] = law.a, law.b, 1.0  # the last sample's is kept
        kept = np.exp(-FORGOTTEN) if TURNED in plant.states else 1.0
        c, d = np.append(law.c, -kept), np.append(law.d, 1.0)
        law, signals = Law(a=a, b=b, c=c, d=d, sample_time_s=law.sample_time_s), (*signals, AGAINST)
    return replace(controller, law=law, reads=signals, compensation=None, outer=None)
