r"""An offset of a reference that is logged in coarse steps, where a log tells it from what rounding leaves.

Integrals run up the mean of rounding as they do an offset. With w what the estimate of the offset weighs each command
with, an error in row j of what the law saw adds :math:`g_j = \sum_k w_k h_{kj}` to it, h what the law makes of one row,
with its limit as logged; where the reference repeats, so does the error. An offset above four std of that is no
rounding: digits that are cut off make one of half a step.
"""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Bool, Float

from seaopt.control import RunnableLaw
from seaopt.machine.response.periods import find_period
from seaopt.machine.stepped import Match, Setting, find_at_limit, find_steady, list_steps, take_weights
from seaopt.records import record

SIGMAS = 4.0


@record
class Offset:
    """By how much the reference that a law was given lies above the logged one."""

    value: float
    std: float
    step: float  # that the reference is logged in
    or_reading: bool  # whether a reading that is logged in coarse steps may be what is off, as much the other way


def tell_offset(setting: Setting, match: Match) -> Offset | None:
    """Return the offset of the reference in a replay that is met; None where rounding may make it."""
    ticks, log = setting.ticks, setting.log or setting.ticks
    if not match.offset:
        return None
    law, steps, n = setting.linear, list_steps(log), len(ticks)
    limited = find_at_limit(ticks, law)
    steady = np.where(limited, 0.0, find_steady(law, limited))
    weights = steady / (steady @ steady)
    seen = _weigh_rows(law, limited, weights)
    phase = np.arange(n) % (find_period(ticks.reference) or n)
    squares = [float(np.sum(np.bincount(phase, each) ** 2)) for each in seen.T]
    variance = float(steps**2 @ squares + log.quantum**2 * np.sum(weights**2)) / 12.0
    if abs(match.offset) <= SIGMAS * math.sqrt(variance):
        return None
    return Offset(
        value=-match.offset,
        std=math.sqrt(variance),
        step=float(steps[0]),
        or_reading=bool(np.any(steps[1:] > abs(match.offset))),
    )


def _weigh_rows(
    law: RunnableLaw, limited: Bool[np.ndarray, " n"], weights: Float[np.ndarray, " n"]
) -> Float[np.ndarray, "n k"]:
    """Return what a weighted sum of a law's commands changes by with the reference, and with each reading, in a row."""
    columns, direct = take_weights(law)
    back = law.anti_windup[:, None]
    ways = (law.a, columns), (law.a - back * law.c, columns - back * direct)
    seen, later = np.empty((limited.size, direct.size)), np.zeros(law.c.size)
    for k, at_limit in reversed(list(enumerate(limited.tolist()))):
        way, drive = ways[int(at_limit)]
        weight = law.per_effort * weights[k]
        seen[k] = weight * direct + later @ drive
        later = weight * law.c + later @ way
    return seen
