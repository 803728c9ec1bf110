"""What may make the logged commands in place of the law, a change of the law or of the log each.

Factors are found by least squares of the logged commands over what reference and readings add to them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float

from seaopt.control import ForceMPC, RunnableSchedule, ScheduledController
from seaopt.control.laws.structures import Gains
from seaopt.errors import SeaoptError
from seaopt.machine.gains.free_gains import make_law
from seaopt.machine.stepped import (
    Others,
    Setting,
    Source,
    change_plan,
    find_limited,
    find_modes,
    follow,
    keep_over,
    limit_law,
    make_setting,
    play,
    stand,
    stands_still,
)
from seaopt.machine.ticks import Ticks
from seaopt.records import record

LEAST_HEAD = 60  # rows within the limit that factors take
EVERY = (2, 3, 4, 5, 10)  # rows per tick of a law that is slower than the logger
UNITS = tuple(each**power for each in (1e3, 60.0 / (2.0 * math.pi), 180.0 / math.pi, 1e6, 1e2) for power in (-1, 1))
SAME_FACTOR = 0.01  # relative: factors that are a unit, or a sign
REFINES = 3  # replays that a factor of a schedule's command takes
ASKED = "the outer loop's output"


@record
class EditedGain:
    """One gain of a table that was edited beside another one."""

    name: str
    points: tuple[float, ...]
    factor: float
    everywhere: bool  # at all points that the log reaches


@record
class Edited:
    """Where the table of a schedule was edited."""

    over: str  # its variable
    unit: str
    points: tuple[float, ...]  # of the edited gains
    factor: float | None  # of the gains; None: each has its own
    everywhere: bool = False  # at all points that the log reaches
    pair: tuple[EditedGain, ...] = ()  # two gains, not at one point


@record(eq=False)
class Alternative:
    """A cause that may be, and what it makes of a setting."""

    kind: str
    what: str
    change: Callable[[Setting], Setting]
    value: float | None = None
    unit: str = ""
    gains: Mapping[str, float] | None = None
    exported: Mapping[str, float] | None = None
    edited: Edited | None = None
    fitted: bool = False  # its value is the one that explains most


def list_alternatives(setting: Setting, others: Others) -> Iterator[Alternative]:
    """Yield what may be the cause, those that change the log first."""
    yield from _list_of_time(setting)
    yield from _list_factors(setting)
    yield from _list_of_guards(setting)
    yield from _list_of_gains(setting)
    yield from _list_places(setting)
    yield from list_others(setting, others)


def list_others(setting: Setting, others: Others) -> Iterator[Alternative]:
    """Yield laws that may have run in its place, of those that read the same."""
    law, signals = setting.law, setting.controller.signals
    over = law.table.over if isinstance(law, RunnableSchedule) else None
    for name, other in keep_over(others, over).items():
        if stand(other, None).signals == signals:
            yield Alternative(kind="another law", what=name, change=lambda given, other=other: _take_law(given, other))


def _take_law(setting: Setting, other: Source) -> Setting:
    if isinstance(other, ScheduledController):
        return replace(setting, law=other.runnable())
    taken = make_setting(other, setting.ticks)
    return replace(setting, controller=taken.controller, law=taken.law)


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
    if ticks.rendered is not None and what in ticks.rendered:
        parts = ticks.rendered | {what: factor * ticks.rendered[what]}
        return replace(setting, ticks=replace(ticks, reference=np.sum([*parts.values()], axis=0), rendered=parts))
    if what in ("reference", ASKED):
        return replace(setting, ticks=replace(ticks, reference=factor * ticks.reference))
    if what in controller.signals:
        scale = np.ones(ticks.measured.shape[1])
        scale[controller.signals.index(what)] = factor
        return replace(setting, ticks=replace(ticks, measured=scale * ticks.measured))
    return replace(setting, ticks=replace(ticks, command=ticks.command / factor))


def _list_factors(setting: Setting) -> Iterator[Alternative]:
    """Yield signs, units and other factors of reference, readings and command."""
    fitted, law, place = _fit_factors(setting), setting.law, setting.ticks.place
    moves = isinstance(law, RunnableSchedule) and place is not None and not stands_still(place, law.table.points)
    if moves and setting.controller.command.input in fitted:
        fitted |= _refine_command(setting, fitted[setting.controller.command.input])
    for what in (
        *(setting.ticks.rendered or ()),
        _name_reference(setting.ticks),
        *setting.controller.signals,
        setting.controller.command.input,
    ):
        factor = fitted.get(what)
        usual = [-1.0, *UNITS] if factor is None else [factor]
        signals = setting.controller.signals
        for kind, value in dict.fromkeys(name_factor(what, each, signals) for each in [-1.0, *usual]):
            yield Alternative(
                kind=kind,
                what=what,
                value=value,
                change=lambda given, what=what, value=value: _scale(what, value, given),
            )


def _refine_command(setting: Setting, factor: float) -> dict[str, float]:
    """Return the factor of a schedule's command, by replays as its variable moves: the linear law is that of its
    middle.
    """
    name = setting.controller.command.input
    for _ in range(REFINES):
        played = play(_scale(name, factor, setting))
        size = float(played.commands @ played.commands)
        factor *= float((played.commands - played.error) @ played.commands) / size if size else 1.0
        if not math.isfinite(factor) or not factor:
            return {}
    return {name: factor}


def _name_reference(ticks: Ticks) -> str:
    """Return what the law's own reference is: the log's, or what an outer loop makes of that."""
    return "reference" if ticks.rendered is None else ASKED


def name_factor(what: str, value: float, signals: Sequence[str]) -> tuple[str, float]:
    """Return what a factor of reference, reading or command is, and its value, exact where it is a sign or a unit."""
    unit = next((each for each in UNITS if abs(value / each - 1.0) < SAME_FACTOR), None)
    if abs(value + 1.0) < SAME_FACTOR:
        return "sign", -1.0
    if unit is None and abs(value) < SAME_FACTOR and what in signals:
        return "open loop", value
    return ("factor", value) if unit is None else ("unit", unit)


def _fit_factors(setting: Setting) -> dict[str, float]:
    """Return the factor of reference, of each reading, and of the command, that fits the logged commands best, each
    by itself; none where the command is at its limit.
    """
    ticks, law = setting.ticks, setting.linear
    limited = find_limited(ticks)
    free = ~limited
    if np.count_nonzero(free) < LEAST_HEAD:
        return {}
    nothing = replace(ticks, reference=0.0 * ticks.reference, measured=0.0 * ticks.measured)
    parts = {_name_reference(ticks): follow(law, replace(nothing, reference=ticks.reference), limited, 0.0)}
    for name, part in (ticks.rendered or {}).items():
        parts[name] = follow(law, replace(nothing, reference=part), limited, 0.0)
    for i, name in enumerate(setting.controller.signals):
        measured = np.zeros_like(ticks.measured)
        measured[:, i] = ticks.measured[:, i]
        parts[name] = follow(law, replace(nothing, measured=measured), limited, 0.0)
    together, modes = follow(law, ticks, limited), find_modes(law, limited)
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
        read = [before.further.index(name) for name in law.further]
        return replace(setting, law=law, ticks=replace(setting.ticks, further=setting.ticks.further[:, read]))

    return change


def _list_of_guards(setting: Setting) -> Iterator[Alternative]:
    """Yield limits, guards and terms that are others, or left out."""
    law, linear, ticks = setting.law, setting.linear, setting.ticks
    reached, unit = float(np.max(np.abs(ticks.command))), setting.controller.command.unit
    if np.any(find_limited(ticks)) and not math.isclose(reached, law.command_limit, rel_tol=1e-3):
        change = lambda given: replace(given, law=limit_law(given.law, reached))  # noqa: E731
        yield Alternative(kind="limit", what="command", value=reached, unit=unit, change=change)
        if not isinstance(law, ForceMPC):
            untold = lambda given: _leave_windup(change(given))  # noqa: E731
            yield Alternative(kind="limit", what="behind the law", value=reached, unit=unit, change=untold)
    if law.gate is not None:
        yield Alternative(kind="gate", what="left out", change=_change_law(gate=None))
    if law.heat is not None:
        yield Alternative(kind="heat", what="left out", change=_change_law(heat=None))
    if isinstance(law, ForceMPC) and law.spec.preview_samples:
        blind = change_plan(law, replace(law.spec, preview_samples=0))
        yield Alternative(kind="part", what="preview", change=lambda given: replace(given, law=blind))
    if not isinstance(law, ForceMPC) and np.any(law.anti_windup):
        yield Alternative(kind="anti-windup", what="left out", change=_leave_windup)
    added = linear.compensation
    terms = [] if added is None else [name for name in ("friction", "gravity", "ripple") if getattr(added, name)]
    for name in terms:
        without = replace(added, **{name: None}) if added is not None and len(terms) > 1 else None
        change = _change_law(linear=not isinstance(law, ForceMPC), compensation=without)
        yield Alternative(kind="compensation", what=name, change=change)
    if setting.controller.link is not None:
        change = _change_ticks(
            lambda rows: replace(rows, measured=rows.measured * _all_but_last(rows.measured.shape[1]))
        )
        yield Alternative(kind="feedforward", what="link", change=change)


def _leave_windup(setting: Setting) -> Setting:
    assert not isinstance(setting.law, ForceMPC)
    return _change_law(anti_windup=np.zeros_like(setting.law.anti_windup))(setting)


def _all_but_last(n: int) -> Float[np.ndarray, " n"]:
    return np.append(np.ones(n - 1), 0.0)


def _change_place(change: Callable[[Any], Any]) -> Callable[[Setting], Setting]:
    """Return what changes where a schedule's variable was logged; a log without it stays as it is."""
    return _change_ticks(lambda rows: replace(rows, place=None if rows.place is None else change(rows.place)))


def _list_places(setting: Setting) -> Iterator[Alternative]:
    """Yield where a schedule's variable may have been for the law: at a point, or in another unit."""
    law, place = setting.law, setting.ticks.place
    if not isinstance(law, RunnableSchedule) or place is None:
        return
    points = law.table.points.tolist()
    over = law.table.over
    for point in dict.fromkeys([law.fallback, *points]):
        change = _change_place(lambda place, point=point: np.full_like(place, point))
        yield Alternative(kind="place", what=over, value=point, unit=law.table.unit, change=change)
    for factor in (-1.0, *UNITS):
        change = _change_place(lambda place, factor=factor: factor * place)
        kind = "sign" if factor < 0.0 else "unit"
        yield Alternative(kind=kind, what=over, value=factor, change=change)
    if (shift := _fit_place(setting)) is not None:
        change = _change_place(lambda place: shift + place)
        still = stands_still(place, law.table.points)
        kind, value = ("place", float(np.median(place)) + shift) if still else ("shift", shift)
        yield Alternative(kind=kind, what=over, value=value, unit=law.table.unit, change=change, fitted=True)


def _fit_place(setting: Setting) -> float | None:
    """Return what is to be added to where a schedule's variable was logged, for the commands that are nearest to the
    logged ones; None where no law runs so. The gains are on lines between the points: looked at are these and the
    middles between them, then the neighbourhood of the best.
    """
    from scipy.optimize import minimize_scalar  # deferred: 0.2 s

    law, place = setting.law, setting.ticks.place
    assert isinstance(law, RunnableSchedule) and place is not None

    def leaves(shift: float) -> float:
        try:
            energy = play(_change_place(lambda logged: shift + logged)(setting)).energy
        except SeaoptError:
            return math.inf
        return energy if math.isfinite(energy) else math.inf

    points = law.table.points
    grid = np.sort([*points, *(0.5 * (points[1:] + points[:-1]))]) - np.median(place)
    rated = [leaves(shift) for shift in grid.tolist()]
    best = int(np.argmin(rated))
    if not math.isfinite(rated[best]):
        return None
    ends = grid[[max(best - 1, 0), min(best + 1, grid.size - 1)]]
    found = minimize_scalar(
        leaves, bounds=tuple(ends.tolist()), method="bounded", options={"xatol": 1e-7 * np.ptp(ends)}
    )
    return float(found.x)


def _list_of_gains(setting: Setting) -> Iterator[Alternative]:
    """Yield laws with parts that are left out, with gains of another size, and made for another rate."""
    controller, gains = setting.controller, setting.controller.read_gains()
    if gains is None:
        return
    for kind, what, value, part in list_parts(gains):
        yield Alternative(kind=kind, what=what, value=value, change=make_law(controller, part))
    for name, value in _fit_gains(setting, gains).items():
        change = make_law(controller, replace(gains, **{name: value}))
        yield Alternative(kind="gain", what=name, value=value, change=change)
    rates = {2.0 * controller.sample_time_s, 0.5 * controller.sample_time_s, 1.0 / setting.ticks.rate_hz}
    for period in rates:
        if not math.isclose(period, controller.sample_time_s, rel_tol=1e-3):
            change = make_law(controller, gains, period)
            yield Alternative(kind="rate", what="gains", value=1.0 / period, unit="Hz", change=change)


def list_parts(gains: Gains) -> Iterator[tuple[str, str, float | None, Gains]]:
    """Yield gains with parts that are left out or others: kind, name, value of a gain, and all of them."""
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
            yield kind, what, value, replace(gains, **changes)


def _fit_gains(setting: Setting, gains: Gains) -> dict[str, float]:
    """Return the size of each gain, alone, that fits the logged commands best: a law is linear in each of them."""
    ticks, limited = setting.ticks, find_limited(setting.ticks)
    free = ~limited
    if np.count_nonzero(free) < LEAST_HEAD:
        return {}
    base, fitted = follow(setting.linear, ticks, limited), dict[str, float]()
    modes = find_modes(setting.linear, limited)
    for name in ("k_p", "k_i", "k_d", "k_r"):
        value = getattr(gains, name)
        if not value:
            continue
        changed = make_law(setting.controller, replace(gains, **{name: 1.01 * value}))(setting)
        column = (follow(changed.linear, ticks, limited) - base) / (0.01 * value)
        table = np.column_stack([column, modes])
        step = np.linalg.lstsq(table[free], (ticks.command - base)[free], rcond=1e-10)[0][0]
        if np.isfinite(step) and value + step > 0.0:
            fitted[name] = float(value + step)
    return fitted
