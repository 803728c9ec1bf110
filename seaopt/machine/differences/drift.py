r"""A reading that drifts while the loop holds it to its reference, so that the true force drifts in its place.

The lines of a period tell nothing of its mean, and the law holds the mean of the reading to that of the reference. What
else knows the force moves: the command, whose static effort is the force at the spring, whatever the motor rubs, and
sensors that were logged besides, such as an encoder of the deflection. With :math:`\bar y_p, \bar b_p` the means over
the periods, :math:`\kappa` the ratio that the model has of both at rest, :math:`t_p` the time, and an offset
:math:`o_s` of each set of phases, which dry friction makes,

.. math:: \bar y_p - \kappa \bar b_p = o_{s(p)} + a t_p + e_p .

The reference is the same in all periods of a set, so that neither a gain that is another one nor friction makes a slope
a; its std is that of the e. A slope that is sure, and more over the log than a machine may be off by, is a drift.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np
from jaxtyping import Float

from seaopt.control import Controller, sample
from seaopt.machine.differences.comparison import TOLERATED
from seaopt.machine.response.periods import list_periods
from seaopt.machine.ticks import Ticks
from seaopt.plants.friction import take_sliding
from seaopt.records import record

SLOW = 1e-3, 1e-2  # Hz: where a static gain is the same at both
RISK = 1e-4  # that noise is taken for a drift


@record
class Drift:
    """How far a reading and what it is compared with drift apart over the periods of a log."""

    log: str
    name: str  # the reading that is regulated
    beside: str  # the command, or another sensor
    value: float
    low: float  # its interval, at `RISK`
    high: float
    unit: str
    lasts_s: float  # in which it does
    of_reading: bool  # whether the reading may be what drifts: no other sensor goes with it


def find_drifts(controller: Controller, logs: Sequence[Ticks]) -> tuple[Drift, ...]:
    """Return the drifts of the regulated reading in some logs."""
    return tuple(each for ticks in logs for each in _judge(controller, ticks))


def _judge(controller: Controller, ticks: Ticks) -> list[Drift]:
    """Return the drifts in a log: beside the command, and beside each sensor that the model has it follow at rest."""
    command, name = controller.command, controller.signals[0]
    reading, found, agrees = ticks.measured[:, 0], list[Drift](), False
    largest = float(np.nanmax(np.abs(reading)))
    for beside, expected in _follow(controller, ticks):
        slope, reach, lasts_s = _fit_slope(ticks, reading - expected)
        drifts = abs(slope) - reach > TOLERATED * largest
        if not drifts:
            agrees = agrees or (beside != command.input and reach <= TOLERATED * largest)
            continue
        found.append(
            Drift(
                log=ticks.source, name=name, beside=beside, value=slope, low=slope - reach, high=slope + reach,
                unit=command.reference_unit, lasts_s=lasts_s, of_reading=not (beside == command.input and agrees),
            )
        )  # fmt: skip
    return found


def _follow(controller: Controller, ticks: Ticks) -> Iterator[tuple[str, Float[np.ndarray, " n"]]]:
    """Yield what knows the force at rest, the sensors first and then the command, with the reading as of each."""
    assert controller.design is not None
    plant, values = controller.design
    names = (controller.signals[0], *ticks.beside)
    seen, timing = controller.see(take_sliding(plant, values)), (controller.sample_time_s, 0)
    static = sample(seen, controller.delay(values), names, controller.per_effort, *timing).responses(np.array(SLOW))
    known = zip(ticks.beside.items(), static[1:], strict=True)
    sensors = [(name, column, static[0] / gain) for (name, column), gain in known if np.all(gain != 0.0)]
    for name, column, gain in sensors:
        if abs(gain[1] / gain[0] - 1.0) <= TOLERATED:
            yield name, gain[0].real * column
    if np.all(np.abs(np.abs(static[0]) - 1.0) <= TOLERATED):  # a link that is free takes the effort as it speeds up
        yield controller.command.input, static[0][0].real / controller.per_effort * ticks.command


def _fit_slope(ticks: Ticks, off: Float[np.ndarray, " n"]) -> tuple[float, float, float]:
    """Return by how much a column drifts over the periods of a log, how sure that is, and how long they last."""
    from scipy.special import stdtrit  # deferred: 0.1 s

    period, starts = list_periods(ticks.reference)
    rows = [(first, number, float(np.mean(off[first : first + period]))) for first, number in starts]
    first, number, mean = np.array([row for row in rows if math.isfinite(row[2])] or [(0.0, 0.0, 0.0)]).T
    sets = number[:, None] == np.unique(number)
    at, free = sets / np.sum(sets, axis=0), first.size - sets.shape[1] - 1
    time, mean = (column - sets @ (at.T @ column) for column in (first, mean))
    spread = float(time @ time)
    if free < 1 or not spread:
        return 0.0, math.inf, 0.0
    slope = float(time @ mean) / spread
    left = float(np.sum((mean - slope * time) ** 2))
    rows_of = float(np.ptp(first)) + period
    reach = float(stdtrit(free, 1.0 - 0.5 * RISK)) * math.sqrt(left / free / spread)
    return slope * rows_of, reach * rows_of, rows_of / ticks.rate_hz
