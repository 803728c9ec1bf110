"""Why a law does not make the logged commands, found by trying.

The law or the log is changed by each of a list of causes (`alternatives`), and replayed. Causes are ranked by how much
of the mismatch they remove; where one removes much and leaves something, a second is looked for behind it.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from seaopt.control import RunnableSchedule
from seaopt.errors import SeaoptError
from seaopt.machine.alternatives import Alternative, Edited, EditedGain, list_alternatives
from seaopt.machine.gains.edited_table import Edit, list_edits
from seaopt.machine.gains.free_gains import find_same, fit_gains, make_law
from seaopt.machine.stepped import Match, Others, Setting, count_head, find_at_limit, play
from seaopt.records import record

WINDOW = 2000  # rows on which causes are tried, about the largest mismatch
MUCH = 0.5  # of the mismatch's energy, which a first cause of two removes
LESS = 0.1  # of what a single cause leaves: another set of gains, which has more to fit, leaves less
FITTED = ("gain", "factor")  # kinds with a size that is fitted
MOST_CAUSES = 6
MOST_ROWS = 50_000  # about the largest mismatch, on which edits of a table are tried: the variable has to move in them
SHORT = {"gain": "short, gain", "factor": "short, factor", "late": "short, late"}  # more periods would tell these
# Why a log of every n-th tick tells nothing.
ROWS = ("terms", "outer", "moving", "periods", "saturated", "phases", "aliases")
UNDECIDED = ("rounding", *SHORT.values(), *ROWS)


@record
class Cause:
    """Something that the machine does in place of what was exported, and how much of the mismatch it explains."""

    kind: str  # rate, late, sign, unit, factor, gain, limit, feedforward, compensation, gate, heat, another law, ...
    what: str  # the signal, gain, term or file that it concerns
    value: float | None  # factor, ticks, limit, rate
    unit: str
    removes: float  # share of the mismatch's energy
    explains: bool  # leaves nothing but rounding
    gains: Mapping[str, float] | None = None  # of a law with another set of them, as fitted
    exported: Mapping[str, float] | None = None  # those of this law
    sigmas: float | None = None  # stds of rounding, over the whole log, of what no single tick shows
    besides: bool = False  # it is so beside the first cause, and removes what it does together with that
    edited: Edited | None = None  # of a gain, or gains, in a schedule's table
    tells_hz: float | None = None  # of a law that the log does not tell: where a line of the reference would

    @property
    def undecided(self) -> bool:
        """Whether it lies in the log, which tells nothing therefore."""
        return self.kind in UNDECIDED


def leave_open(kind: str, what: str, value: float | None = None, unit: str = "") -> Cause:
    """Return why a log tells nothing."""
    assert kind in UNDECIDED
    return Cause(kind=kind, what=what, value=value, unit=unit, removes=0.0, explains=False)


def find_causes(whole: Setting, match: Match, others: Others) -> tuple[tuple[Cause, ...], Setting]:
    """Return the causes that explain a mismatch, the best first, and the setting as the first (and a second) has it."""
    limited = find_at_limit(whole.ticks, whole.linear)
    size = max(WINDOW, count_head(whole.linear))  # about the largest mismatch but where all laws are alike
    middle = int(np.argmax(np.abs(match.error) * (~limited if np.any(~limited) else 1.0)))
    begin = max(0, min(middle - size // 2, len(whole.ticks) - size))
    window = replace(whole, ticks=whole.ticks.take(slice(begin, begin + size)))
    here = play(window)
    if here.met:  # what is slow shows in the whole log alone: within, a state at its first row makes up for it
        window, here = whole, match
    before = here.energy
    if not before:
        return (), whole
    tried = _keep_best(sorted(_try_all(window, others), key=_rank))
    if not tried or not tried[0][1].explains or tried[0][0].kind in FITTED:
        size = min(len(whole.ticks), MOST_ROWS)
        begin = max(0, min(middle - size // 2, len(whole.ticks) - size))
        edited = _try_table(replace(whole, ticks=whole.ticks.take(slice(begin, begin + size))))
        if edited is not None:
            energy = float(np.mean(match.error[begin : begin + size] ** 2))
            rest = [_make_cause(*pair, before) for pair in tried[: MOST_CAUSES - 1] if not pair[1].explains]
            shown = [cause for cause in rest if cause.removes > 0.0]
            return (_make_cause(*edited, energy), *shown), edited[0].change(whole)
    if not tried or tried[0][1].energy >= before:
        return (), whole
    causes = [_make_cause(*pair, before) for pair in tried[:MOST_CAUSES]]
    best, second = tried[0], None
    if not causes[0].explains:
        best, second = _look_further(whole, window, tried, others, causes[0].removes > MUCH)
    if best is not tried[0]:
        causes = [_make_cause(*best, before), *(cause for cause in causes if cause.kind != best[0].kind)]
    if second is not None:
        causes = [causes[0], replace(_make_cause(*second, before), besides=True), *causes[1:]]
    return tuple(cause for cause in causes if cause.removes > 0.0 or cause.besides), best[0].change(whole)


Tried = tuple[Alternative, Match]


def _keep_best(ranked: Iterable[Tried]) -> list[Tried]:
    """Return the causes, of those that are said alike the first: a feedforward that is missing, or another one."""
    best = dict[tuple[str, str, float | None, str], Tried]()
    for alternative, match in ranked:
        key = (alternative.kind, alternative.what, alternative.value, alternative.unit)
        best.setdefault(key, (alternative, match))
    return list(best.values())


def _look_further(
    whole: Setting, window: Setting, tried: Sequence[Tried], others: Others, much: bool
) -> tuple[Tried, Tried | None]:
    """Return what explains more than single causes do: a second one behind the best, which removes `much`; another set
    of gains; either of a command that is logged a row late or early; gains behind a limit.
    """
    best, energy = tried[0], tried[0][1].energy
    if much and (second := _find_behind(best, window, {})) is not None:
        return best, second
    gains = _try_gains(whole, window, energy, others)
    if gains is not None and gains[1].explains:
        return gains, None
    rivals = list[tuple[Tried, Tried]]()
    for first in [pair for pair in tried if pair[0].kind in ("late", "limit")]:
        if first[0].kind == "late" and (first[0].what != "command" or abs(first[0].value or 0.0) != 1.0):
            continue
        change = first[0].change
        behind = _find_behind(first, window, others) if first[0].kind == "late" else None
        behind = behind or _try_gains(change(whole), change(window), energy, others)
        if behind is not None and behind[1].explains:
            rivals.append((first, behind))
    if rivals:
        return min(rivals, key=lambda pair: _rank(pair[1]))
    return (best, None) if gains is None else (gains, None)


def _find_behind(first: Tried, window: Setting, others: Others) -> Tried | None:
    """Return the cause that explains what a first one leaves; None where none explains all of it."""
    second = min(_try_all(first[0].change(window), others), key=_rank, default=None)
    return second if second is not None and second[1].explains else None


def _try_gains(whole: Setting, window: Setting, energy: float, others: Others) -> Tried | None:
    """Return the law with another set of gains, all fitted at once, and its match, where it leaves much less of the
    mismatch than any single cause.
    """
    own, gains = whole.controller.read_gains(), fit_gains(whole)
    if own is None or gains is None:
        return None
    alternative = Alternative(
        kind="gains",
        what=find_same(gains, others) or "law",
        change=make_law(whole.controller, gains),
        gains=gains.by_name(),
        exported=own.by_name(),
    )
    played = next(_play_each(window, [alternative]), None)
    return played if played is not None and (played[1].explains or played[1].energy < LESS * energy) else None


def _try_table(setting: Setting) -> Tried | None:
    """Return the edit of a schedule's table that explains the log, and its match; None where none does."""
    alternatives = (_make_edit(setting, edit) for edit in list_edits(setting))
    return next((pair for pair in _play_each(setting, alternatives) if pair[1].explains), None)


def _make_edit(setting: Setting, edit: Edit) -> Alternative:
    law = setting.law
    assert isinstance(law, RunnableSchedule)
    changed, (name, *further), point = edit.change(law), edit.names, edit.points[0]
    alone = len(edit.points) == 1
    pair = tuple(
        EditedGain(
            name=entries[0][0],
            points=tuple(float(law.table.points[number]) for _, number in entries),
            factor=factor,
            everywhere=len(entries) > 1,
        )
        for entries, factor in zip(edit.shared, edit.factors, strict=True)
        if len(edit.shared) > 1 and not alone
    )
    exported, gains = (
        {each: float(table.gains[each][point]) for each in edit.names} for table in (law.table, changed.table)
    )
    return Alternative(
        kind="gains" if further else "gain",
        what="law" if further else name,
        value=gains[name] if alone and not further else None,
        change=lambda given: replace(given, law=changed),
        gains=gains if alone else None,
        exported=exported if alone else None,
        edited=Edited(
            over=law.table.over,
            unit=law.table.unit,
            points=tuple(law.table.points[list(edit.points)].tolist()),
            factor=edit.factors[0] if len(edit.factors) == 1 else None,
            everywhere=not alone and not pair,
            pair=pair,
        ),
    )


def _rank(pair: Tried) -> tuple[bool, bool, bool, float]:
    """Return the order of a cause: one that explains all first, and of those the ones without a fitted size. At the
    limit many do: a sign runs away, a unit seldom does.
    """
    alternative, match = pair
    fitted, unit = alternative.fitted or alternative.kind in FITTED, alternative.kind == "unit"
    explains = match.explains
    return not explains, explains and fitted, explains and unit, match.energy


def _make_cause(alternative: Alternative, played: Match, before: float) -> Cause:
    return Cause(
        kind=alternative.kind,
        what=alternative.what,
        value=alternative.value,
        unit=alternative.unit,
        removes=1.0 - played.energy / before,
        explains=played.explains,
        gains=alternative.gains,
        exported=alternative.exported,
        edited=alternative.edited,
    )


def _try_all(setting: Setting, others: Others) -> Iterator[tuple[Alternative, Match]]:
    return _play_each(setting, list_alternatives(setting, others))


def _play_each(setting: Setting, alternatives: Iterable[Alternative]) -> Iterator[tuple[Alternative, Match]]:
    for alternative in alternatives:
        try:
            played = play(alternative.change(setting))
        except SeaoptError:  # a law that cannot run so
            continue
        if np.isfinite(played.energy):
            yield alternative, played
