"""Saturated samples of a measured output are masked for a fit: beyond its range the sensor did not follow the plant.

They become missing samples (NaN), which have no weight in a fit, and the log's notes say how many and why.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import replace

import numpy as np
from jaxtyping import Bool

from seaopt.formatting import format_count, format_percent
from seaopt.logs.log.log import Log
from seaopt.logs.quality import faults
from seaopt.signals import VectorN

EXTREME_SAMPLES = 16  # extreme samples among which equal ones give a rail away


def mask_saturated(
    log: Log, outputs: Collection[str], *, ranges: Mapping[str, tuple[float, float]], search: bool
) -> Log:
    """Make the saturated samples of `outputs` missing: those at the ends of declared `ranges` (low, high; SI) or
    beyond, and, with `search`, clear flat tops, as the quality report finds them, where no range is declared.
    """
    for name in outputs:
        if name in ranges:
            low, high = ranges[name]
            rows = (log[name] <= low) | (log[name] >= high)
            reason = f"at or beyond its declared range of {low:g} to {high:g}"
            log = _mask(log, name, rows, reason, "")
        elif search:
            rows, reason = _find_clipped(log[name])
            log = _mask(log, name, rows, reason, ' (flat tops; mask = "declared" keeps them)')
    return log


def _mask(log: Log, name: str, rows: Bool[np.ndarray, " n"], reason: str, remedy: str) -> Log:
    count = int(np.count_nonzero(rows))
    if not count:
        return log
    signal = log.signal(name)
    amount = f"{format_count(count, 'sample')} ({format_percent(count / len(log), 2)})"
    note = f"{name}: {amount} {reason} {signal.unit}".rstrip() + f" masked{remedy}"
    signals = {**log.signals, name: replace(signal, values=np.where(rows, np.nan, signal.values))}
    return replace(log, signals=signals, notes=(*log.notes, note))


def _find_clipped(values: VectorN) -> tuple[Bool[np.ndarray, " n"], str]:
    """Return which samples lie at a clear rail, and where the rails are."""
    rows = np.zeros(values.size, dtype=bool)
    if not _may_be_clipped(values):
        return rows, ""
    quantum = faults.find_quantisation(values)
    tame = values.copy()
    tame[faults.find_outliers(values, quantum)] = np.nan
    rails = [rail for rail in faults.find_rails(tame, quantum, faults.measure_stillness(values)) if rail.clear]
    for rail in rails:
        for start, stop in zip(rail.runs.start, rail.runs.stop, strict=True):
            rows[start:stop] = True
    return rows, "clipped at " + " and ".join(f"{rail.value:.5g}" for rail in rails)


def _may_be_clipped(values: VectorN) -> bool:
    """Return whether some of the largest, or of the least, samples are equal: nearly every log ends here."""
    finite = values[np.isfinite(values)]
    if finite.size <= 2 * EXTREME_SAMPLES:
        return False
    # Two partitions: one for both places takes five times as long.
    least = np.partition(finite, EXTREME_SAMPLES)[:EXTREME_SAMPLES]
    largest = np.partition(finite, finite.size - EXTREME_SAMPLES)[-EXTREME_SAMPLES:]
    return any(np.unique(end).size <= EXTREME_SAMPLES - 2 for end in (least, largest))
