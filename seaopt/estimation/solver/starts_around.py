"""A search that has strayed: it ended far from the given values, and what it leaves is no noise.

A position servo whose start is a factor of three off may end where a heavy link on a soft, damped spring makes up for
an elastic joint: inertia and damping grow together along a valley, hundreds of times over, and no frequency response
shows another start, for the duty is at its limit in half of the log. The given values are within a factor of ten of the
truth, so that a minimum further away from which the residual is not the sensors' noise is in doubt. Starts around the
given values, each a factor of two up or down and the next with all ways turned, are settled roughly, until one leaves
noise; the best goes on.

Where joints stick a short log has other minima near by: with a delay some milliseconds off, a joint that was thrown in
place of one at rest. They leave hundreds of times a sensor's noise. The starts are then at rest, and are settled with
the given delay first: of logs of 8 s of a knee with two encoders 5 of 12 were found, and are all with it.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import islice

import numpy as np

from seaopt.estimation.problem.fit_problem import FitProblem
from seaopt.estimation.problem.noise_floor import measure_most
from seaopt.estimation.problem.normal_equations import invert
from seaopt.estimation.solver.growing import NOISE, list_starts
from seaopt.estimation.solver.least_squares import Callback, name_phase
from seaopt.estimation.solver.settle import Solved, settle, settle_roughly

FAR = 10.0  # times its given value, from which one has strayed
LOST = 100.0  # times a sensor's own: what a search that ended near by leaves where joints stick
OFF, STARTS = 2.0, 12  # times the given values, and how many starts


def search_around(solved: Solved, seed: int, max_iterations: int, callback: Callback | None) -> Solved:
    """Return the better of a minimum that has strayed and the best of those around the given values; the minimum itself
    where it has not, and of linear plants, whose starts are their frequency responses.
    """
    problem, z = solved.problem, solved.solution.z
    unknowns, count = problem.unknowns, problem.unknowns.shared
    sticks, strayed = any(e.model.sticks for e in problem.experiments), _has_strayed(solved)
    if problem.all_linear or not (sticks or strayed):
        return solved
    most = measure_most(problem, z)
    lost = sticks and most > LOST
    if most <= NOISE or not (lost or strayed):
        return solved
    rng, best = np.random.default_rng(seed), solved
    held = _hold_delays(problem) if lost else problem
    given = unknowns.start if lost else np.append(unknowns.start[:count], z[count:])
    for number, start in enumerate(islice(list_starts(unknowns, given, OFF, rng), STARTS), start=1):
        tell = name_phase(callback, f"another start, {number} of {STARTS}")
        rough = settle_roughly(held, held.evaluate(start), tell)
        if lost:
            rough = settle_roughly(problem, problem.evaluate(rough.solution.z), tell)
        best = min(best, rough, key=lambda each: each.misfit)
        if best is rough and measure_most(rough.problem, rough.solution.z) <= NOISE:
            break
    if best is solved:
        return solved
    # With steps of its own: those of a minimum that explains little are too coarse.
    other = settle(problem, problem.evaluate(best.solution.z), max_iterations, name_phase(callback, "another start"))
    iterations = solved.solution.iterations + other.solution.iterations
    other = replace(other, solution=replace(other.solution, iterations=iterations))
    return min(solved, other, key=lambda each: each.misfit)


def _hold_delays(problem: FitProblem) -> FitProblem:
    """Return the problem with its delays at their given values."""
    unknowns = problem.unknowns
    places = [e.slots.delay.index for e in problem.experiments if e.slots.delay.index is not None]
    return replace(problem, unknowns=unknowns.bound(places, unknowns.start[places], unknowns.start[places]))


def _has_strayed(solved: Solved) -> bool:
    """Tell whether a value ended far above the given one, or far below and yet told from none."""
    evaluation, unknowns = solved.solution.evaluation, solved.problem.unknowns
    if not np.isfinite(evaluation.cost) or not np.all(np.isfinite(evaluation.hessian)):
        return False
    start, z = np.abs(unknowns.start[: unknowns.shared]), np.abs(solved.solution.z[: unknowns.shared])
    variances = np.diag(invert(evaluation.hessian)[0])[: unknowns.shared]
    far = (z > FAR * start) | ((z < start / FAR) & (variances < z**2))
    return bool(np.any(far & (start > 0.0)))
