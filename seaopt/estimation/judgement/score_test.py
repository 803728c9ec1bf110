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
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from seaopt.errors import SeaoptError
from seaopt.estimation.judgement.hypotheses import Addition, list_additions
from seaopt.estimation.problem.experiment import Experiment
from seaopt.estimation.problem.fit_problem import Evaluation, FitProblem
from seaopt.estimation.problem.normal_equations import solve_seen
from seaopt.estimation.problem.residual_statistics import StatisticsByExperiment, compute_statistics
from seaopt.estimation.problem.shapes import Vector
from seaopt.estimation.result.covariance import compute_bread, compute_meat
from seaopt.estimation.result.fit_result import Minimum
from seaopt.estimation.solver.least_squares import find_blocked
from seaopt.estimation.solver.step_shares import copy_steps
from seaopt.parameters import Parameter, ParameterSet
from seaopt.plants.published import GRAVITY
from seaopt.records import record
from seaopt.simulation import depends_on_time, make_model

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


@record(eq=False)
class Freed:
    """The problem of a fit in which more is free, at its minimum: what is to be tested."""

    problem: FitProblem
    z: Vector
    units: Mapping[str, str]  # of what is free besides, and is tested
    bending: tuple[str, ...] = ()  # fixed parameters that are not free here, for they make a linear plant nonlinear
    additions: tuple[Addition, ...] = ()  # that are free here as well, at their neutral values

    @classmethod
    def make(
        cls,
        problem: FitProblem,
        z: Vector,
        names: tuple[str, ...] = (),
        delays: Mapping[str, float] | None = None,
        additions: Sequence[Addition] = (),
    ) -> Freed:
        """Return the problem in which parameters of these names are free, and the delays of experiments, from given
        values, under the name EXPERIMENT.delay_s; and with what is added.
        """
        changes: dict[str, dict[str, Any]] = {e.name: {} for e in problem.experiments}
        for name, plant in additions[-1].plants.items() if additions else ():
            changes[name]["plant"] = plant
        for name, value in (delays or {}).items():
            changes[name]["delay_s"] = _make_delay(value)
        data = {e.name: replace(e.data, **changes[e.name]) for e in problem.experiments if changes[e.name]}
        added = (replace(addition.parameter, free=True) for addition in additions)
        params = free_more(problem.params, names).with_parameters(*added)
        freed, at = problem.rebuild(params, z, data)
        units = {name: problem.params[name].unit for name in names} | {f"{name}.delay_s": "s" for name in delays or {}}
        return cls(problem=copy_steps(freed, problem), z=at, units=units, additions=tuple(additions))


def free_fixed(problem: FitProblem, z: Vector) -> Freed:
    """Return the problem with all free that leaves linear plants linear, delays too; and with the effects that logs may
    not show, where plants with them are simulated alike. Its passes are made, where there is room, and those of the
    problem itself kept as parts of them.
    """
    plain, bending = find_candidates(problem)
    delays = {
        e.name: e.slots.delay.value
        for e in problem.experiments
        if e.slots.delay.index is None and not depends_on_time(e.model)
    }
    freed: Freed | None = None
    with suppress(SeaoptError):  # what does not make a problem is left out
        additions = () if problem.predicts else tuple(list_additions(problem, z))
        freed = Freed.make(problem, z, plain, delays, additions) if additions else None
    if freed is None or not problem.simulates_alike(z, freed.problem, freed.z):
        freed = Freed.make(problem, z, plain, delays)
    problem.keep_within(z, freed.problem, freed.z)
    return replace(freed, bending=bending)


def run_score_tests(minimum: Minimum, freed: Freed | None = None) -> dict[str, ScoreTest]:
    """Test each parameter that was fixed, that which would do most first; without those the free ones stand for. A
    parameter that would make a linear plant nonlinear, such as friction fixed at zero, is not tested unless it is
    free in `freed`: the other plant is stepped and not discretised. `minimum`: where; `freed`: what is tested, all
    parameters that leave linear plants linear if left out.
    """
    freed = freed or Freed.make(minimum.problem, minimum.z, find_candidates(minimum.problem)[0])
    if not freed.units:
        return {}
    trial, z, units = freed.problem, freed.z, freed.units
    trial.keep(z)
    evaluation = trial.evaluate(z)
    if not np.isfinite(evaluation.cost):
        return {}
    places = np.array([trial.unknowns.names.index(name) for name in units])
    statistics = minimum.statistics or compute_statistics(trial, z)
    neutral = [each.parameter.name for each in freed.additions]
    score, information, variance = _compute_scores(trial, evaluation, places, neutral, statistics)
    chosen = np.flatnonzero(variance > 0.0)
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


def free_delay(experiment: Experiment, value: float) -> Experiment:
    """Return the experiment with a free delay that starts at a value."""
    return replace(experiment, delay_s=_make_delay(value))


def _make_delay(value: float) -> Parameter:
    return Parameter(name="delay_s", value=value, unit="s", free=True, min=0.0)


def find_candidates(problem: FitProblem) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the fixed parameters whose freedom leaves linear plants linear, and those that would not."""
    params = problem.params
    values = {e.name: e.data.plant.complete(e.data.apply_own(params)) for e in problem.experiments}
    plain: list[str] = []
    bending: list[str] = []
    for name, parameter in params.items():
        users = [e for e in problem.experiments if name in e.data.plant.parameters and name not in e.data.parameters]
        if parameter.free or not users or all(e.data.plant.parameters[name] == GRAVITY for e in users):
            continue  # a constant is not at fault
        models = (make_model(e.data.plant, values[e.name], (*e.model.free, name), e.data.outputs) for e in users)
        same = all(model.linear == e.model.linear for e, model in zip(users, models, strict=True))
        (plain if same else bending).append(name)
    return tuple(plain), tuple(bending)


def free_more(params: ParameterSet, names: tuple[str, ...]) -> ParameterSet:
    """Return parameters with more of them free."""
    return params.with_parameters(*(replace(params[name], free=True, prior_std=None, std=None) for name in names))


def _compute_scores(
    trial: FitProblem,
    evaluation: Evaluation,
    places: Int[np.ndarray, " c"],
    neutral: Sequence[str],
    statistics: StatisticsByExperiment,
) -> tuple[Float[np.ndarray, " c"], Float[np.ndarray, " c"], Float[np.ndarray, " c"]]:
    """Return scores, their information, and their variances with the residuals as coloured as they are, zero of what
    the free ones stand for. `neutral`: unknowns that stay where they are.
    """
    unknowns, z = trial.unknowns, evaluation.passes.z  # whose passes are kept
    apart = find_blocked(evaluation, unknowns.low, unknowns.high)  # a bound takes the place of a zero gradient
    apart[places] = True
    apart[[unknowns.names.index(name) for name in neutral]] = True
    kept = np.flatnonzero(~apart)
    hessian = evaluation.hessian
    if not trial.loss.quadratic:
        hessian = compute_bread(trial, z)
    across = solve_seen(hessian[kept][:, kept], hessian[kept][:, places], 1e-12)
    score = evaluation.gradient[places] - across.T @ evaluation.gradient[kept]
    information = np.diag(hessian)[places] - np.sum(hessian[kept][:, places] * across, axis=0)
    told = np.flatnonzero(information > REDUNDANT * np.diag(evaluation.hessian)[places])
    along, variance = np.zeros((z.size, told.size)), np.zeros(places.size)
    along[kept], along[places[told], np.arange(told.size)] = -across[:, told], 1.0
    if told.size:
        variance[told] = np.diag(compute_meat(trial, z, along, statistics) + (along.T * unknowns.precision) @ along)
    return score, information, variance
