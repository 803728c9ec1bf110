r"""What terms and outer loop of a law feed back, closed around each plant, for figures of the loop as it is exported.

A compensation of gravity adds :math:`\gamma G(x)` of the link's position to the law's reference, one of friction
:math:`c_k = \gamma F_c\, \mathrm{sat}(v_k / v_0)` of the motor's measured speed to its effort. In small motions each is
one more signal that the law reads: the plant has it as an output, linearised where each case and each draw rests, and
the law a column for it,

.. math:: u = C_r (F_\mathrm{ref} + w) - C_y y + (1 - q)\, s, \qquad w = \gamma G(x), \quad
          s = \frac{\gamma F_c}{v_0} \frac{g\,\theta}{T_s} .

An impedance's outer loop is closed, too, on every plant that has the link's position: with a weight compensated it may
be what holds the link. Friction is compensated in full where the plant is stuck; where it slides both it and its
compensation have their full size and no slope. All of a weight compensated leaves a link neutral, on the edge of
stability: it is closed with `SHORT` less.

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
from seaopt.control.laws.outer_run import enclose
from seaopt.control.loops.compensation.terms import Compensation, compensate
from seaopt.control.loops.drift import FORGOTTEN, add_forgetful, leave_out_drift
from seaopt.control.loops.loop import Loop
from seaopt.control.loops.moved_link import find_position, show_position
from seaopt.control.systems.block import EFFORT, REFERENCE, add_up, subtract_last
from seaopt.parameters import ParameterSet
from seaopt.plants import Plant
from seaopt.plants.friction import SLIDING, friction_states, name_states
from seaopt.plants.memo import memo
from seaopt.records import record

WEIGHT, AGAINST = "weight compensated", "friction compensated"  # outputs: of the link's position, of the motor's
SHORT = 1e-4  # of a weight that is compensated whole
TURNED = "motor_turned"  # a state, of the motor's place


@record
class LaterTerms:
    """The terms at the end of a stretch of a schedule's variable, a parameter, over which their numbers are lines."""

    terms: Compensation
    over: str
    low: float  # low, high: the ends of the stretch
    high: float

    def share(self, p: Any) -> Any:
        """Return the share of the way to the end, of a plant's parameters."""
        return (getattr(p, self.over) - self.low) / (self.high - self.low)


def split_states(
    controller: Controller,
    plants: Mapping[str, Plant],
    params: ParameterSet,
    varied: Collection[str] = (),
    later: LaterTerms | None = None,
) -> dict[str, Plant]:
    """Return what `split_friction` does, each plant with what the controller's terms and its outer loop feed back of
    it; with `later` terms those on the way from the controller's.
    """
    terms, outer, split = controller.compensation, controller.outer, dict[str, Plant]()
    for label, (name, state) in name_states(plants, params, varied).items():
        plant = friction_states(plants[name])[state] if state else plants[name]
        plant = plant if outer is None else show_position(plant, outer, controller.signals)
        split[label] = (
            plant if terms is None else _show_terms(plant, terms, controller.signals, state != SLIDING, later)
        )
    return split


@memo
def _show_terms(
    plant: Plant, terms: Compensation, signals: tuple[str, ...], stands: bool, later: LaterTerms | None
) -> Plant:
    """Return a plant with outputs of what terms feed back of it; the plant itself where they feed back nothing."""
    gravity, friction, units, forgets = terms.gravity, terms.friction, dict[str, str](), False
    first, last = _shorten(terms), _shorten(terms if later is None else later.terms)
    if gravity is not None and {gravity.reads, *signals} <= plant.outputs.keys():
        units[WEIGHT] = plant.outputs[signals[0]]
    if friction is not None and stands and friction.reads in plant.outputs:
        units[AGAINST] = plant.outputs[friction.reads]
        forgets = friction.reads not in leave_out_drift(plant, signals).outputs
    if not units:
        return plant

    def h(t: Any, x: Any, u: Any, p: Any) -> Mapping[str, Any]:
        read, shown, share = plant.h(t, x, u, p), dict[str, Any](), 0.0 if later is None else later.share(p)
        numbers = [a if a == b else a + share * (b - a) for a, b in zip(first.numbers, last.numbers, strict=True)]
        if WEIGHT in units and gravity is not None:
            weight, at = replace(terms, friction=None, ripple=None).shape, 0 if friction is None else 2
            series = numbers[at : at + weight.size]
            shown[WEIGHT] = compensate(weight, series, (), 0.0, [read[gravity.reads]], ca)[0]
        if AGAINST in units and friction is not None:
            turned = getattr(x, TURNED) if forgets else read[friction.reads]
            shown[AGAINST] = numbers[0] * numbers[1] * turned
        return {**read, **shown}

    if friction is not None and forgets:
        plant = add_forgetful(plant, friction.reads, FORGOTTEN / terms.sample_time_s, TURNED)
    return replace(plant, h=h, outputs={**plant.outputs, **units})


def _shorten(terms: Compensation) -> Compensation:
    """Return terms of which a weight that is compensated whole is so with `SHORT` less."""
    gravity = terms.gravity
    return terms if gravity is None or gravity.fraction != 1.0 else replace(terms, gravity=gravity.scaled(1.0 - SHORT))


def feeds_back(controller: Controller, plant: Plant) -> bool:
    """Tell whether terms or the outer loop of a controller feed something back of a plant of `split_states`."""
    moves = controller.outer is not None and find_position(plant, controller.outer) is not None
    return moves or bool(_list_shown(controller, plant))


def _list_shown(controller: Controller, plant: Plant) -> set[str]:
    """Return the outputs of what a controller's terms feed back of a plant."""
    return set() if controller.compensation is None else {WEIGHT, AGAINST} & plant.outputs.keys()


def close_whole(controller: Controller, plant: Plant, params: ParameterSet) -> Loop:
    """Return the loop of a controller around a plant of `split_states`, with what is fed back of it besides."""
    return close_terms(controller, plant).close(plant, params)


def close_terms(controller: Controller, plant: Plant) -> Controller:
    """Return a controller whose law reads what its terms and its outer loop feed back of a plant of `split_states`; the
    controller itself where they feed back nothing. Its reference is the force law's.
    """
    if not feeds_back(controller, plant):
        return controller
    enclosed = enclose(controller, plant, of_force=True)
    kept = np.exp(-FORGOTTEN) if TURNED in plant.states else 1.0
    ways = {WEIGHT: add_up(REFERENCE, {WEIGHT: 1.0}), AGAINST: subtract_last(AGAINST, EFFORT, kept)}
    shown = [name for name in ways if name in _list_shown(controller, plant)]
    law = enclosed.law.connected([ways[name] for name in shown], [*enclosed.law.block.inputs, *shown])
    return replace(enclosed, law=law, reads=(*enclosed.signals, *shown), compensation=None, outer=None)
