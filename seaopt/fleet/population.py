r"""A fleet as a population: how its actuators differ, and each one's parameters with what its siblings tell.

Log j of actuator i has the estimates :math:`y_{ij}` with the covariance :math:`S_{ij}` of its fit,

.. math:: y_{ij} = \theta_i + u_{ij} + e_{ij}, \quad \theta_i \sim N(\mu, T), \quad u_{ij} \sim N(0, R), \quad
    e_{ij} \sim N(0, S_{ij})

with what differs between actuators, T, and from run to run, R. The logs of an actuator together are
:math:`\bar y_i \sim N(\theta_i, V_i)`, :math:`V_i = (\sum_j (S_{ij} + R)^{-1})^{-1}`, and given T and R its posterior
is normal:

.. math:: m_i = \mu + B_i (\bar y_i - \mu), \quad B_i = T (T + V_i)^{-1}, \quad
    C_i = T - B_i T + (I - B_i) W (I - B_i)^T

with mu by generalised least squares and W its covariance: empirical Bayes (Efron and Morris 1975; Lindley and Smith
1972). A short log, of large V, is drawn towards its siblings, along the directions in which it tells little.

T and R are where the restricted likelihood, of residuals after mu, is largest, by expectation maximisation (Dempster,
Laird and Rubin 1977; Laird and Ware 1982). Where actuators are few that is often a T of zero in some direction, and
intervals that are too narrow. So the likelihood is multiplied by :math:`|T|` and :math:`|R|`, which keeps them from
zero (Morris and Tang 2011; Chung et al. 2015), and the variance of m_i by the sampling error of T is added to C_i, to
first order (Kass and Steffey 1989).

A parameter that is positive and known well enough is taken by its logarithm, in which stds are relative and intervals
end above zero; the others are taken as they are.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations
from typing import Any

import numpy as np
import polars as pl
from jaxtyping import Float, Int

from seaopt.codec import to_content
from seaopt.errors import SeaoptError
from seaopt.fleet.history import LABEL, check_names, leave_out, order_runs
from seaopt.fleet.plan import name_correlation
from seaopt.fleet.result import Fleet
from seaopt.fleet.worker import FAILED, MET
from seaopt.formatting import format_count, format_number
from seaopt.records import Worded, record
from seaopt.signals import VectorK

# Of p parameters: one vector or matrix, and those of n logs.
Vector = Float[np.ndarray, " p"]
Square = Float[np.ndarray, "p p"]
Vectors = Float[np.ndarray, "n p"]
Squares = Float[np.ndarray, "n p p"]

CONFIDENT = 1.959964  # standard deviations of a 95 % interval
RELATIVE = 0.25  # std over value, up to which a positive parameter is taken by its logarithm
ADJUSTED = 2  # what the factor |T| of the likelihood takes from the number that a mean square is divided by
SPARE = 3  # actuators beyond the number of parameters, at least
MOST_LOGS = 4000  # that T and R are estimated from; of larger fleets every second, third, ... actuator is taken
ITERATIONS, SETTLED = 2000, 1e-5  # of expectation maximisation; relative change at which it ends


@record(eq=False, repr=False)
class Population(Worded):
    """The result of `estimate_population`; ``print(population)`` is a summary.

    Parameters
    ----------
    names : tuple of str
        Parameters.
    units : mapping of name to unit
    logarithmic : tuple of bool
        Which of them are taken by their logarithms; mean, between and within are of these then.
    mean : array
        Of the actuators.
    between, within : array
        Covariances T, between actuators, and R, between runs of one; R is zero where no actuator has several logs.
    table : polars.DataFrame
        One row per actuator: logs, and for each parameter NAME the posterior value, NAME_std, NAME_low and NAME_high
        (95 %), and NAME_own with NAME_own_std from its own logs alone.
    left_out : mapping of reason to int
        Logs that are not used.
    """

    json_keys = ("names", "units", "logarithmic", "mean", "between", "within", "actuators", "left_out")

    names: tuple[str, ...]
    units: Mapping[str, str]
    logarithmic: tuple[bool, ...]
    mean: Vector
    between: Square
    within: Square
    table: pl.DataFrame
    left_out: Mapping[str, int]

    @property
    def actuators(self) -> int:
        """How many it is of."""
        return len(self.table)

    def describe(self) -> list[tuple[str, ...]]:
        """Return of each parameter name, unit, mean, and its std between actuators and between runs."""
        rows: list[tuple[str, ...]] = []
        for k, name in enumerate(self.names):
            center = float(np.exp(self.mean[k])) if self.logarithmic[k] else float(self.mean[k])
            scale = center if self.logarithmic[k] else 1.0
            between, within = (scale * float(matrix[k, k]) ** 0.5 for matrix in (self.between, self.within))
            rows.append((name, self.units[name], *map(format_number, (center, between, within))))
        return rows

    def to_dict(self) -> dict[str, Any]:
        """Return the content of the part population of fleet.json."""
        return to_content(self)


PARTS = ("", "_std", "_low", "_high", "_own", "_own_std")  # columns of a parameter


@record(eq=False)
class _Logs:
    """Estimates of n logs of k actuators in scaled coordinates."""

    values: Vectors
    covariances: Squares
    whose: Int[np.ndarray, " n"]  # actuators, from 0, each with a log at least

    @property
    def actuators(self) -> int:
        """How many."""
        return int(self.whose[-1]) + 1

    def add_up(self, values: Float[np.ndarray, "n ..."]) -> Float[np.ndarray, "k ..."]:
        """Return sums over each actuator's logs, which stand together."""
        return np.add.reduceat(values, np.flatnonzero(np.diff(self.whose, prepend=-1)), axis=0)


@record(eq=False)
class _Posterior:
    """The posterior of the actuators, given T and R."""

    mean: Vector  # mu
    mean_covariance: Square  # W
    pooled: Float[np.ndarray, "k p"]  # their logs together
    pooled_covariances: Float[np.ndarray, "k p p"]  # V
    shrinkage: Float[np.ndarray, "k p p"]  # B
    values: Float[np.ndarray, "k p"]
    covariances: Float[np.ndarray, "k p p"]


def estimate_population(
    fleet: Fleet,
    *,
    actuator: Sequence[str] | None = None,
    time: Sequence[str] | None = None,
    parameters: Sequence[str] | None = None,
) -> Population:
    """Return how actuators differ, and each one's parameters, for which a short log borrows from its siblings.

    Logs that failed, that are not met, or that leave a parameter or covariance open, are left out, and counted.

    Parameters
    ----------
    fleet : Fleet
        Of actuators of one kind.
    actuator, time : sequence of str, optional
        Columns of the identity, as in `find_drift`.
    parameters : sequence of str, optional
        Free parameters; all of them, if left out.

    Raises
    ------
    SeaoptError
        A parameter is not free in the fits, or the actuators are too few: three more than parameters are needed.

    Notes
    -----
    Priors (`prior_std`) are in every fit already: borrowed from the siblings, they count once for each. Leave them out
    where the fleet is large enough to tell.

    Examples
    --------
    Thirty actuators that differ by 5 %, with a log of each that tells its inertia to 10 %:

    >>> rng = np.random.default_rng(0)
    >>> truth = 3e-6 * np.exp(0.05 * rng.normal(size=30))
    >>> J = truth * (1.0 + 0.1 * rng.normal(size=30))
    >>> rows = pl.DataFrame({"log": [f"{i}.csv" for i in range(30)], "status": "met", "J": J, "J_std": 0.1 * truth})
    >>> fleet = Fleet(rows=rows, units={"J": "kg m^2"}, fitted=("J",), free=("J",))
    >>> shrunk = estimate_population(fleet).table["J"].to_numpy()
    >>> [round(float(np.std(values / truth)), 2) for values in (J, shrunk)]
    [0.09, 0.05]
    """
    wanted = fleet.free if parameters is None else parameters
    names = check_names(wanted, fleet.free, "parameters", "free parameter of the fleet")
    if not names:
        raise SeaoptError("no parameter of the fleet is free; give one free = true in the problem file")
    history = order_runs(fleet, actuator, time)
    rows, left_out = _select_rows(history.rows, names)
    count = rows[LABEL].n_unique()
    if count < len(names) + SPARE:
        raise SeaoptError(
            f"{format_count(count, 'actuator')} with logs that are met are too few to tell how {len(names)} parameters "
            f"differ; {len(names) + SPARE} are needed, or fewer parameters"
        )
    logs, logarithmic, offset, scale = _prepare(rows, names)
    between, within = _estimate_covariances(_thin(logs))
    posterior = _infer(logs, between, within)
    covariances = posterior.covariances + _propagate_sampling(posterior, between, _thin(logs).actuators)
    labels = rows[LABEL].unique(maintain_order=True).to_list()
    columns: dict[str, Any] = {"actuator": labels, "logs": logs.add_up(np.ones(len(rows), dtype=int))}
    for k, name in enumerate(names):
        shrunk = posterior.values[:, k] * scale[k] + offset[k], np.sqrt(covariances[:, k, k]) * scale[k]
        alone = posterior.pooled[:, k] * scale[k] + offset[k], np.sqrt(posterior.pooled_covariances[:, k, k]) * scale[k]
        parts = (*_restore(*shrunk, logarithmic[k]), *_restore(*alone, logarithmic[k])[:2])
        columns |= dict(zip((f"{name}{part}" for part in PARTS), parts, strict=True))
    outer = np.outer(scale, scale)
    return Population(
        names=names,
        units={name: fleet.units[name] for name in names},
        logarithmic=logarithmic,
        mean=posterior.mean * scale + offset,
        between=between * outer,
        within=within * outer,
        table=pl.DataFrame(columns),
        left_out=left_out,
    )


def _select_rows(rows: pl.DataFrame, names: Sequence[str]) -> tuple[pl.DataFrame, dict[str, int]]:
    """Return the logs that tell all of the parameters, and how many are left out for which reason."""
    pairs = [name_correlation(*pair) for pair in combinations(names, 2)]
    needed = [name for name in (*names, *(f"{name}_std" for name in names), *pairs) if name in rows.columns]
    conditions = {
        "failed": pl.col("status") != FAILED,
        "not met": pl.col("status") == MET,
        "not identified": pl.all_horizontal(pl.col(name).is_not_null() & pl.col(name).is_finite() for name in needed),
        "certain": pl.all_horizontal(pl.col(f"{name}_std") > 0.0 for name in names),
    }
    return leave_out(rows, conditions)


def _prepare(rows: pl.DataFrame, names: Sequence[str]) -> tuple[_Logs, tuple[bool, ...], Vector, Vector]:
    """Return the logs in coordinates of about unit size, which of these are logarithms, their offsets and scales."""
    values = rows.select(names).to_numpy().astype(float)
    stds = rows.select(f"{name}_std" for name in names).to_numpy().astype(float)
    correlations = np.empty((len(rows), len(names), len(names)))
    correlations[:] = np.eye(len(names))
    for i, j in combinations(range(len(names)), 2):
        correlations[:, i, j] = correlations[:, j, i] = rows[name_correlation(names[i], names[j])].to_numpy()
    positive = np.all(values > 0.0, axis=0)
    relative = stds / np.where(positive, values, 1.0)
    logarithmic = positive & (np.quantile(relative, 0.9, axis=0) < RELATIVE)
    values = np.where(logarithmic, np.log(np.where(logarithmic, values, 1.0)), values)
    stds = np.where(logarithmic, relative, stds)
    offset = np.median(values, axis=0)
    scale = np.sqrt(np.median((values - offset) ** 2 + stds**2, axis=0))
    values, stds = (values - offset) / scale, stds / scale
    _, whose = np.unique(rows[LABEL].rle_id().to_numpy(), return_inverse=True)
    logs = _Logs(values=values, covariances=correlations * stds[:, :, None] * stds[:, None, :], whose=whose)
    return logs, tuple(logarithmic.tolist()), offset, scale


def _thin(logs: _Logs) -> _Logs:
    """Return every so many actuators of a large fleet: what they differ by is as well known from some thousand."""
    step = -(-logs.whose.size // MOST_LOGS)
    kept = logs.whose % step == 0
    if step == 1 or logs.actuators // step < SPARE + logs.values.shape[1]:
        return logs
    return _Logs(values=logs.values[kept], covariances=logs.covariances[kept], whose=logs.whose[kept] // step)


def _infer(logs: _Logs, between: Square, within: Square) -> _Posterior:
    """Return what is known of the actuators, given T and R."""
    weights = np.linalg.inv(logs.covariances + within)
    pooled_covariances = _mirror(np.linalg.inv(logs.add_up(weights)))
    pooled = _times(pooled_covariances, logs.add_up(_times(weights, logs.values)))
    precisions = np.linalg.inv(pooled_covariances + between)
    mean_covariance = np.linalg.inv(precisions.sum(axis=0))
    mean = mean_covariance @ _times(precisions, pooled).sum(axis=0)
    shrinkage = between @ precisions
    remaining = np.eye(len(mean)) - shrinkage
    covariances = between - shrinkage @ between + remaining @ mean_covariance @ remaining.mT
    return _Posterior(
        mean=mean,
        mean_covariance=mean_covariance,
        pooled=pooled,
        pooled_covariances=pooled_covariances,
        shrinkage=shrinkage,
        values=mean + _times(shrinkage, pooled - mean),
        covariances=_mirror(covariances),
    )


def _estimate_covariances(logs: _Logs) -> tuple[Square, Square]:
    """Return T and R by expectation maximisation; R is zero where no actuator has several logs."""
    size, count = logs.values.shape[1], logs.actuators
    repeated = logs.whose.size - count > size
    between, within = 0.5 * np.eye(size), 0.5 * np.eye(size) * repeated
    for _ in range(ITERATIONS):
        posterior = _infer(logs, between, within)
        turned = posterior.shrinkage @ posterior.mean_covariance @ posterior.shrinkage.mT
        spread = between - posterior.shrinkage @ between + turned + _square(posterior.values - posterior.mean)
        new = _mirror(spread.sum(axis=0) / (count - ADJUSTED))
        within_new = _renew_within(logs, posterior, within) if repeated else within
        change = max(_compare(new, between), _compare(within_new, within) if repeated else 0.0)
        between, within = new, within_new
        if change < SETTLED:
            break
    return between, within


def _renew_within(logs: _Logs, posterior: _Posterior, within: Square) -> Square:
    """Return the next R: the expected square of what each log differs by from its actuator."""
    gain = within @ np.linalg.inv(logs.covariances + within)
    away = _square(logs.values - posterior.values[logs.whose]) + posterior.covariances[logs.whose]
    spread = within - gain @ within + gain @ away @ gain.mT
    return _mirror(spread.sum(axis=0) / (logs.whose.size - ADJUSTED))


def _propagate_sampling(posterior: _Posterior, between: Square, count: int) -> Float[np.ndarray, "k p p"]:
    """Return the covariance of the posterior values by the sampling error of T, of which REML's information tells. With
    E_a the derivative of T by its a-th entry, dm_i/dT_a = (I - B_i) E_a (T + V_i)^-1 (y_i - mu).
    """
    size = between.shape[0]
    entries = [(i, j) for i in range(size) for j in range(i, size)]
    derivatives = np.zeros((len(entries), size, size))
    for row, (i, j) in enumerate(entries):
        derivatives[row, i, j] = derivatives[row, j, i] = 1.0
    precisions = np.linalg.inv(posterior.pooled_covariances + between)
    turned = precisions[:, None] @ derivatives  # k entries p p
    information = 0.5 * np.einsum("kaij,kbji->ab", turned, turned) * (count / len(precisions))
    sampling = np.linalg.inv(information)
    remaining = np.eye(size) - posterior.shrinkage
    slopes = np.einsum("kij,ajl,kl->kia", remaining, derivatives, _times(precisions, posterior.pooled - posterior.mean))
    return slopes @ sampling @ slopes.mT


def _restore(values: VectorK, stds: VectorK, logarithmic: bool) -> tuple[VectorK, ...]:
    """Return values, stds and ends of intervals of a parameter; the std of a logarithm is relative."""
    low, high = values - CONFIDENT * stds, values + CONFIDENT * stds
    return (
        (np.exp(values), np.exp(values) * stds, np.exp(low), np.exp(high)) if logarithmic else (values, stds, low, high)
    )


def _times(matrices: Squares, vectors: Vectors) -> Vectors:
    return (matrices @ vectors[..., None])[..., 0]


def _square(vectors: Vectors) -> Squares:
    return vectors[:, :, None] * vectors[:, None, :]


def _mirror(matrices: Float[np.ndarray, "... p p"]) -> Float[np.ndarray, "... p p"]:
    return (matrices + matrices.mT) / 2


def _compare(new: Square, old: Square) -> float:
    return float(np.max(np.abs(new - old)) / np.max(np.abs(new)))
