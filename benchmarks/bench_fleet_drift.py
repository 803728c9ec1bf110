"""Drift of a fleet, false alarms and delays: python benchmarks/bench_fleet_drift.py [FLEETS].

Healthy actuators have three parameters, whose values scatter from run to run around a mean of the actuator's own, with
fits of unlike stds besides. An alarm of any of the three within 100 runs after the first counts; 1 % is what is stated.
"""

from __future__ import annotations

import sys
import time

import numpy as np
import polars as pl

from seaopt.fleet import Fleet, find_drift

NAMES = ("J", "b_r", "K_tau")
MEANS, BETWEEN, FIT = np.array([3e-6, 2e-4, 0.06]), np.array([6e-8, 6e-6, 4e-4]), np.array([6e-8, 2e-6, 4e-4])
RUNS = 101
CHANGED = 20  # one in so many actuators, where some change


def make_fleet(rng: np.random.Generator, actuators: int, change: np.ndarray | None = None, tails: float = np.inf):
    """Return a fleet in which J of the first of `CHANGED` changes as given, run by run, in stds of a run."""
    shape = (actuators, RUNS, 3)
    stds = FIT * rng.uniform(0.5, 1.5, shape)  # logs are not equally long
    noise = rng.normal(size=shape) if np.isinf(tails) else rng.standard_t(tails, shape) * ((tails - 2) / tails) ** 0.5
    values = MEANS * (1.0 + 0.1 * rng.normal(size=(actuators, 1, 3))) + BETWEEN * noise + stds * rng.normal(size=shape)
    if change is not None:
        values[: actuators // CHANGED, :, 0] += change * np.hypot(BETWEEN[0], FIT[0])
    unit, run = np.divmod(np.arange(actuators * RUNS), RUNS)
    columns = {"log": [f"{u}/{r}.csv" for u, r in zip(unit, run, strict=True)], "status": "met"}
    columns |= {"unit": unit.astype(str), "run": run.astype(str)}
    for k, name in enumerate(NAMES):
        columns |= {name: values[:, :, k].ravel(), f"{name}_std": stds[:, :, k].ravel()}
    return Fleet(
        rows=pl.DataFrame(columns), units=dict.fromkeys(NAMES, "-"), identity=("unit", "run"), fitted=NAMES, free=NAMES
    )


def share_alarmed(fleet: Fleet) -> float:
    drift = find_drift(fleet)
    return len({one.actuator for one in drift.alarms}) / drift.actuators


def show_false_alarms(fleets: int) -> None:
    for actuators, tails, what in (
        (1000, np.inf, "1,000 actuators"), (30, np.inf, "30 actuators"), (5, np.inf, "5 actuators"),
        (1, np.inf, "1 actuator"), (1000, 4.0, "1,000 actuators, Student's t of 4 between runs"),
    ):  # fmt: skip
        repeats = max(1, fleets * 1000 // actuators) if actuators > 100 else 100 * fleets
        shares = [share_alarmed(make_fleet(np.random.default_rng([seed, actuators]), actuators, tails=tails))
                  for seed in range(repeats)]  # fmt: skip
        mean, count = np.mean(shares), repeats * actuators
        print(f"false alarms, {what}: {100 * mean:.2f} % of {count} ({100 * (mean * (1 - mean) / count) ** 0.5:.2f})")


def show_delays(actuators: int) -> None:
    since = 20
    after = np.maximum(np.arange(RUNS) - since + 1, 0)
    changes = {f"step of {size:g} std": size * (after > 0) for size in (1.0, 2.0, 3.0, 5.0)}
    changes |= {f"{rate:g} std a run": rate * after for rate in (0.02, 0.05, 0.1, 0.2, 0.5)}
    for what, change in changes.items():
        fleet = make_fleet(np.random.default_rng(7), actuators, change)
        drift = find_drift(fleet)
        first: dict[str, int] = {}
        for one in drift.alarms:
            if (
                int(one.actuator) < actuators // CHANGED
                and one.parameter == "J"
                and int(one.raised_time.removeprefix("run ")) >= since
            ):
                first[one.actuator] = int(one.raised_time.removeprefix("run ")) - since + 1
        delays = np.array(sorted(first.values())) if first else np.array([np.nan])
        share, late = 100 * len(first) / (actuators // CHANGED), np.quantile(delays, 0.9)
        print(
            f"{what} from run {since}: {share:.0f} % told within {RUNS - since} runs, "
            f"after {np.median(delays):.0f} of them (one in ten after more than {late:.0f})"
        )


if __name__ == "__main__":
    fleets = int(sys.argv[1]) if len(sys.argv) > 1 else 2
    begun = time.process_time()
    show_false_alarms(fleets)
    show_delays(1200)
    print(f"{time.process_time() - begun:.0f} s of processor time")
