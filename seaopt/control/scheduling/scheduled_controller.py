"""A scheduled controller: one controller per point of a variable, the lines between their gains, and its judgement."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from itertools import pairwise
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from seaopt.codec import OrInfinite, to_content
from seaopt.control.laws.command import Command, command_of
from seaopt.control.laws.controller import Controller
from seaopt.control.laws.limits import MeasuredLoop
from seaopt.control.laws.outer_run import close_outer
from seaopt.control.laws.realisation import choose_limit
from seaopt.control.laws.spec import ControllerSpec
from seaopt.control.laws.structures import LAW_GAINS, Gains
from seaopt.control.loops.compensation.terms import Compensation
from seaopt.control.loops.loop import Loop
from seaopt.control.loops.outer_loop import OuterLoop
from seaopt.control.loops.sampled_plant import conditions
from seaopt.control.scheduling.gain_table import GainTable
from seaopt.control.scheduling.runnable_schedule import RunnableSchedule, make_runnable
from seaopt.control.scheduling.step_order import SHARE
from seaopt.control.tuning.optimisation_problem import Task
from seaopt.control.tuning.solution import feed_link
from seaopt.control.tuning.tuner import Draws, RobustTo, describe_law, make_task
from seaopt.errors import ControlError, require_type, suggestion
from seaopt.formatting import format_count, join_words
from seaopt.frequency import MeasuredResponse
from seaopt.parameters import ParameterSet
from seaopt.plants import CompletedParameters, Plant
from seaopt.records import Result, Worded, record

if TYPE_CHECKING:
    from seaopt.control.scheduling.stored import StoredPoints

PARTS = 4  # of every stretch between two points, at whose ends the limits are judged
LEAST_BANDWIDTH = 0.9  # of the one asked, that the law has between the points
SAME_GAIN = 0.01  # of its largest, by which a gain that is called the same may change
RESERVE_BETWEEN = 0.03  # with which a limit that is broken between the points may be kept there
LARGE_STEP = 1.0  # of a gain between neighbours, over the smaller of the two, from which it is remarked on
# The keys of controller.json that hold a list, with an entry for each point; all others are those of the first.
PER_POINT = (
    "blocks", "terms", "law", "reference", "measurement", "achieved", "active_constraints", "engineering", "blocked_by",
    "largest_bandwidth_hz", "possible", "measured_responses",
)  # fmt: skip
Plants = Mapping[str, tuple[Plant, ParameterSet]]


@record(eq=False)
class PlaceFigures:
    """What the law does while the variable stands at a value between the points."""

    value: float  # of the variable
    bandwidth_hz: float | None  # of the design plant
    asked_hz: float  # the bandwidth asked there, interpolated
    ms: OrInfinite  # ms, mt: the worst of all plants
    mt: OrInfinite
    broken: tuple[str, ...]  # the limits that are broken


@record(eq=False, repr=False)
class ScheduledController(Result, Worded):
    """A controller per point of one scheduling variable, with its gains interpolated between them.

    Parameters
    ----------
    over, unit : str
        The variable: a state of the plants that is measured, or a parameter that is known as the law runs.
    points : tuple of float
        Its values, ascending.
    controllers : tuple of Controller
        Tuned at these, each with its design plant there.
    others : mapping of name to (Plant, ParameterSet)
        The plants of robust_to, with their nominal parameters.
    fallback : float
        The point whose law counts until a finite value of the variable was read.
    between : tuple of PlaceFigures
        What was found between the points.
    draws : sequence of mappings
        As in `seaopt.tune`: of every plant, at which it is judged besides.
    """

    over: str
    unit: str
    points: tuple[float, ...]
    controllers: tuple[Controller, ...]
    others: Plants
    fallback: float
    between: tuple[PlaceFigures, ...] = ()
    draws: Draws = ()

    @property
    def table(self) -> GainTable:
        """The gains at the points."""
        return make_table(self.over, self.unit, self.points, self.controllers)

    @property
    def spec(self) -> ControllerSpec:
        """The specification at the first point; the others differ in their bandwidth."""
        return self.controllers[0].spec

    @property
    def command(self) -> Command:
        """What is commanded for an effort."""
        return self.controllers[0].command

    @property
    def outer(self) -> OuterLoop | None:
        """The outer loop, one around all points; None without."""
        return self.controllers[0].outer

    @property
    def design(self) -> tuple[Plant, ParameterSet]:
        """The design plant, and its parameters at the first point."""
        design = self.controllers[0].design
        assert design is not None  # a schedule is tuned on models
        return design

    @property
    def bandwidths_hz(self) -> tuple[float, ...]:
        """The bandwidths asked at the points."""
        return tuple(controller.spec.bandwidth_hz for controller in self.controllers)

    @property
    def met(self) -> bool:
        """Whether every limit is met at the points, and where it was looked between them."""
        return all(controller.met for controller in self.controllers) and not any(
            figures.broken for figures in self.between
        )

    @property
    def broken(self) -> tuple[str, ...]:
        """The limits that are broken, each once with where: at the points, and between them."""
        places: dict[str, list[float]] = {}
        for point, controller in self._pairs:
            for name in () if controller.met else controller.active_constraints:
                places.setdefault(name, []).append(point)
        for figures in self.between:
            for name in figures.broken:
                places.setdefault(name, []).append(figures.value)
        texts: list[str] = []
        for name, values in places.items():
            more = f" and {format_count(len(values) - 1, 'more value')}" if len(values) > 1 else ""
            texts.append(f"{name} at {self.over} = {min(values):g}{more}")
        return tuple(texts)

    @property
    def _pairs(self) -> list[tuple[float, Controller]]:
        return list(zip(self.points, self.controllers, strict=True))

    @property
    def plants_at_points(self) -> tuple[str, ...]:
        """The plants on which it is judged at the points alone, and not between them: witnesses, responses."""
        if not self.between:
            return ()
        judged = self.at(self.between[0].value).robust_to
        named = dict.fromkeys(name for controller in self.controllers for name in controller.robust_to)
        return tuple(name for name in named if name not in judged)

    @property
    def remedy(self) -> str:
        """What to change where a limit is broken; empty where none is."""
        for point, controller in self._pairs:
            if not controller.met:
                return f"at {self.over} = {point:g}: {controller.explanation}"
        missed = [figures.value for figures in self.between if figures.broken]
        if not missed:
            return ""
        stretches = pairwise(self.points)
        middles = [0.5 * (low + high) for low, high in stretches if any(low < value < high for value in missed)]
        points = ", ".join(f"{value:.4g}" for value in sorted((*self.points, *middles)))
        room = f"; or tune with more room: reserve = {RESERVE_BETWEEN:g}" if self.spec.reserve < RESERVE_BETWEEN else ""
        return f"add points where it is broken: points = [{points}]{room}"

    @property
    def notes(self) -> tuple[str, ...]:
        """Remarks besides the limits, one sentence each."""
        shared = [note for note in self.controllers[0].notes if all(note in each.notes for each in self.controllers)]
        rows, notes = self.table.gains, list[str]()
        for point, each in zip(self.points, self.controllers, strict=True):
            notes += [f"{self.over} = {point:g}: {note}" for note in each.part_notes if note not in shared]
        if not any(np.ptp(row) > SAME_GAIN * np.max(np.abs(row)) for row in rows.values()):
            notes.append(f"no gain changes over {self.over}: one law for all points does, without a schedule")
        for name, row in rows.items():  # a gain that more than doubles: another valley of the tuner, or too few points
            low, high = np.abs(row[:-1]), np.abs(row[1:])
            smaller = np.maximum(np.minimum(low, high), 1e-3 * np.max(np.abs(row)) or 1.0)
            steps = np.abs(high - low) / smaller
            if name not in ("c", "k_r") and np.max(steps) > LARGE_STEP:
                at = int(np.argmax(steps))
                notes.append(
                    f"{name} changes from {row[at]:.4g} to {row[at + 1]:.4g} between {self.over} = {self.points[at]:g} "
                    f"and {self.points[at + 1]:g}: a point between them would make the step smaller"
                )
        return (*shared, *notes)

    def asked_hz(self, value: float) -> float:
        """Return the bandwidth asked at a value of the variable, between the points interpolated."""
        return float(np.interp(value, self.points, self.bandwidths_hz))

    def at(self, value: float) -> Controller:
        """Return the controller that the schedule is while the variable stands at a value.

        At a point it is the one that was tuned there. Elsewhere its specification asks for the bandwidth that it has:
        what is asked there is judged by `between`. It runs as the schedule does (`Controller.share`). Raises
        ControlError: the value is not finite, or outside the points.
        """
        low, high = self.points[0], self.points[-1]
        if not low <= value <= high:
            raise ControlError(f"{self.over} = {value:g} is outside the points; give {low:g} to {high:g}")
        if value in self.points:
            frozen = self.controllers[self.points.index(value)]
        else:
            spec, first = replace(self.spec, bandwidth_hz=self.asked_hz(value)), self.controllers[0]
            frozen = self._freeze(value, spec)[0]
            kept = {"gate": first.gate, "derate": first.derate}
            frozen = replace(frozen, compensation=self.terms_at(value), **kept)
        if value in self.points and not self.table.nominals:
            return frozen
        share = self.table.find_numbers(value, **{SHARE: self.runnable().anti_windup})[SHARE]
        return replace(frozen, share=share)

    def _freeze(self, value: float, spec: ControllerSpec) -> tuple[Controller, list[MeasuredLoop]]:
        return freeze(self.table, value, spec, self.design, self.others, self.outer, self.draws)

    def terms_at(self, value: float) -> Compensation | None:
        """Return what it compensates at a value, between the points interpolated."""
        i, t = self.table.find_stretch(value)
        low, high = (each.compensation for each in self.controllers[i : i + 2])
        return low if low is None or high is None or low == high else low.mix(high, t)

    def close_points(self, plant: Plant, params: ParameterSet) -> tuple[Loop, ...]:
        """Return a plant's loop at each point, with the variable standing still there."""
        return tuple(law.close(plant, place_variable(plant, params, self.over, point)) for point, law in self._pairs)

    def with_places(self, parts: int = PARTS) -> ScheduledController:
        """Return the schedule judged at the inner ends of so many parts of every stretch between two points."""
        return replace(self, between=tuple(self._judge_place(value) for value in list_inner(self.points, parts)))

    def _judge_place(self, value: float) -> PlaceFigures:
        """Judge the law at a value between the points: all limits, and 0.9 of the bandwidth that is asked there."""
        asked_hz, spec = self.asked_hz(value), replace(self.spec, bandwidth_hz=self.asked_hz(value))
        frozen, loops = self._freeze(value, spec)
        measured = {loop.name: loop.figures for loop in loops}
        cases = place_plants(self.others, self.over, value).items()
        closed = (measured.get(name) or close_outer(frozen, *case).figures() for name, case in cases)
        worst = [loops[0].figures, *closed]
        band = frozen.achieved.bandwidth_hz
        broken = () if frozen.met else frozen.active_constraints
        if band is None or band < LEAST_BANDWIDTH * asked_hz:
            broken = (*broken, f"{LEAST_BANDWIDTH:g} of bandwidth_hz")
        return PlaceFigures(
            value=value,
            bandwidth_hz=band,
            asked_hz=asked_hz,
            ms=max(figures.ms for figures in worst),
            mt=max(figures.mt for figures in worst),
            broken=broken,
        )

    def runnable(
        self, *, limit: float | None = None, tracking_time_s: float | None = None, outer: bool = False
    ) -> RunnableSchedule:
        """Return the law ready to run, with the guards and the compensation of its first controller.

        Parameters
        ----------
        limit : float, optional
            Of the command, in its unit; the specification's if left out.
        tracking_time_s : float, optional
            Of the anti-windup.
        outer : bool
            With its outer loop, where it has one.
        """
        return _make_runnable(self, limit, tracking_time_s, outer)

    def to_dict(self) -> dict[str, Any]:
        """Return the content of controller.json (schema seaopt/controller/3)."""
        first, *further = [controller.to_dict() for controller in self.controllers]
        return {
            **first,
            **{name: [first[name], *(each[name] for each in further)] for name in PER_POINT},
            "met": self.met,
            "feasible": self.met,
            "gains": {name: row.tolist() for name, row in self.table.gains.items()},
            "schedule": {
                "over": self.over,
                "unit": self.unit,
                "points": list(self.points),
                "fallback": self.fallback,
                "bandwidth_hz": list(self.bandwidths_hz),
                "met": [controller.met for controller in self.controllers],
                "anti_windup": self.runnable().anti_windup.tolist(),
                "between": to_content(self.between),
                "broken": list(self.broken),
            },
            "notes": list(self.notes),
        }

    @classmethod
    def read(cls, content: Mapping[str, Any]) -> ScheduledController:
        """Return the schedule of a controller.json, without its design plant and what it achieves there."""
        from seaopt.control.scheduling.stored import read_points  # deferred: pydantic

        table, _, controllers = read_points(content)
        return cls.of_points(table, controllers)

    @classmethod
    def of_points(
        cls,
        table: StoredPoints,
        controllers: Iterable[Controller],
        others: Plants | None = None,
        draws: Draws = (),
    ) -> ScheduledController:
        """Return the schedule of a file's table with the controllers at its points."""
        return cls(
            over=table.over,
            unit=table.unit,
            points=table.points,
            controllers=tuple(controllers),
            others=others or {},
            fallback=table.fallback,
            draws=draws,
        )

    @classmethod
    def from_dict(
        cls,
        content: Mapping[str, Any],
        plant: Plant,
        params: ParameterSet,
        others: Plants | None = None,
        draws: Draws = (),
    ) -> ScheduledController:
        """Return the schedule of a controller.json; what it achieves is computed again, at `draws` too. Raises
        FileError: a field is missing or malformed, or contradicts another.
        """
        from seaopt.control.scheduling.stored import read_points  # deferred: pydantic

        table, contents, _ = read_points(content)
        controllers = (
            Controller.from_dict(tuned, plant, place_variable(plant, params, table.over, point))
            for point, tuned in zip(table.points, contents, strict=True)
        )
        return cls.of_points(table, controllers, others, draws).with_places()


def restore_law(
    content: Mapping[str, Any],
    plant: Plant | MeasuredResponse,
    params: ParameterSet,
    others: Plants | None = None,
    draws: Draws = (),
) -> Controller | ScheduledController:
    """Return the law or the schedule of a controller.json, by `from_dict` of either."""
    if content.get("schedule") is None:
        return Controller.from_dict(content, plant, params)
    require_type(plant, Plant, "plant", "give the model that the schedule was tuned on", ControlError)
    return ScheduledController.from_dict(content, cast(Plant, plant), params, others, draws)


@lru_cache(maxsize=8)
def _make_runnable(
    schedule: ScheduledController, limit: float | None, tracking_time_s: float | None, outer: bool
) -> RunnableSchedule:
    first = schedule.controllers[0]
    law = make_runnable(
        schedule.table,
        per_effort=schedule.command.per_effort,
        limit=choose_limit(schedule.command, schedule.spec, limit),
        fallback=schedule.fallback,
        tracking_time_s=tracking_time_s,
        command=(schedule.command.input, schedule.command.unit),
        compensations=[each.compensation for each in schedule.controllers],
    )
    around = schedule.outer if outer else None
    return replace(law, gate=first.gate, heat=first.heat_guard if first.derate else None, outer=around)


@lru_cache(maxsize=8)
def make_table(over: str, unit: str, points: tuple[float, ...], controllers: tuple[Controller, ...]) -> GainTable:
    """Return the gains of controllers at points. Raises ControlError: they cannot be interpolated; rates differ."""
    first = controllers[0]
    for point, controller in zip(points, controllers, strict=True):
        gains, speed, observer = controller.gains, controller.speed_loop, controller.observer
        made = set(gains) >= set(LAW_GAINS) and Gains.from_names(gains, observer, speed, controller.link)
        whole = made and made.makes(controller.law, controller.spec.structure)
        alike = set(gains) == set(first.gains) and (controller.link is None) == (first.link is None)
        if not alike or not whole:
            raise ControlError(
                f"the controller at {over} = {point:g} is more than its gains, or has other parts than that at "
                f"{points[0]:g}, and only gains are interpolated; use the same structure, notch and prefilter at all "
                "points, and no other parts"
            )
        if controller.outer != first.outer:
            raise ControlError(
                f"the controller at {over} = {point:g} renders another impedance than that at {points[0]:g}, and a "
                "schedule has one outer loop; give all of them one damping"
            )
        if not is_alike(controller.compensation, first.compensation):
            raise ControlError(
                f"the controller at {over} = {point:g} compensates with other terms, ranges or speeds than that at "
                f"{points[0]:g}, and only their coefficients are interpolated; use compensate_schedule"
            )
        if controller.sample_time_s != first.sample_time_s or not math.isclose(
            controller.command.per_effort, first.command.per_effort, rel_tol=1e-9
        ):
            raise ControlError(
                f"the controller at {over} = {point:g} runs at another rate, or commands its effort by another factor, "
                f"than that at {points[0]:g}; a schedule has controller of each"
            )
    return GainTable(
        over=over,
        unit=unit,
        points=np.array(points, dtype=float),
        gains={name: np.array([controller.gains[name] for controller in controllers]) for name in first.gains},
        structure=first.spec.structure,
        sample_time_s=first.sample_time_s,
        speed=first.speed_loop,
        nominals=tuple(each.observer.nominal for each in controllers if each.observer is not None),
        links=tuple(each.link for each in controllers if each.link is not None),
    )


def is_alike(terms: Compensation | None, other: Compensation | None) -> bool:
    """Tell whether two compensations differ in what is interpolated alone."""
    return terms is other or (
        terms is not None and other is not None and terms.shape == other.shape and terms.mix(other, 1.0) == other
    )


def freeze(
    table: GainTable,
    value: float,
    spec: ControllerSpec,
    design: tuple[Plant, ParameterSet],
    robust_to: Plants,
    outer: OuterLoop | None = None,
    draws: Draws = (),
) -> tuple[Controller, list[MeasuredLoop]]:
    """Return the controller of a table's gains at a value with its loops on the plants there, judged by all but the
    bandwidth asked. The limits that depend on the bandwidth, such as a droop up to a third of it, are those of the
    bandwidth it has. `outer` runs around it.
    """
    plant, params = design[0], place_variable(*design, table.over, value)
    task = make_place_task(table, value, spec, design, place_plants(robust_to, table.over, value), outer, draws)
    gains, law = table.find_gains(value), table.law(value)
    loops = task.measure_law(
        law,
        filter_samples=gains.T_f / table.sample_time_s if gains.k_d else math.inf,
        integral_rad_s=gains.integral_rad_s if table.integrates else math.inf,
    )
    band = loops[0].figures.bandwidth_hz
    if band is not None and math.isfinite(band):
        low, high = spec.bandwidth_range_hz
        reached = replace(spec, bandwidth_hz=band, bandwidth_range_hz=(min(low, band), max(high, band)))
        task = replace(task, spec=reached)
    made = describe_law(task, law, loops, (plant, params), gains=table.interpolate(value), observer=gains.observer)
    return made, loops


def make_place_task(
    table: GainTable,
    value: float,
    spec: ControllerSpec,
    design: tuple[Plant, ParameterSet],
    robust_to: RobustTo,
    outer: OuterLoop | None = None,
    draws: Draws = (),
) -> Task:
    """Return the task in which a table's law is measured at a value, beside plants that are placed there."""
    plant, params = design[0], place_variable(*design, table.over, value)
    task = make_task(plant, plant.complete(params), spec, robust_to, draws)
    task = feed_link(task, table.find_gains(value).link)
    return task if outer is None else task.enclosed(outer, command_of(plant, params, spec.regulated).per_effort)


def place_variable(plant: Plant, params: ParameterSet, over: str, value: float) -> ParameterSet:
    """Return a plant's parameters with the scheduling variable at a value; as they are of a plant without it."""
    chosen = params.given if isinstance(params, CompletedParameters) else params
    if over in plant.parameters:
        return chosen.with_parameters(replace(plant.complete(chosen)[over], value=value))
    if over in plant.states:
        return chosen.with_parameters(replace(conditions((plant,))[over], value=value))
    return chosen


def place_plants(plants: Plants, over: str, value: float) -> Plants:
    """Return plants with their parameters, the scheduling variable at a value."""
    return {name: (plant, place_variable(plant, params, over, value)) for name, (plant, params) in plants.items()}


def find_unit(over: str, plants: Mapping[str, Plant]) -> str:
    """Return the unit of a scheduling variable, a state or a parameter of some plant."""
    for plant in plants.values():
        if over in plant.parameters:
            return plant.parameter_unit(over)
        if over in plant.states:
            return plant.states[over]
    names = dict.fromkeys(name for plant in plants.values() for name in (*plant.parameters, *plant.states))
    raise ControlError(
        f'over = "{over}" is no state and no parameter of {join_words(list(plants))}; {suggestion(over, names)}'
    )


def list_inner(points: Sequence[float], parts: int) -> list[float]:
    """Return the inner ends of so many equal parts of every stretch between two points."""
    return [low + (high - low) * k / parts for low, high in pairwise(points) for k in range(1, parts)]
