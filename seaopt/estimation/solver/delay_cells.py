"""Free delays, whose cost may have several minima: others are looked for where least squares has ended.

An input that nearly repeats itself fits nearly as well a period late. A delay shifts what is simulated as a whole, so
that one simulation, held against the log at each whole sample of shift, tells where the cost is less; the search goes
on from there, or from the delay of another log.

A start that is a sample or more off may end in a minimum where other values make up for that, a servo's spring for
the time that its firmware takes: where a shift of the start's own simulation leaves less than half of its cost, the
search begins there.

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
from seaopt.estimation.problem.fit_problem import Evaluation, FitProblem
from seaopt.estimation.problem.residual_statistics import compute_experiment_residuals
from seaopt.estimation.problem.shapes import Vector
from seaopt.estimation.solver.least_squares import Callback, name_phase
from seaopt.estimation.solver.settle import Solved, settle

FURTHEST = 100  # samples to either side
INSIDE = 1e-6  # of a sample beyond a whole one: the next cell
MOST_MOVES = 4  # cells that a delay may be carried on
AT_START, HALF = 20, 0.5  # samples to either side, of a start; and of its cost, what a better delay leaves at most


def shift_start(problem: FitProblem, start: Evaluation) -> Evaluation:
    """Return a start with those free delays at which its simulation lies much nearer to the logs: all of them together,
    for each experiment alone is a part of the cost.
    """
    z = start.z.copy()
    for experiment in problem.experiments:
        index = experiment.slots.delay.index
        if index is not None and np.isfinite(start.cost):
            low, high = problem.unknowns.low[index], problem.unknowns.high[index]
            z[index] = start.z[index] + _find_best_shift(experiment, start.z, low, high, AT_START)
    if np.array_equal(z, start.z):
        return start
    shifted = problem.evaluate(z)
    return shifted if shifted.cost < HALF * start.cost else start


def search_delays(solved: Solved, max_iterations: int, callback: Callback | None = None) -> Solved:
    """Return the best of a minimum, those at other delays, and those in the cells beside them."""
    callback = name_phase(callback, "another delay")
    return _search_cells(_search_further(solved, max_iterations, callback), max_iterations, callback)


def _search_further(solved: Solved, max_iterations: int, callback: Callback | None) -> Solved:
    """Return the best of a minimum and those at delays some samples away, of each free delay in turn."""
    for experiment in solved.problem.experiments:
        problem, evaluation = solved.problem, solved.solution.evaluation
        index, unknowns = experiment.slots.delay.index, problem.unknowns
        if index is None or not np.isfinite(evaluation.cost):
            continue
        delays = {e.slots.delay.at(evaluation.z) for e in problem.experiments} - {float(evaluation.z[index])}
        shift = _find_best_shift(experiment, evaluation.z, unknowns.low[index], unknowns.high[index])
        best = evaluation
        for delay in (*delays, *([evaluation.z[index] + shift] if shift else [])):
            z = evaluation.z.copy()
            z[index] = np.clip(delay, unknowns.low[index], unknowns.high[index])
            best = min(best, problem.evaluate(z), key=lambda each: each.cost)
        if best is not evaluation:
            solved = min(solved, settle(problem, best, max_iterations, callback), key=lambda each: each.misfit)
    return solved


def _find_best_shift(experiment: FitExperiment, z: Vector, low: float, high: float, most: int = FURTHEST) -> float:
    """Return by how many seconds, in whole samples, a simulation is to be shifted to lie nearest to the log."""
    period, delay = experiment.period, experiment.slots.delay.at(z)
    reach = min(most, experiment.longest // 4)
    shifts = [s for s in range(-reach, reach + 1) if low <= delay + s * period <= high]
    squares, counts = np.zeros(len(shifts)), np.zeros(len(shifts))
    residuals = compute_experiment_residuals(experiment, z)
    for output in experiment.outputs:
        for measured, raw in zip(output.measured, residuals.raw_of(output.name), strict=True):
            model = measured + raw
            whole = bool(np.all(np.isfinite(model)))
            for i, s in enumerate(shifts):
                apart = model[max(-s, 0) : model.size - max(s, 0)] - measured[max(s, 0) : measured.size - max(-s, 0)]
                apart = apart if whole else apart[np.isfinite(apart)]
                squares[i] += float(apart @ apart) / output.sigma**2
                counts[i] += apart.size
    means = np.where(counts > 0, squares / np.maximum(counts, 1.0), np.inf)
    return shifts[int(np.argmin(means))] * period if shifts else 0.0


def _search_cells(solved: Solved, max_iterations: int, callback: Callback | None) -> Solved:
    """Return the best of a minimum and those in the cells beside it, of each free delay in turn."""
    for experiment in solved.problem.experiments:
        if experiment.slots.delay.index is None or not ca.depends_on(experiment.model.h, experiment.model.u):
            continue
        if solved.solution.status != "converged":  # steps to and fro across the end of a cell
            inside = _settle_beside(solved, experiment, 0, max_iterations, callback)
            solved = inside if inside is not None and inside.solution.status == "converged" else solved
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
    unknowns, index = problem.unknowns, experiment.slots.delay.index
    assert index is not None
    cell = np.ceil(z[index] / period - INSIDE) + way  # (cell - 1, cell] samples
    low = max(unknowns.low[index], (cell - 1.0 + INSIDE) * period)
    end = cell if experiment.data.hold == "zero" else cell - INSIDE
    high = min(unknowns.high[index], end * period)
    if not low <= high:
        return None
    z[index] = np.clip(z[index], low, high)
    inside = replace(problem, unknowns=unknowns.bound(index, low, high))
    other = settle(inside, inside.evaluate(z), max_iterations, callback)
    return replace(other, problem=replace(other.problem, unknowns=unknowns))
