"""Sweep the bandwidth of a schedule: it is tuned at each by itself, and its figures are those of its worst place."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Executor
from dataclasses import replace
from functools import partial
from typing import Any, TypeVar

from seaopt.control.frontier.free_law import bound_free_law
from seaopt.control.frontier.rows import FrontierRow, SlidingAlone, make_row
from seaopt.control.laws.spec import ControllerSpec
from seaopt.control.loops.outer_loop import OuterLoop
from seaopt.control.loops.sampled_plant import DigitalPlant
from seaopt.control.scheduling.scheduled_controller import ScheduledController, make_place_task, place_plants
from seaopt.control.scheduling.tuning import find_response_place, tune_schedule
from seaopt.control.tuning.tuner import Draws, RobustTo
from seaopt.executors import Shared, map_ordered
from seaopt.frequency import MeasuredResponse
from seaopt.parameters import ParameterSet
from seaopt.plants import Plant
from seaopt.plants.friction import take_sliding
from seaopt.progress import Progress, divide, ignore, prefix
from seaopt.records import record

S = TypeVar("S")
T = TypeVar("T")


def slide_plants(
    plant: Plant | MeasuredResponse, params: ParameterSet, robust_to: RobustTo
) -> tuple[Plant | MeasuredResponse, RobustTo]:
    """Return the plants that slide; measured ones are what they are."""
    sliding: dict[str, Plant | tuple[Plant, ParameterSet] | MeasuredResponse] = {}
    for name, other in robust_to.items():
        if isinstance(other, MeasuredResponse):
            sliding[name] = other
            continue
        model, values = other if isinstance(other, tuple) else (other, params)
        sliding[name] = (take_sliding(model, model.complete(values)), values)
    design = plant if isinstance(plant, MeasuredResponse) else take_sliding(plant, plant.complete(params))
    return design, sliding


@record(eq=False)
class ScheduleSweep:
    """What is tuned at every bandwidth."""

    plant: Plant
    params: ParameterSet
    over: str
    points: Sequence[float]
    robust_to: RobustTo
    draws: Draws
    outer: Callable[[Any], OuterLoop | None] | None
    free_law: bool

    def tune(self, spec: ControllerSpec, progress: Progress) -> ScheduledController:
        """Return the schedule of a specification."""
        options: dict[str, Any] = {"draws": self.draws, "outer": self.outer, "progress": progress}
        return tune_schedule(self.plant, self.params, spec, self.over, self.points, self.robust_to, **options)

    @property
    def sticks(self) -> bool:
        """Whether there is friction that a plant sticks with."""
        pairs = [other if isinstance(other, tuple) else (other, self.params) for other in self.robust_to.values()]
        models = [(plant, values) for plant, values in pairs if isinstance(plant, Plant)]
        every = [(self.plant, self.params), *models]
        return any(take_sliding(plant, plant.complete(values)) is not plant for plant, values in every)

    def slide(self) -> ScheduleSweep:
        """Return the same with plants that slide alone."""
        design, robust_to = slide_plants(self.plant, self.params, self.robust_to)
        assert isinstance(design, Plant)
        return replace(self, plant=design, robust_to=robust_to)

    def measure(self, schedule: ScheduledController, *, free_law: bool = False) -> list[FrontierRow]:
        """Return a row for each place of a schedule; with the best of all linear laws at its points."""
        rows: list[FrontierRow] = []
        responses = [(name, at) for name, at in self.robust_to.items() if isinstance(at, MeasuredResponse)]
        for value in sorted((*schedule.points, *(point.value for point in schedule.between))):
            seen = {
                name: response
                for name, response in responses
                if find_response_place(self.over, name, response, self.params) == value
            }
            spec = replace(schedule.spec, bandwidth_hz=schedule.asked_hz(value))
            task = make_place_task(
                schedule.table,
                value,
                spec,
                schedule.design,
                {**place_plants(schedule.others, self.over, value), **seen},
                schedule.outer,
                self.draws,
            )
            law, free = schedule.table.law(value), None
            if free_law and value in schedule.points and isinstance(task.plants[0], DigitalPlant):
                free = bound_free_law(task.plants[0], spec, [law])
            loops = task.measure_law(law, filter_samples=0.0, integral_rad_s=0.0)
            rows.append(make_row(task, law, loops, schedule.at(value), free_law=free, value=value))
        return rows


Chain = Sequence[ControllerSpec]  # bandwidths that are tuned one after the other


def tune_chains(
    tune: Callable[[S, Chain, Progress], Iterable[T]],
    swept: S,
    chains: Sequence[Chain],
    executor: Executor | None,
    progress: Progress,
) -> Iterator[T]:
    """Yield what `tune` makes of each specification of some chains, in their order, here or where an executor works."""
    parts = divide(progress, *(float(len(chain)) for chain in chains))
    if executor is None:
        for chain, part in zip(chains, parts, strict=True):
            yield from tune(swept, chain, part)
        return
    done = map_ordered(partial(_tune_apart, tune, Shared(swept)), chains, executor)
    for chain, part, tuned in zip(chains, parts, done, strict=True):
        part(f"{chain[-1].bandwidth_hz:g} Hz", 1.0)
        yield from tuned


def _tune_apart(tune: Callable[[S, Chain, Progress], Iterable[T]], swept: Shared[S], chain: Chain) -> list[T]:
    return list(tune(swept.value, chain, ignore))


def tune_row(
    swept: ScheduleSweep, chain: Chain, progress: Progress
) -> Iterator[tuple[FrontierRow, ScheduledController]]:
    """Yield the row of one bandwidth with its schedule."""
    (spec,) = chain
    whole, part = divide(prefix(progress, f"{spec.bandwidth_hz:g} Hz"), 1.0, float(swept.sticks))
    schedule, alone = swept.tune(spec, whole), None
    if swept.sticks:
        sliding = swept.slide()
        tuned = sliding.tune(spec, part)
        places = sliding.measure(tuned)
        alone = SlidingAlone(
            met=tuned.met,
            noise_gain=max(row.noise_gain for row in places),
            disturbance=max(row.disturbance for row in places),
        )
    row = _take_worst(swept.measure(schedule, free_law=swept.free_law), schedule)
    yield replace(row, without_sticking=alone), schedule


def _take_worst(rows: Sequence[FrontierRow], schedule: ScheduledController) -> FrontierRow:
    """Return the figures of a schedule, each of the place where it is worst."""
    worst = max(rows, key=lambda row: row.ms)
    free = [row for row in rows if row.free_law is not None]
    phases = [row.phase_margin_deg for row in rows if row.phase_margin_deg is not None]
    limits = [row.force_limit_N for row in rows if row.force_limit_N is not None]
    objective = "noise_gain" if schedule.spec.objective == "noise" else "disturbance"
    return replace(
        worst,
        met=schedule.met,
        noise_gain=max(row.noise_gain for row in rows),
        disturbance=max(row.disturbance for row in rows),
        sensitivity_bandwidth_hz=min(row.sensitivity_bandwidth_hz for row in rows),
        phase_margin_deg=min(phases, default=None),
        disk_margin=min(row.disk_margin for row in rows),
        force_limit_N=min(limits, default=None),
        blocked_by=schedule.broken,
        free_law=max(free, key=lambda row: getattr(row, objective)).free_law if free else None,
    )
