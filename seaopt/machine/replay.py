"""The replay: the law, fed with the logged reference and readings, makes the logged command, to its rounding.

Where rounding allows more than a tenth of the command, nothing is decided.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from seaopt.control import Controller
from seaopt.errors import LogError
from seaopt.machine.causes import SAME_FACTOR, Cause, find_causes
from seaopt.machine.decimated import SAME_RATE, count_ticks_per_row, match_lines
from seaopt.machine.stepped import Setting, Source, make_setting, play
from seaopt.machine.ticks import AT_LIMIT, Ticks
from seaopt.records import record

SIGMAS = 4.0  # of what rounding allows
COARSEST = 0.1  # of the command's rms, that rounding may allow of a replay that decides
UNDECIDED = ("rounding",)  # causes that lie in the log, for which it decides nothing


@record
class Replay:
    """How near the law comes to the logged command."""

    met: bool
    ticks: int
    mismatch: float  # rms, in the command's unit
    largest: float
    allowed: float  # rms that rounding allows
    rms: float  # of the command about its mean
    off_from: int | None  # first tick that is off
    saturated: float  # share of the ticks at the limit
    command_late: int  # rows by which the command is logged later than what it was made of
    rate_hz: float  # of the log
    law_rate_hz: float
    ticks_per_row: int = 1  # of a log that has every n-th tick: it was compared line by line
    causes: tuple[Cause, ...] = ()

    @property
    def undecided(self) -> bool:
        """Whether the log cannot tell this law from another."""
        return bool(self.causes) and self.causes[0].kind in UNDECIDED


def replay(source: Source, ticks: Ticks, others: Mapping[str, Controller] | None = None) -> Replay:
    """Return how a law matches a log, and where it does not, why. `others`: laws that may have run in its place, by
    name.
    """
    whole = make_setting(source, ticks)
    match = play(whole)
    ticks_per_row = 1 if match.met else count_ticks_per_row(whole.controller, ticks)
    by_line = _replay_lines(whole, ticks_per_row) if ticks_per_row > 1 else None
    if by_line is not None:
        return by_line
    late, causes = 0, ()
    if not match.met:
        causes, changed = find_causes(whole, match, others or {})
        first = causes[0] if causes else None
        if first is not None and first.kind == "late" and first.what == "command" and first.explains:
            late, causes, match = int(first.value or 0), (), play(changed)
    rate_hz, law_rate_hz = ticks.rate_hz, 1.0 / whole.controller.sample_time_s
    if match.met and abs(rate_hz / law_rate_hz - 1.0) > SAME_RATE:
        causes = (Cause(kind="rate", what="clock", value=rate_hz, unit="Hz", removes=1.0, explains=True),)
    allowed, rms = math.sqrt(float(np.mean(match.allowed**2))), float(np.std(ticks.command))
    if match.met and not causes and allowed > COARSEST * rms:
        causes = (Cause(kind="rounding", what="log", value=allowed, unit="", removes=0.0, explains=False),)
    met = match.met and not causes
    limit = whole.linear.command_limit
    off = np.flatnonzero(np.abs(match.error) > SIGMAS * match.allowed)
    return Replay(
        met=met,
        ticks=len(ticks),
        mismatch=math.sqrt(match.energy),
        largest=float(np.max(np.abs(match.error))),
        allowed=allowed,
        rms=rms,
        off_from=None if match.met or not off.size else int(off[0]),
        saturated=find_saturated(ticks, limit),
        command_late=late,
        rate_hz=rate_hz,
        law_rate_hz=law_rate_hz,
        causes=causes,
    )


def _replay_lines(setting: Setting, ticks_per_row: int) -> Replay | None:
    """Return the replay of a log with every n-th tick, where its lines are those of the law, or of a factor times it;
    None where they are not, or the law has terms, which are not linear.
    """
    controller, ticks = setting.controller, setting.ticks
    if setting.linear.compensation is not None:
        return None
    try:
        match = match_lines(controller, ticks)
    except LogError:
        return None
    factor = match.factor
    if not match.is_near(1.0) and not match.is_near(factor):
        return None
    met, name, limit = match.is_near(1.0), controller.command.input, setting.linear.command_limit
    kind = "sign" if abs(factor + 1.0) < SAME_FACTOR else "factor"
    cause = Cause(kind=kind, what=name, value=factor, unit="", removes=1.0, explains=True)
    return Replay(
        met=met,
        ticks=len(ticks),
        mismatch=match.size * float(np.sqrt(np.mean(match.off**2))),
        largest=match.size * float(np.max(match.off)),
        allowed=match.size * float(np.sqrt(np.mean(match.radius[match.sure] ** 2))),
        rms=float(np.std(ticks.command)),
        off_from=None,
        saturated=find_saturated(ticks, limit),
        command_late=match.late,
        rate_hz=ticks.rate_hz,
        law_rate_hz=1.0 / controller.sample_time_s,
        ticks_per_row=ticks_per_row,
        causes=() if met else (cause,),
    )


def find_saturated(ticks: Ticks, limit: float) -> float:
    """Return the share of the ticks at the limit."""
    return float(np.mean(np.abs(ticks.command) >= AT_LIMIT * limit)) if math.isfinite(limit) else 0.0
