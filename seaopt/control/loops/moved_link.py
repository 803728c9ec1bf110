r"""A force law and the outer loop around it as one linear law, and the position that it reads of a link it moves.

With :math:`s` the state of the outer loop's filtered speed (`seaopt.control.loops.outer_loop`), the force law's
reference is :math:`\sigma K_v x_0 - \sigma (K_v + D_v \rho) x - \sigma D_v s`, :math:`\rho` the filter's rate. Put into
the force law it gives a law of the reference x_0 and of the link's position beside what it measures itself; without
stiffness, of a force in place of x_0, to which the damping is added. Broken at the command, the loop gains

.. math:: \sigma\,(K_v + D_v D(q))\, P_x\, C_r .

Where nothing holds the link, and no stiffness is asked for, its position drifts, and the damping does not depend on
where it is. There the plant has a state :math:`\dot m = \dot x - (\epsilon / T_s) m` for it, of which the filter reads

.. math:: m_k - e^{-\epsilon} m_{k-1} = \int_0^{T_s} e^{-\epsilon (1 - t / T_s)}\, \dot x\, dt,

the difference to a share of :math:`\epsilon / 2`; its own eigenvalue :math:`e^{-\epsilon}` is in nothing that is read.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from seaopt.control.loops.drift import FORGOTTEN, add_forgetful, leave_out_drift
from seaopt.control.loops.law import Law
from seaopt.control.loops.loop import Loop
from seaopt.control.loops.measured.loop import DiscLoop
from seaopt.control.loops.measured.plant import MeasuredPlant
from seaopt.control.loops.outer_loop import POSITION, SPEED, OuterLoop
from seaopt.control.loops.sampled_plant import DigitalPlant, sample
from seaopt.control.loops.transfer_function import Frequencies, Response
from seaopt.control.systems.block import OUTSIDE, REFERENCE, add_up
from seaopt.plants import CompletedParameters, Plant
from seaopt.plants.memo import memo
from seaopt.records import record

MOVED = "link_moved"  # state and output, of a link that nothing holds


def show_position(plant: Plant, outer: OuterLoop, signals: tuple[str, ...]) -> Plant:
    """Return a plant with an output that tells how its link moves, where its position drifts and no stiffness is asked
    for; else the plant itself. `signals` are what the force law reads.
    """
    if outer.stiffness or outer.position not in plant.outputs:
        return plant
    return _forget_position(plant, outer.position, signals, FORGOTTEN / outer.sample_time_s)


@memo
def _forget_position(plant: Plant, position: str, signals: tuple[str, ...], rate: float) -> Plant:
    if position in leave_out_drift(plant, signals).outputs:
        return plant

    def h(t: Any, x: Any, u: Any, p: Any) -> Mapping[str, Any]:
        return {**plant.h(t, x, u, p), MOVED: getattr(x, MOVED)}

    return replace(
        add_forgetful(plant, position, rate, MOVED), h=h, outputs={**plant.outputs, MOVED: plant.outputs[position]}
    )


def find_position(plant: Plant, outer: OuterLoop) -> str | None:
    """Return the output of a plant of `show_position` that an outer loop reads; None where the link is held."""
    return next((name for name in (MOVED, outer.position) if name in plant.outputs), None)


def keep_share(position: str) -> float:
    """Return the share of the last sample's position that is taken off the next, for its speed."""
    return float(np.exp(-FORGOTTEN)) if position == MOVED else 1.0


def enclose_law(
    law: Law, outer: OuterLoop, signal: int | None = None, *, kept: float = 1.0, of_force: bool = False
) -> Law:
    """Return the law of x_0, of what a force law measures and of the link's position, that both loops make. `signal`:
    which of the measured signals is the link's position; it is one more, the last, where none of them is. `kept` is of
    `keep_share`. `of_force`: of the force law's reference in place of x_0.
    """
    _, *readings = law.block.inputs
    position = POSITION if signal is None else readings[signal]
    stiffness, damping, _, _ = outer.numbers
    per_given = 1.0 if of_force else outer.per_given
    asked = add_up(REFERENCE, {OUTSIDE: per_given, position: -stiffness, SPEED: -damping})
    inputs = [OUTSIDE, *readings, *[POSITION] * (signal is None)]
    return law.connected([outer.filter_speed(position, kept), asked], inputs)


def respond_outer(outer: OuterLoop, f: Frequencies, kept: float = 1.0) -> Response:
    """Return what an outer loop takes off the force law's reference, per position, at frequencies in Hz."""
    z = np.exp(2j * np.pi * f * outer.sample_time_s)
    return outer.direction * (outer.stiffness + outer.damping * outer.rate * (z - kept) / (z - outer.pole))


@record(eq=False)
class MovedLinks:
    """An outer loop, and of each of a task's plants the one that it reads, the link's position last, with the share of
    a sample's position that is taken off the next; None where the link is held.
    """

    outer: OuterLoop
    plants: tuple[tuple[DigitalPlant, float] | None, ...]

    @classmethod
    def of(
        cls,
        outer: OuterLoop,
        models: Sequence[tuple[Plant, CompletedParameters] | None],
        signals: tuple[str, ...],
        per_effort: float,
        sample_time_s: float,
        delay_samples: int,
    ) -> MovedLinks:
        """Return an outer loop around plants with their parameters; None is a measured response, whose link is held."""

        def read(model: tuple[Plant, CompletedParameters] | None) -> tuple[DigitalPlant, float] | None:
            if model is None:
                return None
            plant, values = show_position(model[0], outer, signals), model[1]
            position = find_position(plant, outer)
            if position is None:
                return None
            sampled = sample(plant, values, (*signals, position), per_effort, sample_time_s, delay_samples)
            return sampled, keep_share(position)

        return cls(outer=outer, plants=tuple(map(read, models)))

    def moves(self, row: int) -> bool:
        """Tell whether a plant's link moves."""
        return self.plants[row] is not None

    def respond(self, row: int, f: Frequencies) -> Response:
        """Return what is taken off the force law's reference, per command, of one plant; zeros of one that is held."""
        moved = self.plants[row]
        if moved is None:
            return 0j * f
        plant, kept = moved
        return respond_outer(self.outer, f, kept) * plant.responses(f)[-1]

    def close(self, row: int, law: Law) -> Loop | None:
        """Return the loop of a force law and the outer loop around one plant; None where the link is held."""
        moved = self.plants[row]
        if moved is None:
            return None
        plant, kept = moved
        return Loop(plant=plant, law=enclose_law(law, self.outer, kept=kept, of_force=True))


def close_plant(plant: DigitalPlant | MeasuredPlant, law: Law) -> Loop | DiscLoop:
    """Return the loop of a law around a plant, a model or a measured one."""
    return DiscLoop(plant=plant, law=law) if isinstance(plant, MeasuredPlant) else Loop(plant=plant, law=law)
