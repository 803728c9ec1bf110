"""The replay: the law, fed with the logged reference and readings, makes the logged command, to its rounding.

Where rounding allows more than a tenth of the command, nothing is decided. Readings in coarse steps may be rounded in
the log, or be the counts that the law itself read. They are counts where the law matches without an allowance for
them, and where another cause leaves nothing without it, which rounding would not.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from seaopt.formatting import join_words
from seaopt.machine.causes import Cause, find_causes, leave_open
from seaopt.machine.decimated import SAME_RATE, LineMatch, count_ticks_per_row, match_lines
from seaopt.machine.hidden import find_hidden
from seaopt.machine.open_loop import find_unfollowed
from seaopt.machine.reference_offset import Offset, tell_offset
from seaopt.machine.response.tripped import Trip
from seaopt.machine.stepped import FLOOR, Match, Others, Setting, Source, make_setting, play
from seaopt.machine.stopped import find_end, find_stop
from seaopt.machine.ticks import Ticks, find_saturated
from seaopt.records import Result, record

SIGMAS = 4.0  # of what rounding allows
HIDES = 0.003  # of the command's rms, above which what is taken for rounding may be a fault


@record
class Replay(Result):
    """How near the law comes to the logged command."""

    met: bool
    ticks: int
    mismatch: float | None  # rms, in the command's unit; None where nothing could be compared
    largest: float | None
    allowed: float | None  # rms that rounding, or noise between the rows, allows
    rms: float  # of the command about its mean
    off_from: int | None  # first tick that is off
    saturated: float  # share of the ticks at the limit
    command_late: int  # rows by which the command is logged later than what it was made of
    rate_hz: float  # of the log
    law_rate_hz: float
    ticks_per_row: int = 1  # of a log that has every n-th tick: it was compared line by line
    causes: tuple[Cause, ...] = ()
    command_most: float = 0.0  # command_most, command_mostly: as in `Ticks`, of the logged command
    command_mostly: float = 0.0
    possible: tuple[Cause, ...] = ()  # of a log with every n-th tick: laws with other parts that it does not exclude
    stretches: int = 1  # between its gaps
    trip: Trip | None = None  # of the law's gate: what comes after it is no longer of the law
    offset: Offset | None = None  # of the reference that the law was given, within half of the step it is logged in
    begins: int = 0  # as in `Ticks`: rows at the start that are left out
    position_stays: float | None = None  # as in `Ticks`: nothing is judged of the outer loop then
    unit_missing: bool = False  # of the reference, which may be the law's own or that of its outer loop

    @property
    def explained(self) -> bool:
        """Whether its first cause makes the logged command."""
        return bool(self.causes) and self.causes[0].explains

    @property
    def undecided(self) -> bool:
        """Whether the log cannot tell this law from another."""
        return bool(self.causes) and self.causes[0].undecided


def replay(source: Source, ticks: Ticks, others: Others | None = None) -> Replay:
    """Return how a law matches a log, and where it does not, why. `others`: laws that may have run in its place, by
    name.
    """
    whole = make_setting(source, ticks)
    match, found = play(whole), None
    if match.met:
        whole, match, found = _read_counts(whole, match, others or {})
    ticks_per_row = 1 if match.met else count_ticks_per_row(whole.controller, ticks)
    lines = match_lines(whole, ticks_per_row, others or {}) if ticks_per_row > 1 else None
    if lines is not None and lines.tells:
        return _describe_lines(whole, lines, ticks_per_row)
    late, causes = 0, ()
    limited = find_saturated(ticks, whole.linear.command_limit) > 0.5  # where all laws are alike
    if not match.met:
        causes, changed = found or find_causes(whole, match, others or {})
        first = causes[0] if causes else None
        if lines is not None and (limited or first is None or not first.explains):
            return _describe_lines(whole, lines, ticks_per_row)
        if first is not None and first.kind == "late" and first.what == "command" and first.explains:
            late, causes, whole, match = int(first.value or 0), (), changed, play(changed)
        elif (stop := find_stop(whole, match)) is not None:
            causes = (stop,)
        elif (names := _find_open(whole, match, first)) is not None:
            causes = (Cause(kind="open loop", what=names, value=None, unit="", removes=1.0, explains=True),)
        elif not (first and first.explains) and np.ptp(ticks.reference) == 0.0:
            given = float(ticks.reference[0])
            causes = (Cause(kind="still", what="reference", value=given, unit="", removes=1.0, explains=True),)
        elif first is not None and first.explains and play(replace(changed, rounded=False)).met:
            match = play(replace(whole, rounded=False))  # what is read in coarse steps is counts
    rate_hz, law_rate_hz = ticks.rate_hz, 1.0 / whole.controller.sample_time_s
    if match.met and abs(rate_hz / law_rate_hz - 1.0) > SAME_RATE:
        causes = (Cause(kind="rate", what="clock", value=rate_hz, unit="Hz", removes=1.0, explains=True),)
    allowed, rms = math.sqrt(float(np.mean(match.allowed**2))), float(np.std(ticks.command))
    if match.met and not causes and match.energy > (FLOOR * rms) ** 2:
        causes = find_hidden(whole, match, others or {})
    if match.met and not causes and match.coarse:
        causes = (leave_open("saturated", "command") if limited else leave_open("rounding", "log", allowed),)
    met = match.met and not causes
    off = np.flatnonzero(np.abs(match.error) > SIGMAS * match.allowed)
    return Replay(
        met=met,
        ticks=len(ticks),
        mismatch=math.sqrt(match.energy),
        largest=float(np.max(np.abs(match.error))),
        allowed=allowed,
        rms=rms,
        off_from=None if match.met or not off.size else int(off[0]),
        saturated=find_saturated(ticks, whole.linear.command_limit),
        command_late=late,
        command_most=ticks.command_most,
        command_mostly=ticks.command_mostly,
        rate_hz=rate_hz,
        law_rate_hz=law_rate_hz,
        causes=causes,
        offset=tell_offset(whole, match) if met else None,
    )


def _find_open(whole: Setting, match: Match, first: Cause | None) -> str | None:
    """Return the signals that a command does not follow; None where it does, or a cause other than gains, which may
    be fitted to a command that was played, explains it.
    """
    if first is not None and first.explains and first.kind != "gains":
        return None
    return join_words(find_unfollowed(whole, match)) or None


def replay_stretches(source: Source, row: Replay, longest: Ticks, whole: Ticks, others: Others) -> Replay:
    """Return the replay of all stretches of a log with gaps, the longest of which is of the law, as `row` has it; or
    where that one has no command, of what was before.

    Each begins in a state that the log does not have, and that its own first rows tell, as at the start of a log; what
    a stretch of few rows says is therefore less than what it would as a part of a longer one. Rounding, and what is as
    good as nothing, are those of the longest.
    """
    if not row.met:
        return _replay_before_stop(source, row, whole, others)
    stretches = whole.move_command(row.command_late).split()
    matches = list[Match]()
    for ticks in stretches:
        setting = replace(make_setting(source, ticks), log=longest)
        match = play(setting)
        if not match.met:
            stop = None if np.any(ticks.command) else find_end(whole)
            causes = find_causes(setting, match, others)[0] if stop is None else (stop,)
            worst = float(np.max(np.abs(match.error)))
            return replace(row, met=False, mismatch=math.sqrt(match.energy), largest=worst, causes=causes)
        matches.append(match)
    if not matches:
        return row
    errors = np.concatenate([match.error for match in matches])
    return replace(
        row,
        ticks=errors.size,
        stretches=len(matches),
        mismatch=math.sqrt(float(np.mean(errors**2))),
        largest=float(np.max(np.abs(errors))),
    )


def _replay_before_stop(source: Source, row: Replay, whole: Ticks, others: Others) -> Replay:
    """Return the replay of a log whose longest stretch has no command: of the longest before, and that the command was
    stopped, where that one is of the law; else `row`.
    """
    stop = find_end(whole)
    moving = [ticks for ticks in whole.split() if np.any(ticks.command)]
    if stop is None or not moving:
        return row
    before = replay(source, max(moving, key=len), others)
    return replace(before, met=False, causes=(stop,)) if before.met else row


def _read_counts(
    whole: Setting, match: Match, others: Others
) -> tuple[Setting, Match, tuple[tuple[Cause, ...], Setting] | None]:
    """Return a setting that is met, and its match, with readings that are not rounded in the log if they are not; and
    what `find_causes` found, where that shows that they are not.
    """
    counts = replace(whole, rounded=False)
    as_read = play(counts)
    if as_read.met:
        return counts, as_read, None
    if as_read.energy > (HIDES * float(np.std(whole.ticks.command))) ** 2:
        causes, changed = find_causes(counts, as_read, others)
        if causes and causes[0].explains:
            return counts, as_read, (causes, changed)
    return whole, match, None


def _describe_lines(setting: Setting, match: LineMatch, ticks_per_row: int) -> Replay:
    """Return the replay of a log with every n-th tick, line by line."""
    ticks, off = setting.ticks, match.off
    return Replay(
        met=not match.causes,
        ticks=len(ticks),
        mismatch=None if off is None else float(np.sqrt(0.5 * np.sum(off**2))),
        largest=None if off is None else float(np.max(off)),
        allowed=match.allowed,
        rms=float(np.std(ticks.command)),
        off_from=None,
        saturated=find_saturated(ticks, setting.linear.command_limit),
        command_late=match.late,
        command_most=ticks.command_most,
        command_mostly=ticks.command_mostly,
        rate_hz=ticks.rate_hz,
        law_rate_hz=1.0 / setting.controller.sample_time_s,
        ticks_per_row=ticks_per_row,
        causes=match.causes,
        possible=match.possible,
    )
