"""A start whose friction lets joints move: where one is held throughout, its log tells nothing of the parameters.

The cost is then flat in all that a motion depends on, and a search ends where it began or far off. Friction that is
free is halved, as often as a simulation gains by it, before a search begins.
"""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from seaopt.estimation.problem.fit_problem import Evaluation, FitProblem
from seaopt.estimation.solver.settle import explains_little
from seaopt.plants import Plant
from seaopt.plants.memo import memo
from seaopt.simulation.sticking import separate_jumps

HALVINGS = 6


def loosen_start(problem: FitProblem, start: Evaluation) -> Evaluation:
    """Return the best of a start that explains little and those with half its friction that sticks, and so on."""
    sticking = [experiment for experiment in problem.experiments if experiment.model.sticks]
    names = {name for experiment in sticking for name in _list_levels(experiment.data.plant)}
    places = [i for i, name in enumerate(problem.shared_names) if name in names]
    if not places or (np.isfinite(start.cost) and not explains_little(problem, start.power)):
        return start
    best, z = start, start.z
    for _ in range(HALVINGS):
        z = z.copy()  # an evaluation keeps its own
        z[places] = np.maximum(0.5 * z[places], problem.unknowns.low[places])
        best = min(best, problem.evaluate(z), key=lambda each: each.cost)
    return best


@memo
def _list_levels(plant: Plant) -> tuple[str, ...]:
    """Return the parameters by which joints are held without a load."""
    levels: Any = separate_jumps(plant)[2]
    still = ca.substitute(levels, ca.vertcat(plant.x, plant.u), ca.DM.zeros(plant.x.numel() + plant.u.numel()))
    symbols = zip(plant.parameters, ca.vertsplit(plant.p), strict=True)
    return tuple(name for name, symbol in symbols if ca.depends_on(still, symbol))
