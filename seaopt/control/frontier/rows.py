"""What a sweep of bandwidths has found: a row for each, of one law or of a schedule."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from seaopt.codec import Key, OrInfinite, check_agrees, read_fields, to_content
from seaopt.control.frontier.free_law import FreeLaw
from seaopt.control.laws.controller import Controller
from seaopt.control.laws.limits import MeasuredLoop
from seaopt.control.loops.law import Law
from seaopt.control.scheduling.scheduled_controller import Plants, ScheduledController, restore_law
from seaopt.control.tuning.optimisation_problem import Task
from seaopt.control.tuning.tuner import Draws, disturbance
from seaopt.errors import FileError
from seaopt.frequency import MeasuredResponse
from seaopt.parameters import ParameterSet
from seaopt.plants import Plant
from seaopt.records import PlotAccessor, Result, Worded, record
from seaopt.units import LINEAR, Mechanics

FRONTIER_SCHEMA = "seaopt/frontier/1"
FILE, SWEEP_AGAIN = "frontier.json", "run its sweep again"


@record
class SlidingAlone(Result):
    """The best law for the sliding plants alone: whether limits are met, noise gain and disturbance, as in a row."""

    json_keys = ("met", "noise_gain", "disturbance", "feasible")

    met: bool
    noise_gain: OrInfinite
    disturbance: OrInfinite


@record
class FrontierRow(Result):
    """One bandwidth; what is not said to be of the worst plant is of the design plant. Of a schedule each figure is of
    the place, of its points and the values between them that are judged, where it is worst.
    """

    json_keys = (
        *("bandwidth_hz", "met", "noise_gain", "ms", "ms_plant", "ms_place", "disturbance"),
        *("sensitivity_bandwidth_hz", "phase_margin_deg", "disk_margin", "force_limit_N", "blocked_by"),
        *("without_sticking", "free_law", "feasible"),
    )

    bandwidth_hz: float
    met: bool  # whether every limit is met; if not, the figures are those of the controller that misses them least
    noise_gain: OrInfinite  # N/N
    ms: OrInfinite  # ms, ms_plant: largest Ms of all plants, and whose it is
    ms_plant: str
    ms_place: float | None  # of a schedule: the value of its variable there
    disturbance: OrInfinite  # integral over ln f of abs(S) from 0.1 Hz to the bandwidth, worst plant
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


@record(eq=False, repr=False)
class Frontier(Result, Worded):
    """The rows of a sweep, and their controllers."""

    json_keys = ("met", "over", "rows", Key(field="contents", name="controllers"))
    plot = PlotAccessor()

    rows: tuple[FrontierRow, ...]
    controllers: tuple[Controller | ScheduledController, ...]
    over: str | None = None  # the variable that the controllers are scheduled over

    @property
    def met(self) -> bool:
        """Whether every limit is met at some bandwidth."""
        return any(row.met for row in self.rows)

    @property
    def mechanics(self) -> Mechanics:
        """Units and words of what the controllers command."""
        return self.controllers[0].command.mechanics if self.controllers else LINEAR

    @property
    def contents(self) -> tuple[Mapping[str, Any], ...]:
        """What controller.json of each holds."""
        return tuple(controller.to_dict() for controller in self.controllers)

    def to_dict(self) -> dict[str, Any]:
        """Return the content of frontier.json (schema seaopt/frontier/1)."""
        return {"schema": FRONTIER_SCHEMA} | to_content(self)

    @classmethod
    def from_dict(
        cls,
        content: Mapping[str, Any],
        plant: Plant | MeasuredResponse,
        params: ParameterSet,
        others: Plants | None = None,
        draws: Draws = (),
    ) -> Frontier:
        """Return the sweep of a frontier.json; nothing is tuned. The arguments are those of the `from_dict` of its
        controllers, `others` and `draws` of schedules. Raises FileError: a field is missing or malformed, or
        contradicts another.
        """
        read = read_fields(cls, content, FILE, remedy=SWEEP_AGAIN)
        tuned: list[Any] = content.get("controllers") or []
        if len(tuned) != len(read["rows"]):
            raise FileError(f"{FILE}: controllers has {len(tuned)} entries for {len(read['rows'])} rows; {SWEEP_AGAIN}")
        frontier = cls(**read, controllers=tuple(restore_law(each, plant, params, others, draws) for each in tuned))
        made = to_content(frontier)
        del made["controllers"]  # each has checked itself, to what figures are known to on another machine
        for row, law in zip(made["rows"], frontier.controllers, strict=True):
            row |= {"bandwidth_hz": _find_asked_hz(law, row["ms_place"]), "met": law.met}
        check_agrees(content, made, FILE, remedy=SWEEP_AGAIN)
        return frontier


def _find_asked_hz(law: Controller | ScheduledController, place: float | None) -> float:
    """Return the bandwidth that was asked for: of a schedule at one of its places."""
    asked = law.spec.bandwidth_hz if isinstance(law, Controller) or place is None else law.asked_hz(place)
    return float(asked)


def measure_disturbance(task: Task, law: Law) -> float:
    """Return the integral of abs(S) of the plant that has most of it."""
    return max(disturbance(task.close(i, law), task.spec.bandwidth_hz) for i in range(len(task.plants)))


def make_row(
    task: Task,
    law: Law,
    loops: list[MeasuredLoop],
    controller: Controller,
    *,
    without_sticking: SlidingAlone | None = None,
    free_law: FreeLaw | None = None,
    value: float | None = None,
) -> FrontierRow:
    """Return the row of a law, which was measured in these loops of a task."""
    design, f_b = loops[0].figures, task.spec.bandwidth_hz
    worst = max(loops, key=lambda loop: loop.figures.ms)
    return FrontierRow(
        bandwidth_hz=f_b,
        met=controller.met,
        noise_gain=design.noise_gain,
        ms=worst.figures.ms,
        ms_plant=worst.name,
        ms_place=value,
        disturbance=measure_disturbance(task, law),
        sensitivity_bandwidth_hz=design.sensitivity_bandwidth_hz,
        phase_margin_deg=design.phase_margin_deg,
        disk_margin=design.disk_margin,
        force_limit_N=controller.force_limit(f_b),
        blocked_by=controller.blocked_by,
        without_sticking=without_sticking,
        free_law=free_law,
    )
