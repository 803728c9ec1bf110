"""What a schedule.json holds, as a pydantic model, and whether its fields agree with each other."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from seaopt.control.laws.stored import TUNE_AGAIN, Finite, StoredController
from seaopt.control.laws.structures import AGREES, LAW_GAINS
from seaopt.control.scheduling.gain_table import check_points
from seaopt.documents import Flag, ResultTable, check_result
from seaopt.errors import ControlError, FileError


class StoredPlace(ResultTable):
    """What the law does at a value between the points."""

    value: Finite
    bandwidth_hz: Finite | None
    asked_hz: Finite
    ms: Finite | None
    mt: Finite | None
    broken: list[str]


class StoredSchedule(ResultTable):
    """A schedule.json."""

    document: Annotated[Literal["seaopt/schedule/2"], Field(alias="schema")]
    over: str
    unit: str
    points: Annotated[list[Finite], Field(min_length=2)]
    fallback: Finite
    feasible: Flag
    broken: list[str]
    notes: list[str] = []
    gains: dict[str, list[Finite]]
    anti_windup: list[Finite]
    between: list[StoredPlace] = []
    controllers: list[StoredController]


def read_schedule(content: Mapping[str, Any]) -> StoredSchedule:
    """Return the fields of a schedule.json.

    Raises
    ------
    FileError
        A field is missing or malformed, or the gains are not those of the controllers.

    """
    table = check_result(StoredSchedule, content, "schedule.json", remedy=TUNE_AGAIN)
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
    for name in LAW_GAINS:
        own = [one.gains.get(name, np.nan) for one in table.controllers]
        stated = table.gains.get(name, [])
        if len(stated) != count or not np.allclose(stated, own, rtol=AGREES, atol=0.0):
            raise FileError(f"schedule.json: gains.{name} is not what the controllers have; {TUNE_AGAIN}")
    return table
