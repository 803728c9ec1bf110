"""Does another start end elsewhere? A second search, where a search may have ended in one of several minima.

Values that a log hardly tells apart, and residuals that are more than noise, leave a cost with valleys and shelves: two
users with other first values then have other fits of one log, each with small intervals. A second search starts with
every free parameter off by a factor, and what it finds counts where it explains the logs as well or better.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from seaopt.errors import SeaoptError
from seaopt.estimation.judgement.second_log import find_excess
from seaopt.estimation.result.covariance import measure_colour
from seaopt.estimation.result.findings import FitFinding
from seaopt.estimation.result.fit_result import Fit, Minimum
from seaopt.estimation.result.model_error import LITTLE
from seaopt.estimation.solver.least_squares import Solution
from seaopt.estimation.solver.settle import Solved, settle_roughly
from seaopt.estimation.solver.step_size import StepError
from seaopt.units import unit_after

OFF = 1.5  # times the fit's value and its inverse, in turn
ENOUGH = 10.0  # of log-likelihood, over the colour of the residual: what chance does not give
APART_STDS, APART = 4.0, 0.02  # by which values differ that are others


def find_other_minimum(fit: Fit) -> Iterator[FitFinding]:
    """Yield that another start ends elsewhere; tried where values are told apart weakly, or a residual is not noise."""
    minimum = fit.require_minimum("find_other_minimum")
    problem = minimum.problem
    excess = max((find_excess(fit, e.plant.name) for e in fit.experiments), default=0.0)
    doubtful = bool(fit.identifiability.weak) or excess > LITTLE
    seen = fit.identifiability.rank == fit.identifiability.free > 0
    if not doubtful or not seen or problem.predicts:
        return
    try:
        solved = _search(minimum)
    except SeaoptError:  # what cannot be simulated is no minimum
        return
    if not np.isfinite(solved.misfit):
        return
    gain = 0.5 * (_measure_misfit(minimum) - solved.misfit) / measure_colour(fit.covariance, fit.white_covariance)
    values = problem.unknowns.by_name(solved.solution.z)
    moved: dict[str, tuple[float, float]] = {}
    for name in fit.covariance.names:
        parameter = fit.parameters[name]
        away = abs(values[name] - parameter.value)
        if away > max(APART_STDS * (parameter.total_std or 0.0), APART * abs(parameter.value)):
            moved[name] = (values[name], parameter.std or 0.0)
    if not moved or gain < -ENOUGH:
        return
    pairs = (f"{name} = {value:.4g}{unit_after(fit.parameters[name].unit)}" for name, (value, _) in moved.items())
    if gain > ENOUGH:
        text = f"another start explains the logs better, with {', '.join(pairs)}: start there"
    else:
        text = (
            f"another start explains the logs as well, with {', '.join(pairs)}: they do not decide; log more, or fix "
            "what is known, or give it a prior"
        )
    yield FitFinding(severity="error", kind="starts", where=", ".join(moved), text=text, preferred=moved)


def _search(minimum: Minimum) -> Solved:
    """Return the better minimum from the given values, and from the fit's off by a factor, up and down in turn."""
    problem, unknowns = minimum.problem, minimum.problem.unknowns
    factors = np.where(np.arange(unknowns.shared) % 2, OFF, 1.0 / OFF)
    solved: list[Solved] = []
    for values in (unknowns.start[: unknowns.shared], minimum.z[: unknowns.shared] * factors):
        start = minimum.z.copy()
        start[: unknowns.shared] = values
        evaluation = problem.evaluate(np.clip(start, unknowns.low, unknowns.high))
        solved.append(settle_roughly(problem, evaluation))
    return min(solved, key=lambda each: each.misfit)


def _measure_misfit(minimum: Minimum) -> float:
    evaluation = minimum.problem.evaluate(minimum.z)
    solution = Solution(z=minimum.z, evaluation=evaluation, status="converged", message="", iterations=0)
    return Solved(problem=minimum.problem, solution=solution, step_error=StepError()).misfit
