"""The 95 % intervals of a fit hold the truth in 95 % of the logs; the cases are those of benchmarks/bench_coverage.py.

With 400 logs the coverage of a right interval has a standard deviation of 1.1 %: 92 to 98 % is 2.7 of them each way.
"""

from __future__ import annotations

import runpy
from pathlib import Path

import numpy as np
import pytest

BENCH = runpy.run_path(str(Path(__file__).parents[2] / "benchmarks" / "bench_coverage.py"))
SEEDS = range(400)


@pytest.mark.parametrize("case", ["white noise", "coloured noise"])
def test_intervals_and_their_ellipsoid_cover_the_truth(case):
    """Six seconds of the stand: J, b_r and eta one by one, and the three together (chi^2 with 3 degrees)."""
    covered = BENCH["coverage"](BENCH["CASES"][case], SEEDS)
    assert all(0.92 <= part <= 0.98 for part in covered.values()), covered


def test_a_mode_outside_the_band_leaves_the_intervals_right():
    """An unmodelled mode at 80 Hz, residuals weighted to 8 Hz: each interval holds the truth in 90 % of the logs."""
    covered = BENCH["coverage"](BENCH["CASES"]["80 Hz mode, 0 to 8 Hz"], SEEDS)
    assert min(covered[name] for name in ("J", "b_r", "eta")) >= 0.90, covered


def test_without_weighting_the_mode_biases_the_inertia():
    """The same logs, all frequencies: J is low by more than its std, and not by chance."""
    error, std, _ = BENCH["errors"](BENCH["CASES"]["80 Hz mode, all frequencies"], range(60))
    assert np.mean(error[:, 0] / std[:, 0]) < -1.0
