"""Starts from the first part of a log, which then grows into the whole.

Where joints stick, each move begins where the last one ended, so that what is a little off adds up: a simulation of
half a minute is soon far from its log, and its cost has many minima, none of which explains it. Over the first half
second the same values are nearly right. Least squares moves them to where they follow that, then a second, and so on.

In so short a part little may move, and what it does not show would run away from there. Parameters are held near the
given values, as by a prior of their own size, until the whole log is followed.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from seaopt.estimation.problem.fit_problem import Evaluation, FitProblem
from seaopt.estimation.problem.noise_floor import measure_excess
from seaopt.estimation.problem.shapes import Vector
from seaopt.estimation.solver.least_squares import Callback
from seaopt.estimation.solver.settle import settle_roughly

SHORTEST, GROWTH = 500, 2  # samples of the first part, and times as long is the next
NOISE = 1.5  # times a sensor's own, that a residual is at most where nothing is wrong


def follow_parts(problem: FitProblem, start: Evaluation, callback: Callback | None = None) -> Evaluation | None:
    """Return what is come to from a start over longer and longer parts of the logs, the whole at last; None where that
    leaves more than the sensors' noise.
    """
    unknowns, longest, z = problem.unknowns, max(e.longest for e in problem.experiments), start.z
    size = np.full(z.size, np.inf)
    size[: unknowns.shared] = np.abs(unknowns.start[: unknowns.shared])
    prior_std = np.minimum(unknowns.prior_std, np.where(size > 0.0, size, np.inf))
    near = replace(problem, unknowns=replace(unknowns, prior_std=prior_std))
    count = SHORTEST + max(e.weights.settle for e in problem.experiments)
    while count * np.sqrt(GROWTH) < longest:
        part = replace(near, experiments=tuple(e.take_first(count) for e in near.experiments))
        if not all(np.all(e.count_weighted()) for e in part.experiments):
            return None  # an output is missing at first: what is followed would be long at once
        if not _is_noise(part, z):
            found = settle_roughly(part, part.evaluate(z), callback).solution
            z = found.z if np.isfinite(found.evaluation.cost) else z
        count *= GROWTH
    if not _is_noise(problem, z):
        z = settle_roughly(problem, problem.evaluate(z), callback).solution.z
        if not _is_noise(problem, z):
            return None
    return problem.evaluate(z)


def _is_noise(problem: FitProblem, z: Vector) -> bool:
    """Tell whether what is left of the logs is its sensors' noise."""
    return max(measure_excess(problem, z).values()) <= NOISE
