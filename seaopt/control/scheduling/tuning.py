"""Tune a schedule: the same structure and limits at every point, each point started from its neighbour.

A law that is tuned by itself may sit in another valley than its neighbour's, with an integral a hundred times slower
say, and lines between the two mean nothing. So one end is tuned as `seaopt.tune` does, from a scan, and every further
point from its neighbour's numbers alone; a scan follows only where that breaks a limit. This is done from both ends,
and the chain is taken that breaks limits at fewer points; of two that keep them, the one whose objective, over the best
that is known at each point, is the smaller at its worst point.

A reading that is missing from the start leaves the law without a place in the table. What counts then is the point
whose law has the least Ms on the worst plant of all points.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from seaopt.control.laws.controller import Controller
from seaopt.control.laws.delay import settle_delays, take_own_delays
from seaopt.control.laws.limits import MeasuredLoop
from seaopt.control.laws.spec import ControllerSpec
from seaopt.control.laws.verdict import list_broken_limits
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
from seaopt.control.tuning.frequencies import place_frequencies
from seaopt.control.tuning.interior_point import refine
from seaopt.control.tuning.law_numbers import LawNumbers, read_numbers
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
    near: ScheduledController | None = None,
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
    near : ScheduledController, optional
        The schedule of these points under other limits, or on other plants: each point is started from its gains there,
        and not from a scan at an end.
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
    others = _pair_plants(robust_to, values)
    if over in DELAYS:
        raise ControlError(f'over = "{over}": a delay cannot be read as the law runs; give a state or a parameter')
    if any(over in draw for draw in draws):
        raise ControlError(f'draws have "{over}", which the schedule is over; take it out of the draws')
    unit = find_unit(over, {"the design plant": plant, **{name: other for name, (other, _) in others.items()}})
    placed: list[tuple[ParameterSet, RobustTo]] = [
        (place_variable(plant, values, over, value), place_plants(others, over, value)) for value in places.tolist()
    ]
    for name, response in responses.items():
        at = _find_point(over, places.tolist(), name, find_response_place(over, name, response, values))
        placed[at] = placed[at][0], {**placed[at][1], name: response}
    tasks = [
        make_task(plant, plant.complete(at_point), point_spec, at_points, draws)
        for (at_point, at_points), point_spec in zip(placed, _specify(spec, places, bandwidths_hz), strict=True)
    ]
    tasks = [_share_nominal(task, tasks[len(tasks) // 2]) for task in tasks]
    controllers: list[Controller] = []
    for (at_point, at_points), task, (x, loops) in zip(
        placed, tasks, _choose_chain(tasks, near, progress), strict=True
    ):
        # What blocks, and what is possible instead, is for the tuner to say; its observer would have another plant.
        if task.nominal is None and _breaks_limits(task, loops):
            controllers.append(tune(plant, at_point, task.spec, at_points, draws=draws))
        else:
            controllers.append(make_controller(task, x, loops, (plant, at_point)))
    make_table(over, unit, tuple(places.tolist()), tuple(controllers))  # refuses gains that cannot be interpolated
    schedule = ScheduledController(
        over=over,
        unit=unit,
        points=tuple(places.tolist()),
        controllers=tuple(controllers),
        others=others,
        fallback=float(places[0]),
    ).with_places()
    progress(f"{places.size} points over {over}", 1.0)
    return replace(schedule, fallback=_choose_fallback(schedule))


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


def _find_point(over: str, points: Sequence[float], name: str, place: float) -> int:
    """Return the point at which a measured response was taken."""
    if place not in points:
        more = ", ".join(f"{value:g}" for value in sorted({*points, place}))
        raise ControlError(
            f"robust_to: {name} is a measured response, which was taken at {over} = {place:g}, and no point is there; "
            f"give points = [{more}], or the value of {over} it was taken at among the parameters"
        )
    return points.index(place)


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
    return replace(task, nominal=other.nominal.scaled(gain))


def _choose_chain(tasks: Sequence[Task], near: ScheduledController | None, progress: Progress) -> Chain:
    """Return the numbers of every point with their loops: those reached from a schedule that is near, or where these
    break limits those of the better of the chains from either end.
    """
    chain = None if near is None else _follow_schedule(tasks, near)
    if chain is not None:
        return chain
    forward, backward = divide(progress, 1.0, 1.0)
    chains = [_tune_chain(tasks, forward), _tune_chain(tasks[::-1], backward)[::-1]]
    values, broken = np.zeros((2, len(tasks))), [0, 0]
    for k, chain in enumerate(chains):
        for point, (task, (x, loops)) in enumerate(zip(tasks, chain, strict=True)):
            values[k, point] = task.rank(task.grid(place_frequencies(task)), x)[1]
            broken[k] += _breaks_limits(task, loops)
    losses = np.max(values / np.min(values, axis=0), axis=1)
    return chains[min(range(2), key=lambda k: (broken[k], losses[k]))]


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


def _follow_schedule(tasks: Sequence[Task], near: ScheduledController) -> Chain | None:
    """Return the numbers reached at every point from those of a schedule; None where these break a limit. What a scan
    has at one point alone may be of another valley than its neighbours.
    """
    chain: Chain = []
    for task, law in zip(tasks, near.controllers, strict=True):
        x = _follow(task, read_numbers(law.gains, task.k_ff, task.spec.sample_time_s))
        chain.append((x, task.measure(x)))
        if _breaks_limits(task, chain[-1][1]):
            return None
    return chain


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
    worst = [max(law.close(*case).figures().ms for case in cases) for law in schedule.controllers]
    return schedule.points[int(np.argmin(worst))]
