"""A log that ends in a runaway: a reading, or the command, goes to its end and does not return."""

from __future__ import annotations

import numpy as np

from seaopt.control import Controller
from seaopt.machine.ticks import AT_LIMIT, Ticks
from seaopt.records import record
from seaopt.units import unit_after

FEWEST, SHARE = 5, 0.02  # rows, and share of all, that the command is at its limit as the log ends
LONGER = 3.0  # times any earlier stay at the limit
GROWS = 3.0  # times the largest error of the first half, and of what the reference swings
NEAR = 0.9  # of the largest error: it is still there as the log ends
SIGNS = "check the signs of command and readings before it is played again"


@record
class Runaway:
    """Where a log ended."""

    reading: float | None  # that the regulated reading ran to, away from the reference; None where it did not
    limited: bool  # the command stays at its limit until the log ends
    swing: float  # of the reference


def find_runaway(controller: Controller, ticks: Ticks) -> Runaway | None:
    """Return how a log ends whose loop ran away; None where it did not."""
    ticks = ticks.take(np.flatnonzero(ticks.complete))
    error = np.abs(ticks.measured[:, 0] - ticks.reference)
    swing = float(np.ptp(ticks.reference))
    before, most = float(np.max(error[: error.size // 2])), float(np.max(error))
    grew = error[-1] >= NEAR * most and most > GROWS * max(before, swing)
    limited = _stays_at_limit(np.sign(ticks.command), np.abs(ticks.command), controller.command_limit or np.inf)
    if not grew and not limited:
        return None
    return Runaway(reading=float(ticks.measured[-1, 0]) if grew else None, limited=limited, swing=swing)


def _stays_at_limit(sign: np.ndarray, size: np.ndarray, limit: float) -> bool:
    """Tell whether the command is at one of its limits as the log ends, and for longer than ever before."""
    at = np.where(size >= AT_LIMIT * limit, sign, 0.0)
    edges = np.flatnonzero(np.diff(at)) + 1
    starts, stops = np.concatenate([[0], edges]), np.concatenate([edges, [at.size]])
    *earlier, last = [int(stop - start) if at[start] else 0 for start, stop in zip(starts, stops, strict=True)]
    return last >= max(FEWEST, SHARE * at.size, LONGER * max(earlier, default=0))


def say_runaway(controller: Controller, ticks: Ticks) -> str | None:
    """Return what ran away and what to look at; None where nothing did."""
    found, command = find_runaway(controller, ticks), controller.command
    if found is None:
        return None
    lasts, said = len(ticks) / ticks.rate_hz, list[str]()
    if found.reading is not None:
        unit, name = unit_after(command.reference_unit), controller.signals[0]
        said.append(f"{name} ran to {found.reading:.3g}{unit} under a reference that swings by {found.swing:.3g}{unit}")
    if found.limited:
        limit = f"{controller.command_limit:.3g}{unit_after(command.unit)}"
        said.append(f"{command.input} went to its limit of {limit} and stayed there")
    return f"the loop ran away: {', and '.join(said)} until the log ends after {lasts:.3g} s; {SIGNS}"
