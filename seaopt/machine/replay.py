r"""The replay: the law, fed with the logged reference and readings, makes the logged command, to its rounding.

What the log does not have is the law's state at its first row. Where neither a law at zero nor one at rest under the
first row goes on as logged, it is taken from the first rows: while the command is within its limit, what a state adds
to the commands is :math:`C A^k x_0`, which is linear in it.

**What rounding allows.** The logged command is off by up to half its step. A reading that is logged coarser than the
law saw it, by a step :math:`q`, adds an error of variance :math:`\frac{q^2}{12} \sum_{j \le k} h_j^2` at row k, with
the law's impulse response h: it grows with the integral. Levels of a reference of steps are no rounding;
where rounding allows more than a tenth of the command, nothing is decided.

**Causes.** Where the replay does not match, each of a list of causes is tried: the law or the log is changed by it, and
replayed. Factors are found by least squares of the logged commands over what reference and readings add to them. They
are ranked by how much of the mismatch they remove; where one removes much and leaves something, a second is looked for
behind it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from seaopt.control import Controller, ForceMPC, RunnableLaw, RunnableSchedule, runnable
from seaopt.control.laws.structures import LAW_GAINS, Gains
from seaopt.control.loops.compensation.terms import FORGOTTEN
from seaopt.errors import LogError, SeaoptError
from seaopt.logs.quality.faults import find_quantisation
from seaopt.machine.decimated import SAME_RATE, count_ticks_per_row, match_lines
from seaopt.machine.stepped import Setting, Source, State, limit_law, list_starts, make_setting, run_setting
from seaopt.machine.ticks import AT_LIMIT, Ticks
from seaopt.records import record

FLOOR = 1e-3  # of the command's variation: a mismatch below is none
ROUNDING = 2.0  # times the std that rounding leaves by the estimate: a mismatch up to there is rounding
SIGMAS = 4.0  # of what rounding allows
HEAD, LEAST_HEAD = 400, 60  # rows that tell the state at the first, and rows within the limit that factors take
HEAD_DECAYS, LONGEST_HEAD = 3.0, 20000  # time constants of the slowest part that they last besides, and rows at most
INTEGRATES = 1e-6  # distance from 1 of a pole that does not decay
COARSEST = 0.1  # of the command's rms, that rounding may allow of a replay that decides
LEVELS = 200  # of a reference that is taken for rounded; what has fewer is steps
LONGEST_RESPONSE = 5000  # rows over which an error of rounding is added up
WINDOW = 2000  # rows on which causes are tried, about the largest mismatch
EVERY = (2, 3, 4, 5, 10)  # rows per tick of a law that is slower than the logger
UNITS = tuple(each**power for each in (1e3, 60.0 / (2.0 * math.pi), 180.0 / math.pi, 1e6, 1e2) for power in (-1, 1))
SAME_FACTOR = 0.01  # relative: factors that are a unit, or a sign
MUCH = 0.5  # of the mismatch's energy, which a first cause of two removes
MOST_CAUSES = 6
UNDECIDED = ("rounding",)  # causes that lie in the log, for which it decides nothing


@record
class Cause:
    """Something that the machine does in place of what was exported, and how much of the mismatch it explains."""

    kind: str  # rate, late, sign, unit, factor, gain, limit, feedforward, compensation, gate, heat, another law, ...
    what: str  # the signal, gain, term or file that it concerns
    value: float | None  # factor, ticks, limit, rate
    unit: str
    removes: float  # share of the mismatch's energy
    explains: bool  # leaves nothing but rounding


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


@record(eq=False)
class Alternative:
    """A cause that may be, and what it makes of a setting."""

    kind: str
    what: str
    change: Callable[[Setting], Setting]
    value: float | None = None
    unit: str = ""


@record(eq=False)
class Match:
    """The commands of a replay, what rounding allows at each row, and how far they are from the log's."""

    commands: Float[np.ndarray, " n"]
    allowed: Float[np.ndarray, " n"]
    error: Float[np.ndarray, " n"]

    @property
    def energy(self) -> float:
        """Mean square of the difference."""
        return float(np.mean(self.error**2))

    @property
    def met(self) -> bool:
        """Whether nothing is left but rounding."""
        return self.energy <= ROUNDING**2 * float(np.mean(self.allowed**2))


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


def play(setting: Setting) -> Match:
    """Return the commands of a setting's law on its log."""
    ticks, linear = setting.ticks, setting.linear
    head = ticks.take(slice(0, _count_head(linear)))
    allowed = _allow(linear, ticks)
    allowed_head = allowed[: len(head)]
    best: tuple[State, int] | None = None
    error = np.inf

    def starts() -> Iterator[tuple[State, int]]:
        yield from list_starts(setting)
        if not isinstance(setting.law, ForceMPC):
            yield replace(setting.law.reset(), x=_estimate_start(linear, head, allowed_head)), 0

    for start, first in starts():
        rows = head if not first else ticks.take(slice(first, first + len(head)))
        off = float(np.mean((run_setting(setting, rows, start) - rows.command) ** 2))
        if off < error:
            best, error = (start, first), off
        if error <= np.mean(allowed_head**2):
            break
    assert best is not None
    start, first = best
    commands = np.concatenate([ticks.command[:first], run_setting(setting, ticks.take(slice(first, None)), start)])
    if linear.compensation is not None:  # which differences to a row before the first
        commands[0] = ticks.command[0]
    return Match(commands=commands, allowed=allowed, error=commands - ticks.command)


def _count_head(law: RunnableLaw) -> int:
    """Return how many rows tell the state at the first: those in which the slowest part of a law decays, too."""
    size = np.abs(np.linalg.eigvals(law.a)) if law.c.size else np.zeros(0)
    decays = size[(size > 0.0) & (size < 1.0 - INTEGRATES)]
    slowest = -1.0 / math.log(float(np.max(decays))) if decays.size else 0.0
    return int(min(max(HEAD, HEAD_DECAYS * slowest), LONGEST_HEAD))


def _drive(law: RunnableLaw, ticks: Ticks) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n m"]]:
    """Return what reference and readings add to the effort at once, and to the next state, at each row."""
    columns, direct = np.reshape(law.b_measurement, (law.c.size, -1)), np.ravel(law.d_measurement)
    reference, added = _compensate(law, ticks)
    effort = law.d_reference * reference - ticks.measured @ direct + added
    return effort, np.outer(reference, law.b_reference) - ticks.measured @ columns.T


def _compensate(law: RunnableLaw, ticks: Ticks) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Return the reference with what the law's terms add to it, and what they add to the effort, at each row."""
    if law.compensation is None:
        return ticks.reference, np.zeros(len(ticks))
    memory, rows = FORGOTTEN, np.empty((len(ticks), 2))
    for k, readings in enumerate(ticks.further[:, : len(law.compensation.reads)].tolist()):
        rows[k, 0], rows[k, 1], memory = law.compensation.step(memory, float(ticks.reference[k]), readings)
    return rows[:, 0], rows[:, 1]


def _find_limited(ticks: Ticks) -> Bool[np.ndarray, " n"]:
    """Tell which logged commands are at a limit: those at the largest magnitude, where several rows in a row are."""
    size = np.abs(ticks.command)
    top = size >= AT_LIMIT * np.max(size)
    return top if np.any(top[1:] & top[:-1]) else np.zeros(size.size, dtype=bool)


def _find_modes(law: RunnableLaw, limited: Bool[np.ndarray, " n"]) -> Float[np.ndarray, "n m"]:
    """Return what each state at the first row adds to the later commands, with the limit as logged."""
    rows, moved = np.empty((limited.size, law.c.size)), np.eye(law.c.size)
    ways = law.a, law.a - np.outer(law.anti_windup, law.c)
    for k, at_limit in enumerate(limited.tolist()):
        rows[k] = law.c @ moved
        moved = ways[at_limit] @ moved
    return law.per_effort * rows


def _follow(
    law: RunnableLaw, ticks: Ticks, limited: Bool[np.ndarray, " n"], share: float = 1.0
) -> Float[np.ndarray, " n"]:
    """Return the commands, not limited, of a law that starts from zero and whose limit acts in the rows where it does
    in the log; with a share of the limit. That is linear in reference, readings and share.
    """
    direct, drive = _drive(law, ticks)
    x, out, most = np.zeros(law.c.size), np.empty(len(ticks)), share * law.force_limit_N
    signs, at_limit = np.sign(ticks.command), limited.tolist()
    for k in range(len(ticks)):
        out[k] = float(law.c @ x) + direct[k]
        x = law.a @ x + drive[k]
        if at_limit[k] and math.isfinite(law.force_limit_N):
            x = x + law.anti_windup * (most * signs[k] - out[k])
    return law.per_effort * out


def _estimate_start(law: RunnableLaw, ticks: Ticks, allowed: Float[np.ndarray, " n"]) -> Float[np.ndarray, " m"]:
    """Return a state from which the first rows match as well as they can."""
    limited = _find_limited(ticks)
    if np.count_nonzero(~limited) < 3 * max(law.c.size, 1) or not law.c.size:
        return np.zeros(law.c.size)
    left, weight = ticks.command - _follow(law, ticks, limited), 1.0 / allowed[~limited]
    modes = _find_modes(law, limited)[~limited] * weight[:, None]
    return np.linalg.lstsq(modes, left[~limited] * weight, rcond=1e-10)[0]


def _allow(law: RunnableLaw, ticks: Ticks) -> Float[np.ndarray, " n"]:
    """Return one std of what rounding allows at each row."""
    n = len(ticks)
    response = _find_modes(law, np.zeros(min(n, LONGEST_RESPONSE) - 1, dtype=bool))
    steps: list[Any] = []
    if np.unique(ticks.reference).size >= LEVELS:
        steps.append((law.b_reference, law.d_reference, ticks.reference))
    columns = np.reshape(law.b_measurement, (law.c.size, -1)), np.ravel(law.d_measurement)
    steps += [(columns[0][:, i], columns[1][i], ticks.measured[:, i]) for i in range(law.measured)]
    variance = np.full(n, ticks.quantum**2 / 12.0 + (FLOOR * float(np.std(ticks.command))) ** 2)
    for b, d, values in steps:
        quantum = find_quantisation(values)
        if quantum:
            impulse = np.concatenate([[law.per_effort * d], response @ b])
            grown = np.cumsum(impulse**2) * quantum**2 / 12.0
            variance += grown[np.minimum(np.arange(n), grown.size - 1)]
    return np.sqrt(np.maximum(variance, np.finfo(float).tiny))


def find_causes(whole: Setting, match: Match, others: Mapping[str, Controller]) -> tuple[tuple[Cause, ...], Setting]:
    """Return the causes that explain a mismatch, the best first, and the setting as the first (and a second) has it."""
    middle, size = int(np.argmax(np.abs(match.error))), max(WINDOW, _count_head(whole.linear))
    begin = max(0, min(middle - size // 2, len(whole.ticks) - size))
    window = replace(whole, ticks=whole.ticks.take(slice(begin, begin + size)))
    before = play(window).energy
    if not before:
        return (), whole
    tried = sorted(_try_all(window, others), key=_rank)
    if not tried or tried[0][1].energy >= before:
        return (), whole
    causes = [_make_cause(alternative, played, before) for alternative, played in tried[:MOST_CAUSES]]
    best = tried[0][0]
    if not causes[0].explains and causes[0].removes > MUCH:
        behind = best.change(window)
        second = min(_try_all(behind, {}), key=lambda pair: pair[1].energy, default=None)
        if second is not None and second[1].met:
            cause = _make_cause(second[0], second[1], before)
            causes = [causes[0], cause, *causes[1:]]
    return tuple(cause for cause in causes if cause.removes > 0.0), best.change(whole)


def _rank(pair: tuple[Alternative, Match]) -> tuple[bool, bool, float]:
    """Return the order of a cause: one that explains all first, and of those the ones without a fitted size."""
    alternative, match = pair
    return not match.met, match.met and alternative.kind in ("gain", "factor"), match.energy


def _make_cause(alternative: Alternative, played: Match, before: float) -> Cause:
    return Cause(
        kind=alternative.kind,
        what=alternative.what,
        value=alternative.value,
        unit=alternative.unit,
        removes=1.0 - played.energy / before,
        explains=played.met,
    )


def _try_all(setting: Setting, others: Mapping[str, Controller]) -> Iterator[tuple[Alternative, Match]]:
    for alternative in list_alternatives(setting, others):
        try:
            played = play(alternative.change(setting))
        except SeaoptError:  # a law that cannot run so
            continue
        if np.isfinite(played.energy):
            yield alternative, played


def list_alternatives(setting: Setting, others: Mapping[str, Controller]) -> Iterator[Alternative]:
    """Yield what may be the cause, those that change the log first."""
    yield from _list_of_time(setting)
    yield from _list_factors(setting)
    yield from _list_of_guards(setting)
    yield from _list_of_gains(setting)
    yield from _list_places(setting)
    signals = setting.controller.signals
    for name, other in others.items():
        if other.signals == signals:
            yield Alternative(kind="another law", what=name, change=lambda given, other=other: _take_law(given, other))


def _take_law(setting: Setting, controller: Controller) -> Setting:
    return replace(setting, controller=controller, law=runnable(controller))


def _change_ticks(change: Callable[[Ticks], Ticks]) -> Callable[[Setting], Setting]:
    return lambda setting: replace(setting, ticks=change(setting.ticks))


def _list_of_time(setting: Setting) -> Iterator[Alternative]:
    """Yield other rates, and signals that come late."""
    for ticks in (1, -1, 2):
        change = _change_ticks(lambda rows, late=ticks: rows.move_command(late))
        yield Alternative(kind="late", what="command", change=change, value=ticks, unit="ticks")
    for ticks in (1, 2):
        change = _change_ticks(lambda rows, late=ticks: rows.delay_readings(late))
        yield Alternative(kind="late", what="readings", change=change, value=ticks, unit="ticks")
    same = float(np.mean(np.diff(setting.ticks.command) == 0.0))
    for every in EVERY:
        if same > 0.9 * (1.0 - 1.0 / every):
            change = _change_ticks(lambda rows, every=every: rows.take_every(every))
            rate = setting.ticks.rate_hz / every
            yield Alternative(kind="rate", what="law", change=change, value=rate, unit="Hz")


def _scale(what: str, factor: float, setting: Setting) -> Setting:
    """Return a setting in which the law is given, or its command is, a factor times what it was."""
    ticks, controller = setting.ticks, setting.controller
    if what == "reference":
        return replace(setting, ticks=replace(ticks, reference=factor * ticks.reference))
    if what in controller.signals:
        scale = np.ones(ticks.measured.shape[1])
        scale[controller.signals.index(what)] = factor
        return replace(setting, ticks=replace(ticks, measured=scale * ticks.measured))
    return replace(setting, ticks=replace(ticks, command=ticks.command / factor))


def _list_factors(setting: Setting) -> Iterator[Alternative]:
    """Yield signs, units and other factors of reference, readings and command."""
    fitted = _fit_factors(setting)
    for what in ("reference", *setting.controller.signals, setting.controller.command.input):
        factor = fitted.get(what)
        usual = [-1.0, *UNITS] if factor is None else [factor]
        for value in dict.fromkeys([-1.0, *usual]):
            unit = next((each for each in UNITS if abs(value / each - 1.0) < SAME_FACTOR), None)
            kind = "sign" if abs(value + 1.0) < SAME_FACTOR else "factor" if unit is None else "unit"
            kind = "open loop" if abs(value) < SAME_FACTOR and what in setting.controller.signals else kind
            value = -1.0 if kind == "sign" else value if unit is None else unit
            yield Alternative(
                kind=kind,
                what=what,
                value=value,
                change=lambda given, what=what, value=value: _scale(what, value, given),
            )


def _fit_factors(setting: Setting) -> dict[str, float]:
    """Return the factor of reference, of each reading, and of the command, that fits the logged commands best, each
    by itself; none where the command is at its limit.
    """
    ticks, law = setting.ticks, setting.linear
    limited = _find_limited(ticks)
    free = ~limited
    if np.count_nonzero(free) < LEAST_HEAD:
        return {}
    nothing = replace(ticks, reference=0.0 * ticks.reference, measured=0.0 * ticks.measured)
    parts = {"reference": _follow(law, replace(nothing, reference=ticks.reference), limited, 0.0)}
    for i, name in enumerate(setting.controller.signals):
        measured = np.zeros_like(ticks.measured)
        measured[:, i] = ticks.measured[:, i]
        parts[name] = _follow(law, replace(nothing, measured=measured), limited, 0.0)
    together, modes = _follow(law, ticks, limited), _find_modes(law, limited)
    columns = {**parts, setting.controller.command.input: together}
    factors: dict[str, float] = {}
    for name, column in columns.items():
        target = ticks.command - (0.0 if column is together else together - column)
        solved = np.linalg.lstsq(np.column_stack([column, modes])[free], target[free], rcond=1e-10)[0]
        if np.isfinite(solved[0]) and (solved[0] or name in setting.controller.signals):
            factors[name] = float(solved[0])
    return factors


def _change_law(*, linear: bool = False, **changes: Any) -> Callable[[Setting], Setting]:
    """Return what changes a law, or its linear form, with the columns of the log that it then reads."""

    def change(setting: Setting) -> Setting:
        before = setting.linear if linear else setting.law
        law = replace(before, **changes)
        if isinstance(before, ForceMPC) or isinstance(law, ForceMPC):
            return replace(setting, law=law)
        read = [before.further.index(name) for name in law.further]
        return replace(setting, law=law, ticks=replace(setting.ticks, further=setting.ticks.further[:, read]))

    return change


def _list_of_guards(setting: Setting) -> Iterator[Alternative]:
    """Yield limits, guards and terms that are others, or left out."""
    law, linear, ticks = setting.law, setting.linear, setting.ticks
    reached, unit = float(np.max(np.abs(ticks.command))), setting.controller.command.unit
    if not math.isclose(reached, law.command_limit, rel_tol=1e-3):
        change = lambda given: replace(given, law=limit_law(given.law, reached))  # noqa: E731
        yield Alternative(kind="limit", what="command", value=reached, unit=unit, change=change)
    if law.gate is not None:
        yield Alternative(kind="gate", what="left out", change=_change_law(gate=None))
    if law.heat is not None:
        yield Alternative(kind="heat", what="left out", change=_change_law(heat=None))
    if not isinstance(law, ForceMPC) and np.any(law.anti_windup):
        none = np.zeros_like(law.anti_windup)
        yield Alternative(kind="anti-windup", what="left out", change=_change_law(anti_windup=none))
    added = linear.compensation
    terms = [] if added is None else [name for name in ("friction", "gravity", "ripple") if getattr(added, name)]
    for name in terms:
        without = replace(added, **{name: None}) if added is not None and len(terms) > 1 else None
        yield Alternative(kind="compensation", what=name, change=_change_law(linear=True, compensation=without))
    if setting.controller.link is not None:
        change = _change_ticks(
            lambda rows: replace(rows, measured=rows.measured * _all_but_last(rows.measured.shape[1]))
        )
        yield Alternative(kind="feedforward", what="link", change=change)


def _all_but_last(n: int) -> Float[np.ndarray, " n"]:
    return np.append(np.ones(n - 1), 0.0)


def _read_gains(controller: Controller) -> Gains | None:
    """Return the gains that make a controller's law; None of a law of the user's own."""
    if not set(LAW_GAINS) <= set(controller.gains):
        return None
    return Gains.from_names(controller.gains, controller.observer, controller.speed_loop, controller.link)


def _list_places(setting: Setting) -> Iterator[Alternative]:
    """Yield where a schedule's variable may have been for the law: at a point, or in another unit."""
    law, place = setting.law, setting.ticks.place
    if not isinstance(law, RunnableSchedule) or place is None:
        return
    points = law.table.points.tolist()
    over = law.table.over
    for point in dict.fromkeys([law.fallback, *points]):
        change = _change_ticks(lambda rows, point=point: replace(rows, place=np.full(len(rows), point)))
        yield Alternative(kind="place", what=over, value=point, unit=law.table.unit, change=change)
    for factor in (-1.0, *UNITS):
        change = _change_ticks(lambda rows, factor=factor: _scale_place(rows, factor))
        kind = "sign" if factor < 0.0 else "unit"
        yield Alternative(kind=kind, what=over, value=factor, change=change)


def _scale_place(ticks: Ticks, factor: float) -> Ticks:
    return replace(ticks, place=None if ticks.place is None else factor * ticks.place)


def _make_law(controller: Controller, gains: Gains, sample_time_s: float | None = None) -> Callable[[Setting], Setting]:
    """Return what gives a setting the law of other gains, or of another sample time, with the guards that it has."""

    def change(setting: Setting) -> Setting:
        period = sample_time_s or controller.sample_time_s
        law = gains.law(controller.spec.structure, period).balanced()
        made = runnable(replace(controller, law=law))
        guards = {name: getattr(setting.linear, name) for name in ("gate", "heat", "compensation", "command_limit")}
        return replace(setting, law=replace(made, **guards))

    return change


def _list_of_gains(setting: Setting) -> Iterator[Alternative]:
    """Yield laws with parts that are left out, with gains of another size, and made for another rate."""
    controller, gains = setting.controller, _read_gains(setting.controller)
    if gains is None:
        return
    parts: list[tuple[str, str, dict[str, Any]]] = [
        ("feedforward", "reference", {"k_r": gains.k_p}),
        ("feedforward", "reference", {"k_r": 0.0}),
        ("feedforward", "derivative of the reference", {"c": 0.0}),
        ("feedforward", "derivative of the reference", {"c": 1.0}),
        ("part", "prefilter", {"prefilter": None}),
        ("part", "notch", {"notch": None}),
        ("part", "disturbance observer", {"observer": None}),
        ("part", "integral", {"k_i": 0.0}),
        ("part", "derivative", {"k_d": 0.0}),
        ("gain", "T_f", {"T_f": 0.5 * gains.T_f}),
        ("gain", "T_f", {"T_f": 2.0 * gains.T_f}),
    ]
    for kind, what, changes in parts:
        if any(getattr(gains, name) != value for name, value in changes.items()):
            value = next(iter(changes.values())) if kind == "gain" else None
            yield Alternative(
                kind=kind, what=what, value=value, change=_make_law(controller, replace(gains, **changes))
            )
    for name, value in _fit_gains(setting, gains).items():
        change = _make_law(controller, replace(gains, **{name: value}))
        yield Alternative(kind="gain", what=name, value=value, change=change)
    rates = {2.0 * controller.sample_time_s, 0.5 * controller.sample_time_s, 1.0 / setting.ticks.rate_hz}
    for period in rates:
        if not math.isclose(period, controller.sample_time_s, rel_tol=1e-3):
            change = _make_law(controller, gains, period)
            yield Alternative(kind="rate", what="gains", value=1.0 / period, unit="Hz", change=change)


def _fit_gains(setting: Setting, gains: Gains) -> dict[str, float]:
    """Return the size of each gain, alone, that fits the logged commands best: a law is linear in each of them."""
    ticks, limited = setting.ticks, _find_limited(setting.ticks)
    free = ~limited
    if np.count_nonzero(free) < LEAST_HEAD:
        return {}
    base, fitted = _follow(setting.linear, ticks, limited), dict[str, float]()
    modes = _find_modes(setting.linear, limited)
    for name in ("k_p", "k_i", "k_d", "k_r"):
        value = getattr(gains, name)
        if not value:
            continue
        changed = _make_law(setting.controller, replace(gains, **{name: 1.01 * value}))(setting)
        column = (_follow(changed.linear, ticks, limited) - base) / (0.01 * value)
        table = np.column_stack([column, modes])
        step = np.linalg.lstsq(table[free], (ticks.command - base)[free], rcond=1e-10)[0][0]
        if np.isfinite(step) and value + step > 0.0:
            fitted[name] = float(value + step)
    return fitted
