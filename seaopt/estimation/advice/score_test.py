r"""Is a parameter that was held fixed at fault? A score test of each, and a refit with the one that would do most.

With :math:`g, H` the gradient and Gauss-Newton Hessian of the cost in the unknowns f and one more parameter c, which
was held, the multiplier of "c is right" and what it would be in chance are

.. math:: s = g_c - H_{cf} H_{ff}^{-1} g_f, \qquad I = H_{cc} - H_{cf} H_{ff}^{-1} H_{fc}, \qquad
          \operatorname{var} s = v^T (B + P)\, v, \quad v = (-H_{ff}^{-1} H_{fc},\, 1),

with B the sum over the residuals' correlations that the covariance of a fit has too, so that the test holds for
coloured residuals. :math:`s^2 / \operatorname{var} s` is chi-square with one degree of freedom where c is right (Rao,
Proc. Cambridge Phil. Soc. 44, 1948; for residuals that are not as assumed White, Econometrica 50, 1982). One
Gauss-Newton step with c free moves it by -s/I, and the cost falls by s^2/(2 I). What would lower it most is
refitted: one step is not enough where a resonance has to move. Parameters whose refits are as likely are told together,
for no residual tells which of them is wrong.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float, Int

from seaopt.estimation.problem.correlation import cross_correlation
from seaopt.estimation.problem.losses import Linear
from seaopt.estimation.problem.methods import Method, MultipleShooting, OutputError, PredictionError
from seaopt.estimation.problem.normal_equations import solved
from seaopt.estimation.problem.residual_statistics import Errors, leftover
from seaopt.estimation.problem.residuals import Evaluation, Residuals
from seaopt.estimation.problem.unknowns import collect
from seaopt.estimation.result.covariance import coloured, robust_bread
from seaopt.estimation.result.fit_result import Fit, Minimum
from seaopt.estimation.result.identifiability import listed
from seaopt.estimation.result.summary import summarise
from seaopt.estimation.solver.least_squares import held_by_bounds
from seaopt.estimation.solver.solve import settle
from seaopt.records import record
from seaopt.simulation import make_model
from seaopt.units import unit_after

CHANCE = 0.01  # a test that fails with less than this probability by chance is told in words
UNSEEN = 1e-7  # of what a parameter does to the outputs: less of it left, and the free ones do the same
SHARE = 0.3  # of the most that a step lowers the cost: a step is not a refit, and the best may be another
ALIKE = 3.0  # of log-likelihood: what no residual tells apart
LEFT = 0.1  # of a residual's power: a parameter that leaves less is at fault, whatever else may be
REFIT = 25  # evaluations of a refit
REFITTED = 5  # parameters at most

METHODS: Mapping[str, Method] = {
    "output_error": OutputError(), "multiple_shooting": MultipleShooting(), "prediction_error": PredictionError(),
}  # fmt: skip


@record
class Held:
    """The score test of one parameter that was held fixed.

    Parameters
    ----------
    value, unit : float and str
        At which it was held.
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


@record(eq=False)
class Culprit:
    """The held parameter that explains most, after a refit with it free, and those that explain as much.

    Parameters
    ----------
    values : mapping of name to float
        What a refit gives each of them, alone; the best first.
    tests : mapping of name to Held
        Their score tests.
    std : float
        Of the first.
    left : tuple of arrays, shape (ny,)
        What the refit of the first leaves of each output's power, an array an experiment.
    clean, white : tuples of arrays of bool, shape (ny,)
        Whether what it leaves follows no input, and whether it is white.

    """

    values: Mapping[str, float]
    tests: Mapping[str, Held]
    std: float
    left: tuple[Float[np.ndarray, " _"], ...]
    clean: tuple[Bool[np.ndarray, " _"], ...]
    white: tuple[Bool[np.ndarray, " _"], ...]

    @property
    def first(self) -> str:
        """The best with its value, in words."""
        name = next(iter(self.values))
        return f"{name} = {self.values[name]:.6g}{unit_after(self.tests[name].unit)}"

    def explains(self, e: int, o: int) -> bool:
        """Tell whether the residual of an output is explained: nothing of it follows an input, or little is left."""
        return bool(self.clean[e][o] or self.left[e][o] < LEFT)

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
            f"one of {listed([*self.values])}, which are held fixed, is wrong ({chi2}): "
            f"{', '.join(each[:-1])} or {each[-1]} explain the logs alike; check these values, or free one"
        )


def culprit(minimum: Minimum, fit: Fit, left: list[list[Errors]]) -> tuple[dict[str, Held], Culprit | None]:
    """Return the tests, and the parameters to blame if some are beyond chance; `left` are the residuals of the fit."""
    tests = held_parameters(minimum, fit)
    most = max((item.fall for item in tests.values()), default=0.0)
    suspects = [name for name, item in tests.items() if item.p < CHANCE and item.fall > SHARE * most][:REFITTED]
    refits: dict[str, Fit] = {}
    for name in suspects:
        found = _refitted(minimum, fit, name, diagnostics=False)
        if found is not None:
            refits[name] = found
    ranked = sorted(refits, key=lambda name: refits[name].log_likelihood, reverse=True)
    best = None if not ranked else _refitted(minimum, fit, ranked[0], diagnostics=True)
    if best is None:
        return tests, None
    alike = [name for name in ranked if refits[name].log_likelihood > best.log_likelihood - ALIKE]
    again = best.at_minimum("diagnose")
    after = again.errors()
    return tests, Culprit(
        values={name: refits[name].parameters[name].value for name in alike},
        tests={name: tests[name] for name in alike},
        std=float(best.parameters[alike[0]].std or 0.0),
        left=tuple(
            _power(again.problem, e, row) / np.maximum(_power(minimum.problem, e, before), 1e-300)
            for e, (row, before) in enumerate(zip(after, left, strict=True))
        ),
        clean=tuple(_clean(again.problem, e, row) for e, row in enumerate(after)),
        white=tuple(
            np.array([item.whiteness_p >= CHANCE for item in best.outputs[experiment.name].values()])
            for experiment in best.experiments
        ),
    )  # fmt: skip


def held_parameters(minimum: Minimum, fit: Fit) -> dict[str, Held]:
    """Test each parameter that was held fixed, that which would do most first; without those the free ones stand for.

    A parameter that would make a linear plant nonlinear, such as friction held at zero, is not tested: the other plant
    is stepped and not discretised, and has to be fitted.
    """
    names = _candidates(minimum.problem, fit)
    if not names:
        return {}
    trial, z = _freed(minimum, fit, names)
    here = trial.evaluate(z)
    if not np.isfinite(here.cost):
        return {}
    places = np.array([trial.unknowns.names.index(name) for name in names])
    score, information, variance = _scores(trial, here, places)
    chosen = np.flatnonzero((information > UNSEEN * np.diag(here.hessian)[places]) & (variance > 0.0))
    order = sorted(chosen, key=lambda i: score[i] ** 2 / information[i], reverse=True)
    return {names[i]: _held(fit, names[i], score[i], information[i], variance[i], chosen.size) for i in order}


def _held(fit: Fit, name: str, score: float, information: float, variance: float, count: int) -> Held:
    from scipy.special import erfc  # deferred: scipy is slow to load

    item, chi2 = fit.parameters[name], float(score**2 / variance)
    return Held(
        value=item.value, unit=item.unit, chi2=chi2, p=min(count * float(erfc(np.sqrt(0.5 * chi2))), 1.0),
        preferred=float(item.value - score / information), fall=0.5 * float(score**2 / information),
    )  # fmt: skip


def _candidates(problem: Residuals, fit: Fit) -> tuple[str, ...]:
    """Return the fixed parameters of the plants whose freedom leaves a linear plant linear."""
    free = fit.parameters.free_names
    found: list[str] = []
    for name in fit.parameters:
        users = [e for e, experiment in enumerate(problem.experiments) if name in experiment.plant.parameters]
        if name in free or not users:
            continue
        models = (
            make_model(problem.experiments[e].plant, fit.parameters, (*free, name), problem.experiments[e].outputs)
            for e in users
        )
        if all(model.linear == problem.unknowns.models[e].linear for e, model in zip(users, models, strict=True)):
            found.append(name)
    return tuple(found)


def _freed(minimum: Minimum, fit: Fit, names: tuple[str, ...]) -> tuple[Residuals, Float[np.ndarray, " n"]]:
    """Return the problem with more parameters free, and the minimum in its unknowns."""
    problem, old = minimum.problem, minimum.problem.unknowns
    noise = problem.observers is not None
    params = fit.parameters.with_parameters(
        *(replace(fit.parameters[name], free=True, prior_std=None, std=None) for name in names)
    )
    new = collect(problem.experiments, params, noise=noise, band_hz=problem.band_hz)
    start, z = new.start.copy(), new.start.copy()
    for name, first, value in zip(old.names, old.start, minimum.z, strict=True):
        if name in new.names:
            start[new.names.index(name)], z[new.names.index(name)] = first, value
    return replace(problem, unknowns=replace(new, start=start)), z


def _scores(
    trial: Residuals, here: Evaluation, places: Int[np.ndarray, " c"]
) -> tuple[Float[np.ndarray, " c"], Float[np.ndarray, " c"], Float[np.ndarray, " c"]]:
    """Return scores, their information, and their variances with the residuals as coloured as they are."""
    unknowns, z = trial.unknowns, here.z
    held = held_by_bounds(here, unknowns.low, unknowns.high)  # a bound takes the place of a zero gradient
    held[places] = True
    rest = np.flatnonzero(~held)
    hessian = here.hessian
    if not isinstance(trial.loss, Linear):
        hessian = robust_bread(trial, z) + np.diag(unknowns.precision)
    across = solved(hessian[np.ix_(rest, rest)], hessian[np.ix_(rest, places)], 1e-12)
    score = here.gradient[places] - across.T @ here.gradient[rest]
    information = np.diag(hessian)[places] - np.sum(hessian[np.ix_(rest, places)] * across, axis=0)
    along = np.zeros((z.size, places.size))
    along[rest], along[places, np.arange(places.size)] = -across, 1.0
    left = [leftover(trial, e, z) for e in range(len(trial.experiments))]
    spread = coloured(trial, z, along, left) + (along.T * unknowns.precision) @ along
    return score, information, np.diag(spread)


def _refitted(minimum: Minimum, fit: Fit, name: str, *, diagnostics: bool) -> Fit | None:
    """Return the fit from the minimum with one more parameter free; None where that does not end inside its bounds."""
    started = time.perf_counter()
    trial, z = _freed(minimum, fit, (name,))
    params = fit.parameters.with_parameters(replace(fit.parameters[name], free=True, prior_std=None, std=None))
    done = settle(trial, trial.evaluate(z), REFIT, None)
    if not np.isfinite(done.solution.evaluation.cost):
        return None
    found = summarise(params, done, METHODS[fit.method], diagnostics, started)
    item = found.parameters[name]
    return found if item.identified and not item.at_bound else None


def _power(problem: Residuals, e: int, row: list[Errors]) -> Float[np.ndarray, " ny"]:
    """Return the power of an experiment's residuals, filtered but not in sigma."""
    return np.sum([np.sum(error.weighted**2, axis=0) for error in row], axis=0) * problem.sigma[e] ** 2


def _clean(problem: Residuals, e: int, row: list[Errors]) -> Bool[np.ndarray, " ny"]:
    """Tell which outputs of an experiment leave a residual that follows no input."""
    clean: list[bool] = []
    for o in range(len(problem.sigma[e])):
        found = [
            cross_correlation(
                [error.weighted[:, o] for error in row], [piece.inputs[i] for piece in problem.segments[e]]
            )
            for i in range(len(problem.experiments[e].plant.inputs))
        ]
        clean.append(all(item is None or item.p >= CHANCE for item in found))
    return np.array(clean)
