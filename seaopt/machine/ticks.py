"""A log taken under a law, as the ticks of that law: its reference, what it read, and what it commanded."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import field, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from seaopt.control import Controller
from seaopt.control.loops.outer_loop import OuterLoop
from seaopt.errors import LogError
from seaopt.formatting import join_words
from seaopt.logs import Log
from seaopt.logs.quality.faults import find_quantisation, find_rails, find_runs, measure_stillness
from seaopt.records import record
from seaopt.signals import REFERENCES, Signal

AT_LIMIT = 1.0 - 1e-6  # of the command's limit, from which on it is there
FORGETS = 35.0  # time constants in which nothing is left of a start
FEWEST_FLAT, FEWEST_VISITS, FLAT = 10, 3, 3  # readings at the edge of a range, visits of it, and rows of one
MOSTLY = 0.95  # of the ticks
FEWEST = 50  # ticks that a replay takes at least


@record
class Gaps:
    """What a log lacks."""

    ticks: int  # that have no row, by its clock
    rows: int  # with a number missing
    count: int  # of places where either is
    first_s: float  # from the log's start to the last row before the first
    longest: int  # rows of the longest stretch without


@record(eq=False)
class Ticks:
    """A log's longest stretch without a gap or a missing number, a row per tick; or all of it, where the rows that are
    missing are no numbers.
    """

    source: str
    rate_hz: float  # by the log's own clock
    reference: Float[np.ndarray, " n"]
    measured: Float[np.ndarray, "n y"]
    further: Float[np.ndarray, "n r"]  # what its terms and its gate read besides
    command: Float[np.ndarray, " n"]
    place: Float[np.ndarray, " n"] | None = None  # of a schedule, its variable
    rendered: dict[str, Float[np.ndarray, " n"]] | None = None  # parts of an outer loop, of which reference is the sum
    given: Float[np.ndarray, "n _"] | None = None  # with them: the force that the outer loop is given, the position
    beside: Mapping[str, Float[np.ndarray, " n"]] = field(default_factory=dict[str, Any])  # outputs it does not read
    left_out: int = 0  # rows of the log that are not in it
    gaps: Gaps | None = None  # of the log; None where it has none
    begins: int = 0  # rows ahead of them, in which an outer loop's filter forgets what was before the log

    def __len__(self) -> int:
        return self.command.size

    @property
    def complete(self) -> Bool[np.ndarray, " n"]:
        """Which rows have all numbers."""
        parts = (self.reference[:, None], self.command[:, None], self.measured, self.further)
        return np.all(np.isfinite(np.column_stack(parts)), axis=1)

    def split(self) -> list[Ticks]:
        """Return the stretches that have all numbers, but for those that are too short for a replay."""
        runs = find_runs(self.complete)
        runs = runs.where(runs.lengths >= FEWEST)
        return [self.take(slice(start, stop)) for start, stop in zip(runs.start, runs.stop, strict=True)]

    def take(self, rows: Any, *, command: slice | None = None, measured: slice | None = None) -> Ticks:
        """Return some rows, a slice or numbers; with the command, or the readings, of other rows."""
        read = rows if measured is None else measured
        return replace(
            self,
            reference=self.reference[rows],
            measured=self.measured[read],
            further=self.further[read],
            place=None if self.place is None else self.place[read],
            rendered=self.rendered and {name: part[rows] for name, part in self.rendered.items()},
            given=None if self.given is None else self.given[rows],
            command=self.command[rows if command is None else command],
            beside={name: part[read] for name, part in self.beside.items()},
        )

    def move_command(self, late: int) -> Ticks:
        """Return the ticks with the command of the row that is `late` rows further down, or up where negative."""
        n, shift = len(self), abs(late)
        first, second = slice(0, n - shift), slice(shift, n)
        return self.take(first, command=second) if late > 0 else self.take(second, command=first)

    def delay_readings(self, ticks: int) -> Ticks:
        """Return the ticks of a law that is given its readings so many ticks late."""
        return self.take(slice(ticks, None), measured=slice(0, len(self) - ticks))

    def take_every(self, every: int) -> Ticks:
        """Return the first of each group of rows in which the command stays, where a slower law ran beside a logger."""
        changes = np.flatnonzero(np.diff(self.command)) + 1
        phase = int(np.argmax(np.bincount(changes % every, minlength=every))) if changes.size else 0
        return self.take(slice(phase, None, every))

    @property
    def command_most(self) -> float:
        """The largest size of the command: of what is beyond it the log tells nothing."""
        return float(np.max(np.abs(self.command)))

    @property
    def command_mostly(self) -> float:
        """What the size of the command is below in 95 % of the ticks."""
        return float(np.quantile(np.abs(self.command), MOSTLY))

    @property
    def middle(self) -> float | None:
        """Where a schedule's variable is as a rule."""
        return None if self.place is None else float(np.nanmedian(self.place))

    @property
    def position_stays(self) -> float | None:
        """Where the link's position stays while what its outer loop is given moves; None where none ran, or it moves,
        too.
        """
        if self.given is None:
            return None
        given, position = (part[np.isfinite(part)] for part in self.given.T)
        return float(position[0]) if np.ptp(given) > 0.0 and not np.ptp(position) else None

    @property
    def quantum(self) -> float:
        """The step of the logged command; 0 where none is seen."""
        return find_quantisation(self.command)


def take_ticks(
    controller: Controller,
    log: Log,
    reference: str | None = None,
    over: str | None = None,
    at: float | None = None,
    *,
    before: bool = False,
    whole: bool = False,
) -> Ticks:
    """Return the ticks of a log whose channels carry the names of the controller's signals, of the input that it
    commands, and of its reference. `over`: the variable of its schedule, which was `at` a value where the log does not
    have it. `before`: the reference is what its outer loop is given, though it has no unit, or is a force.
    `whole`: all of the log, in place of its longest stretch without a gap. Raises LogError: a channel is missing, or no
    stretch is long enough.
    """
    command, names = controller.command, (*controller.signals, *controller.further)
    called = [reference] if reference is not None else [name for name in REFERENCES if name in log.signals]
    around = controller.outer if controller.renders or before else None
    given = find_reference(log, reference)
    if around is not None and not before and given is not None and given.unit != around.place_unit:
        around = None  # the force law's own reference, whatever it comes from
    if around is not None:
        names = tuple(dict.fromkeys((*names, around.position)))
    if not called or called[0] not in log.signals:
        raise LogError(
            f"{log.source}: has no channel {reference or ' or '.join(REFERENCES)}; log what the law was given as its "
            "reference in each tick, or name its column: --reference COLUMN"
        )
    missing = [name for name in (*names, command.input) if name not in log.signals]
    if missing:
        what = "the command that the law returned" if missing == [command.input] else "what the law reads"
        raise LogError(
            f"{log.source}: has no {join_words(missing)}, {what}; log in each tick {join_words(names)} as the law was "
            f"given them, and {command.input} as it returned it"
        )
    if over is not None and over not in log.signals and at is None:
        raise LogError(
            f"{log.source}: has no {over}, over which the law is scheduled; log it in each tick as the law was given "
            "it, or say where it stood: --at VALUE"
        )
    placed = over is not None and over in log.signals
    columns = [log[name] for name in (called[0], command.input, *names, *([over] if placed and over else []))]
    table = np.column_stack(columns)
    has_all = np.all(np.isfinite(table), axis=1)
    rows = _find_longest(log, has_all)
    if rows.stop - rows.start < FEWEST:
        raise LogError(
            f"{log.source}: {rows.stop - rows.start} rows in a row have all of {called[0]}, {command.input}, "
            f"{join_words(names)}; log at least {FEWEST} ticks without a gap, better some periods of the reference"
        )
    count, gaps = len(controller.signals), _find_gaps(log, has_all, rows)
    whole = whole and gaps is not None
    if not np.any(np.ptp(table[rows], axis=0)):
        raise LogError(f"{log.source}: nothing moves in it, which any law may have made; play a reference that moves")
    table = _lay_out(log, np.where(has_all[:, None], table, np.nan)) if whole else table[rows]
    place = table[:, -1] if placed else None if over is None else np.full(len(table), at)
    further = 2 + count + len(controller.further)
    ticks = Ticks(
        source=log.source,
        rate_hz=log.rate_hz,
        reference=table[:, 0],
        command=table[:, 1],
        measured=table[:, 2 : 2 + count],
        further=table[:, 2 + count : further],
        place=place,
        beside=_take_beside(controller, log, has_all if whole else rows, whole),
        left_out=0 if whole else len(log) - len(table),
        gaps=gaps,
    )
    return ticks if around is None else _render(ticks, around, table[:, 2 + names.index(around.position)])


def find_reference(log: Log, reference: str | None) -> Signal | None:
    """Return the reference of a log; None where there is no such channel."""
    names = [name for name in ((reference,) if reference is not None else REFERENCES) if name in log.signals]
    return log.signal(names[0]) if names else None


def _take_beside(controller: Controller, log: Log, rows: Any, whole: bool) -> dict[str, Float[np.ndarray, " n"]]:
    """Return the outputs of the design plant that were logged without a gap, and that the law does not feed back."""
    outputs = {} if controller.design is None else controller.see(controller.design[0]).outputs
    names = [name for name in outputs if name in log.signals and name not in controller.signals]
    names = [name for name in names if np.all(np.isfinite(log[name][rows]))]
    return {name: _lay_out(log, log[name][:, None])[:, 0] if whole else log[name][rows] for name in names}


def _count_lost(log: Log) -> Int[np.ndarray, " n"]:
    """Return how many ticks have no row, by a log's clock, ahead of each row; no more than it has rows."""
    step = np.diff(log.time, prepend=log.time[0] - log.period)
    lost = np.where(step > log.gap_s, np.maximum(np.round(step / log.period) - 1.0, 1.0), 0.0)
    return np.minimum(lost, len(log)).astype(int)


def _lay_out(log: Log, table: Float[np.ndarray, "n k"]) -> Float[np.ndarray, "m k"]:
    """Return the rows of a log where its clock has them, and no numbers between."""
    at = np.arange(len(log)) + np.cumsum(_count_lost(log))
    laid = np.full((at[-1] + 1, table.shape[1]), np.nan)
    laid[at] = table
    return laid


def _find_gaps(log: Log, has_all: Bool[np.ndarray, " n"], longest: slice) -> Gaps | None:
    """Return what a log lacks; None where it lacks nothing."""
    lost = _count_lost(log)
    starts = (lost > 0) | np.diff(~has_all, prepend=False) & ~has_all
    if not np.any(starts):
        return None
    return Gaps(
        ticks=int(np.sum(lost)),
        rows=int(np.sum(~has_all)),
        count=int(np.sum(starts)),
        first_s=float(log.time[max(int(np.argmax(starts)) - 1, 0)] - log.time[0]),
        longest=longest.stop - longest.start,
    )


def _render(ticks: Ticks, outer: OuterLoop, position: Float[np.ndarray, " n"]) -> Ticks:
    """Return ticks whose reference is what an outer loop makes of what it is given and the link's position, but for the
    first, in which its filter forgets what was before the log.
    """
    asked, damping = outer.ask(ticks.reference, position), replace(outer, stiffness=0.0).run(ticks.reference, position)
    parts = {"stiffness" if outer.stiffness else "force": asked - damping, "damping": damping}
    first = min(math.ceil(FORGETS / -math.log(outer.pole)) if outer.pole else 1, len(ticks) - FEWEST)
    given = np.column_stack([outer.per_given * ticks.reference, position])
    begins = max(first, 1)
    return replace(ticks, reference=asked, rendered=parts, given=given, begins=begins).take(slice(begins, None))


def _find_longest(log: Log, whole: Any) -> slice:
    """Return the longest run of rows that are whole, within one segment of the log."""
    best = slice(0, 0)
    for segment in log.segments:
        runs = find_runs(whole[segment])
        for start, stop in zip(runs.start, runs.stop, strict=True):
            if stop - start > best.stop - best.start:
                best = slice(segment.start + int(start), segment.start + int(stop))
    return best


def find_edges(values: Float[np.ndarray, " n"]) -> list[Bool[np.ndarray, " n"]]:
    """Return where readings are at the edge of their sensor's range: many equal ones at the largest or the least, in
    rows one after another, where a signal that turns there by itself has few.
    """
    found: list[Bool[np.ndarray, " n"]] = []
    for rail in find_rails(values, find_quantisation(values), measure_stillness(values)):
        if rail.runs.samples >= FEWEST_FLAT and len(rail.runs) >= FEWEST_VISITS and np.max(rail.runs.lengths) >= FLAT:
            at = np.zeros(values.size, dtype=bool)
            for start, stop in zip(rail.runs.start, rail.runs.stop, strict=True):
                at[start:stop] = True
            found.append(at)
    return found


def find_saturated(ticks: Ticks, limit: float) -> float:
    """Return the share of the ticks at the limit."""
    return float(np.mean(np.abs(ticks.command) >= AT_LIMIT * limit)) if math.isfinite(limit) else 0.0
