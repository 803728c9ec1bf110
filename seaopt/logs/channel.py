"""Figures of one channel: its range, and the faults found in it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Int

from seaopt.logs.faults import (
    HOLDS,
    Rail,
    Runs,
    Skips,
    counter,
    held,
    outliers,
    quantisation,
    rails,
    runs_of,
    stillness,
    stuck,
)
from seaopt.logs.spectra import Hum
from seaopt.records import record
from seaopt.signals import Signal

MOVES = 0.05  # of its standard deviation over the log: what makes a channel move during a run of another


@record(eq=False)
class ChannelQuality:
    """What was found in one channel, in its SI unit; rows are counted from 0.

    Parameters
    ----------
    name, unit : str
    low, high, mean, std : float
        Of the samples that are there; NaN where none is.
    missing : Runs
        Samples that are not finite.
    quantum : float
        Quantisation step; 0 where none is seen.
    still : float
        Share of samples equal to the last, as is usual for the channel.
    held : int
        Samples that each value is repeated, regularly; 1 where it is not.
    stuck : Runs
        Runs of equal samples that the channel's activity does not explain.
    rails : tuple of Rail
        Flat tops and bottoms.
    outliers : array of int
        Rows.
    counter : Skips or None
        Lost samples, where the channel counts.
    hum : Hum or None

    """

    name: str
    unit: str
    low: float
    high: float
    mean: float
    std: float
    missing: Runs
    quantum: float
    still: float
    held: int
    stuck: Runs
    rails: tuple[Rail, ...]
    outliers: Int[np.ndarray, " k"]
    counter: Skips | None
    hum: Hum | None = None

    @property
    def constant(self) -> bool:
        """Whether every sample that is there is the same."""
        return self.low == self.high

    @property
    def saturated(self) -> int:
        """Samples at rails."""
        return sum(rail.runs.samples for rail in self.rails)


def channel_of(signal: Signal) -> ChannelQuality:
    """Return what is found in a channel on its own.

    Examples
    --------
    >>> found = channel_of(Signal(name="F1", values=np.clip(np.sin(np.arange(999.0)), -2, 0.8)))
    >>> [(rail.side, rail.value) for rail in found.rails], found.stuck.samples
    ([('high', 0.8)], 0)

    """
    values = signal.values
    finite = np.isfinite(values)
    missing = Runs() if np.all(finite) else runs_of(~finite)
    good = values if not len(missing) else values[finite]
    values = values if not np.any(np.isinf(values)) else np.where(finite, values, np.nan)
    if not good.size or good.min() == good.max():
        edge = float(good[0]) if good.size else np.nan
        return ChannelQuality(
            name=signal.name, unit=signal.unit, low=edge, high=edge, mean=edge, std=0.0 if good.size else np.nan,
            missing=missing, quantum=0.0, still=1.0, held=1, stuck=Runs(), rails=(),
            outliers=np.zeros(0, dtype=int), counter=None,
        )  # fmt: skip
    quantum, still = quantisation(values), stillness(values)
    counted = counter(values)
    wild = outliers(values, quantum) if counted is None else np.zeros(0, dtype=int)
    tame = values
    if wild.size:  # what lies beyond a rail would hide it
        tame = values.copy()
        tame[wild] = np.nan
    flat = tuple(rails(tame, quantum, still)) if counted is None else ()
    return ChannelQuality(
        name=signal.name, unit=signal.unit, low=float(good.min()), high=float(good.max()), mean=float(good.mean()),
        std=float(good.std()), missing=missing, quantum=quantum, still=still,
        held=held(values) if still >= HOLDS else 1,
        stuck=_off_rails(stuck(values, quantum, still), values, flat) if counted is None else Runs(),
        rails=flat, outliers=wild, counter=counted,
    )  # fmt: skip


def _off_rails(found: Runs, values: Float[np.ndarray, " n"], flat: Sequence[Rail]) -> Runs:
    """Leave out the runs at a rail: those are saturated."""
    at = np.isin(values[found.start], [rail.value for rail in flat]) if len(found) else np.zeros(0, dtype=bool)
    return found.where(~at)


def moving(found: Runs, others: Sequence[tuple[Float[np.ndarray, " n"], float]]) -> Runs:
    """Keep the runs during which another channel moves; all where there is no other.

    Parameters
    ----------
    found : Runs
        Of equal samples.
    others : sequence of (array, float)
        The samples of the other channels and their standard deviations.

    """
    active = [(values, std) for values, std in others if std > 0.0]
    if not active or not len(found):
        return found

    def moves(start: int, stop: int) -> bool:
        return any(np.nanstd(values[start:stop]) > MOVES * std for values, std in active if _seen(values[start:stop]))

    chosen: Bool[np.ndarray, " k"] = np.array(
        [moves(a, b) for a, b in zip(found.start.tolist(), found.stop.tolist(), strict=True)]
    )
    return found.where(chosen)


def _seen(values: Float[np.ndarray, " n"]) -> bool:
    return bool(np.any(np.isfinite(values)))
