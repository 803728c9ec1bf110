"""Which of two explanations is nearer to samples that neither was fitted to.

A damper c in a spring of stiffness k puts its force ahead of its deflection by c/k, as a late stamp of the deflection
would; what else it does is small: it damps a motion that friction damps as well, and its force grows as (w c/k)^2/2.
Over samples that both are fitted to, the likelihoods of such a pair differ by little of what either gains. So each is
fitted to the first part of the logs, from where it is, and compared over the rest.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from seaopt.estimation.problem.fit_problem import FitProblem, pose_problem
from seaopt.estimation.problem.residual_statistics import compute_residuals
from seaopt.estimation.problem.shapes import Vector
from seaopt.estimation.solver.settle import settle_roughly
from seaopt.estimation.solver.step_shares import copy_steps

HELD_OUT = 0.3  # of each log, its end, where the fit holds out nothing
BLOCKS = 20  # of each log's end, whose differences are taken for independent


def compare_held_out(
    first: tuple[FitProblem, Float[np.ndarray, " n"]], second: tuple[FitProblem, Float[np.ndarray, " m"]]
) -> float:
    """Return by how many standard deviations the first minimum is nearer than the second to what neither was fitted to.
    Both are of the same outputs of the same logs, which either may have as experiments of their own.
    """
    pairs = zip(_list_held_out(*first), _list_held_out(*second), strict=True)
    blocks = np.zeros(BLOCKS)
    for ours, theirs in pairs:
        nearer = (theirs - ours) / min(np.nanmean(ours), np.nanmean(theirs))
        blocks += [np.nansum(block) for block in np.array_split(nearer, BLOCKS)]
    return float(np.mean(blocks) / max(np.std(blocks, ddof=1) / np.sqrt(BLOCKS), 1e-300))


def _list_held_out(problem: FitProblem, z: Vector) -> list[Float[np.ndarray, " k"]]:
    """Return each output's squared residuals over the last part of its log, at the minimum over the rest."""
    if not problem.holdout:
        rest = pose_problem(
            tuple(e.data for e in problem.experiments),
            problem.params,
            loss=problem.loss,
            band_hz=problem.band_hz,
            holdout=HELD_OUT,
        )
        rest = copy_steps(rest.with_values("sigma", {e.name: e.sigma for e in problem.experiments}), problem)
        solved = settle_roughly(rest, rest.evaluate(z), checked=True)
        problem, z = solved.problem, solved.solution.evaluation.z
    residuals = compute_residuals(problem, z)
    rows: list[Float[np.ndarray, " k"]] = []
    for experiment in problem.experiments:
        parts = zip(experiment.segments, residuals[experiment.name].segments, strict=True)
        squares = [left.raw[part.samples.keep[0] == 0] ** 2 for part, left in parts]
        rows += list(np.concatenate(squares).T)
    return rows
