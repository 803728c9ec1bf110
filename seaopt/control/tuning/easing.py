"""Where no law keeps all limits: the law that keeps those which can be kept beside the one that is in the way.

The tuner's minimax leaves every limit as much room as the worst one uses: beside a noise gain that no law keeps, say, a
bandwidth far from the one asked costs nothing. So the limits that are missed most are eased to what is used of them,
and the law is looked for again, which then keeps the others as well as may be.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

from seaopt.control.laws.limits import MeasuredLoop
from seaopt.control.tuning.optimisation_problem import LawNumbers, Task
from seaopt.control.tuning.solution import Solution, can_ease, measure_missed, search
from seaopt.progress import Progress, ignore

ROUNDS = 3
ALIKE = 1.1  # limits missed by as much as the worst within this factor are eased with it
ROOM = 1.02  # beyond what is used of an eased limit


def ease_limits(task: Task, x: LawNumbers, loops: list[MeasuredLoop], progress: Progress = ignore) -> Solution:
    """Return the law that keeps what can be kept beside the limits missed most, from the one whose worst is least."""
    best, factors = (x, loops), dict(task.eased)
    for number in range(ROUNDS):
        missed = measure_missed(task, best[1])
        left = {name: used for name, used in missed.items() if can_ease(name) and name not in factors}
        if not left or not math.isfinite(max(missed.values())):
            break
        progress("keeping what can be kept", number / ROUNDS)
        worst = max(left.values())
        factors |= {name: ROOM * used for name, used in left.items() if used * ALIKE >= worst}
        tried = search(replace(task, eased=factors), *best, again=False)
        if _total(measure_missed(task, tried[1])) < _total(missed):
            best = tried
    return best


def _total(missed: Mapping[str, float]) -> float:
    """Return by how much limits are missed in all, in logarithms."""
    return sum(map(math.log, missed.values()))
