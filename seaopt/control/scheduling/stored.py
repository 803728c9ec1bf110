"""What the controller.json of a schedule holds: the columns of its controllers, and what joins them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, NamedTuple

import numpy as np

from seaopt.codec import Constraints, from_content, join_schemas
from seaopt.control.laws.controller import Controller
from seaopt.control.laws.stored import (
    FILE,
    TUNE_AGAIN,
    StoredBlocks,
    StoredController,
    StoredLaw,
    StoredLoop,
    StoredNumber,
    Terms,
)
from seaopt.control.laws.verdict import PossibleBandwidths
from seaopt.control.loops.measured.loop import MeasuredFigures
from seaopt.control.loops.transfer_function import TransferFunction
from seaopt.control.scheduling.gain_table import check_points
from seaopt.control.scheduling.scheduled_controller import PER_POINT, PlaceFigures
from seaopt.errors import ControlError, FileError
from seaopt.records import record


@record(eq=False)
class StoredPoints:
    """What a schedule is over, and what holds at its points; `between` them what was looked at."""

    over: str
    unit: str
    points: Annotated[tuple[float, ...], Constraints(min_length=2)]
    fallback: float
    bandwidth_hz: tuple[float, ...]
    met: tuple[bool, ...]
    anti_windup: tuple[float, ...]
    between: tuple[PlaceFigures, ...] = ()
    broken: tuple[str, ...]


@record(eq=False)
class StoredSchedule(StoredLoop):
    """The controller.json of a schedule: lists have an entry for each point."""

    schedule: StoredPoints
    gains: dict[str, tuple[float, ...]]
    blocks: tuple[StoredBlocks, ...]
    terms: tuple[Terms, ...]
    law: tuple[StoredLaw, ...]
    reference: tuple[TransferFunction, ...]
    measurement: tuple[TransferFunction | tuple[TransferFunction, ...], ...]
    active_constraints: tuple[tuple[str, ...], ...]
    blocked_by: tuple[tuple[str, ...], ...]
    possible: tuple[PossibleBandwidths | None, ...]
    measured_responses: tuple[tuple[MeasuredFigures, ...], ...]
    engineering: tuple[dict[str, StoredNumber], ...]


class Points(NamedTuple):
    """A schedule as its file has it: its points, and at each the content of a controller, and the controller."""

    table: StoredPoints
    contents: list[dict[str, Any]]
    controllers: list[Controller]


def read_points(content: Mapping[str, Any]) -> Points:
    """Return the points of a schedule's controller.json. Raises FileError: one is missing or malformed, or the law at
    a point contradicts itself.
    """
    stored = from_content(StoredSchedule, content, FILE, remedy=TUNE_AGAIN)
    table, columns = stored.schedule, {name: content[name] for name in PER_POINT}
    try:
        check_points(table.over, np.array(table.points))
    except ControlError as error:
        raise FileError(f"{FILE}: {error}; {TUNE_AGAIN}") from error
    if table.fallback not in table.points:
        raise FileError(f"{FILE}: schedule.fallback = {table.fallback:g} is none of the points; {TUNE_AGAIN}")
    joined = {f"schedule.{name}": getattr(table, name) for name in ("bandwidth_hz", "met", "anti_windup")}
    for name, column in (columns | joined | {f"gains.{name}": row for name, row in stored.gains.items()}).items():
        if len(column) != len(table.points):
            raise FileError(f"{FILE}: {name} has {len(column)} entries for {len(table.points)} points; {TUNE_AGAIN}")
    shared = {name: value for name, value in content.items() if name != "made_from"}  # the digest is of the whole
    contents = [
        {
            **shared,
            **{name: column[k] for name, column in columns.items()},
            "schedule": None,
            "gains": {name: row[k] for name, row in stored.gains.items()},
            "spec": {**content["spec"], "bandwidth_hz": content["schedule"]["bandwidth_hz"][k]},
            "met": table.met[k],
            "feasible": table.met[k],
        }
        for k in range(len(table.points))
    ]
    controllers: list[Controller] = []
    for point, each in zip(table.points, contents, strict=True):
        try:
            controllers.append(Controller.read(each))
        except FileError as error:
            raise FileError(f"at {table.over} = {point:g}, {error}") from error
    return Points(table, contents, controllers)


def read_laws(content: Mapping[str, Any]) -> list[Controller]:
    """Return the controllers in a controller.json: of a law one, of a schedule one for each point."""
    return read_points(content).controllers if content.get("schedule") else [Controller.read(content)]


def controller_schema() -> dict[str, Any]:
    """Return the JSON Schema of a controller.json: of one law, or of a schedule."""
    return join_schemas(StoredController, StoredSchedule)
