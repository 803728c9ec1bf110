"""What the gate of a law made of a log's readings: which it did not believe, and where that became a fault."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Literal

import numpy as np
from jaxtyping import Bool

from seaopt.control import Controller, GateState
from seaopt.machine.ticks import Ticks
from seaopt.records import record


@record
class Trip:
    """A fault that a gate made of readings: from there on the law stood still."""

    at_s: float  # of the fault, from the first row
    row: int  # of the first of the readings
    readings: int  # in a row that it did not believe
    reading: float  # the last of them
    why: Literal["range", "step", "encoders"]  # what it was beyond, or did not agree with
    stopped_s: float  # from the fault to the end


def find_refused(controller: Controller, ticks: Ticks) -> Bool[np.ndarray, " n"]:
    """Tell in which rows the gate of a law does not believe what it reads."""
    refused = np.zeros(len(ticks), dtype=bool)
    for k, state in _screen(controller, ticks):
        refused[k] = state.held > 0
    return refused


def find_trip(controller: Controller, ticks: Ticks) -> Trip | None:
    """Return where the gate of a law made a fault of what it read; None where it did not."""
    gate = controller.gate
    row, state = next(((k, state) for k, state in _screen(controller, ticks) if state.fault), (0, None))
    if gate is None or state is None:
        return None
    reading, (low, high) = float(ticks.measured[row, 0]), gate.range_N
    return Trip(
        at_s=row / ticks.rate_hz,
        row=row + 1 - state.held,
        readings=state.held,
        reading=reading,
        why="encoders" if state.disagrees else "step" if low <= reading <= high else "range",
        stopped_s=(len(ticks) - row) / ticks.rate_hz,
    )


def _screen(controller: Controller, ticks: Ticks) -> Iterator[tuple[int, GateState]]:
    """Yield the rows that have all numbers, and what a gate holds after each."""
    gate, state = controller.gate, GateState()
    if gate is None:
        return
    read, encoders = ticks.measured[:, 0], [ticks.further[:, controller.further.index(name)] for name in gate.reads]
    for k, row in enumerate(zip(read.tolist(), *(each.tolist() for each in encoders), strict=True)):
        if not all(map(math.isfinite, row)):  # a gap: what was held before it is not known
            state = GateState()
            continue
        _, state = gate.screen(state, row[0], row[1:])
        yield k, state
