"""Find the law of a task: a solution, an evolution, what is possible instead, and all that with an outer loop."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Protocol, Self, TypeVar, runtime_checkable

from seaopt.control.laws.command import Command
from seaopt.control.laws.controller import Controller
from seaopt.control.laws.limits import MeasuredLoop
from seaopt.control.laws.spec import ControllerSpec
from seaopt.control.laws.verdict import PossibleBandwidths
from seaopt.control.loops.outer_loop import OuterLoop
from seaopt.control.tuning.frequencies import count_growing
from seaopt.control.tuning.grid import FRICTION
from seaopt.control.tuning.law_numbers import LawNumbers, read_numbers
from seaopt.control.tuning.optimisation_problem import Task
from seaopt.control.tuning.possible_bandwidths import find_largest_fall, find_possible_bandwidths
from seaopt.control.tuning.solution import (
    ease_limits,
    follow_task,
    lower_fraction,
    measure_missed,
    retry,
    search,
    solve_beside,
    solve_near,
)
from seaopt.errors import ControlError, SeaoptError
from seaopt.plants.friction import list_fall_parameters
from seaopt.progress import Progress, divide
from seaopt.records import record

SOLUTION, BANDWIDTHS, EASING = 1.0, 2.0, 2.0  # of the time of a tune that is not possible as asked
OUTER_ROUNDS = 6  # of tuning with an outer loop that follows
Surround = Callable[[Controller], OuterLoop | None]


@runtime_checkable
class Enclosed(Protocol):
    """What an outer loop is around: a controller, or a schedule of them."""

    @property
    def met(self) -> bool:
        """Whether every limit is met."""
        ...

    @property
    def command(self) -> Command:
        """What is commanded for an effort."""
        ...

    @property
    def outer(self) -> OuterLoop | None:
        """The outer loop that it was measured with."""
        ...


@runtime_checkable
class Found(Protocol):
    """What was found of a task, or of the tasks of a schedule."""

    @property
    def missed(self) -> float:
        """The worst usage of a limit that is missed; 0 where none is."""
        ...

    def enclose(self, outer: OuterLoop, per_effort: float) -> Self:
        """Return it measured with an outer loop."""
        ...

    def follow(self, progress: Progress, *, first: bool) -> Self:
        """Return what is found from it; `first`: also what takes a search of its own."""
        ...


FoundT = TypeVar("FoundT", bound=Found)
EnclosedT = TypeVar("EnclosedT", bound=Enclosed)


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

    def enclose(self, outer: OuterLoop, per_effort: float) -> FoundLaw:
        """Return the law measured with an outer loop."""
        task = self.task.enclosed(outer, per_effort)
        return FoundLaw(task=task, x=self.x, loops=task.measure(self.x), possible=self.possible)

    def follow(self, progress: Progress, *, first: bool) -> FoundLaw:
        """Return the law found from this one, at first by all means, then near it."""
        if first:
            return find_law(self.task, (self.x,), progress)
        x, loops = follow_task(self.task, self.x, self.loops)
        return FoundLaw(task=self.task, x=x, loops=loops)


def meet_outer(
    found: FoundT,
    describe: Callable[[FoundT], EnclosedT],
    outer: Callable[[EnclosedT], OuterLoop | None],
    progress: Progress,
) -> FoundT:
    """Return what keeps its limits with the outer loop that it gets, from what was found without; where nothing does,
    what misses least. Damping that is critical is another around each law: where that takes one beyond a limit, the law
    follows it.
    """
    tried, rounds = list[FoundT](), divide(progress, *[1.0] * OUTER_ROUNDS)
    for number in range(OUTER_ROUNDS + 1):
        law = describe(found)
        try:
            required = outer(law)
        except SeaoptError:
            if law.met and not tried:
                raise
            break  # around a law that misses its limits, or one that follows, there may be none
        if required is None:
            break
        if required == law.outer:
            tried.append(found)
            break
        found = found.enclose(required, law.command.per_effort)
        tried.append(found)
        if not found.missed or number == OUTER_ROUNDS:
            break
        rounds[number]("tuning with the outer loop", 0.0)
        found = found.follow(rounds[number], first=not number)
    return min(tried, key=lambda each: each.missed) if tried else found


def find_law(task: Task, warm: Sequence[LawNumbers], progress: Progress) -> FoundLaw:
    """Return the best law of a task, and where it misses a limit what is possible instead."""
    first = SOLUTION * (8.0 if task.asks_margin else 1.0)
    solving, seeking, easing = divide(progress, first, BANDWIDTHS, EASING)
    x, loops = solve_beside(task, warm, progress=solving)
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


def find_near(task: Task, near: Controller) -> FoundLaw | None:
    """Return the best law in the valley of a neighbour, of the same parts; None where it is not stable here, or the
    law misses a limit: another valley may have one that does not. So it is where a friction margin is asked for. Raises
    ControlError: the neighbour has other parts.
    """
    if _list_parts(near.spec) != _list_parts(task.spec):
        raise ControlError(
            f"near is a law of other parts than the one asked for ({near.structure}, {task.spec.structure}); give one "
            "of the same structure, measured outputs, notch and prefilter, or leave it out"
        )
    x = task.tidy(read_numbers(near.gains, task.k_ff, near.sample_time_s))
    if task.asks_margin or not task.is_stable(x):
        return None
    x, loops = solve_near(task, x)
    return None if task.list_broken(loops) else FoundLaw(task=task, x=x, loops=loops)


def _list_parts(spec: ControllerSpec) -> tuple[object, ...]:
    """Return what a law is made of: laws of the same have the same gains."""
    return spec.structure, spec.measured, spec.notch is None, spec.reference_filter is None


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
