"""Figures of one channel: its range, and the faults found in it."""

from __future__ import annotations

from dataclasses import field
from typing import Any

import numpy as np
from jaxtyping import Int

from seaopt.codec import Key, OrNaN
from seaopt.logs.quality import faults
from seaopt.logs.quality.faults import CounterLosses, Rail, RowRanges
from seaopt.logs.quality.spectra import Hum
from seaopt.records import record
from seaopt.signals import RowsK, Signal

BEYOND = 1e30  # in SI: more than any sensor gives, and with a square that is still a number


@record(eq=False)
class ChannelQuality:
    """Range and faults of one channel, in its SI unit; rows are counted from 0."""

    json_keys = (
        *("name", "unit", "low", "high", "mean", "std"),
        Key(field="missing_samples", name="missing"),
        "constant",
        Key(field="quantum", name="quantisation"),
        "held",
        Key(field="stuck_samples", name="stuck"),
        *("saturated", "rails"),
        Key(field="outlying_samples", name="outliers"),
        "hum",
        Key(field="missing", name="missing_rows"),
        Key(field="beyond", name="beyond_rows"),
        "still",
        Key(field="stuck", name="stuck_rows"),
        Key(field="outliers", name="outlier_rows"),
        "counter",
    )

    name: str
    unit: str
    # low, high, mean, std: of the samples that are there; NaN where none is
    low: OrNaN
    high: OrNaN
    mean: OrNaN
    std: OrNaN
    missing: RowRanges  # samples that are not finite
    beyond: Int[np.ndarray, " b"]  # rows of numbers that no sensor gives; no figure is made of them
    # What follows is a constant's, which has no faults besides.
    quantum: float = 0.0  # quantisation step; 0 where none is seen
    still: float = 1.0  # share of samples equal to the last, as is usual for the channel
    held: int = 1  # samples that each value is repeated, regularly; 1 where it is not
    stuck: RowRanges = field(default_factory=RowRanges)  # runs of equal samples that its activity does not explain
    rails: tuple[Rail, ...] = ()  # flat tops and bottoms
    outliers: RowsK = field(default_factory=lambda: np.zeros(0, dtype=int))  # rows
    counter: CounterLosses | None = None  # lost samples, where the channel counts
    hum: Hum | None = None

    @property
    def constant(self) -> bool:
        """Whether every sample that is there is the same."""
        return self.low == self.high

    @property
    def varies(self) -> bool:
        """Whether it has a spectrum that means something: a constant has none, and that of a counter means nothing."""
        return self.std > 0.0 and self.counter is None

    @property
    def missing_samples(self) -> int:
        """Samples that are not finite."""
        return self.missing.samples

    @property
    def stuck_samples(self) -> int:
        """Samples in runs of equal ones."""
        return self.stuck.samples

    @property
    def outlying_samples(self) -> int:
        """Samples that are outliers."""
        return int(self.outliers.size)

    @property
    def saturated(self) -> int:
        """Samples at rails."""
        return sum(rail.samples for rail in self.rails)


def assess_channel(signal: Signal) -> ChannelQuality:
    """Return range and faults of one channel, looked at on its own."""
    values = signal.values
    finite = np.isfinite(values)
    missing = RowRanges() if np.all(finite) else faults.find_runs(~finite)
    beyond = np.flatnonzero(finite & (np.abs(values) > BEYOND))
    finite[beyond] = False
    present = values[finite]
    values = values if np.all(finite) else np.where(finite, values, np.nan)
    figures: dict[str, Any] = {"name": signal.name, "unit": signal.unit, "missing": missing, "beyond": beyond}
    if not present.size:
        return ChannelQuality(low=np.nan, high=np.nan, mean=np.nan, std=np.nan, **figures)
    low, high = float(present.min()), float(present.max())
    if low == high:
        return ChannelQuality(low=low, high=low, mean=low, std=0.0, **figures)
    figures |= {"low": low, "high": high, "mean": float(present.mean()), "std": float(present.std())}
    quantum, still = faults.find_quantisation(values), faults.measure_stillness(values)
    figures |= {"quantum": quantum, "still": still}
    figures["held"] = faults.count_repeats(values) if still >= faults.HOLDS else 1
    losses = faults.find_counter_losses(values)
    if losses is not None:
        return ChannelQuality(counter=losses, **figures)
    outliers = faults.find_outliers(values, quantum)
    tame = values
    if outliers.size:  # what lies beyond a rail would hide it
        tame = values.copy()
        tame[outliers] = np.nan
    rails = tuple(faults.find_rails(tame, quantum, still))
    stuck = faults.find_stuck(values, quantum, still)
    at_rail = np.isin(values[stuck.start], [rail.value for rail in rails])  # such a run is saturated
    return ChannelQuality(stuck=stuck.where(~at_rail), rails=rails, outliers=outliers, **figures)
