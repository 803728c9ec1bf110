"""What the samples of a column tell of it as a clock: whether it is one, and in which unit."""

from __future__ import annotations

import numpy as np

from seaopt.signals import VectorN

# Steps of a clock without a unit, from and up to: actuators are sampled between 5 Hz and 50 kHz.
TIME_STEPS = {"s": (2e-5, 0.2), "ms": (0.2, 200.0), "us": (200.0, 2e5), "ns": (2e5, 1e9)}
EVEN = 5.0  # median steps, which nine of ten steps of a clock stay below


def guess_time_unit(time: VectorN) -> str:
    """Return the unit that the size of a clock's steps suggests."""
    step = np.abs(np.diff(time[np.isfinite(time)]))
    usual = float(np.median(step[step > 0.0])) if np.any(step > 0.0) else 0.0
    return next((unit for unit, (low, high) in TIME_STEPS.items() if low <= usual < high), "s")


def runs_on(values: VectorN) -> bool:
    """Tell whether a column is a clock by its samples: it only rises, by much the same each time."""
    step = np.diff(values)
    return bool(
        step.size > 1 and np.all(step > 0.0) and np.quantile(step, 0.9) < EVEN * np.median(step) < 1e7 * step[0]
    )
