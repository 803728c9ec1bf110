"""Tabulate what a bandwidth costs: one tuned controller for each of several, and their figures."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from concurrent.futures import Executor
from dataclasses import replace
from typing import Any

from seaopt.control.frontier.free_law import FreeLaw, bound_free_law
from seaopt.control.frontier.rows import Frontier, FrontierRow, SlidingAlone, make_row, measure_disturbance
from seaopt.control.frontier.scheduled import Chain, ScheduleSweep, slide_plants, tune_chains, tune_row
from seaopt.control.laws.command import command_of
from seaopt.control.laws.controller import Controller
from seaopt.control.laws.delay import settle_delays, take_own_delays
from seaopt.control.laws.limits import MeasuredLoop
from seaopt.control.laws.spec import ControllerSpec
from seaopt.control.laws.verdict import judge_all, list_broken
from seaopt.control.loops.compensation.link_feedforward import LinkPath
from seaopt.control.loops.outer_loop import OuterLoop
from seaopt.control.loops.sampled_plant import DigitalPlant
from seaopt.control.tuning.found_law import FoundLaw, Surround, meet_outer
from seaopt.control.tuning.law_numbers import LawNumbers
from seaopt.control.tuning.optimisation_problem import Task
from seaopt.control.tuning.solution import feed_link, lower_fraction, search, solve, solve_beside
from seaopt.control.tuning.tuner import Draws, RobustTo, aim_task, make_controller, make_task, name_design
from seaopt.errors import ControlError, require_number, require_type
from seaopt.estimation import Fit
from seaopt.executors import check_executor
from seaopt.frequency import MeasuredResponse
from seaopt.parameters import ParameterSet
from seaopt.plants import Plant
from seaopt.progress import Progress, divide, ignore, prefix
from seaopt.records import record

MOST_ROWS = 1000
CHAIN = 4  # bandwidths of which each starts from the one before: chains are independent, whatever works on them


def sweep(
    plant: Plant | MeasuredResponse,
    params: Fit | ParameterSet,
    spec: ControllerSpec,
    bandwidths_hz: Sequence[float],
    robust_to: RobustTo | None = None,
    *,
    over: str | None = None,
    points: Sequence[float] = (),
    draws: Draws = (),
    outer: Callable[[Any], OuterLoop | None] | None = None,
    free_law: bool = False,
    executor: Executor | None = None,
    progress: Progress = ignore,
) -> Frontier:
    """Tune at each of several bandwidths, but for every fourth also starting from the one before.

    An infeasible row is a result.

    Parameters
    ----------
    plant, params, spec, robust_to, draws, outer
        As `tune`; the specification's own bandwidth is not used.
    bandwidths_hz : sequence of float
        In the specification's range.
    over, points : str and sequence of float, optional
        Of a schedule, as in `seaopt.control.tune_schedule`, which is tuned at every bandwidth by itself.
    free_law : bool
        Also compute, for each bandwidth, the best that any linear law could do on the design plant under these limits
        (`seaopt.control.bound_free_law`), which takes about two seconds; of a schedule at each point, and that of the
        point with the largest objective is stated. Not where the design plant is measured.
    executor : concurrent.futures.Executor, optional
        Where bandwidths are tuned, four by four, schedules one by one (`seaopt.executors`); here, if left out. The
        result is the same, bit for bit.
    progress : callable, optional
        Called with the bandwidth that is tuned and the share of all that is done (`seaopt.progress.Progress`).

    Raises
    ------
    ControlError
        As `tune`; or there is no bandwidth, too many, or one is outside the range; or a free law is asked for beside
        one that reads several signals.

    Examples
    --------
    >>> import seaopt as so
    >>> from seaopt.control import sweep
    >>> spec = so.ControllerSpec(max_sensitivity=1.6, max_noise_gain=25)
    >>> frontier = sweep(so.plants.high_impedance(), so.plants.thor(), spec, [20, 30])
    >>> [row.feasible for row in frontier.rows], frontier.rows[0].noise_gain <= 25
    ([True, True], True)
    """
    require_type(spec, ControllerSpec, "spec", "give a ControllerSpec", ControlError)
    check_executor(executor, ControlError)
    design = name_design(plant)
    require_type(bandwidths_hz, Collection, "bandwidths_hz", "give a sequence of frequencies in Hz", ControlError)
    if free_law and not isinstance(spec.measured, str):
        raise ControlError(
            f"free_law = True with measured = {list(spec.measured)}: the best of all linear laws is computed of those "
            "that read one signal; leave free_law out"
        )
    if not 0 < len(bandwidths_hz) <= MOST_ROWS:
        raise ControlError(f"bandwidths_hz has {len(bandwidths_hz)} values; give 1 to {MOST_ROWS}")
    robust_to = take_own_delays(spec, design, robust_to or {}, params)
    spec, params = settle_delays(spec, design, params)
    # What is wrong with any row is said before the first is tuned.
    specs = [replace(spec, bandwidth_hz=require_number(f, "bandwidths_hz", ControlError)) for f in bandwidths_hz]
    if over is None and len(points):
        raise ControlError(
            f"points = {list(points)} without over: a schedule's are meant; name its variable, or leave them out"
        )
    if over is not None:
        if isinstance(plant, MeasuredResponse):
            raise ControlError(
                f"over = {over}: a measured response stands at one value, and a schedule takes a model as its design "
                "plant; name the response in robust_to"
            )
        schedules = ScheduleSweep(
            plant=plant,
            params=params,
            over=over,
            points=points,
            robust_to=robust_to,
            draws=draws,
            outer=outer,
            free_law=free_law,
        )
        pairs = list(tune_chains(tune_row, schedules, [[each] for each in specs], executor, progress))
        progress(f"{spec.structure} over {over}, {len(pairs)} bandwidths", 1.0)
        return Frontier(rows=tuple(row for row, _ in pairs), controllers=tuple(law for _, law in pairs), over=over)
    sliding, sliding_robust_to = slide_plants(plant, params, robust_to)
    swept = _SweepTask(
        task=make_task(plant, params, specs[0], robust_to, draws),
        sliding=make_task(sliding, params, specs[0], sliding_robust_to, draws),
        design=(plant, params),
        outer=outer,
        free_law=free_law,
    )
    rows: list[FrontierRow] = []
    controllers: list[Controller] = []
    chains = [specs[k : k + CHAIN] for k in range(0, len(specs), CHAIN)]
    for point, solved in zip(specs, tune_chains(_solve_chain, swept, chains, executor, progress), strict=True):
        task = swept.surround(feed_link(replace(swept.task, spec=point), solved.link), solved.outer)
        controllers.append(make_controller(task, solved.x, solved.loops, swept.design))
        compared: dict[str, Any] = {"without_sticking": solved.without_sticking, "free_law": solved.free_law}
        rows.append(make_row(task, task.law_of(solved.x), solved.loops, controllers[-1], **compared))
    progress(f"{spec.structure}, {len(rows)} bandwidths", 1.0)
    return Frontier(rows=tuple(rows), controllers=tuple(controllers))


@record(eq=False)
class _SweepTask:
    """What is tuned at every bandwidth, and on the sliding plants alone."""

    task: Task
    sliding: Task
    design: tuple[Plant | MeasuredResponse, ParameterSet]
    outer: Surround | None
    free_law: bool

    @property
    def sticks(self) -> bool:
        """Whether there is friction that a plant sticks with."""
        return len(self.sliding.plants) < len(self.task.plants)

    def surround(self, task: Task, outer: OuterLoop | None) -> Task:
        """Return a task with an outer loop, where there is one."""
        if outer is None:
            return task
        command = command_of(name_design(self.design[0]), self.design[1], task.spec.regulated)
        return task.enclosed(outer, command.per_effort)

    def describe(self, found: FoundLaw) -> Controller:
        """Return the controller of what was found."""
        return make_controller(found.task, found.x, found.loops, self.design)


@record(eq=False)
class _SolvedBandwidth:
    """The numbers of one bandwidth's law, its loops, its link's path, its outer loop, and what it is compared with."""

    x: LawNumbers
    loops: list[MeasuredLoop]
    link: LinkPath | None
    outer: OuterLoop | None
    without_sticking: SlidingAlone | None
    free_law: FreeLaw | None


def _solve_chain(swept: _SweepTask, chain: Chain, progress: Progress) -> Iterator[_SolvedBandwidth]:
    """Yield the solution of each specification; every one but the first also starts from the one before."""
    warm: tuple[LawNumbers, ...] = ()
    for point, part in zip(chain, divide(progress, *(1.0 for _ in chain)), strict=True):
        whole, sliding_alone = divide(prefix(part, f"{point.bandwidth_hz:g} Hz"), 1.0, float(swept.sticks))
        task = aim_task(swept.task, point)
        task, x, loops = lower_fraction(task, *solve_beside(task, warm, whole))
        x, loops = search(task, x, loops)
        if swept.outer is not None:
            found = meet_outer(FoundLaw(task=task, x=x, loops=loops), swept.describe, swept.outer, ignore)
            task, x, loops = found.task, found.x, found.loops
        around = None if task.moved is None else task.moved.outer
        sliding = swept.surround(feed_link(replace(swept.sliding, spec=point), task.link), around)
        alone = _tune_sliding(sliding, x, sliding_alone) if swept.sticks else None
        free = None
        if swept.free_law and isinstance(task.plants[0], DigitalPlant):
            free = bound_free_law(task.plants[0], point, [task.law_of(x).balanced()])
        yield _SolvedBandwidth(x=x, loops=loops, link=task.link, outer=around, without_sticking=alone, free_law=free)
        warm = (x,)


def _tune_sliding(task: Task, start: LawNumbers, progress: Progress) -> SlidingAlone:
    x, loops = solve(task, (start,), progress)
    return SlidingAlone(
        met=not list_broken(judge_all(task.spec, loops)),
        noise_gain=loops[0].figures.noise_gain,
        disturbance=measure_disturbance(task, task.law_of(x)),
    )
