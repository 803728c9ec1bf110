"""Long series drawn with few points: of each stretch the least and the largest sample, in the order they come.

This min-max method keeps every peak, and each point drawn is a sample; what lies between the two is left out. The ends
of a series are drawn, too.
"""

from __future__ import annotations

import numpy as np

from seaopt.signals import RowsK, VectorM, VectorN

STRETCHES = 500
METHOD = "least and largest sample of each of {} stretches (min-max)"


def thin_series(time: VectorN, values: VectorN, stretches: int = STRETCHES) -> tuple[VectorM, VectorM]:
    """Return at most two samples per stretch of equal length, and the ends; NaN where a stretch has no sample."""
    n = values.size
    if n <= 2 * stretches:
        return time, values
    edges = np.linspace(0, n, stretches + 1).astype(int)
    width = int(np.max(np.diff(edges)))
    rows = np.minimum(edges[:-1, None] + np.arange(width), edges[1:, None] - 1)  # the last of a short one twice
    block = values[rows]
    low = np.argmin(np.where(np.isnan(block), np.inf, block), axis=1)
    high = np.argmax(np.where(np.isnan(block), -np.inf, block), axis=1)
    ends = np.sort(np.stack([low, high], axis=1), axis=1)
    kept = np.unique(np.concatenate([[0], np.take_along_axis(rows, ends, axis=1).ravel(), [n - 1]]))
    return time[kept], values[kept]


def break_at(time: VectorN, values: VectorN, gaps: RowsK) -> tuple[VectorM, VectorM]:
    """Return a series with a missing sample in front of each sample of a row number, so that no line joins them."""
    middles = 0.5 * (time[gaps - 1] + time[gaps])
    return np.insert(time, gaps, middles), np.insert(values, gaps, np.nan)


def describe_thinning(count: int) -> str:
    """Return how a series of so many samples is drawn, as a sentence for captions; empty where it is drawn whole."""
    return "" if count <= 2 * STRETCHES else f"Of {count} samples, {METHOD.format(STRETCHES)} are drawn."
