r"""A law of any kind, stepped over the ticks of a log: its commands, its linear form, and states that it may begin in.

A law and a schedule run as in the compiled loop (`seaopt.control.running.law_step`), predictive control by its own
step. What a state at the first row adds to the commands is taken from the linear form: that of a schedule is the law
where its variable stands, of predictive control the law while no limit is active.

What a log does not have is the law's state at its first row. Where neither a law at zero nor one at rest under the
first row goes on as logged, it is taken from the first rows: while the command is within its limit, what a state adds
to the commands is :math:`C A^k x_0`, which is linear in it.

**What rounding allows.** The logged command is off by up to half its step. A reading that is logged coarser than the
law saw it, by a step :math:`q`, adds an error of variance :math:`\frac{q^2}{12} \sum_{j \le k} h_j^2` at row k, with
the law's impulse response h: it grows with the integral. A reading at the edge of its sensor's range is rounded alike
in all those rows: there it is :math:`\frac{q^2}{12} (\sum_j h_j)^2`. Levels of a reference of steps are no rounding,
nor are the counts of a converter that the law itself reads: where the commands match without this, it was none.
In a long log that hides much; within some seconds rounding adds up to no more than in a log of these, but for what the
integrals hold at the first of them, a polynomial, which is taken out of them first.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Bool, Complex, Float

from seaopt.control import (
    Controller,
    ControllerSpec,
    ForceMPC,
    LawState,
    MPCSpec,
    MPCState,
    RunnableLaw,
    RunnableSchedule,
    ScheduledController,
    ScheduleState,
    force_mpc,
    runnable,
)
from seaopt.control.loops.compensation.terms import FORGOTTEN
from seaopt.control.loops.law import Law
from seaopt.control.running.law_step import run_law
from seaopt.errors import SeaoptError
from seaopt.logs.quality.faults import find_quantisation
from seaopt.machine.ticks import AT_LIMIT, Ticks, find_edges
from seaopt.records import record
from seaopt.robustness import linear_controller

SETTLED = 400  # rows at most over which the estimate of predictive control follows the log
COARSEST = 0.1  # of the command's rms, that rounding may allow of a replay that decides
SAME_PLACE = 0.02  # of the span of a schedule's points: a variable that moves less stands still
FLOOR = 1e-3  # of the command's variation: a mismatch below is none
EXACT = 1e-3  # of that, below which a start is the right one
ROUNDING = 2.0  # times the std that rounding leaves by the estimate: a mismatch up to there is rounding
HEAD = 400  # rows that tell the state at the first
HEAD_DECAYS, LONGEST_HEAD = 3.0, 20000  # time constants of the slowest part that they last besides, and rows at most
INTEGRATES = 1e-6  # distance from 1 of a pole that does not decay
LEVELS, MOVING = 200, 0.5  # of a reference that is taken for rounded; what has fewer, and moves in fewer rows, is steps
LONGEST_RESPONSE = 5000  # rows after which an impulse has left what the integrals hold of it
Source = Controller | ScheduledController | ForceMPC
Others = Mapping[str, Source]  # laws that may have run in a law's place, by name
State = LawState | MPCState
Spec = TypeVar("Spec", ControllerSpec, MPCSpec)


@record(eq=False)
class Setting:
    """A law and a log, as they are or as a cause has them."""

    controller: Controller  # the linear form, with what it was designed for
    law: RunnableLaw | RunnableSchedule | ForceMPC
    ticks: Ticks
    rounded: bool = True  # whether the law may have seen finer readings than are logged
    log: Ticks | None = None  # by which rounding and the command's size are judged, of few ticks of a longer log

    @property
    def linear(self) -> RunnableLaw:
        """The law while no limit is active and a schedule's variable stands where it is in the middle of the log."""
        law = self.law
        if isinstance(law, ForceMPC):
            return runnable(self.controller)
        if isinstance(law, RunnableSchedule):
            middle = self.ticks.middle
            return law.freeze(law.fallback if middle is None else middle, self.controller.compensation)
        return law


def stand(source: Source, place: float | None) -> Controller:
    """Return the controller that something is in its linear form; of a schedule where its variable is at a place."""
    if isinstance(source, ScheduledController):
        low, high = source.points[0], source.points[-1]
        return source.at(min(max(source.fallback if place is None else place, low), high))
    if isinstance(source, ForceMPC):
        linear = linear_controller(source)
        return replace(linear, spec=replace(linear.spec, command_limit=source.command_limit), gate=source.gate)
    return source


def keep_over(others: Others, over: str | None) -> Others:
    """Return the laws that may run in place of one, scheduled over a variable or not: none scheduled over another."""
    return {
        name: other
        for name, other in others.items()
        if not isinstance(other, ScheduledController) or other.over == over
    }


def stands_still(place: Float[np.ndarray, " n"], points: Sequence[float] | Float[np.ndarray, " k"]) -> bool:
    """Tell whether a schedule's variable moves so little that the schedule is one law. `points`: of the schedule."""
    return float(np.nanmax(place) - np.nanmin(place)) <= SAME_PLACE * float(np.ptp(points))


def make_setting(source: Source, ticks: Ticks) -> Setting:
    """Return a law on a log."""
    law: Any = source
    if not isinstance(source, ForceMPC):
        law = source.runnable() if isinstance(source, ScheduledController) else runnable(source)
    return Setting(controller=stand(source, ticks.middle), law=law, ticks=ticks)


def run_setting(setting: Setting, ticks: Ticks, start: State) -> Float[np.ndarray, " n"]:
    """Return the commands of a setting's law on some ticks."""
    law = setting.law
    if isinstance(law, ForceMPC):
        assert isinstance(start, MPCState)
        return _run_plan(law, ticks, start)[0]
    assert isinstance(start, LawState)
    places = ticks.place if isinstance(law, RunnableSchedule) else None
    return run_law(law, ticks.reference, ticks.measured, ticks.further, places, start)


def _run_plan(
    law: ForceMPC, ticks: Ticks, state: MPCState, *, follow: bool = False
) -> tuple[Float[np.ndarray, " n"], MPCState]:
    """Return the commands of predictive control, and its last state; `follow`: as if each command were the log's. The
    last rows, whose references ahead are not in the log, have its commands.
    """
    out, ahead = np.empty(len(ticks)), law.spec.preview_samples + 1
    rows, names = np.column_stack([ticks.further, ticks.measured]), (*law.further, *law.signals)
    for k, readings in enumerate(rows[:, [names.index(name) for name in law.reads]].tolist()):
        before = state.kalman
        result = law.step(state, ticks.reference[k : k + ahead], float(ticks.measured[k, 0]), readings)
        out[k], state = result.command, result.state
        if follow:
            line = np.vstack([before.past, np.zeros(before.past.shape[1])])
            line[-1, 0] = ticks.command[k] - result.state.terms[1] * law.per_effort
            kalman = law.kalman.go_on(line, state.kalman.corrected, state.kalman.innovation)
            state = replace(state, command=float(ticks.command[k]), kalman=kalman)
    told = max(len(ticks) - law.spec.preview_samples, 0)
    return np.append(out[:told], ticks.command[told:]), state


def list_starts(setting: Setting) -> Iterator[tuple[State, int]]:
    """Yield states in which a law may begin, at zero and at rest under the first row, and from which row on."""
    law, ticks = setting.law, setting.ticks
    if isinstance(law, ForceMPC):
        yield law.start, 0
        ahead = law.spec.preview_samples
        rows = min(SETTLED, max(len(ticks) - ahead, 0) // 3)
        state = _run_plan(law, ticks.take(slice(0, rows)), law.start, follow=True)[1]
        yield _refine_start(law, ticks.take(slice(rows, 2 * rows + ahead)), state), rows
        return
    yield law.reset(), 0
    first = ticks.measured[0]
    measured: Any = float(first[0]) if law.measured == 1 else first
    command = float(np.clip(ticks.command[0], -law.command_limit, law.command_limit))
    placed: dict[str, Any] = (
        {} if isinstance(law, RunnableLaw) else {"place": math.nan if ticks.place is None else ticks.place[0]}
    )
    try:
        yield (
            law.reset(
                float(ticks.reference[0]), measured, command=command, readings=ticks.further[0].tolist(), **placed
            ),
            0,
        )
    except SeaoptError:  # a reading outside the gate's range
        return


def _refine_start(law: ForceMPC, ticks: Ticks, state: MPCState) -> MPCState:
    """Return a state whose estimate is the one from which the next commands follow best, with no limit active."""
    linear, n = law.unlimited(), len(law.kalman.A)
    modes, moved = np.empty((len(ticks), n)), np.eye(linear.c.size)[:, :n]
    for k in range(len(ticks)):
        modes[k], moved = linear.c @ moved, linear.a @ moved
    left, told = ticks.command - _run_plan(law, ticks, state)[0], max(len(ticks) - law.spec.preview_samples, 0)
    predicted = state.kalman.predicted + np.linalg.lstsq(modes[:told], left[:told], rcond=1e-10)[0]
    return replace(state, kalman=replace(state.kalman, predicted=predicted))


def limit_law(law: RunnableLaw | RunnableSchedule | ForceMPC, limit: float) -> Any:
    """Return a law with another limit of its command."""
    if not isinstance(law, ForceMPC):
        return replace(law, command_limit=limit)
    return change_plan(law, limit_spec(law.spec, limit))


def change_plan(plan: ForceMPC, spec: MPCSpec) -> ForceMPC:
    """Return predictive control of another specification, with the same around it."""
    changed = force_mpc(*plan.design, spec, gate=plan.gate, heat=plan.heat)
    return replace(changed, outer=plan.outer, compensation=plan.compensation, link=plan.link)


def limit_spec(spec: Spec, limit: float) -> Spec:
    """Return a specification with another limit of its command."""
    return replace(spec, **{"current_limit_A" if spec.current_limit_A is not None else "command_limit": limit})


@record(eq=False)
class Match:
    """The commands of a replay, what rounding allows at each row, and how far they are from the log's."""

    commands: Float[np.ndarray, " n"]
    allowed: Float[np.ndarray, " n"]
    error: Float[np.ndarray, " n"]
    integrals: int  # of the law, in which rounding adds up
    allowed_within: float  # rms, within stretches, beside what the integrals hold at the start of each
    offset: float = 0.0  # by which a rounded reference lies above what the law was given

    @property
    def energy(self) -> float:
        """Mean square of the difference."""
        return float(np.mean(self.error**2))

    @property
    def coarse(self) -> bool:
        """Whether rounding allows so much of the command that any law may be met."""
        logged = self.commands - self.error
        return math.sqrt(float(np.mean(self.allowed**2))) > COARSEST * float(np.std(logged))

    @property
    def explains(self) -> bool:
        """Whether it is met, and not for a log that lets any law pass; a command that is the same is no such."""
        return self.met and not (self.coarse and self.energy)

    @property
    def met(self) -> bool:
        """Whether nothing is left but rounding, in all and within stretches."""
        if self.energy > ROUNDING**2 * float(np.mean(self.allowed**2)):
            return False
        within = leave_integrals(self.error, self.integrals)
        return float(np.mean(within**2)) <= (ROUNDING * self.allowed_within) ** 2


def leave_integrals(error: Float[np.ndarray, " n"], integrals: int) -> Float[np.ndarray, " n"]:
    """Return an error without what integrals make of it between stretches: in each, the polynomial of so many terms
    that is nearest to it.
    """
    left = list[Any]()
    for part in np.array_split(error, max(1, error.size // LONGEST_RESPONSE)):
        powers = np.vander(np.linspace(-1.0, 1.0, part.size), integrals)
        left.append(part - powers @ np.linalg.lstsq(powers, part, rcond=None)[0])
    return np.concatenate(left)


def count_integrals(law: RunnableLaw) -> int:
    """Return how many integrals a law has."""
    return int(np.count_nonzero(np.abs(np.linalg.eigvals(law.a) - 1.0) < INTEGRATES)) if law.c.size else 0


def play(setting: Setting) -> Match:
    """Return the commands of a setting's law on its log."""
    ticks, linear = setting.ticks, setting.linear
    head = ticks.take(slice(0, count_head(linear)))
    log = setting.log or ticks
    steps = list_steps(log) if setting.rounded else np.zeros(1 + log.measured.shape[1])
    allowed, allowed_within = _allow(linear, ticks, log, steps)
    allowed_head, floor = allowed[: len(head)], FLOOR * float(np.std(log.command))
    # A start that is nearly right drifts in the integrals: what the floor allows is not taken for rounding.
    exact = float(np.mean(allowed_head**2)) - (1.0 - EXACT**2) * floor**2
    best: tuple[State, int] | None = None
    error = np.inf

    def starts() -> Iterator[tuple[State, int]]:
        yield from list_starts(setting)
        if not isinstance(setting.law, ForceMPC):
            yield replace(setting.law.reset(), x=_estimate_start(linear, head, allowed_head)), 0
        if isinstance(setting.law, RunnableSchedule) and (moved := _estimate_moving(setting, head, allowed_head)):
            yield moved, 0

    for start, first in starts():
        rows = head if not first else ticks.take(slice(first, first + len(head)))
        off = float(np.mean((run_setting(setting, rows, start) - rows.command) ** 2))
        if off < error:
            best, error = (start, first), off
        if error <= exact:
            break
    assert best is not None
    start, first = best
    commands = np.concatenate([ticks.command[:first], run_setting(setting, ticks.take(slice(first, None)), start)])
    if linear.compensation is not None:  # which differences to a row before the first
        commands[0] = ticks.command[0]
    offset, steady = find_offset(linear, ticks, float(steps[0]), commands - ticks.command)
    commands = commands - offset * steady
    return Match(
        commands=commands,
        offset=offset,
        allowed=allowed,
        error=commands - ticks.command,
        integrals=count_integrals(linear),
        allowed_within=allowed_within,
    )


def count_head(law: RunnableLaw) -> int:
    """Return how many rows tell the state at the first: those in which the slowest part of a law decays, too."""
    size = np.abs(np.linalg.eigvals(law.a)) if law.c.size else np.zeros(0)
    decays = size[(size > 0.0) & (size < 1.0 - INTEGRATES)]
    slowest = -1.0 / math.log(float(np.max(decays))) if decays.size else 0.0
    return int(min(max(HEAD, HEAD_DECAYS * slowest), LONGEST_HEAD))


@record(eq=False)
class Inputs:
    """What a law is given over rows in which no limit acts, for any number of laws that have the same terms."""

    columns: Float[np.ndarray, "n m"]  # the reference with what terms add to it, and the readings
    added: Float[np.ndarray, " n"]  # what terms add to the effort
    spectra: Complex[np.ndarray, "f m"]  # of the columns

    @classmethod
    def make(cls, law: RunnableLaw, ticks: Ticks) -> Inputs:
        """Return what a law, and any with its terms, is given."""
        reference, added = _compensate(law, ticks)
        columns = np.column_stack([reference, ticks.measured])
        return cls(columns=columns, added=added, spectra=transform(columns))

    def respond(self, law: Law) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n k"]]:
        """Return the efforts of a law that starts from zero, and what each state at the first row adds to them."""
        n = len(self.columns)
        rows = list_powers(law.c, law.a, n)
        out = self.columns @ law.d + self.added
        out[1:] += np.fft.irfft(np.sum(transform(rows @ law.b) * self.spectra, axis=1))[: n - 1]
        return out, rows


def take_weights(law: RunnableLaw) -> tuple[Float[np.ndarray, "m k"], Float[np.ndarray, " k"]]:
    """Return with which weights a law's states and its effort take the reference and the readings."""
    weights = np.column_stack(
        [law.b_reference, -np.reshape(law.b_measurement, (law.c.size, np.size(law.d_measurement)))]
    )
    return weights, np.append(law.d_reference, -np.ravel(law.d_measurement))


def transform(columns: Float[np.ndarray, "n m"]) -> Complex[np.ndarray, "f m"]:
    """Return spectra of columns with zeros behind them, whose products are those of convolutions that do not wrap."""
    return np.fft.rfft(columns, 1 << (2 * len(columns) - 1).bit_length(), axis=0)


def _compensate(law: RunnableLaw, ticks: Ticks) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Return the reference with what the law's terms add to it, and what they add to the effort, at each row."""
    if law.compensation is None:
        return ticks.reference, np.zeros(len(ticks))
    memory, rows = FORGOTTEN, np.empty((len(ticks), 2))
    for k, readings in enumerate(ticks.further[:, : len(law.compensation.reads)].tolist()):
        rows[k, 0], rows[k, 1], memory = law.compensation.step(memory, float(ticks.reference[k]), readings)
    return rows[:, 0], rows[:, 1]


def find_limited(ticks: Ticks) -> Bool[np.ndarray, " n"]:
    """Tell which logged commands are at a limit: those at the largest magnitude, where several rows in a row are."""
    size = np.abs(ticks.command)
    top = size >= AT_LIMIT * np.max(size)
    return top if np.any(top[1:] & top[:-1]) else np.zeros(size.size, dtype=bool)


def find_at_limit(ticks: Ticks, law: RunnableLaw) -> Bool[np.ndarray, " n"]:
    """Tell which logged commands are at a limit: at the law's own single rows, too."""
    return find_limited(ticks) | (np.abs(ticks.command) >= AT_LIMIT * law.command_limit)


def find_modes(law: RunnableLaw, limited: Bool[np.ndarray, " n"]) -> Float[np.ndarray, "n m"]:
    """Return what each state at the first row adds to the later commands, with the limit as logged."""
    return law.per_effort * _list_modes(law.a, law.c, law.anti_windup, limited)


def find_steady(law: RunnableLaw, limited: Bool[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Return what a reference of one adds to the commands from the first row on, with the limit as logged: that of one
    more state, which stays.
    """
    n = law.c.size
    way = np.block([[law.a, law.b_reference[:, None]], [np.zeros((1, n)), np.ones((1, 1))]])
    modes = _list_modes(way, np.append(law.c, law.d_reference), np.append(law.anti_windup, 0.0), limited)
    return law.per_effort * modes[:, -1]


def _list_modes(
    way: Float[np.ndarray, "m m"],
    row: Float[np.ndarray, " m"],
    anti_windup: Float[np.ndarray, " m"],
    limited: Bool[np.ndarray, " n"],
) -> Float[np.ndarray, "n m"]:
    """Return what each state at the first row adds to the later efforts."""
    rows, moved = np.empty((limited.size, row.size)), np.eye(row.size)
    ways = way, way - np.outer(anti_windup, row)
    stretches = np.split(np.arange(limited.size), np.flatnonzero(np.diff(limited)) + 1) if limited.size else []
    for part in stretches:
        taken = ways[int(limited[part[0]])]
        rows[part] = list_powers(row, taken, part.size) @ moved
        moved = np.linalg.matrix_power(taken, part.size) @ moved
    return rows


def list_powers(row: Float[np.ndarray, " m"], way: Float[np.ndarray, "m m"], count: int) -> Float[np.ndarray, "n m"]:
    """Return a row times each power of a matrix, twice as many at each step."""
    rows = row[None]
    while len(rows) < count:
        rows, way = np.concatenate([rows, rows[: count - len(rows)] @ way]), way @ way
    return rows


def follow(
    law: RunnableLaw, ticks: Ticks, limited: Bool[np.ndarray, " n"], share: float = 1.0
) -> Float[np.ndarray, " n"]:
    """Return the commands, not limited, of a law that starts from zero and whose limit acts in the rows where it does
    in the log; with a share of the limit. That is linear in reference, readings and share.
    """
    if not np.any(limited) or not math.isfinite(law.force_limit_N):
        (b, d), given = take_weights(law), Inputs.make(law, ticks)
        return law.per_effort * given.respond(Law(a=law.a, b=b, c=law.c, d=d, sample_time_s=law.sample_time_s))[0]
    reference, added = _compensate(law, ticks)
    direct = law.d_reference * reference - ticks.measured @ np.ravel(law.d_measurement) + added
    if not law.c.size:  # no state, for which the limit would make any difference
        return law.per_effort * direct
    columns = np.reshape(law.b_measurement, (law.c.size, -1))
    drive = np.outer(reference, law.b_reference) - ticks.measured @ columns.T
    over = share * law.force_limit_N * np.sign(ticks.command) - direct
    drive += np.outer(np.where(limited, over, 0.0), law.anti_windup)
    ways = np.array([law.a, law.a - np.outer(law.anti_windup, law.c)])
    return law.per_effort * (_scan(ways, limited, drive) @ law.c + direct)


def _scan(
    ways: Float[np.ndarray, "2 m m"], second: Bool[np.ndarray, " n"], drive: Float[np.ndarray, "n m"]
) -> Float[np.ndarray, "n m"]:
    """Return the states, from zero on, of which each is one of two matrices times the one before, and what drives it:
    those within blocks of rows side by side, from zero and from each state at their starts, then block after block.
    """
    n, m = drive.shape
    rows = math.isqrt(n) + 1
    blocks = -(-n // rows)
    spare = blocks * rows - n
    taken = ways[np.pad(second, (0, spare)).astype(int)].reshape(blocks, rows, m, m)
    driven = np.pad(drive, ((0, spare), (0, 0))).reshape(blocks, rows, m)
    moved, within = np.tile(np.eye(m, m + 1), (blocks, 1, 1)), np.empty((blocks, rows, m, m + 1))
    for k in range(rows):
        within[:, k] = moved
        moved = taken[:, k] @ moved
        moved[:, :, m] += driven[:, k]
    starts = np.zeros((blocks, m))
    for k in range(1, blocks):
        starts[k] = moved[k - 1, :, :m] @ starts[k - 1] + moved[k - 1, :, m]
    states = np.einsum("bkij,bj->bki", within[..., :m], starts) + within[..., m]
    return states.reshape(-1, m)[:n]


def _estimate_start(law: RunnableLaw, ticks: Ticks, allowed: Float[np.ndarray, " n"]) -> Float[np.ndarray, " m"]:
    """Return a state from which the first rows match as well as they can."""
    limited = find_at_limit(ticks, law)
    if np.count_nonzero(~limited) < 3 * max(law.c.size, 1) or not law.c.size:
        return np.zeros(law.c.size)
    left, weight = ticks.command - follow(law, ticks, limited), 1.0 / allowed[~limited]
    modes = find_modes(law, limited)[~limited] * weight[:, None]
    return np.linalg.lstsq(modes, left[~limited] * weight, rcond=1e-10)[0]


def _estimate_moving(setting: Setting, ticks: Ticks, allowed: Float[np.ndarray, " m"]) -> ScheduleState | None:
    """Return a state from which a schedule whose variable moves matches the first rows, up to the first at a limit, as
    well as it can: it is linear in its state, at whatever places. None where they are too few.
    """
    schedule = setting.law
    assert isinstance(schedule, RunnableSchedule) and ticks.place is not None
    at_limit = find_at_limit(ticks, setting.linear)
    rows = int(np.argmax(at_limit)) if np.any(at_limit) else len(ticks)
    begin = schedule.reset(place=float(ticks.place[0]))
    if rows < 3 * max(begin.x.size, 1) or not begin.x.size:
        return None
    free, first = replace(setting, law=limit_law(schedule, math.inf)), ticks.take(slice(0, rows))
    still = run_setting(free, first, replace(begin, x=0.0 * begin.x))
    ways = [run_setting(free, first, replace(begin, x=unit)) - still for unit in np.eye(begin.x.size)]
    weight = 1.0 / allowed[:rows]
    modes = np.column_stack(ways) * weight[:, None]
    return replace(begin, x=np.linalg.lstsq(modes, (first.command - still) * weight, rcond=1e-10)[0])


def find_offset(
    law: RunnableLaw, ticks: Ticks, step: float, error: Float[np.ndarray, " n"]
) -> tuple[float, Float[np.ndarray, " n"]]:
    """Return by how much a reference lies above what a law was given, as an error has it, and what an offset of one
    makes of the commands: where the reference repeats the mean of its rounding is the same in each period, and runs up
    in integrals. It is no more than half of the `step` that it is rounded to.
    """
    limited = find_at_limit(ticks, law)
    if not step or not count_integrals(law) or np.all(limited):
        return 0.0, np.zeros(len(ticks))
    steady = np.where(limited, 0.0, find_steady(law, limited))
    if not np.any(steady):  # no row within the limit has seen the reference
        return 0.0, steady
    return float(np.clip(steady @ error / (steady @ steady), -0.5 * step, 0.5 * step)), steady


def list_steps(ticks: Ticks) -> Float[np.ndarray, " k"]:
    """Return the steps that reference and readings are rounded to; none of a reference of steps."""
    return np.array(_list_steps(ticks.reference.tobytes(), *(column.tobytes() for column in ticks.measured.T)))


@lru_cache(maxsize=4)  # dozens of laws are played on one log
def _list_steps(*contents: bytes) -> list[float]:
    reference, *measured = map(np.frombuffer, contents)
    return [find_quantisation(reference) if _is_rounded(reference) else 0.0, *map(find_quantisation, measured)]


def _is_rounded(reference: Float[np.ndarray, " n"]) -> bool:
    """Tell whether a reference may be logged with fewer digits than the law was given: not where it is steps, which
    has few values and stays at each.
    """
    moves = float(np.mean(np.diff(reference) != 0.0)) if reference.size > 1 else 0.0
    return np.unique(reference).size >= LEVELS or moves > MOVING


def _allow(
    law: RunnableLaw, ticks: Ticks, log: Ticks, steps: Float[np.ndarray, " k"]
) -> tuple[Float[np.ndarray, " n"], float]:
    """Return one std of what rounding allows at each row, of the command and of what the law saw, which is rounded to
    `steps` in the log, and its rms within stretches.
    """
    from scipy.signal import fftconvolve  # deferred: 0.3 s

    n, integrals = len(ticks), count_integrals(law)
    response = find_modes(law, np.zeros(min(n, LONGEST_RESPONSE) - 1, dtype=bool))
    (columns, direct), seen = take_weights(law), np.column_stack([ticks.reference, ticks.measured])
    variance = np.full(n, log.quantum**2 / 12.0 + (FLOOR * float(np.std(log.command))) ** 2)
    within = float(variance[0])
    for b, d, values, step in zip(columns.T, direct, seen.T, steps, strict=True):
        each = step**2 / 12.0
        if each:
            impulse = np.concatenate([[law.per_effort * d], response @ b])
            within += each * float(np.mean(np.cumsum(impulse**2)))
            impulse = np.pad(impulse, (0, n - impulse.size), mode="edge")
            variance += each * np.cumsum(impulse**2)
            for edge in find_edges(values):
                walk = fftconvolve(edge.astype(float), impulse)[:n]
                variance += each * walk**2
                within += each * float(np.mean(leave_integrals(walk, integrals) ** 2))
    return np.sqrt(np.maximum(variance, np.finfo(float).tiny)), math.sqrt(within)
