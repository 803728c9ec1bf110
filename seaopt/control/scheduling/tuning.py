"""Tune a schedule: the same structure and limits at every point, each point started from its neighbour.

A law that is tuned by itself may sit in another valley than its neighbour's, with an integral a hundred times slower
say, and lines between the two mean nothing. So one end is tuned as `seaopt.tune` does, from a scan, and every further
point from its neighbour's numbers alone; a scan follows only where that breaks a limit. This is done from both ends,
and the chain is taken that breaks limits at fewer points; of two that keep them, the one that changes its valley less
often; of two that do so alike, the one whose objective, over the best that is known at each point, is the smaller at
its worst point, or where both change it, the one that breaks limits at fewer values between the points.

A reading that is missing from the start leaves the law without a place in the table. What counts then is the point
whose law has the least Ms on the worst plant of all points.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np

from seaopt.control.laws.controller import Controller
from seaopt.control.laws.delay import settle_delays, take_own_delays
from seaopt.control.laws.limits import INTEGRAL_RAD_S, MeasuredLoop
from seaopt.control.laws.outer_run import close_outer
from seaopt.control.laws.spec import ControllerSpec
from seaopt.control.laws.verdict import list_broken_limits
from seaopt.control.loops.outer_loop import OuterLoop
from seaopt.control.loops.sampled_plant import DELAYS
from seaopt.control.scheduling.gain_table import check_points, check_structure
from seaopt.control.scheduling.scheduled_controller import (
    Plants,
    ScheduledController,
    find_unit,
    make_table,
    place_plants,
    place_variable,
)
from seaopt.control.tuning.convex_concave import improve
from seaopt.control.tuning.found_law import FoundLaw, meet_outer
from seaopt.control.tuning.frequencies import place_frequencies
from seaopt.control.tuning.interior_point import refine
from seaopt.control.tuning.law_numbers import K_I, K_P, LawNumbers, read_numbers
from seaopt.control.tuning.optimisation_problem import Task
from seaopt.control.tuning.solution import Solution, recheck, solve
from seaopt.control.tuning.tuner import Draws, RobustTo, make_controller, make_task, tune
from seaopt.errors import ControlError, require_type
from seaopt.estimation import Fit
from seaopt.frequency import MeasuredResponse
from seaopt.parameters import ParameterSet
from seaopt.plants import Plant
from seaopt.plants.plant import require_plant
from seaopt.progress import Progress, count_off, divide, ignore
from seaopt.records import record

SLOWEST_OBSERVER_S = 3.0  # beside integrals a slower one costs a law that is frozen at a place too many digits
ANOTHER_VALLEY = 10.0  # factor by which an integral's rate differs between two of the tuner's valleys
Chain = list[Solution]  # of every point


def tune_schedule(
    plant: Plant,
    params: Fit | ParameterSet,
    spec: ControllerSpec,
    over: str,
    points: Sequence[float],
    robust_to: RobustTo | None = None,
    *,
    bandwidths_hz: Sequence[float] | None = None,
    draws: Draws = (),
    witnesses: Plants | None = None,
    near: ScheduledController | None = None,
    outer: Callable[[ScheduledController], OuterLoop | None] | None = None,
    progress: Progress = ignore,
) -> ScheduledController:
    """Tune a controller per point of a scheduling variable, with gains that are interpolated between the points.

    Parameters
    ----------
    plant : Plant
        The design plant.
    params : Fit or ParameterSet
        Its parameters.
    spec : ControllerSpec
        Limits, the same at every point; the structure "pd", "pid", "pid_dob" or "cascade", with or without a notch and
        a prefilter.
    over : str
        The variable: a state that is measured, such as an angle, at which the plants are linearised; or a parameter
        that is known while the law runs, such as a load.
    points : sequence of float
        Its values, ascending, SI; the ends are the range for which the schedule is made.
    robust_to : mapping of name to Plant, (Plant, ParameterSet) or MeasuredResponse, optional
        As in `seaopt.tune`; those that have the variable are placed at each point. A measured response counts at the
        value at which it was taken, which has to be a point: its own (`MeasuredResponse.values`), or that of `params`.
    bandwidths_hz : sequence of float, optional
        One per point, in place of the specification's.
    draws : sequence of mappings, optional
        As in `seaopt.tune`.
    witnesses : mapping of name to (Plant, ParameterSet), optional
        More plants on which every plant's limits are kept at the points, such as the worst draws of a certificate;
        between the points the law is not judged on them.
    near : ScheduledController, optional
        A schedule of these points, or of some of them, under other limits or on other plants: a point that it
        has is started from its gains there, any other from its neighbour's, and none from a scan at an end.
    outer : callable, optional
        Returns the one outer loop that a schedule is to run with, or None; as in `seaopt.tune`.
    progress : callable, optional
        Called with what is done and the share of it that is done.

    Returns
    -------
    ScheduledController
        Judged at the points and at three values in every stretch between two of them.

    Raises
    ------
    ControlError
        As `seaopt.tune`; no plant has the variable, the points do not ascend, or the gains cannot be interpolated.

    Examples
    --------
    >>> import seaopt as so
    >>> from seaopt.control import tune_schedule
    >>> spec = so.ControllerSpec(bandwidth_hz=20, max_sensitivity=1.6)
    >>> stiffer = tune_schedule(so.plants.high_impedance(), so.plants.thor(), spec, "k", [5e5, 6e5])
    >>> stiffer.feasible, [round(one.achieved.bandwidth_hz) for one in stiffer.controllers]
    (True, [20, 20])
    """
    require_type(spec, ControllerSpec, "spec", "give a ControllerSpec", ControlError)
    require_plant(plant, "plant", ControlError)
    check_structure(spec.structure)
    places = np.asarray(points, dtype=float)
    check_points(over, places)
    robust_to = take_own_delays(spec, plant, robust_to or {}, params)
    spec, values = settle_delays(spec, plant, params)
    responses = {name: plant for name, plant in robust_to.items() if isinstance(plant, MeasuredResponse)}
    robust_pairs = _pair_plants(robust_to, values)
    kept = {**robust_pairs, **(witnesses or {})}
    if over in DELAYS:
        raise ControlError(f'over = "{over}": a delay cannot be read as the law runs; give a state or a parameter')
    if any(over in draw for draw in draws):
        raise ControlError(f'draws have "{over}", which the schedule is over; take it out of the draws')
    unit = find_unit(over, {"the design plant": plant, **{name: other for name, (other, _) in robust_pairs.items()}})
    placed: list[tuple[ParameterSet, RobustTo]] = [
        (place_variable(plant, values, over, value), place_plants(kept, over, value)) for value in places.tolist()
    ]
    for name, response in responses.items():
        at = _find_point(over, places.tolist(), name, find_response_place(over, name, response, values))
        placed[at] = placed[at][0], {**placed[at][1], name: response}
    tasks = [
        make_task(plant, plant.complete(at_point), point_spec, at_points, draws)
        for (at_point, at_points), point_spec in zip(placed, _specify(spec, places, bandwidths_hz), strict=True)
    ]
    tasks = [_share_nominal(task, tasks[len(tasks) // 2]) for task in tasks]

    @cache
    def make(found: _FoundChain) -> ScheduledController:
        """Return the schedule of what was found at the points."""
        controllers: list[Controller] = []
        for (at_point, at_points), law in zip(placed, found.laws, strict=True):
            # What blocks, and what is possible instead, is for the tuner to say; its observer would have another plant.
            if law.task.nominal is None and law.missed:
                around = None if law.task.moved is None else _give(law.task.moved.outer)
                controllers.append(tune(plant, at_point, law.task.spec, at_points, draws=draws, outer=around))
            else:
                controllers.append(make_controller(law.task, law.x, law.loops, (plant, at_point)))
        make_table(over, unit, tuple(places.tolist()), tuple(controllers))  # refuses gains that cannot be interpolated
        return ScheduledController(
            over=over,
            unit=unit,
            points=tuple(places.tolist()),
            controllers=tuple(controllers),
            others=robust_pairs,
            fallback=float(places[0]),
            draws=tuple(draws),
        ).with_places()

    alone, around = divide(progress, 1.0, 1.0 * (outer is not None))
    chains = _rank_chains(tasks, None if near is None else _follow_schedule(tasks, points, near), alone)
    found, *further = [_FoundChain.of(tasks, chain) for chain in chains]
    if _count_hops(chains[0]) and not make(found).met:
        found = min([found, *further], key=lambda each: sum(bool(figures.broken) for figures in make(each).between))
    if outer is not None:
        found = meet_outer(found, make, outer, around)
    schedule = make(found)
    progress(f"{places.size} points over {over}", 1.0)
    return replace(schedule, fallback=_choose_fallback(schedule))


@record(eq=False)
class _FoundChain:
    """The laws that were found at the points of a schedule."""

    laws: tuple[FoundLaw, ...]

    @classmethod
    def of(cls, tasks: Sequence[Task], chain: Chain) -> _FoundChain:
        """Return the laws of a chain."""
        pairs = zip(tasks, chain, strict=True)
        return cls(laws=tuple(FoundLaw(task=task, x=x, loops=loops) for task, (x, loops) in pairs))

    @property
    def missed(self) -> float:
        """The worst usage of a limit that is missed at a point; 0 where none is."""
        return max(law.missed for law in self.laws)

    def enclose(self, outer: OuterLoop, per_effort: float) -> _FoundChain:
        """Return the laws measured with an outer loop."""
        return _FoundChain(laws=tuple(law.enclose(outer, per_effort) for law in self.laws))

    def follow(self, progress: Progress, *, first: bool) -> _FoundChain:
        """Return the laws found from these, near each that misses a limit, and where that is not enough at `first` all
        of them anew.
        """
        near = _FoundChain(laws=tuple(law.follow(ignore, first=False) if law.missed else law for law in self.laws))
        if not first or not near.missed:
            return near
        tasks = [law.task for law in self.laws]
        return _FoundChain.of(tasks, _rank_chains(tasks, None, progress)[0])


def _give(outer: OuterLoop) -> Callable[[Controller], OuterLoop]:
    return lambda _: outer


def _pair_plants(robust_to: Mapping[str, Any], values: ParameterSet) -> Plants:
    """Return the plants of robust_to with their parameters."""
    pairs: dict[str, tuple[Plant, ParameterSet]] = {}
    for name, plant in robust_to.items():
        if isinstance(plant, MeasuredResponse):
            continue
        pairs[str(name)] = plant if isinstance(plant, tuple) else (plant, values)
        require_plant(pairs[str(name)][0], f"robust_to: {name}", ControlError)
    return pairs


def find_response_place(over: str, name: str, response: MeasuredResponse, values: ParameterSet) -> float:
    """Return the value of a scheduling variable at which a response was measured: the response's, else that of the
    parameters, else the default of its plant. Raises ControlError: there is none.
    """
    if over in response.values:
        return response.values[over]
    for parameters in (values, response.plant.defaults):
        if over in parameters:
            return parameters[over].value
    raise ControlError(
        f"{name} is a measured response, which stands at one value of {over}, which is not given; give {over} among "
        "the parameters"
    )


def _find_point(over: str, points: Sequence[float], name: str, taken: float) -> int:
    """Return the point at which a measured response was taken."""
    if taken not in points:
        more = ", ".join(f"{value:g}" for value in sorted({*points, taken}))
        raise ControlError(
            f"robust_to: {name} is a measured response, which was taken at {over} = {taken:g}, and no point is there; "
            f"give points = [{more}], or the value of {over} it was taken at among the parameters"
        )
    return points.index(taken)


def _specify(spec: ControllerSpec, points: Any, bandwidths_hz: Sequence[float] | None) -> list[ControllerSpec]:
    """Return the specification of every point."""
    if bandwidths_hz is None:
        return [spec] * len(points)
    if len(bandwidths_hz) != len(points):
        raise ControlError(
            f"bandwidths_hz has {len(bandwidths_hz)} values and points {len(points)}; give one per point"
        )
    return [replace(spec, bandwidth_hz=band) for band in bandwidths_hz]


def _share_nominal(task: Task, other: Task) -> Task:
    """Return a task whose observer has another's nominal plant, but for its gain: the same states at every point."""
    if task.nominal is None or other.nominal is None:
        return task
    gain = other.nominal.inverse_gain * task.nominal.static_inverse / other.nominal.static_inverse
    return replace(task, nominal=other.nominal.scaled(gain), slowest_observer_s=SLOWEST_OBSERVER_S)


def _rank_chains(tasks: Sequence[Task], followed: Chain | None, progress: Progress) -> list[Chain]:
    """Return the numbers of every point with their loops: those `followed`, or where there are none those of the chains
    from either end, the better one first, and the other where it breaks limits at no more points.
    """
    if followed is not None:
        return [followed]
    forward, backward = divide(progress, 1.0, 1.0)
    chains = [_tune_chain(tasks, forward), _tune_chain(tasks[::-1], backward)[::-1]]
    values, broken = np.zeros((2, len(tasks))), [0, 0]
    for k, chain in enumerate(chains):
        for point, (task, (x, loops)) in enumerate(zip(tasks, chain, strict=True)):
            values[k, point] = task.rank(task.grid(place_frequencies(task)), x)[1]
            broken[k] += _breaks_limits(task, loops)
    losses = np.max(values / np.min(values, axis=0), axis=1)
    order = sorted(range(2), key=lambda k: (broken[k], _count_hops(chains[k]), losses[k]))
    return [chains[k] for k in order if broken[k] == broken[order[0]]]


def _count_hops(chain: Chain) -> int:
    """Return how often neighbours' integrals differ as those of two valleys do."""
    rates = [max(x[K_I] / (1.0 + x[K_P]), INTEGRAL_RAD_S) for x, _ in chain]
    return int(np.count_nonzero(np.abs(np.diff(np.log(rates))) > math.log(ANOTHER_VALLEY)))


def _tune_chain(tasks: Sequence[Task], progress: Progress) -> Chain:
    """Return the numbers of every point, of the first from a scan and of the others from the one before."""
    chain: Chain = []
    for task in count_off(tasks, "point", progress):
        if not chain:
            chain.append(solve(task))
            continue
        before = chain[-1][0]
        x = _follow(task, before)
        loops = task.measure(x)
        chain.append(solve(task, [before]) if _breaks_limits(task, loops) else (x, loops))
    return chain


def _follow_schedule(tasks: Sequence[Task], points: Sequence[float], near: ScheduledController) -> Chain | None:
    """Return the numbers reached at every point from those of a schedule of all, or of some; None where these break a
    limit, or there are none. What a scan has at one point alone may be of another valley than its neighbours.
    """
    shared = [k for k, point in enumerate(points) if point in near.points]
    reached: dict[int, Solution] = {}
    if not shared:
        return None
    for k in (*range(shared[0], len(tasks)), *reversed(range(shared[0]))):
        task = tasks[k]
        if k in shared:
            gains = near.controllers[near.points.index(points[k])].gains
            start = read_numbers(gains, task.k_ff, task.spec.sample_time_s)
        else:
            start = reached[k - 1 if k > shared[0] else k + 1][0]
        x = _follow(task, start)
        reached[k] = x, task.measure(x)
        if _breaks_limits(task, reached[k][1]):
            return None
    return [reached[k] for k in range(len(tasks))]


def _breaks_limits(task: Task, loops: Sequence[MeasuredLoop]) -> bool:
    return bool(list_broken_limits(task.spec, loops, task.design_states))


def _follow(task: Task, x: LawNumbers) -> LawNumbers:
    """Return the numbers that the optimisation reaches from those of a neighbour, without a scan."""
    grid = task.grid(place_frequencies(task))
    start = task.tidy(x)
    return recheck(task, grid, refine(task, grid, improve(task, grid, start)[1])) if task.is_stable(start) else start


def _choose_fallback(schedule: ScheduledController) -> float:
    """Return the point whose law has the least Ms on the worst plant of all points."""
    plants = {"": schedule.design, **schedule.others}
    cases = [pair for value in schedule.points for pair in place_plants(plants, schedule.over, value).values()]
    chosen, least = schedule.points[0], math.inf
    for point, law in zip(schedule.points, schedule.controllers, strict=True):
        worst = 0.0
        for number, case in enumerate(cases):
            worst = max(worst, close_outer(law, *case).figures().ms)
            if worst >= least:
                cases.insert(0, cases.pop(number))  # what rules out one law soon does so with the next
                break
        else:
            chosen, least = point, worst
    return chosen
