r"""The bootstrap of a fit: how the parameters vary when stretches of the residuals are drawn anew.

The covariance of a fit is a formula; this is an experiment that does not use it. The residuals of each experiment are
cut into blocks at random places, all outputs at once, the blocks are put in random order, round the end of the log
(circular blocks; Politis and Romano, in: Exploring the Limits of Bootstrap, 1992), and the fit is made anew with them:
within a block their colour stays what it is. The length of the blocks follows from the residuals' correlation r
(Politis and White, Econometric Reviews 23, 2004, corrected by Patton, Politis and White, ibid. 28, 2009),

.. math:: b = \left(\tfrac32 (G/g)^2 N\right)^{1/3}, \qquad G = \sum_k \lambda_k |k|\, |r_k|, \qquad
          g = \sum_k \lambda_k |r_k|,

under their trapezoidal window :math:`\lambda`. They have r in place of its absolute value, for a mean; a parameter
weighs the residuals at the frequencies of its sensitivity, where all of their correlation may count. Blocks cut what is
correlated across their ends, so that the bootstrap's variance is low by about G/(g b).

Two ways of making the fit anew: one Gauss-Newton step from the minimum, :math:`-H^{-1} J^T r^*` (the default: no fits
are made, and a log of a minute takes a second), or a refit of model output minus :math:`r^*` from there.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from concurrent.futures import Executor
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from seaopt.errors import EstimationError, require_seed
from seaopt.estimation.problem.correlation import autocorrelation
from seaopt.estimation.problem.fit_experiment import FitExperiment, FitSegment
from seaopt.estimation.problem.fit_problem import FitProblem
from seaopt.estimation.problem.normal_equations import invert
from seaopt.estimation.problem.residual_statistics import ExperimentResiduals, ResidualsByExperiment, stream_columns
from seaopt.estimation.problem.shapes import ParameterVector, Vector
from seaopt.estimation.result.covariance import Covariance, compute_bread, compute_influence, map_to_influence
from seaopt.estimation.result.fit_result import Fit, Minimum
from seaopt.estimation.solver.least_squares import minimise
from seaopt.executors import map_ordered
from seaopt.formatting import html_text
from seaopt.records import record
from seaopt.units import unit_after

FEWEST_DRAWS = 20  # draws, below which a covariance says nothing


@record(eq=False, repr=False)
class Bootstrap:
    """Parameters after draws of the residuals; ``print(bootstrap)`` is a table.

    Parameters
    ----------
    names, units : tuple of str
        The free parameters of the plants.
    estimates : array, shape (p,)
        The fit's values.
    draws : array, shape (n, p)
        Values after each draw.
    blocks : mapping of experiment to int
        Length of the blocks, in samples.
    refit : bool
        Whether each draw was a fit, or one step.
    reference : Covariance
        The fit's own, for comparison.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    estimates: ParameterVector
    draws: Float[np.ndarray, "n p"]
    blocks: Mapping[str, int]
    refit: bool
    reference: Covariance

    @property
    def covariance(self) -> Covariance:
        """Covariance of the draws."""
        return Covariance(names=self.names, matrix=np.atleast_2d(np.cov(self.draws, rowvar=False)))

    def std(self, name: str) -> float:
        """Return the standard deviation of one parameter."""
        return self.covariance.std(name)

    def interval(self, name: str, level: float = 0.95) -> tuple[float, float]:
        """Return the percentile interval of one parameter."""
        tail = 50.0 * (1.0 - level)
        low, high = np.percentile(self.draws[:, self.names.index(name)], [tail, 100.0 - tail])
        return float(low), float(high)

    def to_dict(self) -> dict[str, Any]:
        """Return the content as numbers, lists and text."""
        return {
            "names": list(self.names),
            "draws": len(self.draws),
            "refit": self.refit,
            "blocks": dict(self.blocks),
            "covariance": self.covariance.matrix,
            "parameters": {
                name: {"value": value, "unit": unit, "std": self.std(name), "ci95": list(self.interval(name))}
                for name, unit, value in zip(self.names, self.units, self.estimates.tolist(), strict=True)
            },
        }

    def __repr__(self) -> str:
        how = "refits" if self.refit else "steps from the minimum"
        cut = ", ".join(f"{name} {length}" for name, length in self.blocks.items())
        lines = [f"Bootstrap: {len(self.draws)} {how}; blocks of residuals, in samples: {cut}"]
        for name, unit, value in zip(self.names, self.units, self.estimates, strict=True):
            low, high = self.interval(name)
            lines.append(
                f"  {name} = {value:.6g}{unit_after(unit)}: std {self.std(name):.2g} "
                f"(the fit says {self.reference.std(name):.2g}), 95 % of the draws {low:.6g} to {high:.6g}"
            )
        return "\n".join(lines)

    _repr_html_ = html_text


def bootstrap(
    fit: Fit,
    draws: int = 200,
    seed: int = 0,
    *,
    refit: bool = False,
    block: int | None = None,
    executor: Executor | None = None,
) -> Bootstrap:
    """Return how the parameters vary when blocks of the residuals are resampled (`Bootstrap`).

    Parameters
    ----------
    fit : Fit
        As `fit` returned it.
    draws : int
        How many; the std of a std from n draws is 1/sqrt(2 n) of it, 5 % for 200.
    seed : int
        Of the draws.
    refit : bool
        Make a fit for each draw, from the minimum, instead of one Gauss-Newton step: slower; it includes nonlinearity.
    block : int, optional
        Length of the blocks in samples; from the residuals' correlation if left out.
    executor : concurrent.futures.Executor, optional
        Where refits are made; here, if left out. The numbers are the same, bit for bit (`seaopt.executors`).

    Raises
    ------
    EstimationError
        The fit was read from a file, or does not identify some parameter; fewer than 20 draws; `refit` of prediction
        errors, which cannot be added to a simulation.

    Examples
    --------
    >>> import seaopt as so
    >>> from seaopt.bench import PAPER_STAND, Sensors, virtual_log
    >>> from seaopt.estimation import bootstrap
    >>> plant, truth = so.plants.high_impedance(), so.plants.thor()
    >>> log = virtual_log(plant, truth, PAPER_STAND, duration_s=20, rate_hz=400, seed=1,
    ...                   sensors=Sensors(noise_std={"F1": 2.0, "F2": 2.0}))
    >>> fit = so.fit([so.Experiment(plant=plant, log=log, outputs=("F1", "F2"))], truth.free("J", "b_r"))
    >>> 0.7 < bootstrap(fit).std("J") / fit.covariance.std("J") < 1.3
    True
    """
    minimum = fit.require_minimum("bootstrap")
    problem = minimum.problem
    _check(fit, problem, draws, refit, block)
    residuals = minimum.residuals()
    rng = np.random.default_rng(require_seed(seed, EstimationError))
    names = problem.shared_names
    blocks: dict[str, _ResidualBlocks] = {}
    for name, residual in residuals.items():
        used = _find_used_rows(residual)
        pool, count = _make_pool(residual, problem, refit), int(np.count_nonzero(used))
        length = min(block or estimate_block_length(residual.weighted[used]), max(count // 2, 1))
        starts = rng.integers(0, len(pool), size=(draws, -(-len(residual.raw) // length)))
        blocks[name] = _ResidualBlocks(pool=pool, length=length, starts=starts)
    if refit:
        values = _draw_refits(minimum, residuals, blocks, draws, rng, executor)
    else:
        values = _draw_steps(minimum, blocks, draws, rng)
    return Bootstrap(
        names=names,
        units=tuple(fit.parameters[name].unit for name in names),
        estimates=minimum.z[: len(names)],
        draws=values,
        blocks={name: each.length for name, each in blocks.items()},
        refit=refit,
        reference=fit.covariance,
    )


def _check(fit: Fit, problem: FitProblem, draws: int, refit: bool, block: int | None) -> None:
    if draws < FEWEST_DRAWS:
        raise EstimationError(f"bootstrap: draws = {draws} are too few for a covariance; give {FEWEST_DRAWS} or more")
    if block is not None and block < 1:
        raise EstimationError(f"bootstrap: block = {block} samples; give 1 or more, or leave it out")
    if fit.identifiability.rank < fit.identifiability.free:
        raise EstimationError(f"bootstrap: {fit.message}")
    if refit and problem.predicts:
        raise EstimationError(
            "bootstrap: refit=True needs a simulation's residuals, and this fit has errors of prediction: leave it out"
        )


def _find_used_rows(residuals: ExperimentResiduals) -> Bool[np.ndarray, " n"]:
    """Return which samples counted in some output."""
    return np.any(residuals.weighted != 0.0, axis=1)


def estimate_block_length(residual: Float[np.ndarray, "n ny"]) -> int:
    """Return the length of blocks that leaves the colour of a residual, of the output that needs the longest."""
    n = len(residual)
    quiet, most = max(5, int(np.sqrt(np.log10(max(n, 10))))), min(int(3.0 * np.sqrt(n)), n // 3)
    longest = 1.0
    for o in range(residual.shape[1]):
        r = autocorrelation(residual[:, o], min(int(np.sqrt(n)) * 4, n - 1))
        small = np.abs(r[1:]) < 2.0 * np.sqrt(np.log10(max(n, 10)) / n)
        run = np.convolve(small, np.ones(quiet), "valid")
        still = int(np.argmax(run == quiet)) if np.any(run == quiet) else r.size // 2
        if not still:
            continue
        k = np.arange(1, min(2 * still, r.size - 1) + 1)
        window = np.clip(2.0 * (1.0 - k / (2.0 * still)), 0.0, 1.0)
        g = 1.0 + 2.0 * float(np.sum(window * np.abs(r[k])))
        moment = 2.0 * float(np.sum(window * k * np.abs(r[k])))
        longest = max(longest, (1.5 * (moment / g) ** 2 * n) ** (1.0 / 3.0))
    return int(min(np.ceil(longest), max(most, 1)))


def _make_pool(residuals: ExperimentResiduals, problem: FitProblem, raw: bool) -> Float[np.ndarray, "m ny"]:
    """Return residuals to draw from, raw or weighted by the loss: without mean, scaled up for missing samples."""
    used = _find_used_rows(residuals)
    whole = residuals.raw[used] if raw else problem.loss.slope(residuals.weighted[used])
    present = np.isfinite(whole) & (whole != 0.0)
    share = np.maximum(np.mean(present, axis=0), 1e-300)
    mean = np.sum(np.where(present, whole, 0.0), axis=0) / np.maximum(np.sum(present, axis=0), 1)
    return np.where(present, whole - mean, 0.0) / np.sqrt(share)


@record(eq=False)
class _ResidualBlocks:
    """The draws of an experiment: residuals to draw from, the length of blocks, and where they start."""

    pool: Float[np.ndarray, "m ny"]
    length: int
    starts: Int[np.ndarray, "draws b"]

    def draw(self, d: int, rows: Int[np.ndarray, " n"]) -> Float[np.ndarray, "n ny"]:
        """Return the residuals that draw d puts at `rows`."""
        return self.pool[(self.starts[d][rows // self.length] + rows % self.length) % len(self.pool)]


def _draw_steps(
    minimum: Minimum, blocks: Mapping[str, _ResidualBlocks], draws: int, rng: np.random.Generator
) -> Float[np.ndarray, "draws p"]:
    """Return one Gauss-Newton step per draw."""
    problem, z = minimum.problem, minimum.z
    p, prior = problem.unknowns.shared, problem.unknowns.prior_std**-1.0
    hessian = problem.evaluate(z).hessian if problem.loss.quadratic else compute_bread(problem, z)
    inverse = invert(hessian)[0][:, :p]
    moved = (rng.normal(size=(draws, z.size)) * prior) @ inverse
    for experiment in problem.experiments:
        first = 0
        for segment in experiment.segments:
            into = map_to_influence(experiment, segment, inverse)
            for rows, columns, used in stream_columns(experiment, segment, z):
                flat = compute_influence(columns, used, into).transpose(2, 0, 1).reshape(-1, p)
                at = first + np.arange(rows.start, rows.start + len(columns))
                for d in range(draws):
                    moved[d] += blocks[experiment.name].draw(d, at).ravel() @ flat
            first += segment.samples.n
    return z[:p] - moved


def _draw_refits(
    minimum: Minimum,
    residuals: ResidualsByExperiment,
    blocks: Mapping[str, _ResidualBlocks],
    draws: int,
    rng: np.random.Generator,
    executor: Executor | None,
) -> Float[np.ndarray, "draws p"]:
    """Return one fit per draw, of the model's outputs with the drawn residuals, from the minimum."""
    problem, z = minimum.problem, minimum.z
    unknowns, p = problem.unknowns, problem.unknowns.shared
    prior_std = np.where(np.isfinite(unknowns.prior_std), unknowns.prior_std, 0.0)

    def make_trials() -> Iterator[tuple[FitProblem, Vector]]:
        for d in range(draws):
            experiments = tuple(
                _with_drawn(experiment, residuals[experiment.name], blocks[experiment.name], d)
                for experiment in problem.experiments
            )
            start = z + prior_std * rng.normal(size=z.size)
            yield replace(problem, experiments=experiments, unknowns=replace(unknowns, start=start)), z

    values: list[ParameterVector] = []
    for d, (cost, best) in enumerate(map_ordered(_refit, make_trials(), executor)):
        if not np.isfinite(cost):
            raise EstimationError(f"bootstrap: draw {d} overflows the simulation; use refit = False")
        values.append(best[:p])
    return np.array(values)


def _refit(trial: tuple[FitProblem, Vector]) -> tuple[float, Vector]:
    """Return the least cost of a problem, searched from a point, and where it is."""
    problem, z = trial
    solution = minimise(problem, z, problem.unknowns.low, problem.unknowns.high)
    return float(solution.evaluation.cost), solution.z


def _with_drawn(
    experiment: FitExperiment, residuals: ExperimentResiduals, blocks: _ResidualBlocks, d: int
) -> FitExperiment:
    """Return the experiment as if the model's outputs with the residuals of a draw had been measured."""
    first, segments = 0, list[FitSegment]()
    for segment, row in zip(experiment.segments, residuals.segments, strict=True):
        rows = np.arange(first, first + segment.samples.n)
        y = np.column_stack(segment.samples.y) + row.raw - blocks.draw(d, rows)
        measured = tuple(np.ascontiguousarray(column) for column in y.T)
        segments.append(replace(segment, samples=replace(segment.samples, y=measured)))
        first += rows.size
    return replace(experiment, segments=tuple(segments))
