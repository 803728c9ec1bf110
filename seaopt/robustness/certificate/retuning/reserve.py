"""The reserve that a certificate's draws need: a look at some draws of a law, and a schedule tuned again for them.

The tuner puts a law on its limits at the nominal parameters, and draws break them by a little. So a tuned law is looked
at where a certificate will: a few draws on every plant, of a schedule at its points and between them, and a search from
those of the value that is worst. What one value's search finds is tried at all others, as it is bad there as a rule,
and another is searched only where that leaves something worse.

What is over a limit is given to the tuner as one more plant. It knows the law alone, at the points: with what terms
feed back, or between the points, more of a limit may be used, by a factor that hardly changes as the law does. That
factor is taken off all limits, as a reserve. The two points about the worst place are tuned so first, again and again,
as that costs little; all then start from these two. Draws and searches are never those of a certificate, which says
with draws of its own what the law is worth.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from seaopt.control import Controller, ControllerSpec, ScheduledController
from seaopt.control.laws.limits import LIMIT_ROUNDING
from seaopt.control.scheduling.scheduled_controller import RESERVE_BETWEEN
from seaopt.formatting import format_percent, format_values
from seaopt.parameters import ParameterSet
from seaopt.plants import Plant
from seaopt.progress import Progress, divide, prefix
from seaopt.records import record
from seaopt.robustness.certificate.cases import Cases, pose
from seaopt.robustness.uncertainty.batch import batch_figures
from seaopt.robustness.uncertainty.draws import Column, Plants, Points, Ranges, Source
from seaopt.robustness.uncertainty.severity import UNSTABLE, severities
from seaopt.robustness.uncertainty.worst import Worst, find_worst, measure_worst

LOOKED_AT, LOOK_STREAM = 64, 0x100C  # draws of a look, and their seed, which no certificate has
SEARCHES = 4  # of each plant, at values of a schedule
MS, MT = "max_sensitivity", "max_complementary"
ROUNDS = 3  # of looking and tuning again
PILOTS = 4  # of the same at two points, before all are tuned again
ROOM = 1e-3  # more than what was found asks, as the next law is another
MOST_RESERVE = 0.15  # that is given unasked: what needs more lacks points, or a term asks too much
NEAR = 0.98  # of the limits: what uses less is no witness
Witnesses = Mapping[str, tuple[Plant, ParameterSet]]
Make = Callable[[ControllerSpec, Witnesses, ScheduledController | None, Sequence[float], Progress], ScheduledController]
Looks = Mapping[str, "Look"]
LookAt = Callable[[ScheduledController], Looks]


@record(eq=False)
class Look:
    """The worst case of a plant, and how much of the limits the law uses there without its terms, at its points if
    scheduled.
    """

    worst: Worst
    alone: float

    @classmethod
    def of_law(cls, law: Controller, worst: Worst) -> Look:
        """Return a worst case of a law, and what the law uses there without its terms."""
        return cls(worst=worst, alone=measure_worst(_strip(law), worst[0], worst[1], worst.parameters).severity)

    @property
    def is_over(self) -> bool:
        """Whether it breaks Ms, Mt or, where neither is asked, stability."""
        return self.worst.severity > (1.0 + LIMIT_ROUNDING if self.worst.limited else UNSTABLE)

    @property
    def needed(self) -> float:
        """The reserve with which the law alone leaves room for what uses more; 1 where that makes it unstable."""
        more = 1.0 - self.alone / self.worst.severity
        return min(more + ROOM, 1.0) if more > 1e-6 else 0.0


@record(eq=False)
class _Aim:
    """What a schedule is tuned with: a specification with its reserve, and plants besides."""

    spec: ControllerSpec
    witnesses: Witnesses
    looks: int = 0

    def add(self, looks: Looks, broken: bool) -> _Aim | None:
        """Return the same with the worst cases of a look, and the reserve that those over a limit need, or that one
        `broken` between the points does; None where that is too much.
        """
        raised = raise_reserve(
            self.spec, [each for each in looks.values() if each.is_over], RESERVE_BETWEEN if broken else 0.0
        )
        witnesses = dict(self.witnesses)
        for name, each in looks.items():
            witnesses |= list_witnesses(name, self.looks + 1, each.worst)
        return None if raised is None else _Aim(spec=raised, witnesses=witnesses, looks=self.looks + 1)


def look_at_draws(
    law: Controller | ScheduledController, plants: Plants, parameters: Source, ranges: Ranges, supplement: ParameterSet
) -> dict[str, Look]:
    """Return of each plant the worst case that a few of `certify`'s draws and searches from them find, at the value of
    a schedule where it is worst; none where nothing is uncertain.
    """
    posed = pose(law, plants, parameters, ranges, supplement)
    first, *_ = cases = list(posed.values())
    if not first.unknown.size:
        return {}
    points = first.unknown.draw(LOOKED_AT, np.random.default_rng(LOOK_STREAM))
    tuned = [each for value, each in posed.items() if value in law.points]
    return {name: _look_at_plant(cases, tuned, name, points) for name in first.plants}


def _look_at_plant(posed: Sequence[Cases], tuned: Sequence[Cases], name: str, points: Points) -> Look:
    """Return the worst case of a plant at all values, those at which the law was `tuned` among them."""
    most = np.array([np.max(_rank(cases, name, cases.unknown.values(points))) for cases in posed])
    searched: dict[int, Worst] = {}
    while len(searched) < SEARCHES and (at := int(np.argmax(most))) not in searched:
        cases = posed[at]
        searched[at] = find_worst(cases.controller, cases.plants[name], cases.unknown, points)
        most = np.maximum(most, [_rank_one(each, name, searched[at]) for each in posed])
        most[at] = searched[at].severity
    worst = max(searched.values(), key=lambda case: case.severity)
    alone = (replace(each, controller=_strip(each.controller)) for each in tuned)
    return Look(worst=worst, alone=max(_rank_one(each, name, worst) for each in alone))


def _strip(law: Controller) -> Controller:
    """Return a law without what its terms feed back."""
    return replace(law, compensation=None)


def _rank(cases: Cases, name: str, values: Mapping[str, Column]) -> Column:
    figures = batch_figures(cases.controller, cases.plants[name], cases.unknown.nominal, values)
    return severities(cases.controller, figures)


def _rank_one(cases: Cases, name: str, worst: Worst) -> float:
    return float(_rank(cases, name, {key: np.array([value]) for key, value in worst.parameters.items()})[0])


def keep_reserve(
    make: Make, look: LookAt, spec: ControllerSpec, points: Sequence[float], progress: Progress
) -> ScheduledController:
    """Return a schedule that keeps its limits at the draws that are looked at, too, tuned again until it does. Where
    none does, it is the one that misses least, and a remark says by how much and where; or one that misses limits at
    its points, which says what can be had. `make` tunes with a specification, with further plants on which its limits
    are kept, near a schedule, at points; `look` returns the worst case of each plant.
    """
    aim = _Aim(spec=spec, witnesses={})
    first, *again = divide(progress, *(1.0 for _ in range(1 + ROUNDS)))
    kept = schedule = make(spec, {}, None, points, first)
    least, left = math.inf, dict[str, Look]()
    for number, part in enumerate((*again, None), start=1):
        if not all(each.met for each in schedule.controllers):
            return schedule
        looks = look(schedule)
        over = {name: each for name, each in looks.items() if each.is_over}
        broken = any(figures.broken for figures in schedule.between)
        missed = max((each.worst.severity for each in over.values()), default=0.0) + UNSTABLE * broken
        if missed >= least:
            break
        kept, least, left = schedule, missed, over
        raised = aim.add(looks, broken)
        if not missed or raised is None or part is None:
            break
        tuning = prefix(part, f"with worst cases, round {number}")
        aim, near = _pilot(make, look, raised, schedule, over, tuning)
        schedule = make(aim.spec, aim.witnesses, near, points, tuning)
    if left:
        progress(describe_shortfall(kept, left))
    progress("worst cases looked at", 1.0)
    return kept


def _pilot(
    make: Make, look: LookAt, aim: _Aim, schedule: ScheduledController, over: Looks, progress: Progress
) -> tuple[_Aim, ScheduledController]:
    """Return what is to be aimed at, and the schedule to start from: of the two points about the worst place, tuned
    again until draws keep their limits between the two. What that takes is what the others need, as a rule.
    """
    pilot = _take_stretch(schedule, over)
    for _ in range(PILOTS if len(pilot.points) < len(schedule.points) else 0):
        pilot = make(aim.spec, aim.witnesses, pilot, pilot.points, progress)
        if not pilot.met:
            break
        looks = look(pilot)
        if not any(each.is_over for each in looks.values()):
            return aim, pilot
        raised = aim.add(looks, broken=False)
        if raised is None:
            break
        aim = raised
    return aim, schedule


def _take_stretch(schedule: ScheduledController, over: Looks) -> ScheduledController:
    """Return the two points about the place where a schedule is worst at draws, on plants whose loops depend on it; a
    schedule that breaks no limit there as it is.
    """
    if not over:
        return schedule
    placed = [(each.worst.severity, each.worst[1]) for each in over.values() if schedule.over in each.worst[1]]
    _, worst = max(placed, key=lambda pair: pair[0], default=(0.0, None))
    value = schedule.points[0] if worst is None else worst[schedule.over].value
    first = max(min(bisect_right(schedule.points, value), len(schedule.points) - 1), 1) - 1
    pair = slice(first, first + 2)
    return replace(schedule, points=schedule.points[pair], controllers=schedule.controllers[pair], between=())


def describe_shortfall(schedule: ScheduledController, over: Mapping[str, Look]) -> str:
    """Return one sentence: where a schedule breaks a limit most at draws, by how much, and what would do."""
    name, look = max(over.items(), key=lambda pair: pair[1].worst.severity)
    worst, variable = look.worst, schedule.over
    value = worst[1][variable].value if variable in worst[1] else None
    between = value is not None and value not in schedule.points
    places = worst.parameters | ({} if value is None else {variable: value})
    where = f"on {name} at {format_values(places, missing='nominal')}"
    lower = f"a bandwidth_hz below {schedule.spec.bandwidth_hz if value is None else schedule.asked_hz(value):.3g}"
    what = f"add a point at {variable} = {value:.4g}, or ask for {lower}" if between else f"ask for {lower}"
    if worst.severity >= UNSTABLE:
        return f"the schedule is unstable {where}; {what}"
    shares = (
        (figure / level, f"{symbol} = {figure:.4g}, {format_percent(figure / level - 1.0, 2)} beyond {key} = {level:g}")
        for symbol, figure, key in (("Ms", worst.witness.ms, MS), ("Mt", worst.witness.mt, MT))
        if (level := schedule.spec.level(key)) is not None
    )
    return f"the schedule has {max(shares)[1]}, {where}; {what}"


def raise_reserve(spec: ControllerSpec, over: Iterable[Look], least: float = 0.0) -> ControllerSpec | None:
    """Return a specification with the reserve that what is over a limit needs, no less than it has; None where that is
    more than it has and more than `MOST_RESERVE`.
    """
    needed = max(spec.reserve, least, *(each.needed for each in over))
    return replace(spec, reserve=needed) if needed <= max(spec.reserve, MOST_RESERVE) else None


def list_witnesses(name: str, number: int, worst: Worst) -> Witnesses:
    """Return where a plant has its largest Ms and its largest Mt, by name, but for those far from the limits: what
    mends one of them brings the other up to its limit.
    """
    near = (each for each in (worst.witness, *worst.largest) if each.severity > NEAR)
    return {
        f"{name}, round {number}: {format_values(each.parameters, missing='nominal')}": (
            worst[0],
            worst[1].update(**each.parameters),
        )
        for each in near
    }
