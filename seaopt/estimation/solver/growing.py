"""Starts from the first part of a log, which then grows into the whole.

Where joints stick, each move begins where the last one ended, so that what is a little off adds up: a simulation of
half a minute is soon far from its log, and its cost has many minima, none of which explains it. Over the first half
second the same values are nearly right. Least squares moves them to where they follow that, then a second, and so on.

The half second is one in which something moves: a log that is quiet at first tells nothing there. Where a part is not
followed from values that follow the one before, it adds too much to that, and half as much is added. Where the first
one is not, half of it is tried, and then values around the given ones, with less friction where that holds a joint.

In so short a part little may move, and what it does not show would run away from there. Parameters are held near the
given values, as by a prior of their own size, until the whole log is followed.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from seaopt.estimation.problem.fit_experiment import FitExperiment
from seaopt.estimation.problem.fit_problem import Evaluation, FitProblem
from seaopt.estimation.problem.noise_floor import measure_most
from seaopt.estimation.problem.shapes import Vector
from seaopt.estimation.problem.unknowns import Unknowns
from seaopt.estimation.solver.least_squares import Callback, name_phase
from seaopt.estimation.solver.loosening import loosen_start
from seaopt.estimation.solver.settle import settle_roughly

SHORTEST = 500  # samples of the first part; the next is at most twice as long
MOVED = 0.01  # of an output's spread, by which it has moved
FOLLOWED = 10.0  # times a sensor's noise, that a residual of a part is at most: 500 samples tell that noise badly
NOISE = 1.5  # times a sensor's own, that a residual is at most where nothing is wrong
FAILURES = 7  # of parts to follow, one after the other, that end it
TRIES = 40  # of parts to follow, in all
OFF = 1.5  # times the given values, where the first part is begun anew


def follow_parts(problem: FitProblem, start: Evaluation, callback: Callback | None = None) -> Evaluation | None:
    """Return what is come to from a start over longer and longer parts of the logs, the whole at last; None where a
    part is not followed, it takes too many of them, or the whole leaves more than the sensors' noise.
    """
    unknowns, z = problem.unknowns, start.z
    quiet = [_count_quiet(experiment) for experiment in problem.experiments]
    longest = max(e.longest - before for e, before in zip(problem.experiments, quiet, strict=True))
    cut = any(experiment.data.shots > 1 for experiment in problem.experiments)
    if cut and SHORTEST * np.sqrt(2.0) >= longest:  # shots are begun anew before what is off adds up
        return None
    size = np.full(z.size, np.inf)
    size[: unknowns.shared] = np.abs(unknowns.start[: unknowns.shared])
    prior_std = np.minimum(unknowns.prior_std, np.where(size > 0.0, size, np.inf))
    near = replace(problem, unknowns=replace(unknowns, prior_std=prior_std))
    further = list_starts(unknowns, start.z, OFF, np.random.default_rng(0))
    followed, added, failed = 0, SHORTEST, 0
    for number in range(1, TRIES + 1):
        if (followed + added) * np.sqrt(2.0) >= longest:
            break
        counts = [before + followed + added for before in quiet]
        parts = tuple(e.take_first(count) for e, count in zip(near.experiments, counts, strict=True))
        if not all(np.all(each.count_weighted()) for each in parts):
            return None  # an output is missing at first: what is followed would be long at once
        phase = f"part {number} of {TRIES}, {followed + added} of {longest} samples"
        found = _follow(replace(near, experiments=parts), z, name_phase(callback, phase))
        if found is not None:
            followed, z, failed = followed + added, found, 0
            added = min(2 * added, followed)
            continue
        failed += 1
        if failed == FAILURES or added == 1:  # half of which adds nothing
            return None
        if followed or failed == 1:
            added //= 2
        else:
            added, z = SHORTEST, next(further, z)
    else:
        return None  # what is added has become little
    if measure_most(problem, z) > NOISE:
        z = settle_roughly(problem, problem.evaluate(z), callback).solution.z
        if measure_most(problem, z) > NOISE:
            return None
    return problem.evaluate(z)


def _follow(part: FitProblem, z: Vector, callback: Callback | None) -> Vector | None:
    """Return values near by that follow a part of the logs; None where none are found."""
    if measure_most(part, z) <= NOISE:
        return z
    found = settle_roughly(part, loosen_start(part, part.evaluate(z)), callback).solution
    follows = np.isfinite(found.evaluation.cost) and measure_most(part, found.z) <= FOLLOWED
    return found.z if follows else None


def _count_quiet(experiment: FitExperiment) -> int:
    """Return how many samples tell nothing: a filter settles, or no output has moved yet."""
    first = experiment.longest
    for output in experiment.outputs:
        for measured in output.measured:
            begin = measured[np.isfinite(measured)][:1]
            moved = np.flatnonzero(np.abs(measured - begin) > MOVED * output.spread) if begin.size else begin
            first = min(first, int(moved[0])) if moved.size else first
    return experiment.weights.settle + first


def list_starts(unknowns: Unknowns, z: Vector, factor: float, rng: np.random.Generator) -> Iterator[Vector]:
    """Yield starts around values: each shared one moved by a factor, up or down, and in the next the other way."""
    count, tried = unknowns.shared, set[tuple[float, ...]]()
    ways = np.ones(count)
    while len(tried) < 2**count:
        ways = -ways if len(tried) % 2 else rng.choice([-1.0, 1.0], count)
        if tuple(ways) not in tried:
            tried.add(tuple(ways))
            around = z.copy()
            around[:count] *= factor**ways
            yield np.clip(around, unknowns.low, unknowns.high)
