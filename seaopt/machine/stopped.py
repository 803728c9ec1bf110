"""A log whose command was stopped: by a gate that tripped, a stage that watches its signals, or by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from seaopt.machine.causes import Cause
from seaopt.machine.stepped import Match, Setting, play
from seaopt.machine.ticks import FEWEST, Ticks

SIGMAS = 6.0  # of what rounding allows, from which on the command is another one


def find_stop(whole: Setting, match: Match) -> Cause | None:
    """Return since when the command is none, where the law makes it up to there; None where it is not so.

    Between the last tick of the law and the zero it may be faded out.
    """
    ticks = whole.ticks
    moving = np.flatnonzero(ticks.command)
    off = np.flatnonzero(np.abs(match.error) > SIGMAS * match.allowed)
    if not moving.size or not off.size:
        return None
    last, first = int(moving[-1]) + 1, int(off[0])
    if len(ticks) - last < FEWEST or not FEWEST <= first <= last:
        return None
    if not play(replace(whole, ticks=ticks.take(slice(0, first)))).met:
        return None
    return Cause(kind="stopped", what="command", value=last / ticks.rate_hz, unit="s", removes=1.0, explains=True)


def find_end(whole: Ticks) -> Cause | None:
    """Return since when the command of a log is none, where that is so behind a gap: with readings that were no
    numbers, of which a gate makes a fault, no stretch has both the law and its stop.
    """
    moving = np.flatnonzero(np.nan_to_num(whole.command))
    last = int(moving[-1]) + 1 if moving.size else 0
    if not last or np.count_nonzero(whole.complete[last:]) < FEWEST:
        return None
    value = last / whole.rate_hz
    return Cause(kind="stopped", what="command", value=value, unit="s", removes=1.0, explains=True)
