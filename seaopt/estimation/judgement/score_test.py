r"""Is a parameter that was fixed at fault? A score test of each, and a refit with the one that would do most.

With :math:`g, H` the gradient and Gauss-Newton Hessian of the cost in the unknowns f and one more parameter c, which
was fixed, the multiplier of "c is right" and what it would be by chance are

.. math:: s = g_c - H_{cf} H_{ff}^{-1} g_f, \qquad I = H_{cc} - H_{cf} H_{ff}^{-1} H_{fc}, \qquad
          \operatorname{var} s = v^T (B + P)\, v, \quad v = (-H_{ff}^{-1} H_{fc},\, 1),

with B the sum over the residuals' correlations that the covariance of a fit has too, so that the test holds for
coloured residuals. :math:`s^2 / \operatorname{var} s` is chi-square with one degree of freedom where c is right (Rao,
Proc. Cambridge Phil. Soc. 44, 1948; for residuals that are not as assumed White, Econometrica 50, 1982). One
Gauss-Newton step with c free moves it by -s/I, and the cost falls by s^2/(2 I). What would lower it most is
refitted: one step is not enough where a resonance has to move. Parameters whose refits are as likely are named
together, for no residual shows which of them is wrong.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from jaxtyping import Float, Int

from seaopt.estimation.problem.correlation import CrossCorrelation, cross_correlation
from seaopt.estimation.problem.experiment import Experiment
from seaopt.estimation.problem.fit_experiment import FitOutput
from seaopt.estimation.problem.fit_problem import Evaluation, FitProblem
from seaopt.estimation.problem.normal_equations import solve_seen
from seaopt.estimation.problem.residual_statistics import ResidualsByExperiment, compute_statistics
from seaopt.estimation.result.covariance import compute_bread, compute_meat
from seaopt.estimation.result.fit_result import Fit, Minimum
from seaopt.estimation.result.summary import summarise
from seaopt.estimation.solver.least_squares import find_blocked
from seaopt.estimation.solver.settle import settle
from seaopt.formatting import join_words
from seaopt.parameters import ParameterSet
from seaopt.records import record
from seaopt.simulation import make_model
from seaopt.units import unit_after

SIGNIFICANCE = 0.01  # a test that fails with less than this probability by chance is reported
REDUNDANT = 1e-7  # of what a parameter does to the outputs: less of it left, and the free ones do the same
SHARE = 0.3  # of the most that a step lowers the cost: a step is not a refit, and the best may be another
INDISTINGUISHABLE = 3.0  # of log-likelihood: what no residual distinguishes
EXPLAINED_POWER = 0.1  # of a residual's: a parameter that leaves less is at fault, whatever else may be
REFIT_ITERATIONS = 25
MOST_REFITTED = 5  # parameters


@record
class ScoreTest:
    """The score test of one parameter that was fixed.

    Parameters
    ----------
    value, unit : float and str
        At which it was fixed.
    chi2 : float
        With one degree of freedom where the value is right, allowing for coloured residuals.
    p : float
        Probability that chance exceeds it in some parameter of those tested (Bonferroni's bound).
    preferred : float
        Where one Gauss-Newton step with it free would put it: near the value of a refit, where that is near.
    fall : float
        By how much that step would lower the cost.

    """

    value: float
    unit: str
    chi2: float
    p: float
    preferred: float
    fall: float


@record
class Remainder:
    """What a refit leaves of an output's residual.

    Parameters
    ----------
    power : float
        Over that of the fit.
    follows_no_input, white : bool
        Of what it leaves.

    """

    power: float
    follows_no_input: bool
    white: bool

    @property
    def explained(self) -> bool:
        """Whether nothing of the residual follows an input, or little is left."""
        return self.follows_no_input or self.power < EXPLAINED_POWER


@record(eq=False)
class Culprit:
    """The fixed parameter that explains most, after a refit with it free, and those that explain as much.

    Parameters
    ----------
    values : mapping of name to float
        What a refit gives each of them, alone; the best first.
    tests : mapping of name to ScoreTest
        Their score tests.
    std : float
        Of the first.
    remainders : mapping of EXPERIMENT.OUTPUT to Remainder
        What the refit of the first leaves.

    """

    values: Mapping[str, float]
    tests: Mapping[str, ScoreTest]
    std: float
    remainders: Mapping[str, Remainder]

    @property
    def first(self) -> str:
        """The best with its value, in words."""
        name = next(iter(self.values))
        return f"{name} = {self.values[name]:.6g}{unit_after(self.tests[name].unit)}"

    @property
    def sentence(self) -> str:
        """What the logs prefer, and what would do as well."""
        name, (test, *_) = next(iter(self.values)), self.tests.values()
        chi2 = f"chi-square {test.chi2:.3g} on one degree of freedom"
        if len(self.values) == 1:
            unit = unit_after(test.unit)
            return (
                f"{name} = {test.value:.6g}{unit} is held fixed, and the logs prefer {self.values[name]:.6g} ± "
                f"{self.std:.2g}{unit} ({chi2}): check the value, or free it"
            )
        each = [
            f"{name} = {value:.6g} in place of {self.tests[name].value:.6g}{unit_after(self.tests[name].unit)}"
            for name, value in self.values.items()
        ]
        return (
            f"one of {join_words([*self.values])}, which are held fixed, is wrong ({chi2}): "
            f"{', '.join(each[:-1])} or {each[-1]} explain the logs alike; check these values, or free one"
        )


def find_culprit(
    minimum: Minimum, fit: Fit, residuals: ResidualsByExperiment
) -> tuple[dict[str, ScoreTest], Culprit | None]:
    """Return the tests, and the parameters to blame if some are beyond chance, from the residuals of the fit."""
    tests = run_score_tests(minimum, fit)
    most = max((test.fall for test in tests.values()), default=0.0)
    suspects = [name for name, test in tests.items() if test.p < SIGNIFICANCE and test.fall > SHARE * most]
    refits: dict[str, Fit] = {}
    for name in suspects[:MOST_REFITTED]:
        refit = _refit_with(minimum, fit, name, diagnostics=False)
        if refit is not None:
            refits[name] = refit
    ranked = sorted(refits, key=lambda name: refits[name].log_likelihood, reverse=True)
    best = None if not ranked else _refit_with(minimum, fit, ranked[0], diagnostics=True)
    if best is None:
        return tests, None
    alike = [name for name in ranked if refits[name].log_likelihood > best.log_likelihood - INDISTINGUISHABLE]
    again = best.require_minimum("diagnose")
    after = again.residuals()
    return tests, Culprit(
        values={name: refits[name].parameters[name].value for name in alike},
        tests={name: tests[name] for name in alike},
        std=float(best.parameters[alike[0]].std or 0.0),
        remainders={
            new.label: Remainder(
                power=_measure_power(new, after) / max(_measure_power(old, residuals), 1e-300),
                follows_no_input=_follows_no_input(new, after),
                white=best.outputs[new.experiment.name][new.name].whiteness_p >= SIGNIFICANCE,
            )
            for old, new in zip(minimum.problem.outputs, again.problem.outputs, strict=True)
        },
    )


def run_score_tests(
    minimum: Minimum, fit: Fit, names: tuple[str, ...] | None = None, data: Mapping[str, Experiment] | None = None
) -> dict[str, ScoreTest]:
    """Test each parameter that was fixed, that which would do most first; without those the free ones stand for.

    A parameter that would make a linear plant nonlinear, such as friction fixed at zero, is not tested unless it is
    named: the other plant is stepped and not discretised.

    Parameters
    ----------
    minimum, fit : Minimum and Fit
        Where, and of what.
    names : tuple of str, optional
        The parameters to test; those that leave linear plants linear, if left out.
    data : mapping of name to Experiment, optional
        Experiments with a free delay, which is then tested too, under the name EXPERIMENT.delay_s.

    """
    names, data = find_candidates(minimum.problem, fit)[0] if names is None else names, data or {}
    if not names and not data:
        return {}
    trial, z = minimum.problem.rebuild(free_more(fit, names), minimum.z, data)
    here = trial.evaluate(z)
    if not np.isfinite(here.cost):
        return {}
    units = {name: fit.parameters[name].unit for name in names} | {f"{name}.delay_s": "s" for name in data}
    places = np.array([trial.unknowns.names.index(name) for name in units])
    score, information, variance = _compute_scores(trial, here, places)
    chosen = np.flatnonzero((information > REDUNDANT * np.diag(here.hessian)[places]) & (variance > 0.0))
    order = sorted(chosen, key=lambda i: score[i] ** 2 / information[i], reverse=True)
    rows = list(units.items())
    return {
        rows[i][0]: _test(float(here.z[places[i]]), rows[i][1], score[i], information[i], variance[i], chosen.size)
        for i in order
    }


def _test(value: float, unit: str, score: float, information: float, variance: float, count: int) -> ScoreTest:
    from scipy.special import erfc  # deferred: scipy is slow to load

    chi2 = float(score**2 / variance)
    return ScoreTest(
        value=value, unit=unit, chi2=chi2,
        p=min(count * float(erfc(np.sqrt(0.5 * chi2))), 1.0), preferred=float(value - score / information),
        fall=0.5 * float(score**2 / information),
    )  # fmt: skip


def find_candidates(problem: FitProblem, fit: Fit) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the fixed parameters whose freedom leaves linear plants linear, and those that would not."""
    free = fit.parameters.free_names
    plain: list[str] = []
    bending: list[str] = []
    for name in fit.parameters:
        users = [experiment for experiment in problem.experiments if name in experiment.data.plant.parameters]
        if name in free or not users:
            continue
        models = (make_model(e.data.plant, fit.parameters, (*free, name), e.data.outputs) for e in users)
        same = all(model.linear == e.model.linear for e, model in zip(users, models, strict=True))
        (plain if same else bending).append(name)
    return tuple(plain), tuple(bending)


def free_more(fit: Fit, names: tuple[str, ...]) -> ParameterSet:
    """Return the fit's parameters with more of them free."""
    return fit.parameters.with_parameters(
        *(replace(fit.parameters[name], free=True, prior_std=None, std=None) for name in names)
    )


def _compute_scores(
    trial: FitProblem, here: Evaluation, places: Int[np.ndarray, " c"]
) -> tuple[Float[np.ndarray, " c"], Float[np.ndarray, " c"], Float[np.ndarray, " c"]]:
    """Return scores, their information, and their variances with the residuals as coloured as they are."""
    unknowns, z = trial.unknowns, here.z
    apart = find_blocked(here, unknowns.low, unknowns.high)  # a bound takes the place of a zero gradient
    apart[places] = True
    rest = np.flatnonzero(~apart)
    hessian = here.hessian
    if not trial.loss.quadratic:
        hessian = compute_bread(trial, z) + np.diag(unknowns.precision)
    across = solve_seen(hessian[np.ix_(rest, rest)], hessian[np.ix_(rest, places)], 1e-12)
    score = here.gradient[places] - across.T @ here.gradient[rest]
    information = np.diag(hessian)[places] - np.sum(hessian[np.ix_(rest, places)] * across, axis=0)
    along = np.zeros((z.size, places.size))
    along[rest], along[places, np.arange(places.size)] = -across, 1.0
    meat = compute_meat(trial, z, along, compute_statistics(trial, z))
    return score, information, np.diag(meat + (along.T * unknowns.precision) @ along)


def _refit_with(minimum: Minimum, fit: Fit, name: str, *, diagnostics: bool) -> Fit | None:
    """Return the fit from the minimum with one more parameter free; None where that does not end inside its bounds."""
    started = time.perf_counter()
    trial, z = minimum.problem.rebuild(free_more(fit, (name,)), minimum.z)
    solved = settle(trial, trial.evaluate(z), REFIT_ITERATIONS, None)
    if not np.isfinite(solved.solution.evaluation.cost):
        return None
    refit = summarise(solved, minimum.method, diagnostics, started)
    parameter = refit.parameters[name]
    return refit if parameter.identified and not parameter.at_bound else None


def _measure_power(output: FitOutput, residuals: ResidualsByExperiment) -> float:
    """Return the power of an output's residuals, filtered but not in sigma."""
    squares = [np.sum(r**2) for r in residuals[output.experiment.name].weighted_of(output.name)]
    return float(np.sum(squares) * output.sigma**2)


def _follows_no_input(output: FitOutput, residuals: ResidualsByExperiment) -> bool:
    """Tell whether an output's residual follows no input."""
    return all(cross.p >= SIGNIFICANCE for cross in correlate_with_inputs(output, residuals).values())


def correlate_with_inputs(output: FitOutput, residuals: ResidualsByExperiment) -> dict[str, CrossCorrelation]:
    """Return the correlation of an output's residual with each input that moves."""
    segments = output.experiment.segments
    weighted = residuals[output.experiment.name].weighted_of(output.name)
    correlations: dict[str, CrossCorrelation] = {}
    for i, name in enumerate(output.experiment.data.plant.inputs):
        cross = cross_correlation(weighted, [segment.samples.inputs[i] for segment in segments])
        if cross is not None:
            correlations[name] = cross
    return correlations
