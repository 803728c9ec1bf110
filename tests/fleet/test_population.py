"""Empirical Bayes over a fleet: against closed forms, a brute-force likelihood, and the truth of simulated fleets."""

from __future__ import annotations

from typing import Any

import numpy as np
import polars as pl
import pytest
from jaxtyping import Float
from scipy.optimize import minimize

from seaopt.errors import SeaoptError
from seaopt.fleet import Fleet, Population, estimate_population
from seaopt.fleet.plan import name_correlation

NAMES = ("J", "b_r")
CORRELATION = -0.6  # of the errors of a fit
MEAN = np.array([-50.0, -20.0])  # no logarithms are taken


def make_fleet(seed: int, actuators: int, runs: int = 1, within: float = 0.0) -> tuple[Fleet, Float[np.ndarray, "k 2"]]:
    """Return a fleet of logs of unlike lengths and its truth: stds of 1 and 2 between actuators, correlated by 0.5."""
    rng = np.random.default_rng(seed)
    between = np.array([[1.0, 1.0], [1.0, 4.0]])
    truth = MEAN + rng.multivariate_normal(np.zeros(2), between, actuators)
    whose = np.repeat(np.arange(actuators), runs)
    stds = rng.uniform(0.5, 3.0, whose.size)[:, None] * np.array([1.0, 1.5])
    errors = rng.multivariate_normal(np.zeros(2), [[1.0, CORRELATION], [CORRELATION, 1.0]], whose.size)
    values = truth[whose] + within * rng.normal(size=(whose.size, 2)) + stds * errors
    return tabulate(values, stds, whose), truth


def tabulate(values: Float[np.ndarray, "n 2"], stds: Float[np.ndarray, "n 2"], whose: Any) -> Fleet:
    rows: dict[str, Any] = {"log": [f"{k:05d}.csv" for k in range(len(values))], "status": "met"}
    rows |= {"unit": [f"{one:04d}" for one in whose], name_correlation(*NAMES): CORRELATION}
    for k, name in enumerate(NAMES):
        rows |= {name: values[:, k], f"{name}_std": stds[:, k]}
    units: dict[str, str] = dict.fromkeys(NAMES, "-")
    return Fleet(rows=pl.DataFrame(rows), units=units, identity=("unit",), fitted=NAMES, free=NAMES)


def collect(population: Population, what: str) -> Float[np.ndarray, "k 2"]:
    return population.table.select(f"{name}{what}" for name in NAMES).to_numpy()


def test_posterior_and_covariances_are_those_of_brute_force() -> None:
    fleet, _ = make_fleet(3, 40)
    population = estimate_population(fleet)
    values, stds = fleet.rows.select(NAMES).to_numpy(), fleet.rows.select("J_std", "b_r_std").to_numpy()
    fits = np.array([np.outer(s, s) * [[1.0, CORRELATION], [CORRELATION, 1.0]] for s in stds])

    def unfold(z: Any) -> Any:
        factor = np.array([[np.exp(z[0]), 0.0], [z[1], np.exp(z[2])]])
        return factor @ factor.T

    def cost(z: Any) -> float:  # minus the logarithm of restricted likelihood times |T|
        total = np.linalg.inv(unfold(z) + fits)
        information = total.sum(axis=0)
        mean = np.linalg.solve(information, np.einsum("kij,kj->i", total, values))
        away = values - mean
        logs = -np.linalg.slogdet(total)[1].sum() + np.linalg.slogdet(information)[1]
        return 0.5 * (logs + np.einsum("ki,kij,kj->", away, total, away)) - np.linalg.slogdet(unfold(z))[1]

    best = unfold(minimize(cost, np.zeros(3), method="Nelder-Mead", options={"xatol": 1e-8, "fatol": 1e-11}).x)
    assert population.between == pytest.approx(best, rel=1e-2, abs=1e-2)
    total = np.linalg.inv(best + fits)
    mean = np.linalg.solve(total.sum(axis=0), np.einsum("kij,kj->i", total, values))
    posterior = mean + np.einsum("ij,kjl,kl->ki", best, total, values - mean)
    assert collect(population, "") == pytest.approx(posterior, abs=0.02)
    assert np.all(population.within == 0.0)


@pytest.mark.slow
@pytest.mark.parametrize(("runs", "within"), [(1, 0.0), (4, 1.0)])
def test_intervals_hold_the_truth_and_values_are_closer_to_it(runs: int, within: float) -> None:
    inside, errors, own = [], [], []
    for seed in range(25):
        fleet, truth = make_fleet(seed, 30, runs, within)
        population = estimate_population(fleet)
        inside.append((collect(population, "_low") <= truth) & (truth <= collect(population, "_high")))
        errors.append((collect(population, "") - truth) ** 2)
        own.append((collect(population, "_own") - truth) ** 2)
    assert 0.93 <= np.mean(inside) <= 0.97
    assert np.all(np.mean(errors, axis=(0, 1)) < 0.75 * np.mean(own, axis=(0, 1)))


def test_what_differs_from_run_to_run_is_told_from_what_differs_between_actuators() -> None:
    population = estimate_population(make_fleet(1, 300, 4, 1.5)[0])
    assert np.diag(population.between) == pytest.approx([1.0, 4.0], rel=0.35)
    assert np.diag(population.within) == pytest.approx([2.25, 2.25], rel=0.2)
    assert population.mean == pytest.approx(MEAN, abs=0.4)


def test_positive_parameters_are_taken_by_their_logarithms_where_they_are_known() -> None:
    rng = np.random.default_rng(2)
    values = np.exp(rng.normal([0.0, 5.0], 0.3, size=(40, 2)))
    population = estimate_population(tabulate(values, values * np.array([0.02, 0.9]), range(40)))
    assert population.logarithmic == (True, False)
    low, value, high = (collect(population, what)[:, 0] for what in ("_low", "", "_high"))
    assert value == pytest.approx(np.sqrt(low * high), rel=1e-9) and np.all(low > 0)


def test_logs_that_failed_are_not_met_or_tell_nothing_are_left_out() -> None:
    fleet, _ = make_fleet(5, 20)
    rows = fleet.rows.with_row_index("k").with_columns(
        status=pl.when(pl.col("k") == 3)
        .then(pl.lit("not met"))
        .when(pl.col("k").is_in([4, 5]))
        .then(pl.lit("failed"))
        .otherwise("status"),
        J_std=pl.when(pl.col("k") == 7).then(float("inf")).otherwise("J_std"),
    )
    population = estimate_population(Fleet(rows=rows, units=fleet.units, identity=("unit",), free=NAMES))
    assert population.left_out == {"failed": 2, "not met": 1, "not identified": 1} and len(population.table) == 16


@pytest.mark.parametrize("options", [{"parameters": ["m_k"]}, {"actuator": ["robot"]}])
def test_what_is_refused(options: Any) -> None:
    with pytest.raises(SeaoptError):
        estimate_population(make_fleet(1, 20)[0], **options)


def test_too_few_actuators_are_refused() -> None:
    with pytest.raises(SeaoptError, match="5 are needed"):
        estimate_population(make_fleet(1, 4)[0])
