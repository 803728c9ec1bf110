"""Empirical Bayes over simulated fleets, coverage and error: python benchmarks/bench_population.py [INTERVALS].

Fleets of three parameters, whose fits have unlike and correlated errors: how many of the intervals of 95 % hold the
truth, and the mean squared error over that of the logs of each actuator alone.
"""

from __future__ import annotations

import sys
import time
from itertools import combinations

import numpy as np
import polars as pl

from seaopt.fleet import Fleet, estimate_population
from seaopt.fleet.plan import name_correlation

NAMES = ("J", "b_r", "K_tau")
MEANS = np.array([3e-6, 2e-4, 0.06])
ALIKE = np.array([[1.0, 0.5, 0.0], [0.5, 1.0, -0.3], [0.0, -0.3, 1.0]])  # correlations between actuators
ERRORS = np.array([[1.0, -0.6, 0.3], [-0.6, 1.0, 0.0], [0.3, 0.0, 1.0]])  # and of the errors of a fit
PART = np.array([0.06, 0.1, 0.05])  # relative stds of a fit of middling length
USUAL, CLOSE, WIDE = (0.05, 0.1, 0.03), (0.005, 0.01, 0.003), (0.2, 0.4, 0.1)  # relative stds between actuators
RUN = (0.03, 0.05, 0.01)  # and between runs
LENGTHS = 3.0  # stds of fits are up to so many times larger and smaller


def make_fleet(rng: np.random.Generator, actuators: int, runs: int, between, within, noise: float):
    """Return a fleet, and the truth."""
    truth = MEANS * np.exp(rng.multivariate_normal(np.zeros(3), ALIKE * np.outer(between, between), actuators))
    whose = np.repeat(np.arange(actuators), runs)
    stds = noise * PART * MEANS * np.exp(rng.uniform(-1.0, 1.0, (whose.size, 1)) * np.log(LENGTHS))
    values = truth[whose] * np.exp(np.array(within) * rng.normal(size=(whose.size, 3)))
    values = values + stds * rng.multivariate_normal(np.zeros(3), ERRORS, whose.size)
    columns = {"log": [f"{k:06d}" for k in range(whose.size)], "status": "met", "unit": [f"{k:05d}" for k in whose]}
    for k, name in enumerate(NAMES):
        columns |= {name: values[:, k], f"{name}_std": stds[:, k]}
    for i, j in combinations(range(3), 2):
        columns |= {name_correlation(NAMES[i], NAMES[j]): ERRORS[i, j]}
    fleet = Fleet(
        rows=pl.DataFrame(columns), units=dict.fromkeys(NAMES, "-"), identity=("unit",), fitted=NAMES, free=NAMES
    )
    return fleet, truth


def check(intervals: int, actuators: int, runs: int = 1, between=USUAL, within=(0.0, 0.0, 0.0), noise: float = 1.0):
    inside, errors, own = [], [], []
    for seed in range(max(10, intervals // actuators)):
        fleet, truth = make_fleet(np.random.default_rng([seed, actuators]), actuators, runs, between, within, noise)
        table = estimate_population(fleet).table
        low, high, value, alone = (
            table.select(f"{name}{part}" for name in NAMES).to_numpy() for part in ("_low", "_high", "", "_own")
        )
        inside.append((low <= truth) & (truth <= high))
        errors.append((value / truth - 1.0) ** 2)
        own.append((alone / truth - 1.0) ** 2)
    held = ", ".join(f"{100 * share:.1f}" for share in np.mean(np.concatenate(inside), axis=0))
    ratio = np.mean(np.concatenate(errors), axis=0) / np.mean(np.concatenate(own), axis=0)
    print(
        f"{actuators} actuators, logs of each: {runs}, between {between}, runs {within}, noise x {noise:g}: "
        f"{held} % hold the truth; squared error {', '.join(f'{one:.2f}' for one in ratio)} of single ones"
    )


if __name__ == "__main__":
    intervals = int(sys.argv[1]) if len(sys.argv) > 1 else 2000
    begun = time.process_time()
    for actuators in (8, 15, 30, 200):
        check(intervals, actuators)
    check(intervals, 30, runs=4, within=RUN)
    check(intervals, 10, runs=3, within=RUN)
    check(intervals, 30, between=WIDE)
    check(intervals, 30, between=CLOSE)
    check(intervals, 30, noise=2.5)
    print(f"{time.process_time() - begun:.0f} s of processor time")
