"""Where the lines of a log have to lie for its response to confirm anything, and where they do not."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from jaxtyping import Float

from seaopt.control import Controller

REACH = 0.25, 2.0  # of the crossover: lines go from below the first to above the second
CLOSEST = 1.5  # ratio of neighbouring lines, at most, from half the crossover on
FEWEST_LINES = 8
NYQUIST = 0.8  # of half the sample rate, above which no line has to lie
ON_GRID = 0.05  # relative, by which the outermost lines may miss, which lie on multiples of the period's

Band = tuple[float, float]  # Hz


def find_reach(controller: Controller) -> Band:
    """Return from where to where (Hz) lines are to lie: about the crossover, or the bandwidth where there is none."""
    middle = controller.achieved.crossover_hz or controller.spec.bandwidth_hz
    return REACH[0] * middle, min(REACH[1] * middle, NYQUIST * 0.5 / controller.sample_time_s)


def find_missing(f: Float[np.ndarray, " m"], low: float, high: float) -> tuple[Band, ...]:
    """Return between which frequencies lines are missing: they are to reach from below `low` to above `high`, and to
    lie closely from twice the lower end on; all of it where they are few.
    """
    if f.size < FEWEST_LINES:
        return ((low, high),)
    first = np.searchsorted(f, 2.0 * low * (1.0 + ON_GRID), side="right") - 1
    last = np.searchsorted(f, high * (1.0 - ON_GRID))
    apart = [(float(a), float(b)) for a, b in pairwise(f) if b > CLOSEST * (1.0 + 1e-9) * a]
    close = f[max(first, 0)], f[min(last, f.size - 1)]
    missing = [(a, b) for a, b in apart if a >= close[0] and b <= close[1]]
    if f[0] > low * (1.0 + ON_GRID):
        missing.insert(0, (low, float(f[0])))
    if f[-1] < high * (1.0 - ON_GRID):
        missing.append((float(f[-1]), high))
    joined = list[Band]()
    for a, b in missing:
        if joined and joined[-1][1] == a:
            joined[-1] = joined[-1][0], b
        else:
            joined.append((a, b))
    return tuple(joined)
