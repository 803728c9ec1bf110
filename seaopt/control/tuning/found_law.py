"""Find the law of a task: a solution, an evolution, what is possible instead, and all that with an outer loop."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

from seaopt.control.laws.controller import Controller
from seaopt.control.laws.limits import MeasuredLoop
from seaopt.control.laws.verdict import PossibleBandwidths
from seaopt.control.loops.outer_loop import OuterLoop
from seaopt.control.tuning.frequencies import count_growing
from seaopt.control.tuning.grid import FRICTION
from seaopt.control.tuning.law_numbers import LawNumbers
from seaopt.control.tuning.optimisation_problem import Task
from seaopt.control.tuning.possible_bandwidths import find_largest_fall, find_possible_bandwidths
from seaopt.control.tuning.solution import (
    ease_limits,
    follow_task,
    lower_fraction,
    measure_missed,
    retry,
    search,
    solve,
)
from seaopt.errors import SeaoptError
from seaopt.plants.friction import list_fall_parameters
from seaopt.progress import Progress, divide, ignore
from seaopt.records import record

SOLUTION, BANDWIDTHS, EASING = 1.0, 2.0, 2.0  # of the time of a tune that is not possible as asked
OUTER_ROUNDS = 6  # of tuning with an outer loop that follows
Surround = Callable[[Controller], OuterLoop | None]


@record(eq=False)
class FoundLaw:
    """A law that was found, and what is possible where it misses a limit."""

    task: Task
    x: LawNumbers
    loops: list[MeasuredLoop]
    possible: PossibleBandwidths | None = None

    @property
    def missed(self) -> float:
        """The worst usage of a limit that is missed; 0 where none is."""
        return max(measure_missed(self.task, self.loops).values(), default=0.0)


def meet_outer(
    found: FoundLaw, describe: Callable[[FoundLaw], Controller], outer: Surround, progress: Progress
) -> FoundLaw:
    """Return a law that keeps its limits with the outer loop that it gets, from one that was found without; where none
    does, the one that misses least. Damping that is critical is another around each law: where that takes one beyond a
    limit, the law follows it.
    """
    tried: list[FoundLaw] = []
    for number in range(OUTER_ROUNDS + 1):
        controller = describe(found)
        try:
            asked = outer(controller)
        except SeaoptError:
            if controller.met and not tried:
                raise
            break  # around a law that misses its limits, or one that follows, there may be none
        if asked is None:
            break
        if asked == controller.outer:
            tried.append(found)
            break
        task = found.task.enclosed(asked, controller.command.per_effort)
        found = FoundLaw(task=task, x=found.x, loops=task.measure(found.x), possible=found.possible)
        tried.append(found)
        if not found.missed or number == OUTER_ROUNDS:
            break
        progress("tuning with the outer loop", number / OUTER_ROUNDS)
        if number:
            x, loops = follow_task(task, found.x, found.loops)
            found = FoundLaw(task=task, x=x, loops=loops)
        else:
            found = find_law(task, (found.x,), ignore)
    return min(tried, key=lambda law: law.missed) if tried else found


def find_law(task: Task, warm: Sequence[LawNumbers], progress: Progress) -> FoundLaw:
    """Return the best law of a task, and where it misses a limit what is possible instead."""
    first = SOLUTION * (8.0 if task.asks_margin else 1.0)
    solving, seeking, easing = divide(progress, first, BANDWIDTHS, EASING)
    x, loops = solve(task, warm, progress=solving)
    task, x, loops = lower_fraction(task, x, loops)
    if not task.eased:
        x, loops = search(task, x, loops)
    possible, broken = None, task.list_broken(loops)
    if broken - {FRICTION}:  # of a margin alone it is known what can be had
        near: list[LawNumbers] = []
        if not task.eased:
            possible, near = _find_possible(task, x, seeking, stable="stability" not in broken)
        # From there another answer may be in reach: a better compromise, or none needed.
        if near:
            x, loops = retry(task, x, loops, near)
        if task.list_broken(loops):
            x, loops = ease_limits(task, x, loops, easing)
    return FoundLaw(task=task, x=x, loops=loops, possible=possible)


def _find_possible(
    task: Task, x: LawNumbers, progress: Progress, *, stable: bool
) -> tuple[PossibleBandwidths, list[LawNumbers]]:
    """Return what is possible instead, and laws near it: at other bandwidths, or with friction that falls less. The
    fall is what to ask about where no law is `stable` at this bandwidth, or none keeps the limits at any.
    """
    possible, near = find_possible_bandwidths(task, x, progress)
    if (stable and possible.nearest_hz) or task.moved is not None or not any(map(count_growing, task.plants)):
        return possible, near
    eased = find_largest_fall(task)
    if eased is None:
        return possible, near
    steepest, largest, law = eased
    friction, fall = steepest.find_fall()
    parameters = list_fall_parameters(steepest.model, friction)
    possible = replace(
        possible, fall=fall, largest_fall=largest * fall, fall_unit=friction.slope_unit, fall_parameters=parameters
    )
    return possible, [*near, law]
