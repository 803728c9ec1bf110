"""What a schedule.json holds, and whether its fields agree with each other."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal

import numpy as np

from seaopt.codec import Constraints, Key, from_content
from seaopt.control.laws.stored import TUNE_AGAIN, StoredController
from seaopt.control.laws.structures import AGREES, LAW_GAINS
from seaopt.control.scheduling.gain_table import check_points
from seaopt.control.scheduling.scheduled_controller import PlaceFigures
from seaopt.errors import ControlError, FileError
from seaopt.records import record


@record(eq=False)
class StoredSchedule:
    """A schedule.json."""

    json_keys = (
        *(Key(field="document", name="schema"), "over", "unit", "points", "fallback", "feasible", "broken", "notes"),
        *("gains", "anti_windup", "between", "controllers"),
    )

    document: Literal["seaopt/schedule/2"]
    over: str
    unit: str
    points: Annotated[tuple[float, ...], Constraints(min_length=2)]
    fallback: float
    feasible: bool
    broken: tuple[str, ...]
    notes: tuple[str, ...] = ()
    gains: dict[str, tuple[float, ...]]
    anti_windup: tuple[float, ...]
    between: tuple[PlaceFigures, ...] = ()
    controllers: tuple[StoredController, ...]


def read_schedule(content: Mapping[str, Any]) -> StoredSchedule:
    """Return the fields of a schedule.json. Raises FileError: one is missing or malformed, or gains disagree."""
    table = from_content(StoredSchedule, content, "schedule.json", remedy=TUNE_AGAIN)
    try:
        check_points(table.over, np.array(table.points))
    except ControlError as error:
        raise FileError(f"schedule.json: {error}; {TUNE_AGAIN}") from error
    count = len(table.points)
    if len(table.controllers) != count or len(table.anti_windup) != count:
        raise FileError(
            f"schedule.json: has {count} points, {len(table.controllers)} controllers and {len(table.anti_windup)} "
            f"numbers in anti_windup; {TUNE_AGAIN}"
        )
    if table.fallback not in table.points:
        raise FileError(f"schedule.json: fallback = {table.fallback:g} is none of the points; {TUNE_AGAIN}")
    for name in dict.fromkeys((*LAW_GAINS, *table.gains, *table.controllers[0].gains)):
        tuned = [controller.gains.get(name, np.nan) for controller in table.controllers]
        stated = table.gains.get(name, [])
        if len(stated) != count or not np.allclose(stated, tuned, rtol=AGREES, atol=0.0):
            raise FileError(f"schedule.json: gains.{name} is not what the controllers have; {TUNE_AGAIN}")
    return table
