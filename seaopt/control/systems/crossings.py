"""Zeros and minima of a curve over frequency that a grid brackets, and its turns about zero."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Complex, Float

from seaopt.signals import VectorK, VectorM

Curve = Callable[[Float[np.ndarray, " _"]], Float[np.ndarray, " _"]]
ROUNDING_DISTANCE = 1e-11  # of a frequency: nearer, values of a curve differ by rounding, which would hide a minimum


def find_crossings(curve: Curve, f: VectorM) -> VectorK:
    """Return the zeros of a curve, ascending; two between the same two points of the grid are not seen."""
    from scipy.optimize import elementwise

    values = curve(f)
    index = np.flatnonzero(np.sign(values[:-1]) * np.sign(values[1:]) < 0)
    return elementwise.find_root(curve, (f[index], f[index + 1])).x if index.size else f[index]


def count_turns(
    curve: Callable[[Float[np.ndarray, " _"]], Complex[np.ndarray, " _"]], f: VectorM, most: float, rounds: int
) -> tuple[float, VectorK]:
    """Return by how much a curve turns about zero (rad), and the frequencies between which it turns by less than `most`
    each, halved in so many rounds, and not beyond rounding.
    """
    turns = np.zeros(0)
    for _ in range(rounds):
        values = curve(f)
        turns = np.angle(values[1:] / values[:-1])
        wide = np.flatnonzero(np.abs(turns) > most)
        if not wide.size or np.min(np.diff(f)[wide] / f[wide]) < 1e-12:
            break
        f = np.sort(np.concatenate([f, 0.5 * (f[wide] + f[wide + 1])]))
    return float(np.sum(turns)), f


def add_minima(curve: Curve, f: VectorM, shallow: float = np.inf) -> VectorK:
    """Return f with every local minimum of the curve on that grid, refined by thirds, ascending. Who looks for
    crossings of zero can leave out minima that do not reach it: on the grid they are above zero by more than `shallow`
    times what they are below their neighbours.
    """
    distinct = f[np.concatenate([[True], np.diff(f) > ROUNDING_DISTANCE * np.abs(f[1:])])]
    values = curve(distinct)
    inner = np.flatnonzero((values[1:-1] <= values[:-2]) & (values[1:-1] <= values[2:])) + 1
    depth = np.maximum(values[inner - 1], values[inner + 1]) - values[inner]
    inner = inner[values[inner] / shallow <= depth]
    low, high = distinct[inner - 1], distinct[inner + 1]
    for _ in range(60 if inner.size else 0):
        left, right = low + (high - low) / 3, high - (high - low) / 3
        lower = np.less(*np.split(curve(np.concatenate([left, right])), 2))
        low, high = np.where(lower, low, left), np.where(lower, right, high)
    return np.unique(np.concatenate([f, 0.5 * (low + high)]))
