"""Zeros of a curve over frequency that a grid brackets."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Float


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
