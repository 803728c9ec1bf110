"""Tabulate what a bandwidth costs: one tuned controller for each of several, and their figures."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from concurrent.futures import Executor
from dataclasses import asdict, replace
from functools import partial
from typing import Any

from seaopt.control.frontier.free_law import FreeLaw, bound_free_law
from seaopt.control.laws.controller import Controller
from seaopt.control.laws.delay import settle_delays
from seaopt.control.laws.limits import MeasuredLoop
from seaopt.control.laws.spec import ControllerSpec
from seaopt.control.laws.verdict import judge_all, list_broken
from seaopt.control.loops.compensation.link_feedforward import LinkPath
from seaopt.control.loops.sampled_plant import DigitalPlant
from seaopt.control.tuning.law_numbers import LawNumbers
from seaopt.control.tuning.optimisation_problem import Task
from seaopt.control.tuning.solution import feed_link, lower_fraction, search, solve
from seaopt.control.tuning.tuner import Draws, RobustTo, aim_task, disturbance, make_controller, make_task, name_design
from seaopt.errors import ControlError, require_number, require_type
from seaopt.estimation import Fit
from seaopt.executors import Shared, check_executor, map_ordered
from seaopt.frequency import MeasuredResponse
from seaopt.parameters import ParameterSet
from seaopt.plants import Plant
from seaopt.plants.friction import take_sliding
from seaopt.progress import Progress, divide, ignore, prefix
from seaopt.records import PlotAccessor, Result, Worded, record
from seaopt.units import LINEAR, Mechanics

FRONTIER_SCHEMA = "seaopt/frontier/1"
MOST_ROWS = 1000
CHAIN = 4  # bandwidths of which each starts from the one before: chains are independent, whatever works on them


@record
class SlidingAlone(Result):
    """The best law for the sliding plants alone: whether limits are met, noise gain and disturbance, as in a row."""

    met: bool
    noise_gain: float
    disturbance: float


@record
class FrontierRow(Result):
    """One bandwidth; what is not said to be of the worst plant is of the design plant."""

    bandwidth_hz: float
    met: bool  # whether every limit is met; if not, the figures are those of the controller that misses them least
    noise_gain: float  # N/N
    ms: float  # ms, ms_plant: largest Ms of all plants, and whose it is
    ms_plant: str
    disturbance: float  # integral over ln f of abs(S) from 0.1 Hz to the bandwidth, worst plant
    sensitivity_bandwidth_hz: float  # abs(S) stays below -3 dB up to here
    phase_margin_deg: float | None  # phase_margin_deg, disk_margin: as in `LoopFigures`
    disk_margin: float
    # largest amplitude of the reference at the bandwidth before the current saturates; None without a limit
    force_limit_N: float | None
    blocked_by: tuple[str, ...]  # the limits that are broken
    # what could be had if no plant ever stuck; None where none has friction. The difference is what friction costs
    without_sticking: SlidingAlone | None = None
    # the best that any linear law could do on the design plant; None where it was not asked for. The difference to the
    # disturbance, or with that objective to the noise gain, is what the structure costs, at most
    free_law: FreeLaw | None = None

    def to_dict(self) -> dict[str, Any]:
        """Return the row of frontier.json."""
        fields, alone = asdict(self) | {"feasible": self.met}, self.without_sticking
        return fields if alone is None else fields | {"without_sticking": asdict(alone) | {"feasible": alone.met}}


@record(eq=False, repr=False)
class Frontier(Result, Worded):
    """The rows of a sweep, and their controllers."""

    plot = PlotAccessor()

    rows: tuple[FrontierRow, ...]
    controllers: tuple[Controller, ...]

    @property
    def met(self) -> bool:
        """Whether every limit is met at some bandwidth."""
        return any(row.met for row in self.rows)

    @property
    def mechanics(self) -> Mechanics:
        """Units and words of what the controllers command."""
        return self.controllers[0].command.mechanics if self.controllers else LINEAR

    def to_dict(self) -> dict[str, Any]:
        """Return the content of frontier.json (schema seaopt/frontier/1)."""
        return {
            "schema": FRONTIER_SCHEMA,
            "met": self.met,
            "rows": [row.to_dict() for row in self.rows],
            "controllers": [controller.to_dict() for controller in self.controllers],
        }


def sweep(
    plant: Plant | MeasuredResponse,
    params: Fit | ParameterSet,
    spec: ControllerSpec,
    bandwidths_hz: Sequence[float],
    robust_to: RobustTo | None = None,
    *,
    draws: Draws = (),
    free_law: bool = False,
    executor: Executor | None = None,
    progress: Progress = ignore,
) -> Frontier:
    """Tune at each of several bandwidths, but for every fourth also starting from the one before.

    An infeasible row is a result.

    Parameters
    ----------
    plant, params, spec, robust_to, draws
        As `tune`; the specification's own bandwidth is not used.
    bandwidths_hz : sequence of float
        In the specification's range.
    free_law : bool
        Also compute, for each bandwidth, the best that any linear law could do on the design plant under these limits
        (`seaopt.control.bound_free_law`), which takes about two seconds; not where the design plant is measured.
    executor : concurrent.futures.Executor, optional
        Where bandwidths are tuned, four by four (`seaopt.executors`); here, if left out. The result is the same, bit
        for bit.
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
    spec, params = settle_delays(spec, design, params)
    # What is wrong with any row is said before the first is tuned.
    specs = [replace(spec, bandwidth_hz=require_number(f, "bandwidths_hz", ControlError)) for f in bandwidths_hz]
    robust_to = robust_to or {}
    swept = _Sweep(
        task=make_task(plant, params, specs[0], robust_to, draws),
        sliding=_make_sliding_task(plant, params, specs[0], robust_to, draws),
        design=(plant, params),
        free_law=free_law,
    )
    rows: list[FrontierRow] = []
    controllers: list[Controller] = []
    for point, solved in zip(specs, _solve_chains(swept, specs, executor, progress), strict=True):
        task = feed_link(replace(swept.task, spec=point), solved.link)
        controllers.append(make_controller(task, solved.x, solved.loops, swept.design))
        rows.append(_make_row(task, solved, controllers[-1]))
    progress(f"{spec.structure}, {len(rows)} bandwidths", 1.0)
    return Frontier(rows=tuple(rows), controllers=tuple(controllers))


@record(eq=False)
class _Sweep:
    """What is tuned at every bandwidth, and on the sliding plants alone."""

    task: Task
    sliding: Task
    design: tuple[Plant | MeasuredResponse, ParameterSet]
    free_law: bool

    @property
    def sticks(self) -> bool:
        """Whether there is friction that a plant sticks with."""
        return len(self.sliding.plants) < len(self.task.plants)


@record(eq=False)
class _Solved:
    """The numbers of one bandwidth's law, its loops, its link's path, and what it is compared with."""

    x: LawNumbers
    loops: list[MeasuredLoop]
    link: LinkPath | None
    without_sticking: SlidingAlone | None
    free_law: FreeLaw | None


def _solve_chains(
    swept: _Sweep, specs: Sequence[ControllerSpec], executor: Executor | None, progress: Progress
) -> Iterator[_Solved]:
    """Yield the solution of each specification, in their order."""
    chains = [specs[k : k + CHAIN] for k in range(0, len(specs), CHAIN)]
    parts = divide(progress, *(float(len(chain)) for chain in chains))
    if executor is None:
        for chain, part in zip(chains, parts, strict=True):
            yield from _solve_chain(swept, chain, part)
        return
    done = map_ordered(partial(_solve_part, Shared(swept)), chains, executor)
    for chain, part, solved in zip(chains, parts, done, strict=True):
        part(f"{chain[-1].bandwidth_hz:g} Hz", 1.0)
        yield from solved


def _solve_part(swept: Shared[_Sweep], chain: Sequence[ControllerSpec]) -> list[_Solved]:
    return list(_solve_chain(swept.value, chain, ignore))


def _solve_chain(swept: _Sweep, chain: Sequence[ControllerSpec], progress: Progress) -> Iterator[_Solved]:
    """Yield the solution of each specification; every one but the first also starts from the one before."""
    warm: tuple[LawNumbers, ...] = ()
    for point, part in zip(chain, divide(progress, *(1.0 for _ in chain)), strict=True):
        whole, sliding_alone = divide(prefix(part, f"{point.bandwidth_hz:g} Hz"), 1.0, float(swept.sticks))
        task = aim_task(swept.task, point)
        task, x, loops = lower_fraction(task, *solve(task, warm, whole))
        x, loops = search(task, x, loops)
        sliding = feed_link(replace(swept.sliding, spec=point), task.link)
        alone = _tune_sliding(sliding, x, sliding_alone) if swept.sticks else None
        free = None
        if swept.free_law and isinstance(task.plants[0], DigitalPlant):
            free = bound_free_law(task.plants[0], point, [task.law_of(x).balanced()])
        yield _Solved(x=x, loops=loops, link=task.link, without_sticking=alone, free_law=free)
        warm = (x,)


def _make_sliding_task(
    plant: Plant | MeasuredResponse, params: ParameterSet, spec: ControllerSpec, robust_to: RobustTo, draws: Draws
) -> Task:
    """Return the task on the sliding plants alone; measured ones are what they are."""
    sliding: dict[str, Plant | tuple[Plant, ParameterSet] | MeasuredResponse] = {}
    for name, other in robust_to.items():
        if isinstance(other, MeasuredResponse):
            sliding[name] = other
            continue
        model, values = other if isinstance(other, tuple) else (other, params)
        sliding[name] = (take_sliding(model, model.complete(values)), values)
    design = plant if isinstance(plant, MeasuredResponse) else take_sliding(plant, plant.complete(params))
    return make_task(design, params, spec, sliding, draws)


def _tune_sliding(task: Task, start: LawNumbers, progress: Progress) -> SlidingAlone:
    x, loops = solve(task, (start,), progress)
    return SlidingAlone(
        met=not list_broken(judge_all(task.spec, loops)),
        noise_gain=loops[0].figures.noise_gain,
        disturbance=_worst_disturbance(task, x),
    )


def _worst_disturbance(task: Task, x: LawNumbers) -> float:
    return max(disturbance(task.loop(x, i), task.spec.bandwidth_hz) for i in range(len(task.plants)))


def _make_row(task: Task, solved: _Solved, controller: Controller) -> FrontierRow:
    design, f_b = solved.loops[0].figures, task.spec.bandwidth_hz
    worst = max(solved.loops, key=lambda loop: loop.figures.ms)
    return FrontierRow(
        bandwidth_hz=f_b,
        met=controller.met,
        noise_gain=design.noise_gain,
        ms=worst.figures.ms,
        ms_plant=worst.name,
        disturbance=_worst_disturbance(task, solved.x),
        sensitivity_bandwidth_hz=design.sensitivity_bandwidth_hz,
        phase_margin_deg=design.phase_margin_deg,
        disk_margin=design.disk_margin,
        force_limit_N=controller.force_limit(f_b),
        blocked_by=controller.blocked_by,
        without_sticking=solved.without_sticking,
        free_law=solved.free_law,
    )
