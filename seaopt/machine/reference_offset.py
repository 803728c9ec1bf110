r"""An offset of a reference that is logged in coarse steps, where a log tells it from what rounding leaves.

Integrals run up the mean of rounding as they do an offset. With w what the estimate of the offset weighs each command
with, an error in row j of what the law saw adds :math:`g_j = \sum_k w_k h_{k-j}` to it, h the law's response to one
row; where the reference repeats, so does the error. An offset above four std of that is no rounding: digits that are
cut off make one of half a step.
"""

from __future__ import annotations

import math

import numpy as np

from seaopt.machine.response.periods import find_period
from seaopt.machine.stepped import Match, Setting, find_at_limit, list_impulses, list_steps, transform
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
    n, steps, impulses = len(ticks), list_steps(log), list_impulses(setting.linear, len(ticks))
    steady = np.where(find_at_limit(ticks, setting.linear), 0.0, np.cumsum(impulses[0]))
    weights = steady / (steady @ steady)
    seen = np.fft.irfft(np.conj(transform(impulses.T)) * transform(weights[:, None]), axis=0)[:n]
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
