"""Lower the fraction of a link's motion that is fed forward, where the tuner finds no law with all of it."""

from __future__ import annotations

import math
from dataclasses import replace

from seaopt.control.laws.limits import MeasuredLoop
from seaopt.control.laws.verdict import list_broken_limits
from seaopt.control.loops.compensation.link_feedforward import LinkPath
from seaopt.control.tuning.frequencies import place_frequencies
from seaopt.control.tuning.interior_point import HOPELESS, refine
from seaopt.control.tuning.optimisation_problem import FRICTION, LawNumbers, Task
from seaopt.control.tuning.solution import FAR_OFF, solve

LOWER_FRACTIONS = 4  # by a fifth each


def feed_link(task: Task, link: LinkPath | None) -> Task:
    """Return a task whose link is fed forward by another path; the same where it is not fed forward."""
    if link is None:
        return task
    return replace(task, link=link, further=(*task.further[:-1], link.feedback(task.spec.sample_time_s)))


def lower_fraction(task: Task, x: LawNumbers, loops: list[MeasuredLoop]) -> tuple[Task, LawNumbers, list[MeasuredLoop]]:
    """Return task, numbers and loops with as large a fraction of the link's feedforward as keeps the limits.

    It is lowered by a fifth at a time where none is asked and a limit is broken; where none keeps them, it is that
    which shows most of a friction margin that alone is missed, else zero, as nothing shows then which one misses least.
    Where limits are missed clearly with all of it and without any, what lies between is solved only where a law near
    one of these two comes close to keeping them.
    """
    asked, link = task.spec.link_feedforward, task.link
    broken = list_broken_limits(task.spec, loops, task.design_states)
    if asked is None or asked.fraction is not None or link is None or not broken:
        return task, x, loops
    shares = (*(0.8 ** (power + 1) for power in range(LOWER_FRACTIONS)), 0.0)
    *lower, none = (feed_link(task, replace(link, fraction=round(share * link.fraction, 3))) for share in shares)
    missing, without = [(task, x, loops)] if broken == {FRICTION} else [], None
    if _measure_miss(task, x) > HOPELESS:
        without = solve(none)
        least = min(_measure_miss(task, x), _measure_miss(none, without[0]))
        if least > FAR_OFF:
            lower = []
        elif least > HOPELESS:
            lower = [one for one in lower if min(_follow(one, start) for start in (x, without[0])) <= HOPELESS]
    found = (task, x, loops)
    for one in (*lower, none):
        found = (one, *(without if one is none and without else solve(one)))
        broken = list_broken_limits(one.spec, found[2], one.design_states)
        if not broken:
            return found
        if broken == {FRICTION}:
            missing.append(found)
    return max(missing, key=lambda one: min(loop.friction_slope for loop in one[2])) if missing else found


def _measure_miss(task: Task, x: LawNumbers) -> float:
    """Return the worst usage of a limit."""
    return task.rank(task.grid(place_frequencies(task)), x)[0]


def _follow(task: Task, x: LawNumbers) -> float:
    """Return the worst usage of a limit near a law of another fraction."""
    x = task.tidy(x)
    if not task.is_stable(x):
        return math.inf
    grid = task.grid(place_frequencies(task))
    return task.rank(grid, refine(task, grid, x, 2))[0]
