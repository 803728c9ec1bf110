"""Zeros and minima of a curve over frequency that a grid brackets."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Float

SAME = 1e-11  # of a frequency: nearer, two values of a curve differ by rounding, which would hide a minimum beside them


def crossings(
    curve: Callable[[Float[np.ndarray, " _"]], Float[np.ndarray, " _"]], f: Float[np.ndarray, " m"]
) -> Float[np.ndarray, " k"]:
    """Return the zeros of a curve between grid points of opposite sign, by bisection, ascending.

    Two zeros between the same two points are not seen: the grid has to resolve the curve.

    Examples
    --------
    >>> crossings(lambda f: f**2 - 2.0, np.array([0.0, 1.0, 3.0])).round(6).tolist()
    [1.414214]

    """
    values = curve(f)
    index = np.flatnonzero(np.sign(values[:-1]) * np.sign(values[1:]) < 0)
    low, high, left = f[index], f[index + 1], np.sign(values[index])
    if not index.size:
        return low
    for _ in range(50):
        middle = 0.5 * (low + high)
        same = np.sign(curve(middle)) == left
        low, high = np.where(same, middle, low), np.where(same, high, middle)
    return 0.5 * (low + high)


def with_minima(
    curve: Callable[[Float[np.ndarray, " _"]], Float[np.ndarray, " _"]], f: Float[np.ndarray, " m"]
) -> Float[np.ndarray, " k"]:
    """Return f with every local minimum of the curve on it refined by thirds, ascending.

    Examples
    --------
    >>> with_minima(lambda f: (f - 0.7) ** 2, np.array([0.0, 1.0, 3.0])).round(6).tolist()
    [0.0, 0.7, 1.0, 3.0]

    """
    apart = f[np.concatenate([[True], np.diff(f) > SAME * np.abs(f[1:])])]
    values = curve(apart)
    inner = np.flatnonzero((values[1:-1] <= values[:-2]) & (values[1:-1] <= values[2:])) + 1
    low, high = apart[inner - 1], apart[inner + 1]
    for _ in range(60 if inner.size else 0):
        left, right = low + (high - low) / 3, high - (high - low) / 3
        lower = curve(left) < curve(right)
        low, high = np.where(lower, low, left), np.where(lower, right, high)
    return np.unique(np.concatenate([f, 0.5 * (low + high)]))
