r"""A reading that drifts while the loop holds it to its reference, so that the true force drifts in its place.

The lines of a period tell nothing of its mean, and the law holds the mean of the reading to that of the reference. What
else knows the force moves: the command, whose static effort is the force at the spring, whatever the motor rubs, and
sensors that were logged besides, such as an encoder of the deflection. With :math:`\bar y_p, \bar b_p` the means over
the periods, :math:`\kappa` the ratio that the model has of both at rest, :math:`z_p` how far a zero has moved, and an
offset :math:`o_s` of each set of phases, which dry friction makes (without it, of each mean that the reference has),

.. math:: \bar y_p - \kappa \bar b_p = o_{s(p)} + z_p + e_p .

The reference is the same in all periods of a set, so that neither a gain that is another one nor friction makes a z.
It is looked for in two ways. Of a slow drift, :math:`z_p = a t_p`, whose std is that of what the line leaves. Of any
other, such as a jump, as the largest difference between two means of one offset, of all pairs at once (Bonferroni). The
std of a mean is there that of the noise within the periods, at their lowest lines without what repeats: the median of
the periods, which a zero that moves once leaves alone. Friction that holds a motor lets the command go to and fro
without the force; beside it, a difference counts beyond that.

What is sure, and more than a machine may be off by, is a drift. Whose it is a third one tells, as the command of a
reading and an encoder that drift apart: the share of that, by least squares over the means, that the reading has beside
it. It is the reading's where that part of it is a drift itself, and surely not where it surely has not most of it; in
between the log does not tell.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped

from seaopt.control import Controller, sample
from seaopt.machine.differences.comparison import TOLERATED
from seaopt.machine.response.periods import list_periods
from seaopt.machine.response.verdicts import find_friction
from seaopt.machine.ticks import Ticks
from seaopt.plants.friction import take_sliding
from seaopt.records import record

SLOW = 1e-3, 1e-2  # Hz: where a static gain is the same at both
RISK = 1e-4  # that noise is taken for a drift
HELD = 4.0  # times the dry friction: the motor rests anywhere within twice that, and a machine may have twice as much
SAME_LEVEL = 1e-3  # of the largest reference: means that are one
SHOWN = 0.6  # of a drift of the reading, that any other shows of it: spring and efficiency may be 20 % off
LINES = 5  # of a period, the lowest, whose noise is that of its mean


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
    # Whether the reading may be what drifts; None where another sensor does or the reading, and the log does not tell.
    of_reading: bool | None


@record(eq=False)
class Means:
    """Means over periods of what a reading is off by."""

    first: Int[np.ndarray, " p"]  # row of each period
    mean: Float[np.ndarray, " p"]
    sets: Bool[np.ndarray, "p s"]  # those of one set of phases
    levels: Bool[np.ndarray, "p l"]  # those of one mean of the reference
    period: int  # rows
    std: float  # of a mean, by the noise within the periods
    free: int  # degrees of freedom of that, for its median tells less than a mean by a half


@record
class Change:
    """A change of the means, how sure it is, and within how many rows."""

    value: float
    reach: float
    rows: int

    @property
    def least(self) -> float:
        """The least that it may be."""
        return abs(self.value) - self.reach


UNKNOWN = Change(value=0.0, reach=math.inf, rows=0)


def find_drifts(controller: Controller, logs: Sequence[Ticks]) -> tuple[Drift, ...]:
    """Return the drifts of the regulated reading in some logs."""
    return tuple(each for ticks in logs for each in _judge(controller, ticks))


def _judge(controller: Controller, ticks: Ticks) -> Iterator[Drift]:
    """Yield the drifts in a log: beside the command, and beside each sensor that the model has it follow at rest."""
    reading, command = ticks.measured[:, 0], controller.command.input
    tolerated = TOLERATED * float(np.nanmax(np.abs(reading)))
    period, starts = list_periods(ticks.reference)
    apart = {beside: reading - expected for beside, expected in _follow(controller, ticks)}
    held = {beside: HELD * find_friction(controller) if beside == command else 0.0 for beside in apart}

    def attribute(beside: str, size: float) -> bool | None:
        """Return whether the reading is what drifts by this size, as the others tell; it may be beside the command."""
        told = list[bool | None]()
        for other in apart.keys() - {beside}:
            there = np.isfinite(apart[beside] + apart[other])
            columns = (np.where(there, apart[each], np.nan) for each in (beside, other))
            ours, others = (_average(ticks, column, period, starts) for column in columns)
            told.append(_tell_reading(ours, others, held[other], size, tolerated))
        sure = {each for each in told if each is not None}
        return None if len(sure) > 1 else sure.pop() if sure else True if beside == command else None

    for beside, off in apart.items():
        means = _average(ticks, off, period, starts)
        groups = means.sets if held[beside] else means.levels
        line, jump = _fit_slope(means, groups), _find_jump(means, groups)
        sure = [each for each, most in ((line, 0.0), (jump, held[beside])) if each.least > tolerated + most]
        if sure:
            each = max(sure, key=lambda each: each.least)
            yield Drift(
                log=ticks.source, name=controller.signals[0], beside=beside, value=each.value,
                low=each.value - each.reach, high=each.value + each.reach, unit=controller.command.reference_unit,
                lasts_s=each.rows / ticks.rate_hz, of_reading=attribute(beside, abs(each.value)),
            )  # fmt: skip


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


def _average(ticks: Ticks, off: Float[np.ndarray, " n"], period: int, starts: Sequence[tuple[int, int]]) -> Means:
    """Return the means of a column over the periods of a log that have all numbers, and their noise. `period`,
    `starts`: as of `list_periods`.
    """
    from scipy.special import chdtri  # deferred: 0.1 s

    there = np.isfinite(off + ticks.reference)
    whole = [row for row in starts if np.all(there[row[0] : row[0] + period])]
    first, number = np.array(whole, dtype=int).reshape(-1, 2).T
    rows = off[first[:, None] + np.arange(period)]
    sets = number[:, None] == np.unique(number)
    count = np.sum(sets, axis=0)
    content = np.fft.rfft(rows, axis=1)[:, 1 : LINES + 1] / period
    content = content - sets @ ((sets.T @ content) / count[:, None])
    several = (sets @ count) > 1
    power = np.mean(np.abs(content) ** 2, axis=1)[several] * (sets @ (count / np.maximum(count - 1, 1)))[several]
    std = math.sqrt(float(np.median(power)) * 2 * LINES / float(chdtri(2 * LINES, 0.5))) if power.size else math.inf
    level = np.mean(ticks.reference[first[:, None] + np.arange(period)], axis=1) / np.nanmax(np.abs(ticks.reference))
    level = np.round(level / SAME_LEVEL)
    return Means(
        first=first, mean=np.mean(rows, axis=1), sets=sets, levels=level[:, None] == np.unique(level), period=period,
        std=std, free=LINES * (first.size - count.size),
    )  # fmt: skip


def _centre(groups: Bool[np.ndarray, "p g"], *columns: Shaped[np.ndarray, " p"]) -> Iterator[Float[np.ndarray, " p"]]:
    """Yield columns over periods without the mean of each group."""
    at = groups / np.sum(groups, axis=0)
    return (column - groups @ (at.T @ column) for column in columns)


def _fit_slope(means: Means, groups: Bool[np.ndarray, "p g"]) -> Change:
    """Return by how much the means change over a log if evenly, by a line with an offset of each group."""
    from scipy.special import stdtrit  # deferred: 0.1 s

    free = means.first.size - groups.shape[1] - 1
    if free < 1:
        return UNKNOWN
    time, mean = _centre(groups, means.first, means.mean)
    spread = float(time @ time)
    slope = float(time @ mean) / spread
    left = float(np.sum((mean - slope * time) ** 2))
    rows = int(np.ptp(means.first)) + means.period
    reach = float(stdtrit(free, 1.0 - 0.5 * RISK)) * math.sqrt(left / free / spread)
    return Change(value=slope * rows, reach=reach * rows, rows=rows)


def _find_jump(means: Means, groups: Bool[np.ndarray, "p g"]) -> Change:
    """Return the largest difference between two means of a group."""
    from scipy.special import stdtrit  # deferred: 0.1 s

    pair = np.triu(groups @ groups.T, 1)  # the earlier one first
    pairs = int(np.sum(pair))
    if not pairs or not means.free:
        return UNKNOWN
    apart = np.where(pair, means.mean[None, :] - means.mean[:, None], 0.0)
    one, other = np.unravel_index(np.argmax(np.abs(apart)), apart.shape)
    reach = float(stdtrit(means.free, 1.0 - 0.5 * RISK / pairs)) * math.sqrt(2.0) * means.std
    rows = int(means.first[other] - means.first[one]) + means.period
    return Change(value=float(apart[one, other]), reach=reach, rows=rows)


def _tell_reading(apart: Means, other: Means, held: float, size: float, tolerated: float) -> bool | None:
    """Tell by what a reading is off beside another signal whether it is what drifts by a size. `held`: by how much
    friction lets the other go to and fro.
    """
    low, high = _find_share(apart, other, held)
    if low * size > tolerated:
        return True
    whole = _find_jump(other, other.levels)
    still = other.levels.shape[1] == 1 and abs(whole.value) + whole.reach <= min(tolerated, SHOWN * size)
    return False if still or -SHOWN < low <= high < SHOWN else None


def _find_share(apart: Means, other: Means, held: float) -> tuple[float, float]:
    """Return the interval of the share of what a reading is off by beside one signal that it is off by beside another.
    `held`: by how much friction lets the other go to and fro, beside which a line tells more.
    """
    from scipy.special import stdtrit  # deferred: 0.1 s

    groups = other.sets if held else other.levels
    ours, theirs = _centre(groups, apart.mean, other.mean)
    power, low, high = float(ours @ ours), -math.inf, math.inf
    if power and other.free:
        reach = float(stdtrit(other.free, 1.0 - 0.5 * RISK)) * other.std / math.sqrt(power)
        reach += 0.5 * held * float(np.sum(np.abs(ours))) / power
        share = float(ours @ theirs) / power
        low, high = share - reach, share + reach
    line, beside = _fit_slope(apart, groups), _fit_slope(other, groups)
    if line.least > 0.0 and math.isfinite(beside.reach):
        share, reach = beside.value / line.value, beside.reach / line.least
        low, high = max(low, share - reach), min(high, share + reach)
    return low, high
