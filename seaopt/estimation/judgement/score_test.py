r"""Is a parameter that was fixed at fault? A score test of each.

With :math:`g, H` the gradient and Gauss-Newton Hessian of the cost in the unknowns f and one more parameter c, which
was fixed, the multiplier of "c is right" and what it would be by chance are

.. math:: s = g_c - H_{cf} H_{ff}^{-1} g_f, \qquad I = H_{cc} - H_{cf} H_{ff}^{-1} H_{fc}, \qquad
          \operatorname{var} s = v^T (B + P)\, v, \quad v = (-H_{ff}^{-1} H_{fc},\, 1),

with B the sum over the residuals' correlations that the covariance of a fit has too, so that the test holds for
coloured residuals. :math:`s^2 / \operatorname{var} s` is chi-square with one degree of freedom where c is right (Rao,
Proc. Cambridge Phil. Soc. 44, 1948; for residuals that are not as assumed White, Econometrica 50, 1982). One
Gauss-Newton step with c free moves it by -s/I, and the cost falls by s^2/(2 I): one step is no refit where a resonance
has to move, see `causes`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from jaxtyping import Float, Int

from seaopt.estimation.problem.experiment import Experiment
from seaopt.estimation.problem.fit_problem import Evaluation, FitProblem
from seaopt.estimation.problem.normal_equations import solve_seen
from seaopt.estimation.problem.residual_statistics import StatisticsByExperiment, compute_statistics
from seaopt.estimation.result.covariance import compute_bread, compute_meat
from seaopt.estimation.result.fit_result import Fit, Minimum
from seaopt.estimation.solver.least_squares import find_blocked
from seaopt.estimation.solver.step_shares import copy_steps
from seaopt.parameters import ParameterSet
from seaopt.plants.published import GRAVITY
from seaopt.records import record
from seaopt.simulation import make_model

REDUNDANT = 1e-7  # of what a parameter does to the outputs: less of it left, and the free ones do the same


@record
class ScoreTest:
    """The score test of one parameter that was fixed."""

    value: float  # value, unit: at which it was fixed
    unit: str
    chi2: float  # with one degree of freedom where the value is right, allowing for coloured residuals
    p: float  # probability that chance exceeds it in some parameter of those tested (Bonferroni's bound)
    # where one Gauss-Newton step with it free would put it: near the value of a refit, where that is near
    preferred: float
    fall: float  # by how much that step would lower the cost


def run_score_tests(
    minimum: Minimum, fit: Fit, names: tuple[str, ...] | None = None, data: Mapping[str, Experiment] | None = None
) -> dict[str, ScoreTest]:
    """Test each parameter that was fixed, that which would do most first; without those the free ones stand for. A
    parameter that would make a linear plant nonlinear, such as friction fixed at zero, is not tested unless it is
    named: the other plant is stepped and not discretised. `minimum`, `fit`: where, and of what; `names`: the parameters
    to test; those that leave linear plants linear, if left out; `data`: experiments with a free delay, which is then
    tested too, under the name EXPERIMENT.delay_s.
    """
    names, data = find_candidates(minimum.problem, fit)[0] if names is None else names, data or {}
    if not names and not data:
        return {}
    trial, z = minimum.problem.rebuild(free_more(fit, names), minimum.z, data)
    trial = copy_steps(trial, minimum.problem)
    trial.keep(z)
    evaluation = trial.evaluate(z)
    if not np.isfinite(evaluation.cost):
        return {}
    units = {name: fit.parameters[name].unit for name in names} | {f"{name}.delay_s": "s" for name in data}
    places = np.array([trial.unknowns.names.index(name) for name in units])
    statistics = minimum.statistics or compute_statistics(trial, z)
    score, information, variance = _compute_scores(trial, evaluation, places, statistics)
    chosen = np.flatnonzero((information > REDUNDANT * np.diag(evaluation.hessian)[places]) & (variance > 0.0))
    order = sorted(chosen, key=lambda i: score[i] ** 2 / information[i], reverse=True)
    rows = list(units.items())
    return {
        rows[i][0]: _test(
            float(evaluation.z[places[i]]), rows[i][1], score[i], information[i], variance[i], chosen.size
        )
        for i in order
    }


def _test(value: float, unit: str, score: float, information: float, variance: float, count: int) -> ScoreTest:
    chi2 = float(score**2 / variance)
    return ScoreTest(
        value=value,
        unit=unit,
        chi2=chi2,
        p=min(count * math.erfc(math.sqrt(0.5 * chi2)), 1.0),
        preferred=float(value - score / information),
        fall=0.5 * float(score**2 / information),
    )


def find_candidates(problem: FitProblem, fit: Fit) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the fixed parameters whose freedom leaves linear plants linear, and those that would not."""
    free = fit.parameters.free_names
    plain: list[str] = []
    bending: list[str] = []
    for name in fit.parameters:
        users = [e for e in problem.experiments if name in e.data.plant.parameters and name not in e.data.parameters]
        if name in free or not users or all(e.data.plant.parameters[name] == GRAVITY for e in users):
            continue  # a constant is not at fault
        models = (
            make_model(e.data.plant, e.data.apply_own(fit.parameters), (*e.model.free, name), e.data.outputs)
            for e in users
        )
        same = all(model.linear == e.model.linear for e, model in zip(users, models, strict=True))
        (plain if same else bending).append(name)
    return tuple(plain), tuple(bending)


def free_more(fit: Fit, names: tuple[str, ...]) -> ParameterSet:
    """Return the fit's parameters with more of them free."""
    return fit.parameters.with_parameters(
        *(replace(fit.parameters[name], free=True, prior_std=None, std=None) for name in names)
    )


def _compute_scores(
    trial: FitProblem, evaluation: Evaluation, places: Int[np.ndarray, " c"], statistics: StatisticsByExperiment
) -> tuple[Float[np.ndarray, " c"], Float[np.ndarray, " c"], Float[np.ndarray, " c"]]:
    """Return scores, their information, and their variances with the residuals as coloured as they are."""
    unknowns, z = trial.unknowns, evaluation.passes.z  # whose passes are kept
    apart = find_blocked(evaluation, unknowns.low, unknowns.high)  # a bound takes the place of a zero gradient
    apart[places] = True
    kept = np.flatnonzero(~apart)
    hessian = evaluation.hessian
    if not trial.loss.quadratic:
        hessian = compute_bread(trial, z)
    across = solve_seen(hessian[kept][:, kept], hessian[kept][:, places], 1e-12)
    score = evaluation.gradient[places] - across.T @ evaluation.gradient[kept]
    information = np.diag(hessian)[places] - np.sum(hessian[kept][:, places] * across, axis=0)
    along = np.zeros((z.size, places.size))
    along[kept], along[places, np.arange(places.size)] = -across, 1.0
    meat = compute_meat(trial, z, along, statistics)
    return score, information, np.diag(meat + (along.T * unknowns.precision) @ along)
