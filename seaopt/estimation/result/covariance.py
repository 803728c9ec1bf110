r"""Covariance of a fit, honest for coloured residuals.

With residuals and derivatives in units of sigma, :math:`H = J^T J + P` (P from the priors), the covariance for white
residuals is :math:`H^{-1}`. Residuals of a real log are coloured; then

.. math:: \Sigma = H^{-1} (B + P) H^{-1}, \qquad B = \sum_{t,s} J_t^T\, R(t - s)\, J_s

with R the correlation of the residuals of all outputs, at all lags (Ljung, System Identification, 2nd ed., Sec. 9.5;
Newey and West 1987). R is estimated from the residuals under a Parzen window, whose spectral matrix is never
indefinite. A fit takes out of a short log's residuals what its parameters can follow, which leaves them anticorrelated
and would make B too small: where no lag of a short log differs from chance, lags may widen the covariance but not
narrow it. With a robust loss the residuals in B are what the loss makes of them, and J^T J counts each sample with the
loss's second derivative; for white residuals B is then E[psi^2] J^T J, psi the loss's derivative (Huber, Robust
Statistics, 1981, ch. 7).

Only the parameters' part of :math:`\Sigma` is wanted, so that the double sum is over the influence of each sample on
them, :math:`a_t = J_t H^{-1} E`, with as many columns as parameters. R of a few lags is summed in one compiled pass;
of a few thousand it acts as a filter in the frequency domain (overlap-save), chunk by chunk. Neither takes memory that
grows with the log.
Long sums are NumPy's own, or cut short: threads of the linear-algebra library cost more than they on a busy machine.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Annotated, Any

import numpy as np
from jaxtyping import Bool, Complex, Float

from seaopt.codec import NullIs
from seaopt.errors import EstimationError
from seaopt.estimation.problem.correlation import find_quick_size, parzen
from seaopt.estimation.problem.fit_experiment import CACHED_SAMPLES, FitExperiment, FitSegment
from seaopt.estimation.problem.fit_problem import FitProblem
from seaopt.estimation.problem.normal_equations import add_gram
from seaopt.estimation.problem.residual_statistics import ResidualStatistics, StatisticsByExperiment, stream_columns
from seaopt.estimation.problem.shapes import Matrix, ParameterMatrix, ParameterVector, Vector
from seaopt.records import record
from seaopt.simulation import double_sum

CHANCE_CORRELATION = 2.0  # correlations above this times sqrt(log10(n) / n) differ from chance
SINGLE_THREADED = 512  # samples of a product that the linear-algebra library does on one thread
COMPILED_LAGS = 64  # that a compiled pass sums more quickly than transforms do
SHORT_LOG = 5000  # samples, beyond which what a fit takes out of its own residuals no longer matters
SHORTEST_WINDOW, WIDER = 8, 3.0  # and a window's reach over the last lag that differs from chance


@record(eq=False)
class Covariance:
    """A covariance with names: ``matrix[i, j]`` belongs to ``names[i]``, ``names[j]``, in SI."""

    names: tuple[str, ...]
    matrix: Annotated[ParameterMatrix, NullIs(value=math.inf)]

    @classmethod
    def _from_json(cls, content: Mapping[str, Any]) -> Covariance:
        """Return the covariance of a file; refuse what is not square, or has a negative variance."""
        read = cls(**content)
        n = len(read.names)
        if read.matrix.size != n * n or (n and read.matrix.shape != (n, n)):
            raise EstimationError(f"matrix is not {n} by {n}, as names is long")
        finite = np.isfinite(np.diag(read.matrix)) if n else np.zeros(0, dtype=bool)
        least = np.linalg.eigvalsh(read.matrix[finite][:, finite]) if n else ()
        if np.any(least < -1e-9 * np.max(np.diag(read.matrix)[finite], initial=0.0)):
            raise EstimationError("has a negative variance")
        return read

    def std(self, name: str) -> float:
        """Return the standard deviation of one parameter."""
        i = self.names.index(name)
        return float(np.sqrt(max(self.matrix[i, i], 0.0)))


def take_root(covariance: ParameterMatrix) -> ParameterMatrix:
    """Return a factor of a covariance, R R^T, for draws: standard deviations times the correlation's root. The root is
    taken of the correlation, whose entries are of one size: the eigenvalues of a covariance in m, N/m and kg m^2 span
    so many decades that the small ones would be lost in rounding.
    """
    std = np.sqrt(np.diag(covariance))
    scale = np.where(std > 0.0, std, 1.0)
    values, vectors = np.linalg.eigh(covariance / scale / scale[:, None])
    return std[:, None] * vectors * np.sqrt(np.maximum(values, 0.0))


def compute_bread(problem: FitProblem, z: Vector) -> Matrix:
    """Return J^T J with the loss's second derivative as weight, and the priors."""
    bread = _sum_weighted(problem, z, lambda experiment, o, r: problem.loss.curvature(r))
    return bread + np.diag(problem.unknowns.precision)


def compute_white_meat(problem: FitProblem, z: Vector, statistics: StatisticsByExperiment) -> Matrix:
    """Return B for white residuals: J^T J with the mean square of what the loss makes of each output's residuals."""
    power = {name: np.diagonal(sums.correlation[0]) / np.maximum(sums.count, 1.0) for name, sums in statistics.items()}
    return _sum_weighted(problem, z, lambda experiment, o, r: np.full(r.size, power[experiment.name][o]))


def _sum_weighted(
    problem: FitProblem,
    z: Vector,
    weigh: Callable[[FitExperiment, int, Float[np.ndarray, " m"]], Float[np.ndarray, " m"]],
) -> Matrix:
    """Return J^T J with weights that come of the residuals, in sigma, of an experiment's output."""
    normal = np.zeros((1 + z.size, 1 + z.size))
    for experiment in problem.experiments:
        for segment in experiment.segments:
            for _, columns, used in stream_columns(experiment, segment, z):
                for o, places in enumerate(experiment.columns(segment)):
                    v = columns[:, o] / experiment.sigma[o]
                    weight = used[:, o] * weigh(experiment, o, v[:, 0])
                    add_gram(normal, (v * weight[:, None]).T @ v, places)
    return normal[1:, 1:]


def compute_meat(
    problem: FitProblem, z: Vector, inverse: Float[np.ndarray, "n p"], statistics: StatisticsByExperiment
) -> ParameterMatrix:
    """Return E^T H^-1 B H^-1 E of the module docstring, with `inverse` = H^-1 E: B for residuals of any colour."""
    p = inverse.shape[1]
    total = np.zeros((p, p))
    for experiment in problem.experiments:
        sums = statistics[experiment.name]
        r, last = estimate_correlations(sums)
        places = np.concatenate([at for segment in experiment.segments for at in experiment.columns(segment)])
        seen = np.unique(places[places >= 0])
        forms = 2 if np.max(sums.count) < SHORT_LOG and not last else 1
        if seen.size < p:  # one of many logs: its few unknowns move all that is asked for
            basis = np.zeros((len(inverse), seen.size))
            basis[seen, np.arange(seen.size)] = 1.0
            meats = inverse[seen].T @ _sum_twice(experiment, z, basis, r, forms) @ inverse[seen]
        else:
            meats = _sum_twice(experiment, z, inverse, r, forms)
        total += meats[0] if forms == 1 else _at_least(*meats)
    return total


def _sum_twice(
    experiment: FitExperiment,
    z: Vector,
    inverse: Float[np.ndarray, "n p"],
    r: Float[np.ndarray, "lags1 ny ny"],
    forms: int,
) -> Float[np.ndarray, "forms p p"]:
    """Return one experiment's part of the double sum, and of two forms of that what t = s gives."""
    total = np.zeros((forms, *(inverse.shape[1],) * 2))
    reach, chunk = len(r) - 1, max(CACHED_SAMPLES, 4 * len(r))
    pairs = [(segment, map_to_influence(experiment, segment, inverse)) for segment in experiment.segments]
    if reach <= COMPILED_LAGS:
        point, weights = experiment.point(z), experiment.weights
        sums = [
            double_sum(experiment.model, segment.samples, point, segment.start(z), weights, into, r, forms=forms)
            for segment, into in pairs
        ]
        if all(part is not None for part in sums):
            return np.sum(np.array(sums), axis=0)
    whole = _DoubleSum.make(r, reach + min(chunk, experiment.longest))
    twice, together = _DoubleSum.make(r, reach), _DoubleSum.make(r[:1], chunk)
    for segment, into in pairs:
        tail = np.zeros((*into.shape[:2], 0))
        for _, columns, used in stream_columns(experiment, segment, z, chunk):
            now = compute_influence(columns, used, into)
            with_tail = np.concatenate([tail, now], axis=2)
            total[0] += whole(with_tail) - twice(tail)
            if forms == 2:
                total[1] += together(now)
            tail = with_tail[:, :, max(with_tail.shape[2] - reach, 0) :]
    return total


def _at_least(matrix: ParameterMatrix, floor: ParameterMatrix) -> ParameterMatrix:
    """Return the floor, and of what lies beside it only the directions in which it is more."""
    scale = np.sqrt(np.maximum(np.diag(floor), 1e-300))
    values, vectors = np.linalg.eigh((matrix - floor) / np.outer(scale, scale))
    return floor + np.outer(scale, scale) * ((vectors * np.maximum(values, 0.0)) @ vectors.T)


def map_to_influence(
    experiment: FitExperiment, segment: FitSegment, inverse: Float[np.ndarray, "n p"]
) -> Float[np.ndarray, "ny p nc"]:
    """Return what takes the columns of each output to their influence on the parameters."""
    rows: list[Float[np.ndarray, "p nc"]] = []
    for o, places in enumerate(experiment.columns(segment)):
        moved = np.where(places >= 0, inverse[places].T, 0.0) / experiment.sigma[o]
        rows.append(np.hstack([np.zeros((inverse.shape[1], 1)), moved]))
    return np.array(rows)


def compute_influence(
    columns: Float[np.ndarray, "m ny nc"], used: Bool[np.ndarray, "m ny"], into: Float[np.ndarray, "ny p nc"]
) -> Float[np.ndarray, "ny p m"]:
    """Return the influence of each sample; zero where it does not count."""
    influence = np.empty((*into.shape[:2], len(columns)))
    for first in range(0, len(columns), SINGLE_THREADED):
        rows = slice(first, first + SINGLE_THREADED)
        np.matmul(into, columns[rows].transpose(1, 2, 0), out=influence[:, :, rows])
    return influence if np.all(used) else influence * used.T[:, None, :]


@record(eq=False)
class _DoubleSum:
    """The double sum over t and s of a_t' R(t - s) a_s, for stretches of a of limited length."""

    size: int
    density: Complex[np.ndarray, "ny ny f"]

    @classmethod
    def make(cls, r: Float[np.ndarray, "lags1 ny ny"], n: int) -> _DoubleSum:
        """Return the form for at most n samples."""
        reach, size = len(r) - 1, find_quick_size(n + len(r))
        kernel = np.zeros((*r.shape[1:], size))
        kernel[:, :, : reach + 1] = r.transpose(1, 2, 0)
        kernel[:, :, size - reach :] = r[:0:-1].transpose(2, 1, 0)  # R(-k) = R(k)'
        density = np.fft.rfft(kernel) * (2.0 / size)
        density[:, :, 0] *= 0.5
        if size % 2 == 0:
            density[:, :, -1] *= 0.5
        return cls(size=size, density=density)

    def __call__(self, a: Float[np.ndarray, "ny p n"]) -> ParameterMatrix:
        """Return the sum."""
        ny, p, n = a.shape
        if not n:
            return np.zeros((p, p))
        spectrum = np.fft.rfft(a, self.size)
        density, total = self.density[:, :, None], np.zeros((p, p))
        for o in range(ny):
            filtered: Complex[np.ndarray, "p f"] = np.zeros_like(spectrum[o])
            for b in range(ny):
                filtered += density[o, b] * spectrum[b]
            total += np.einsum("if,jf->ij", spectrum[o].view(float), filtered.view(float))
        return total


def estimate_correlations(statistics: ResidualStatistics) -> tuple[Float[np.ndarray, "lags1 ny ny"], int]:
    """Return R(k)[a, b] = correlation of r_a(t) with r_b(t - k), k = 0..lags, under a Parzen window, and the last lag.
    The last lag is that at which correlation differs from chance. The window reaches three times as far (after Politis,
    J. Nonparametric Statistics 15, 2003): a longer one would let noise in, which makes intervals too narrow.
    """
    count = np.maximum(statistics.count, 1.0)
    r = statistics.correlation.transpose(1, 2, 0) / np.sqrt(np.outer(count, count))[:, :, None]
    last = _find_last_lag(r, float(np.max(count)))
    reach = min(max(SHORTEST_WINDOW, int(WIDER * last)), r.shape[2] - 1)
    return (r[:, :, : reach + 1] * parzen(reach)).transpose(2, 0, 1), last


def _find_last_lag(r: Float[np.ndarray, "ny ny lags1"], count: float) -> int:
    """Return the last lag before a run of lags at which no correlation differs from chance; 0 if there is none."""
    power = np.sqrt(np.maximum(np.diagonal(r[:, :, 0]), 1e-300))
    size = np.max(np.abs(r) / np.outer(power, power)[:, :, None], axis=(0, 1))[1:]
    seen = np.flatnonzero(size > CHANCE_CORRELATION * np.sqrt(np.log10(max(count, 10.0)) / max(count, 1.0)))
    run = max(20, int(np.sqrt(count) / 2))
    before = np.concatenate([[-1], seen])
    quiet = np.flatnonzero(np.diff(np.append(before, size.size + run)) > run)
    return int(before[quiet[0]]) + 1


def mark_unseen(matrix: ParameterMatrix, unseen: ParameterVector) -> ParameterMatrix:
    """Return a covariance in which what is not seen has infinite variance."""
    lost = unseen > 1e-6
    marked = 0.5 * (matrix + matrix.T)
    marked[lost, :] = marked[:, lost] = np.inf
    return marked


def measure_colour(coloured: Covariance, white: Covariance) -> float:
    """Return how many times more than for white residuals estimates vary: at least once."""
    variances, if_white = np.diag(coloured.matrix), np.diag(white.matrix)
    finite = np.isfinite(variances) & np.isfinite(if_white) & (if_white > 0.0)
    return float(np.max(variances[finite] / if_white[finite], initial=1.0))
