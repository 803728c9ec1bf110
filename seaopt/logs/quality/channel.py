"""Figures of one channel: its range, and the faults found in it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import field

import numpy as np
from jaxtyping import Bool, Float, Int

from seaopt.logs.quality import faults
from seaopt.logs.quality.faults import CounterLosses, Rail, RowRanges
from seaopt.logs.quality.spectra import Hum
from seaopt.records import record
from seaopt.signals import Signal

BEYOND = 1e30  # in SI: more than any sensor gives, and with a square that is still a number
MOVING_STD = 0.05  # of its standard deviation over the log: what makes a channel move during a run of another


@record(eq=False)
class ChannelQuality:
    """Range and faults of one channel, in its SI unit; rows are counted from 0."""

    name: str
    unit: str
    # low, high, mean, std: of the samples that are there; NaN where none is
    low: float
    high: float
    mean: float
    std: float
    missing: RowRanges  # samples that are not finite
    beyond: Int[np.ndarray, " b"]  # rows of numbers that no sensor gives; no figure is made of them
    # What follows is a constant's, which has no faults besides.
    quantum: float = 0.0  # quantisation step; 0 where none is seen
    still: float = 1.0  # share of samples equal to the last, as is usual for the channel
    held: int = 1  # samples that each value is repeated, regularly; 1 where it is not
    stuck: RowRanges = field(default_factory=RowRanges)  # runs of equal samples that its activity does not explain
    rails: tuple[Rail, ...] = ()  # flat tops and bottoms
    outliers: Int[np.ndarray, " k"] = field(default_factory=lambda: np.zeros(0, dtype=int))  # rows
    counter: CounterLosses | None = None  # lost samples, where the channel counts
    hum: Hum | None = None

    @property
    def constant(self) -> bool:
        """Whether every sample that is there is the same."""
        return self.low == self.high

    @property
    def saturated(self) -> int:
        """Samples at rails."""
        return sum(rail.runs.samples for rail in self.rails)


def assess_channel(signal: Signal) -> ChannelQuality:
    """Return range and faults of one channel, looked at on its own.

    Examples
    --------
    >>> channel = assess_channel(Signal(name="F1", values=np.clip(np.sin(np.arange(999.0)), -2, 0.8)))
    >>> [(rail.side, rail.value) for rail in channel.rails], channel.stuck.samples
    ([('high', 0.8)], 0)

    """
    values = signal.values
    finite = np.isfinite(values)
    missing = RowRanges() if np.all(finite) else faults.find_runs(~finite)
    beyond = np.flatnonzero(finite & (np.abs(values) > BEYOND))
    finite[beyond] = False
    present = values[finite]
    values = values if np.all(finite) else np.where(finite, values, np.nan)
    if not present.size or present.min() == present.max():
        edge = float(present[0]) if present.size else np.nan
        return ChannelQuality(
            name=signal.name,
            unit=signal.unit,
            low=edge,
            high=edge,
            mean=edge,
            std=0.0 if present.size else np.nan,
            missing=missing,
            beyond=beyond,
        )
    quantum, still = faults.find_quantisation(values), faults.measure_stillness(values)
    losses = faults.find_counter_losses(values)
    outliers = faults.find_outliers(values, quantum) if losses is None else np.zeros(0, dtype=int)
    tame = values
    if outliers.size:  # what lies beyond a rail would hide it
        tame = values.copy()
        tame[outliers] = np.nan
    rails = tuple(faults.find_rails(tame, quantum, still)) if losses is None else ()
    return ChannelQuality(
        name=signal.name,
        unit=signal.unit,
        low=float(present.min()),
        high=float(present.max()),
        mean=float(present.mean()),
        std=float(present.std()),
        missing=missing,
        quantum=quantum,
        still=still,
        held=faults.count_repeats(values) if still >= faults.HOLDS else 1,
        stuck=_off_rails(faults.find_stuck(values, quantum, still), values, rails) if losses is None else RowRanges(),
        rails=rails,
        outliers=outliers,
        counter=losses,
        beyond=beyond,
    )


def _off_rails(runs: RowRanges, values: Float[np.ndarray, " n"], rails: Sequence[Rail]) -> RowRanges:
    """Leave out the runs at a rail: those are saturated."""
    at_rail = np.isin(values[runs.start], [rail.value for rail in rails]) if len(runs) else np.zeros(0, dtype=bool)
    return runs.where(~at_rail)


def keep_runs_while_others_move(runs: RowRanges, others: Sequence[tuple[Float[np.ndarray, " n"], float]]) -> RowRanges:
    """Keep the runs of equal samples during which another channel moves; all where there is no other.

    `others`: the samples of the other channels and their standard deviations.
    """
    active = [(values, std) for values, std in others if std > 0.0]
    if not active or not len(runs):
        return runs

    def moves(start: int, stop: int) -> bool:
        pieces = [(values[start:stop], std) for values, std in active]
        return any(np.nanstd(piece) > MOVING_STD * std for piece, std in pieces if np.any(np.isfinite(piece)))

    chosen: Bool[np.ndarray, " k"] = np.array(
        [moves(start, stop) for start, stop in zip(runs.start.tolist(), runs.stop.tolist(), strict=True)]
    )
    return runs.where(chosen)
