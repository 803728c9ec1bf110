"""Where no law keeps all limits: the law that keeps those which can be kept beside the one that is in the way.

The tuner's minimax leaves every limit as much room as the worst one uses: beside a noise gain that no law keeps, say, a
bandwidth far from the one asked costs nothing. So the limits that are missed most are eased to what is used of them,
and the law is looked for again, which then keeps the others as well as may be.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

from seaopt.control.laws.limits import BY_NAME, MeasuredLoop
from seaopt.control.laws.verdict import judge_all, list_broken_limits
from seaopt.control.tuning.frequencies import place_frequencies
from seaopt.control.tuning.interior_point import refine
from seaopt.control.tuning.optimisation_problem import LawNumbers, Task
from seaopt.control.tuning.solution import Solution, search
from seaopt.progress import Progress, ignore

ROUNDS = 3
ALIKE = 1.1  # limits missed by as much as the worst within this factor are eased with it
ROOM = 1.02  # beyond what is used of an eased limit
NARROW = 1.01  # of a limit: what a law misses by less, it misses between the frequencies looked at
TIGHTENINGS = 3
FAR_OFF = 10.0  # a frequency that is further off counts no more: |F/F_ref| along -3 dB falls below it anywhere


def ease_limits(task: Task, x: LawNumbers, loops: list[MeasuredLoop], progress: Progress = ignore) -> Solution:
    """Return the law that misses the limits least, one that keeps what can be kept beside those missed most.

    Parameters
    ----------
    task : Task
        What no law was found for.
    x : array, shape (14,)
        The numbers whose worst limit is missed least.
    loops : list of MeasuredLoop
        Their loops.
    progress : callable, optional
        Called before each solution.

    """
    best, factors = (x, loops), dict(task.eased)
    for number in range(ROUNDS):
        missed = _measure_missed(task, best[1])
        left = {name: used for name, used in missed.items() if _can_ease(name) and name not in factors}
        if not left or not math.isfinite(max(missed.values())):
            break
        progress("keeping what can be kept", number / ROUNDS)
        worst = max(left.values())
        factors |= {name: ROOM * used for name, used in left.items() if used * ALIKE >= worst}
        tried = search(replace(task, eased=factors), *best, again=False)
        if _total(_measure_missed(task, tried[1])) < _total(missed):
            best = tried
    return best


def tighten_limits(task: Task, x: LawNumbers, loops: list[MeasuredLoop]) -> Solution:
    """Return a law that keeps limits which the given one misses by next to nothing; that one where none is found.

    With no reserve a law is on its limits at the frequencies looked at, and may be beyond them in between. So these
    are lowered by what is missed, and the law refined.
    """
    best, factors = (x, loops), dict(task.eased)
    for _ in range(TIGHTENINGS):
        missed = _measure_missed(task, best[1])
        if not missed or max(missed.values()) > NARROW or not all(map(_can_ease, missed)):
            break
        factors |= {name: factors.get(name, 1.0) / used**2 for name, used in missed.items()}
        tight = replace(task, eased=factors)
        trial = refine(tight, tight.grid(place_frequencies(tight)), best[0])
        best = (trial, task.measure(trial))
        if not list_broken_limits(task.spec, best[1], task.design_states):
            return best
    return x, loops


def _can_ease(name: str) -> bool:
    """Tell whether a limit is a level, and not a frequency, which is what is asked for."""
    return BY_NAME[name].curve is not None and BY_NAME[name].reserve == "figure"


def _measure_missed(task: Task, loops: Sequence[MeasuredLoop]) -> dict[str, float]:
    """Return how much of each limit that is missed is used, on the plant that uses most."""
    missed: dict[str, float] = {}
    for verdict in judge_all(task.spec, loops, task.design_states):
        if not verdict.met:
            name = verdict.limit.name
            used = verdict.severity if _can_ease(name) or name == "stability" else min(verdict.severity, FAR_OFF)
            missed[name] = max(missed.get(name, 1.0), used)
    return missed


def _total(missed: Mapping[str, float]) -> float:
    """Return by how much limits are missed in all, in logarithms."""
    return sum(map(math.log, missed.values()))
