r"""A sampled loop at rest where a run's conditions are, such as an angle, instead of at zero.

The plant rests in the state x and under the current I of `seaopt.control.loops.sampled_plant.find_rest`, its measured
force being y. The law rests with it where :math:`x_c = A x_c + B_r r - B_y y` and :math:`C x_c + D_r r - D_y y = I/g`:
one linear equation for its state and for the reference r that keeps the plant there. With an integrator r is y;
without one it is what makes the law command I. The commands that wait are all I. A schedule rests as the law that it is
where its variable stands.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from seaopt.control.laws.realisation import Reading, RunnableLaw
from seaopt.control.loops.compensation.terms import FORGOTTEN
from seaopt.control.loops.sampled_plant import find_rest
from seaopt.control.running.held import observe_function
from seaopt.control.running.law_step import LawShape
from seaopt.control.running.sampled_loop import LoopState, SampledLoop
from seaopt.errors import ControlError
from seaopt.plants import CompletedParameters, Plant
from seaopt.plants.plant import name_input
from seaopt.records import record
from seaopt.units import LINEAR, show_command

Runs = Float[np.ndarray, " runs"]


@record(eq=False)
class Equilibrium:
    """Where runs rest."""

    state: LoopState  # of plant, law and waiting commands
    # reference, force, rest_command, energy_J: shape (runs,); F_ref and the measured output (N); the command; what the
    # plant stores, zero where it declares no energy
    reference: Runs
    given: Runs  # what the law is given for it: x_0 with an outer loop around it
    force: Runs
    rest_command: Runs
    energy_J: Runs
    unit: str = LINEAR.unit  # of reference and force: N, or N m of a torque
    command: tuple[str, str] = ("I", "A")

    def __repr__(self) -> str:
        rows = zip(self.force, self.rest_command, strict=True)
        return "Equilibrium at " + ", ".join(
            f"{force:.4g} {self.unit}, {show_command(current, *self.command)}" for force, current in rows
        )


def equilibrium(loop: SampledLoop, params: Sequence[CompletedParameters], variable: float = math.nan) -> Equilibrium:
    """Return where a loop, its current unlimited, rests at the conditions (such as phi) among each run's parameters; at
    zero without any. `variable`: where that of a schedule stands. Raises ControlError: the plant cannot rest
    there, or no reference makes the law command what it takes.
    """
    plant, law, terms, stands = loop.plant, loop.law, None, np.zeros(0)
    before, around = np.cumsum(LawShape.of_law(law).sizes)[[3, 5]]  # what is kept before the place, and the command
    if not isinstance(law, RunnableLaw):
        law, terms, stands = law.freeze(variable, law.compensation), law.find_terms(variable), np.array([variable])
    observe = observe_function(plant, sticks=False)
    names, rows = list(plant.outputs), [find_rest(plant, values) for values in params]
    figures = np.zeros((len(params), 5))
    z = np.zeros((len(params), loop.law_states + loop.waiting))
    for run, ((x, u), values) in enumerate(zip(rows, params, strict=True)):
        if not (np.any(x) or np.any(u)) and law.compensation is None and law.outer is None:
            z[run, before : before + stands.size] = stands
            continue
        y = np.array(observe(0.0, x, u, values.vector)).ravel()
        read = y[[names.index(name) for name in loop.fed_back]]
        force, weight, added = float(read[0]), 0.0, 0.0
        if law.compensation is not None:
            stated = {} if loop.place is None else {loop.place: variable}
            readings = stated | dict(zip(names, y, strict=False))
            further = [float(readings.get(name, 0.0)) for name in law.compensation.reads]
            weight, added, _ = law.compensation.step(FORGOTTEN, 0.0, further, terms)
        inner, reference = _law_at_rest(
            law, read if law.measured > 1 else force, float(u[0]) - law.per_effort * added, plant, loop.regulated
        )
        reference -= weight
        given = reference
        if law.outer is not None:
            position = float(y[names.index(law.outer.position)]) if law.outer.position in names else 0.0
            given = law.outer.split(position)[0] + reference / law.outer.per_given
        z[run, : inner.size], z[run, before : before + stands.size], z[run, around:] = inner, stands, u[0]
        figures[run] = reference, given, force, u[0], 0.0 if plant.energy is None else y[-1]
    reference, given, force, current, energy = figures.T.copy()
    state = LoopState(x=np.stack([x for x, _ in rows]), z=z)
    unit = plant.outputs[loop.regulated]
    return Equilibrium(
        state=state,
        reference=reference,
        given=given,
        force=force,
        rest_command=current,
        energy_J=energy,
        unit=unit,
        command=name_input(plant),
    )


def _law_at_rest(
    law: RunnableLaw, read: Reading, command: float, plant: Plant, measured: str
) -> tuple[Float[np.ndarray, " n"], float]:
    """Return the law's state and the reference at which it commands a current, unlimited, under constant readings."""
    n = law.c.size
    left = np.block([[np.eye(n) - law.a, -law.b_reference[:, None]], [law.c[None, :], np.array([[law.d_reference]])]])
    right = np.append(
        -np.dot(law.b_measurement, read), command / law.per_effort + float(np.dot(law.d_measurement, read))
    )
    try:
        solution = np.linalg.solve(left, right)
    except np.linalg.LinAlgError:
        solution = np.full(n + 1, np.nan)
    if not np.all(np.isfinite(solution)):
        raise ControlError(
            f"no reference makes the law command the {show_command(command, *name_input(plant))} that rest takes at "
            f"{float(np.ravel(read)[0]):.4g} {plant.outputs[measured]}; its "
            "reference path is blocked at 0 Hz"
        )
    return solution[:-1], float(solution[-1])
