"""Free delays of outputs that the input reaches at once: the sample in force changes at whole samples of delay.

An output with feedthrough jumps with the input. With a held input the cost of a delay d is then smooth between whole
samples only, in cells (m - 1, m] in which sample k - m is in force at sample k, and least squares ends in the cell in
which it started, or goes to and fro across an end. Each neighbouring cell is searched too, from the end that is nearer,
until none is better.

Where samples are joined by lines, such an output has a corner in the delay at whole samples in place of a jump: its
slope there is that of the cell after, so that a cell is searched to just short of its end.
"""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np

from seaopt.estimation.problem.fit_experiment import FitExperiment
from seaopt.estimation.solver.least_squares import Callback
from seaopt.estimation.solver.settle import Solved, settle

INSIDE = 1e-6  # of a sample beyond a whole one: the next cell
MOST_MOVES = 4  # cells that a delay may be carried on


def search_delay_cells(solved: Solved, max_iterations: int, callback: Callback | None = None) -> Solved:
    """Return the best of a minimum and those in the cells beside it, of each free delay in turn."""
    for experiment in solved.problem.experiments:
        if experiment.slots.delay.index is None or not ca.depends_on(experiment.model.h, experiment.model.u):
            continue
        if solved.solution.status != "converged":  # steps to and fro across the end of a cell
            inside = _settle_beside(solved, experiment, 0, max_iterations, callback)
            if inside is not None and inside.solution.status == "converged":
                solved = inside
        for way in (-1, 1):
            for _ in range(MOST_MOVES):
                other = _settle_beside(solved, experiment, way, max_iterations, callback)
                if other is None or not other.misfit < solved.misfit:
                    break
                solved = other
    return solved


def _settle_beside(
    solved: Solved, experiment: FitExperiment, way: int, max_iterations: int, callback: Callback | None
) -> Solved | None:
    """Return the minimum in an experiment's cell (0), or that before or after it; None where bounds forbid it."""
    problem, z, period = solved.problem, solved.solution.z.copy(), experiment.period
    unknowns, place = problem.unknowns, experiment.slots.delay.index
    assert place is not None
    cell = np.ceil(z[place] / period - INSIDE) + way  # (cell - 1, cell] samples
    low, high = unknowns.low.copy(), unknowns.high.copy()
    low[place] = max(low[place], (cell - 1.0 + INSIDE) * period)
    end = cell if experiment.data.hold == "zero" else cell - INSIDE
    high[place] = min(high[place], end * period)
    if not low[place] <= high[place]:
        return None
    z[place] = np.clip(z[place], low[place], high[place])
    inside = replace(problem, unknowns=replace(unknowns, low=low, high=high))
    other = settle(inside, inside.evaluate(z), max_iterations, callback)
    return replace(other, problem=replace(other.problem, unknowns=unknowns))
