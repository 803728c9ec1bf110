"""Does another start end elsewhere? A second search, where a search may have ended in one of several minima.

Values that a log hardly tells apart, and residuals that are more than noise, leave a cost with valleys and shelves: two
users with other first values then have other fits of one log, each with small intervals. A second search starts with
every free parameter off by a factor, and what it finds counts where it explains the logs as well or better. It takes
integration steps as coarse as the residual allows, and ends where it comes back to the fit.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import suppress

import numpy as np
from jaxtyping import Float

from seaopt.errors import SeaoptError
from seaopt.estimation.judgement.second_log import find_excess
from seaopt.estimation.problem.fit_problem import BudgetError, Evaluation, count_left
from seaopt.estimation.result.covariance import measure_colour
from seaopt.estimation.result.findings import FitFinding, find_ended_start
from seaopt.estimation.result.fit_result import Fit, Minimum
from seaopt.estimation.result.model_error import LITTLE
from seaopt.estimation.solver.settle import Solved, coarsen, measure_misfit, refine_to, settle_roughly
from seaopt.units import unit_after

OFF = 1.5  # times the fit's value and its inverse, in turn
ENOUGH = 10.0  # of log-likelihood, over the colour of the residual: what chance does not give
FLAT = 0.02  # of a value, that an interval covers where a cost has a valley along it
APART_STDS, APART = 4.0, 0.02  # by which values differ that are others
RETURNED = 0.25  # of that, within which a search is back


def find_other_minimum(fit: Fit) -> Iterator[FitFinding]:
    """Yield that another start ends elsewhere, or that it was left before its end; tried where values are told apart
    weakly, or a residual is not noise.
    """
    minimum = fit.require_minimum("find_other_minimum")
    problem = minimum.problem
    excess = max((find_excess(fit, e.plant.name) for e in fit.experiments), default=0.0)
    weak = {name for direction in fit.identifiability.weak for name in direction}
    doubtful = excess > LITTLE or any((fit.parameters[name].known or 0.0) > FLAT for name in weak)
    seen = fit.identifiability.rank == fit.identifiability.free > 0
    if not doubtful or not seen or problem.predicts:
        return
    colour = measure_colour(fit.covariance, fit.white_covariance)
    try:
        there = problem.evaluate(minimum.z)
        solved, ended = _search(fit, minimum, 2.0 * ENOUGH * colour)
    except SeaoptError:  # what cannot be simulated is no minimum
        return
    if ended:
        yield find_ended_start()
    if solved is None or not np.isfinite(solved.misfit):
        return
    gain = 0.5 * (measure_misfit(there) - solved.misfit) / colour
    values = problem.unknowns.by_name(solved.solution.z)
    moved = _find_moved(fit, values)
    if not moved or gain < -ENOUGH:
        return
    # To start there takes every value: a search from two of them and the given others may end where this fit did.
    names = fit.covariance.names if gain > ENOUGH else moved
    preferred = {name: (values[name], fit.parameters[name].std or 0.0) for name in names}
    pairs = (f"{name} = {value:.4g}{unit_after(fit.parameters[name].unit)}" for name, (value, _) in preferred.items())
    if gain > ENOUGH:
        text = f"another start explains the logs better, with {', '.join(pairs)}: start there"
    else:
        text = (
            f"another start explains the logs as well, with {', '.join(pairs)}: they do not decide; log more, or fix "
            "what is known, or give it a prior"
        )
    yield FitFinding(severity="error", kind="starts", where=", ".join(moved), text=text, preferred=preferred)


def _find_moved(fit: Fit, values: Mapping[str, float], scale: float = 1.0) -> list[str]:
    """Return the free parameters whose values are others than a fit's."""
    away = {name: abs(values[name] - fit.parameters[name].value) for name in fit.covariance.names}
    moved: list[str] = []
    for name, distance in away.items():
        parameter = fit.parameters[name]
        if distance > scale * max(APART_STDS * (parameter.total_std or 0.0), APART * abs(parameter.value)):
            moved.append(name)
    return moved


def _search(fit: Fit, minimum: Minimum, worse: float) -> tuple[Solved | None, bool]:
    """Return the better minimum from the given values, and from the fit's off by a factor, up and down in turn; None
    where both come back to the fit, or to a misfit that with the same steps is by so much `worse` than there. With it,
    whether no evaluation was left before both had ended.
    """
    coarse, there = coarsen(minimum.problem, minimum.z)
    unknowns = coarse.unknowns
    factors = np.where(np.arange(unknowns.shared) % 2, OFF, 1.0 / OFF)

    def comes_back(evaluation: Evaluation) -> bool:
        return not _find_moved(fit, unknowns.by_name(evaluation.z), RETURNED)

    def search_from(values: Float[np.ndarray, " n"]) -> Solved | None:
        start = minimum.z.copy()
        start[: unknowns.shared] = values
        evaluation = coarse.evaluate(np.clip(start, unknowns.low, unknowns.high))
        found = settle_roughly(coarse, evaluation, ends=comes_back, checked=True)
        if found.misfit > measure_misfit(there) + worse:
            return None
        if not comes_back(found.solution.evaluation):
            found = refine_to(found, minimum.problem, comes_back)
        return None if comes_back(found.solution.evaluation) else found

    solved: list[Solved] = []
    with suppress(BudgetError):
        for values in (unknowns.start[: unknowns.shared], minimum.z[: unknowns.shared] * factors):
            if (found := search_from(values)) is not None:
                solved.append(found)
    return min(solved, key=lambda each: each.misfit, default=None), count_left() < 1.0
