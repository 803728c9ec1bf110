"""Two causes at once, where one alone leaves of the difference what is no noise."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from seaopt.machine.differences.comparison import TOLERATED, Comparison
from seaopt.machine.differences.leeway import Spread
from seaopt.machine.differences.size_fit import UNTOLD, Difference, Tried, drop_digits, rank
from seaopt.machine.differences.size_search import ROUNDS, Knob, Search, find_slopes, refine
from seaopt.parameters import ParameterSet
from seaopt.records import record

BEGUN = 2  # rounds of the search of each pair, before the best of them go on
FIRST = 3  # single causes that a second is tried beside
REFINED = 8  # pairs that are searched to the end
MORE_ROUNDS = ROUNDS  # of a search along two sizes at once
HALVES = 0.5  # of what one cause leaves, that two are to leave at most


@record(eq=False)
class Start:
    """A single cause from which pairs are tried: what moves it, its size, the model that has it, and what it leaves."""

    knob: Knob
    size: float
    comparison: Comparison
    single: Tried


def find_pairs(
    starts: Sequence[Start],
    knobs: Sequence[Knob],
    values: ParameterSet,
    spread: Spread,
    singles: Sequence[Tried],
    noise: float,
) -> list[Tried]:
    """Return the pairs of causes that explain much more than the best of `singles`, the best first, those that are as
    good beside it. `knobs`: of the second causes; `noise`: what it leaves of the misfit.
    """
    best = min(starts, key=lambda start: start.single.left, default=None)
    if best is None or best.single.difference.low is None:  # more of it than is tried may be all
        return []
    late = [start for start in starts[FIRST:] if start.knob.kind == "delay"]  # what most often comes second
    searches = [(start, each) for start in (*starts[:FIRST], *late) for each in _begin(start, knobs, values, spread)]
    searches.sort(key=lambda pair: drop_digits(pair[1].best.left) if pair[1].best else np.inf)
    found, seen = list[Tried](), list[set[str]]()
    for start, search in searches:
        if {*search.names} in seen:
            continue
        if len(seen) == REFINED:
            break
        seen.append({*search.names})
        found += _search_on(start, search, values, spread)
    least, alone = min(each.left for each in singles), {each.difference.name: each.left for each in singles}
    found = rank(_order(each, alone) for each in found if is_worth(each, least, noise))
    return _fold([each for each in found if each.is_untold(found[0], noise)])


def _begin(start: Start, knobs: Sequence[Knob], values: ParameterSet, spread: Spread) -> list[Search]:
    """Return a single cause with each of the others beside it, some rounds of the search from none of these on."""
    comparison, knob = start.comparison, start.knob
    if comparison.simulates:  # as behind a drive's limit: no loop is simulated earlier
        knobs = [replace(other, earliest=0.0) for other in knobs]
    (model,) = comparison.predict([knob.place(values, start.size)])
    slopes = find_slopes(comparison, spread, knob.place(values, start.size), model)
    begun = [
        Search(knobs=(knob, other), sizes=np.array([start.size, 0.0]), model=model, slopes=slopes)
        for other in knobs
        if other.parameter.name != knob.parameter.name
    ]
    return refine(comparison, spread, values, begun, BEGUN)


def _search_on(start: Start, search: Search, values: ParameterSet, spread: Spread) -> list[Tried]:
    """Return a pair as far as it comes."""
    found = refine(start.comparison, spread, values, [search], MORE_ROUNDS)
    if not found or not spread.names:
        return [each.conclude(values) for each in found]
    (pair,) = found
    there = find_slopes(start.comparison, spread, pair.place(values), pair.model)
    return [
        each.conclude(values) for each in refine(start.comparison, spread, values, [replace(pair, slopes=there)], 2)
    ]


def _order(pair: Tried, alone: Mapping[str, float]) -> Tried:
    """Return a pair with that cause first which by itself leaves the least."""
    parts = sorted((pair.difference, *pair.difference.beside), key=lambda part: alone.get(part.name, math.inf))
    first, *others = (replace(part, beside=()) for part in parts)
    return replace(pair, difference=replace(first, beside=tuple(others)))


def is_worth(pair: Tried, single: float, noise: float) -> bool:
    """Tell whether two causes explain much more than one, and both are there."""
    gained = single - pair.left > 2.0 * UNTOLD * max(pair.left / noise, 1.0)
    parts = (pair.difference, *pair.difference.beside)
    return gained and pair.left <= HALVES * single and all(part.is_there for part in parts)


def _fold(pairs: Sequence[Tried]) -> list[Tried]:
    """Return pairs, those of one response as one: what only one of two causes differs in, as alike to that."""
    kept = list[Tried]()
    for pair in pairs:
        mine = _name_parts(pair.difference)
        for k, other in enumerate(kept):
            its = _name_parts(other.difference)
            apart = [(a, b) for a in mine for b in its if a not in its and b not in mine]
            if len(apart) == 1 and np.max(np.abs(pair.response / other.response - 1.0)) <= TOLERATED:
                kept[k] = replace(other, difference=_add_alike(other.difference, apart[0][1], mine[apart[0][0]]))
                break
        else:
            kept.append(pair)
    return kept


def _name_parts(difference: Difference) -> Mapping[str, Difference]:
    """Return both causes of a pair by their names."""
    return {part.name: part for part in (difference, *difference.beside)}


def _add_alike(difference: Difference, name: str, other: Difference) -> Difference:
    """Return a difference in which one of the parts has another beside it that would explain as much."""
    if difference.name == name:
        alike, sizes = (*difference.alike, other.name), (*difference.alike_values, other.value)
        return replace(difference, alike=alike, alike_values=sizes)
    return replace(
        difference,
        beside=tuple(_add_alike(part, name, other) if part.name == name else part for part in difference.beside),
    )
