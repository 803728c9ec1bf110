r"""How the runs of healthy actuators scatter: by how much, how alike runs are that follow each other, with what tails.

Three figures of each parameter are estimated over the whole fleet, each so that a step, a slow drift or a wild run of
some actuators does not spoil it.

*Std and correlation.* The part of a run that is not of its fit is taken as :math:`u_t = \phi u_{t-1} + \ldots` of std
:math:`\sigma`. Runs that are k apart differ by a variance of :math:`2 \sigma^2 (1 - \phi^k)` and those of their fits.
Squared differences beyond `CLIP_SQUARE` count as that, whatever they are (Huber's scale, for differences of unlike
variances); over k this is a robust variogram, to which the two figures are fitted. The charts take :math:`\phi` one
standard error larger: too large a one makes alarms rarer.

*Tails.* The innovations of the charts, until what led to an alarm, are taken as Student's t: its scale and degrees of
freedom by maximum likelihood, where that is likelier than a normal distribution by more than chance.

*What does not fit.* With all this each chart's innovations should be independent and normal. A chart at a threshold so
low that about a quarter of healthy actuators go beyond it tells whether they are, by its count. So do actuators that
scatter unlike one another, and means of two halves of a history that are further apart than the correlation lets them:
over many runs a slow walk adds up that hardly shows from run to run.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from scipy.special import chdtr, chdtrc

from seaopt.codec import OrInfinite
from seaopt.fleet.cusum import Runs
from seaopt.formatting import format_number
from seaopt.records import record
from seaopt.signals import VectorN

CLIP_SQUARE = 6.0  # standardised squared differences count for no more; 1.4 % of those of healthy actuators are larger
CLIPPED = chdtr(3, CLIP_SQUARE) + CLIP_SQUARE * chdtrc(1, CLIP_SQUARE)  # mean of a clipped square, if normal
CLIPPED_SQUARE = 3.0 * chdtr(5, CLIP_SQUARE) + CLIP_SQUARE**2 * chdtrc(1, CLIP_SQUARE)  # of its square
FEWEST_PAIRS = 8  # of runs that follow each other, in the whole fleet, from which a variance can be told
FEWEST_OF_SHAPE = 200  # pairs from which correlation and tails can be told
FEWEST_ACTUATORS = 10  # of which it can be told whether they scatter alike
UNLIKE = 0.05  # by which the stds of actuators may differ: charts then raise 1.2 times as many alarms
FEWEST_OF_HALVES = 8  # runs of a history whose halves are compared
WANDERS = 0.1  # by which squares of their differences may be larger: charts then raise 1.3 times as many alarms
LAGS = 6  # runs apart, at most, of which differences are taken
LARGEST_CORRELATION = 0.95
HEAVIEST, LIGHTEST = 2.2, 200.0  # degrees of freedom of Student's t
MOST_OF_TAILS = 20_000  # innovations of which tails are estimated
HEAVY = 30.0  # degrees of freedom from which on a first run is no worse than any other
FIRST_OF_HEAVY = 6  # runs that a baseline starts from below that: a wild one alone would spoil it for long
CHANCE = 6.0  # by which twice the log-likelihood must rise for heavy tails: 1 % of normal fleets do

BETWEEN_HEAD = ("std between runs", "correlation", "tails, as t of", "of pairs")


@record
class Between:
    """How a parameter differs from run to run, beyond the std of its fits.

    Parameters
    ----------
    std : float
    pairs : int
        Runs that follow each other, of which that is known.
    dof : float
        Degrees of freedom of the variance of a run, fit and between runs together.
    correlation : float
        Of runs that follow each other, as the charts take it; 0 where too few runs tell it.
    tails, scale : float
        Degrees of freedom and scale of Student's t that standardised innovations follow; infinite and 1 of normal ones.
    shaped : bool
        Whether the runs are enough to tell correlation and tails.
    """

    json_keys = ("std", "pairs", "dof", "correlation", "tails", "scale")

    std: float
    pairs: int
    dof: float
    correlation: float = 0.0
    tails: OrInfinite = np.inf
    scale: float = 1.0
    shaped: bool = False

    @property
    def chart(self) -> dict[str, Any]:
        """Return the arguments of `seaopt.fleet.cusum.chart_runs`."""
        return {
            "between": self.std**2,
            "correlation": self.correlation,
            "scale": self.scale,
            "dof": 1.0 / (1.0 / self.dof + 1.0 / self.tails),
            "start": FIRST_OF_HEAVY if self.tails < HEAVY else 1,
        }

    def describe(self) -> tuple[str, str, str, str]:
        """Return what stands under `BETWEEN_HEAD`."""
        correlation, tails = "not known", "not known"
        if self.shaped:
            correlation = format_number(self.correlation, 2)
            tails = format_number(self.tails, 2) if np.isfinite(self.tails) else "normal"
        return format_number(self.std), correlation, tails, str(self.pairs)

    def widen(self, variances: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
        """Return by what each run counts in the variance of a mean of many, from the variances of their fits."""
        alike = (1.0 + self.correlation) / (1.0 - self.correlation)
        return self.inflation * (variances + self.std**2 * alike)

    @property
    def inflation(self) -> float:
        """By how much the tails make a variance larger."""
        return self.scale**2 * (self.tails / (self.tails - 2.0) if np.isfinite(self.tails) else 1.0)


def estimate_between_runs(runs: Sequence[tuple[Runs, Runs]]) -> Between | None:
    """Return how much values differ from run to run beyond the variances of their fits; None of too few runs. `runs`: a
    row per actuator in the order of time, nan where there is no run.
    """
    first = _list_differences(runs, 1)
    if first[0].size < FEWEST_PAIRS or not first[0].any():
        return None
    variogram = [_find_variance(*first)]
    dof, pairs = _count_freedom(first[1], variogram[0]), first[0].size
    for lag in range(2, LAGS + 1):
        squares, fits = _list_differences(runs, lag)
        if pairs < FEWEST_OF_SHAPE or squares.size < pairs / 2:  # few runs, or short histories
            break
        variogram.append(_find_variance(squares, fits))
    if len(variogram) == 1 or not variogram[0]:
        return Between(std=variogram[0] ** 0.5, pairs=pairs, dof=dof, shaped=len(variogram) > 1)
    variance, correlation = _fit_variogram(np.array(variogram), np.median(first[1]) / 2.0, pairs)
    return Between(std=variance**0.5, pairs=pairs, dof=dof, correlation=correlation, shaped=True)


def _list_differences(runs: Sequence[tuple[Runs, Runs]], lag: int) -> tuple[VectorN, VectorN]:
    """Return the squares of the differences of runs so far apart, and the variances of their fits."""
    squares = [_select((values[:, lag:] - values[:, :-lag]) ** 2) for values, _ in runs]
    fits = [_select(variances[:, lag:] + variances[:, :-lag]) for _, variances in runs]
    return np.concatenate(squares or [np.zeros(0)]), np.concatenate(fits or [np.zeros(0)])


def _find_variance(squares: VectorN, fits: VectorN) -> float:
    """Return the variance of one of two runs, beyond that of the fits, which squared differences have."""
    from scipy.optimize import brentq  # deferred: 0.2 s

    def exceed(variance: float) -> float:
        ratios = squares / np.maximum(2.0 * variance + fits, 1e-300)
        return float(np.mean(np.minimum(ratios, CLIP_SQUARE)) - CLIPPED)

    solver: Any = brentq
    largest = float(squares.max())
    return 0.0 if exceed(0.0) <= 0.0 else float(solver(exceed, 0.0, largest, xtol=1e-12 * largest))


def _fit_variogram(variogram: VectorN, fit: float, pairs: int) -> tuple[float, float]:
    """Return variance and correlation, by least squares of sigma^2 (1 - phi^k); the latter by an error larger."""
    from scipy.optimize import minimize_scalar  # deferred: 0.2 s

    lags = np.arange(1, variogram.size + 1)

    def fit_variance(correlation: float) -> float:
        shape = 1.0 - correlation**lags
        return float(shape @ variogram / (shape @ shape))

    def miss(correlation: float) -> float:
        return float(np.sum((variogram - fit_variance(correlation) * (1.0 - correlation**lags)) ** 2))

    solver: Any = minimize_scalar
    best = float(solver(miss, bounds=(0.0, LARGEST_CORRELATION), method="bounded").x)
    error = min(1.0 + fit / variogram[0], 3.0) / pairs**0.5  # fits that tell little hide it
    correlation = min((best if miss(best) < miss(0.0) else 0.0) + error, LARGEST_CORRELATION)
    return fit_variance(correlation), float(correlation)


def _count_freedom(fits: VectorN, variance: float) -> float:
    """Return the degrees of freedom of a run's variance, from the sampling variance of the clipped mean square.
    Differences that share a run are correlated by -1/2, their squares by 1/4: half as much again as if they were not.
    """
    slope = np.mean(2.0 / (2.0 * variance + fits)) * chdtr(3, CLIP_SQUARE)
    sampling = 1.5 * (CLIPPED_SQUARE - CLIPPED**2) / fits.size / slope**2
    return float(2.0 * (variance + np.median(fits) / 2.0) ** 2 / sampling)


def estimate_tails(ratios: VectorN) -> tuple[float, float]:
    """Return degrees of freedom and scale of Student's t; infinite and 1 where ratios may as well be normal. `ratios`:
    standardised innovations of healthy runs, before they are clipped.
    """
    if ratios.size < FEWEST_OF_SHAPE:
        return np.inf, 1.0
    from scipy.optimize import minimize  # deferred, as the next: 0.2 s
    from scipy.stats import norm, t  # 0.5 s

    chosen = ratios[:: -(-ratios.size // MOST_OF_TAILS)]

    def miss(unknown: Float[np.ndarray, " two"]) -> float:
        dof, scale = 1.0 / unknown[0], np.exp(unknown[1])
        return float(chosen.size * np.log(scale) - np.sum(t.logpdf(chosen / scale, dof)))

    solver: Any = minimize
    bounds = [(1.0 / LIGHTEST, 1.0 / HEAVIEST), (-3.0, 3.0)]
    solution = solver(miss, np.array([0.1, 0.0]), bounds=bounds, method="L-BFGS-B")
    normal = chosen.size * np.log(np.std(chosen)) - float(np.sum(norm.logpdf(chosen / np.std(chosen))))
    if 2.0 * (normal - solution.fun) < CHANCE:
        return np.inf, 1.0
    return float(1.0 / solution.x[0]), float(np.exp(solution.x[1]))


def differ_in_scatter(runs: Sequence[tuple[Runs, Runs]], between: Between) -> bool:
    """Return whether some actuators scatter more than others, by more than chance and enough to matter. What differs
    shows in both halves of an actuator's history alike, chance does not. `runs`: as in `estimate_between_runs`.
    `between`: of all of them.
    """
    halves = np.concatenate([_measure_halves(values, variances, between) for values, variances in runs])
    halves = halves[np.isfinite(halves).all(axis=1)]
    if len(halves) < FEWEST_ACTUATORS:
        return False
    covariance = np.cov(halves.T)
    unlike = covariance[0, 1] / halves.mean() ** 2  # variance of the actuators' own scatter, a square, over its mean
    chance = (covariance[0, 0] * covariance[1, 1] / len(halves)) ** 0.5
    return bool(unlike > (2.0 * UNLIKE) ** 2 and covariance[0, 1] > 3.0 * chance)


def wander(runs: Sequence[tuple[Runs, Runs]], between: Between) -> bool:
    """Return whether the halves of histories differ by more than chance, and by enough to matter to a chart. `runs`: as
    in `estimate_between_runs`, of actuators that have not changed. `between`: of all of them.
    """
    squares = np.concatenate([_compare_halves(values, variances, between) for values, variances in runs])
    squares = _select(squares)
    if squares.size < FEWEST_ACTUATORS:
        return False
    chance = ((CLIPPED_SQUARE - CLIPPED**2) / squares.size) ** 0.5
    return bool(squares.mean() > CLIPPED + max(3.0 * chance, WANDERS * CLIPPED))


def _compare_halves(values: Runs, variances: Runs, between: Between) -> Float[np.ndarray, " actuators"]:
    """Return the clipped square of the difference of the halves' means, over its variance; nan of short histories."""
    present, later = _split_halves(values)
    halves = [present & part for part in (~later, later)]
    first, second = (half / np.maximum(half.sum(axis=1, keepdims=True), 1) for half in halves)
    weights, apart = second - first, np.arange(values.shape[1])
    alike = between.std**2 * ((weights @ between.correlation ** np.abs(apart[:, None] - apart)) * weights).sum(axis=1)
    variance = between.inflation * (alike + (weights**2 * np.where(present, variances, 0.0)).sum(axis=1))
    difference = (weights * np.where(present, values, 0.0)).sum(axis=1)
    enough = present.sum(axis=1) >= FEWEST_OF_HALVES
    return np.where(enough, np.minimum(difference**2 / np.where(enough, variance, 1.0), CLIP_SQUARE), np.nan)


def _split_halves(values: Runs) -> tuple[Bool[np.ndarray, "actuators runs"], Bool[np.ndarray, "actuators runs"]]:
    """Return where there are runs (or differences of them), and which are of the second half of a history."""
    present = np.isfinite(values)
    return present, np.cumsum(present, axis=1) > present.sum(axis=1, keepdims=True) / 2


def _measure_halves(values: Runs, variances: Runs, between: Between) -> Float[np.ndarray, "actuators 2"]:
    """Return the mean clipped square of the differences in the first and the second half of each history."""
    fits = variances[:, 1:] + variances[:, :-1]
    expected = 2.0 * between.std**2 * (1.0 - between.correlation) + fits
    squares = np.minimum(np.diff(values, axis=1) ** 2 / expected, CLIP_SQUARE)
    present, later = _split_halves(squares)
    halves = [
        np.where(present & part, squares, 0.0).sum(axis=1) / (present & part).sum(axis=1) for part in (~later, later)
    ]
    return np.stack(halves, axis=1)


def _select(values: Float[np.ndarray, "..."]) -> VectorN:
    return values[np.isfinite(values)]
