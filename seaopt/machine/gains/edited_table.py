r"""Gains of an exported table that were edited, with their factors, told by commands under a variable that moves.

With factors :math:`\theta` of the gains at the points, all one in what was exported, the commands are
:math:`u(\theta)`, affine in most of them while no limit is active. A column :math:`\partial u/\partial\theta` is the
difference of two replays, the variable as logged. Least squares over it and what a state at the first row adds gives a
factor, at once or by Gauss-Newton steps (filters' time constants). Of each kind of edit the ones that leave least are
proposed: one gain at one point, one gain at all points, all gains at one point, by one factor or each by its own, and
two gains, each at one point or at all.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np
from jaxtyping import Bool, Float

from seaopt.control import LawState, RunnableSchedule
from seaopt.control.scheduling.runnable_schedule import make_runnable
from seaopt.errors import SeaoptError
from seaopt.machine.stepped import HEAD, Setting, find_at_limit, find_modes, list_starts, run_setting, stands_still
from seaopt.records import record

STEP = 0.01  # of a factor, by which a column is made
LIKELY, LIKELY_PAIRS = 2, 6  # edits of each kind, and pairs, that are proposed
ROUNDS, SAME = 8, 1e-7  # steps at most, and the relative step that is none
FURTHEST = 3.0  # times, that a factor moves in a step where the law is not affine in it
LARGER = ("k_p", "k_i", "k_d", "k_r")  # with which all of a law at a point grows
Entry = tuple[str, int]  # gain, number of the point
Shared = tuple[Entry, ...]  # entries with one factor


@record(eq=False)
class Edit:
    """Gains of a table times factors."""

    shared: tuple[Shared, ...]
    factors: tuple[float, ...]  # one of each
    exported: bool = False  # after the edit, so that the anti-windup is that of the edited gains

    def change(self, law: RunnableSchedule) -> RunnableSchedule:
        """Return a law with the edited table."""
        rows = {name: np.array(row, dtype=float) for name, row in law.table.gains.items()}
        for entries, factor in zip(self.shared, self.factors, strict=True):
            for name, point in entries:
                rows[name][point] *= factor
        table = replace(law.table, gains=rows)
        return replace(
            law, table=table, anti_windup=make_runnable(table).anti_windup if self.exported else law.anti_windup
        )

    @property
    def points(self) -> tuple[int, ...]:
        """The numbers of the points that it concerns."""
        return tuple(dict.fromkeys(point for entries in self.shared for _, point in entries))

    @property
    def names(self) -> tuple[str, ...]:
        """The gains that it concerns."""
        return tuple(dict.fromkeys(name for entries in self.shared for name, _ in entries))


def list_edits(setting: Setting) -> Iterator[Edit]:
    """Yield edits of a schedule's table that may explain the logged commands, those of one gain first; none where its
    variable stands still, where a table is one law.
    """
    law, place = setting.law, setting.ticks.place
    if not isinstance(law, RunnableSchedule) or place is None:
        return
    if stands_still(place, law.table.points):
        return
    fit = _Fit.make(setting, law)
    columns = {
        entry: fit.find_column(Edit(shared=((entry,),), factors=(1.0,)), 0, fit.exported)
        for entry in _list_entries(law)
    }
    for kind in _list_kinds(law, columns):
        rated = [
            (fit.rate([np.sum([columns[entry] for entry in part], axis=0) for part in shared]), shared)
            for shared in kind
        ]
        yield from fit.refine_each([shared for _, shared in sorted(rated, key=lambda pair: pair[0])[:LIKELY]])
    yield from fit.refine_each(_list_pairs(fit, columns))


def _list_pairs(fit: _Fit, columns: dict[Entry, Float[np.ndarray, " n"]]) -> list[tuple[Shared, ...]]:
    """Return the pairs of edits, each of one gain at a point or at all of them, that leave least; none of two gains at
    one point, of which all gains there are one kind of edit.
    """
    single, everywhere = _list_kinds(fit.law, columns)[:2]
    parts = [part for (part,) in (*single, *everywhere)]
    table = np.column_stack([np.sum([columns[entry] for entry in part], axis=0) for part in parts])
    table /= np.linalg.norm(table, axis=0)
    alike, wanted = table.T @ table, table.T @ fit.target
    rated = list[tuple[float, tuple[Shared, ...]]]()
    for (i, one), (j, other) in combinations(enumerate(parts), 2):
        apart = 1.0 - alike[i, j] ** 2
        if one[0][0] == other[0][0] or len({point for _, point in (*one, *other)}) == 1 or apart < SAME:
            continue
        taken = wanted[i] ** 2 + (wanted[j] - alike[i, j] * wanted[i]) ** 2 / apart
        rated.append((-float(taken), (one, other)))
    return [shared for _, shared in sorted(rated, key=lambda pair: pair[0])[:LIKELY_PAIRS]]


def _list_entries(law: RunnableSchedule) -> list[Entry]:
    """Return the entries of a table that a factor changes."""
    return [(name, int(i)) for name, row in law.table.gains.items() for i in np.flatnonzero(row)]


def _list_kinds(law: RunnableSchedule, columns: dict[Entry, Float[np.ndarray, " n"]]) -> list[list[tuple[Shared, ...]]]:
    """Return the edits of each kind, of entries that the commands depend on."""
    seen = [entry for entry, column in columns.items() if np.any(column)]
    points = range(law.table.points.size)
    everywhere = [tuple(entry for entry in seen if entry[0] == name) for name in law.table.gains]
    rows = [tuple(entry for entry in seen if entry[1] == point) for point in points]
    larger = [tuple(entry for entry in row if entry[0] in LARGER) for row in rows]
    return [
        [((entry,),) for entry in seen],
        [(entries,) for entries in everywhere if len(entries) > 1],
        [(entries,) for entries in larger if len(entries) > 1],
        [tuple((entry,) for entry in row) for row in rows if len(row) > 1],
    ]


def _choose_start(setting: Setting) -> LawState:
    """Return the state, at zero or at rest, from which the first commands are nearest to the logged ones."""
    head, found = setting.ticks.take(slice(0, HEAD)), list[tuple[float, LawState]]()
    for start, _ in list_starts(setting):
        assert isinstance(start, LawState)
        found.append((float(np.mean((run_setting(setting, head, start) - head.command) ** 2)), start))
    return min(found, key=lambda pair: pair[0])[1]


@record(eq=False)
class _Fit:
    """The rows without a limit, what a state at the first adds there, and the law from a state near the right one."""

    setting: Setting
    law: RunnableSchedule
    start: LawState
    free: Bool[np.ndarray, " n"]
    basis: Float[np.ndarray, "k m"]
    exported: Float[np.ndarray, " n"]  # the commands of what was exported

    @classmethod
    def make(cls, setting: Setting, law: RunnableSchedule) -> _Fit:
        limited = find_at_limit(setting.ticks, setting.linear)
        start = _choose_start(setting)
        modes = find_modes(setting.linear, limited)[~limited]
        modes /= np.maximum(np.linalg.norm(modes, axis=0), np.finfo(float).tiny)
        left, size, _ = np.linalg.svd(modes, full_matrices=False)
        basis = left[:, size > 1e-9 * np.max(size, initial=0.0)]
        return cls(
            setting=setting,
            law=law,
            start=start,
            free=~limited,
            basis=basis,
            exported=run_setting(setting, setting.ticks, start),
        )

    def run(self, edit: Edit) -> Float[np.ndarray, " n"]:
        """Return the commands with an edit."""
        return run_setting(replace(self.setting, law=edit.change(self.law)), self.setting.ticks, self.start)

    def find_column(self, edit: Edit, number: int, base: Float[np.ndarray, " n"]) -> Float[np.ndarray, " m"]:
        """Return what the commands change by per relative change of a factor."""
        more = tuple(factor * (1.0 + STEP * (i == number)) for i, factor in enumerate(edit.factors))
        return self.leave_state((self.run(replace(edit, factors=more)) - base) / STEP)

    def leave_state(self, commands: Float[np.ndarray, " n"]) -> Float[np.ndarray, " m"]:
        """Return commands in the free rows without what a state at the first row makes of them."""
        free = commands[self.free]
        return free - self.basis @ (self.basis.T @ free)

    def solve(
        self, columns: Sequence[Float[np.ndarray, " m"]], target: Float[np.ndarray, " m"]
    ) -> tuple[Float[np.ndarray, " k"], float]:
        """Return the relative steps of factors, and the sum of squares that they leave."""
        table = np.column_stack(columns)
        size = np.maximum(np.linalg.norm(table, axis=0), np.finfo(float).tiny)
        steps = np.linalg.lstsq(table / size, target, rcond=1e-9)[0] / size
        return steps, float(np.sum((target - table @ steps) ** 2))

    def rate(self, columns: Sequence[Float[np.ndarray, " m"]]) -> float:
        """Return what an edit leaves, by its columns at what was exported."""
        return self.solve(columns, self.target)[1]

    @property
    def target(self) -> Float[np.ndarray, " m"]:
        """By what the logged commands differ from those of what was exported."""
        return self.leave_state(self.setting.ticks.command - self.exported)

    def refine_each(self, kind: Sequence[tuple[Shared, ...]]) -> Iterator[Edit]:
        """Yield edits with the factors that fit best, with the anti-windup before and after where a limit acts."""
        for shared in kind:
            for exported in (False, True)[: 1 if np.all(self.free) else 2]:
                edit = self.refine(shared, exported=exported)
                if edit is not None:
                    yield edit

    def refine(self, shared: tuple[Shared, ...], *, exported: bool) -> Edit | None:
        """Return an edit with the factors that fit best; None where no law has them."""
        edit = Edit(shared=shared, factors=(1.0,) * len(shared), exported=exported)
        affine = np.array([entries[0][0].startswith("k_") or entries[0][0] == "c" for entries in shared])
        try:
            for _ in range(ROUNDS):
                base = self.run(edit)
                columns = [self.find_column(edit, i, base) for i in range(len(shared))]
                steps, _ = self.solve(columns, self.leave_state(self.setting.ticks.command - base))
                moved = 1.0 + np.where(affine, steps, np.clip(steps, 1.0 / FURTHEST - 1.0, FURTHEST - 1.0))
                edit = replace(edit, factors=tuple((edit.factors * moved).tolist()))
                if np.max(np.abs(steps)) < SAME:
                    break
        except (SeaoptError, np.linalg.LinAlgError):
            return None
        return edit if np.all(np.isfinite(edit.factors)) else None
