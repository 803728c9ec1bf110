"""Peaks of machines beside what a bring-up expects of them at most, with friction as modelled and sticking.

    python benchmarks/acceptance/peaks.py 1198355151 2144082540 ...

Of each seed are the plan's phases and draws, and 40 machines within what was certified, each with its own noise; they
are those of tests/machine/machine.c under the exported C.
"""

from __future__ import annotations

import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

from seaopt.simulation.native import find_compiler  # noqa: E402
from tests.machine.simulator import Bench  # noqa: E402
from tests.machine.test_expected_peaks import MACHINES, make_knee, make_stand, plan_stages  # noqa: E402

WAYS = {"as modelled": {}, "sticking": {"smoothing": 0.0}}


def add_shares(shares, make, seed):
    """Add the shares of machines below what is expected at most, and their largest peak over it."""
    plan, values, ranges, name, noise, of = plan_stages(make, seed)
    rng = np.random.default_rng(seed)
    drawn = [values.update(**{key: rng.uniform(*ends) for key, ends in ranges.items()}) for _ in range(MACHINES)]
    for stage in plan.stages:
        bench = Bench(find_compiler(), tempfile.mkdtemp(), stage.controller, stage.name)
        for way, changes in WAYS.items():
            logs = [
                bench.log(replace(of(each), **changes), stage.excitation.reference, noise=noise, seed=[seed, number])
                for number, each in enumerate(drawn)
            ]
            for signal in ("I", name):
                peaks = np.array([np.max(np.abs(log[signal])) for log in logs]) / stage.excitation.peaks[signal]
                key = make.__name__.removeprefix("make_"), stage.name, way, signal
                shares.setdefault(key, []).append((np.mean(peaks <= 1.0), np.max(peaks)))


def main():
    shares = {}
    for seed in map(int, sys.argv[1:]):
        for make in (make_knee, make_stand):
            add_shares(shares, make, seed)
    for key, rows in shares.items():
        below, largest = np.array(rows).T
        print(f"{' '.join(key):32s} below {100.0 * np.mean(below):6.2f} %, largest {np.max(largest):.3f} times")
    for way in WAYS:
        below = [share for key, rows in shares.items() if key[2] == way for share, _ in rows]
        print(f"{way}: {100.0 * np.mean(below):.2f} % of {MACHINES * len(below)} peaks below")


if __name__ == "__main__":
    main()
