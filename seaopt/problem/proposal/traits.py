r"""Traits of a log that a fit must allow for: a delay, outliers, friction that sticks.

**Delay.** Well above the resonance of an actuator with m poles more than zeros the phase of its response is
:math:`-m\pi/2 + c/f - 2\pi f \tau`: the poles' damping vanishes as c/f, and only what takes effect late goes on to
fall. So :math:`\tau` is the slope by f of a line in 1, 1/f and f through the highest coherent frequencies, less half a
period where the input holds its values.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from seaopt.logs import Quality, assess_quality
from seaopt.logs.quality.excitation import InputExcitation
from seaopt.logs.quality.spectra import Spectra
from seaopt.records import record
from seaopt.signals import RawLog

COHERENT = 0.9
BAND = 3.0  # highest over lowest frequency of the line
FEWEST_LINES = 12
SURE = 4.0  # standard deviations
LEAST_PERIODS = 0.75  # of a delay that is worth a parameter
OUTLIERS = 3  # from which a log asks for a loss that bears them


@record(eq=False)
class Traits:
    """Traits of a log."""

    # by how much its outputs are late, beyond the plant's own lag; None where that is not seen
    delay_s: float | None = None
    outliers: int = 0  # samples of outputs that stand far off
    standing: tuple[str, ...] = ()  # positions that stand still time and again while they are driven
    unexcited: InputExcitation | None = None  # of an input that no output follows linearly


def find_traits(
    table: RawLog, source: str, outputs: Sequence[str], positions: Sequence[str], *, is_command: bool
) -> Traits:
    """Return the traits of a log. `outputs`: what is fitted. `positions`: which of it are positions. `is_command`:
    whether the input holds each value until the next sample; a measured one does not.
    """
    quality = assess_quality(table, inputs=[source])
    excitation = quality.excitation.get(source)
    return Traits(
        delay_s=_find_delay(quality, source, outputs, is_command=is_command),
        outliers=sum(quality.channels[name].outliers.size for name in outputs),
        standing=tuple(name for name in positions if len(quality.channels[name].stuck) > 1),
        unexcited=excitation if excitation is not None and excitation.usable_hz is None else None,
    )


def _find_delay(quality: Quality, source: str, outputs: Sequence[str], *, is_command: bool) -> float | None:
    """Return the delay of the output that tells it best; None where none tells one."""
    spectra = quality.spectra
    if spectra is None or source not in spectra.channels:
        return None
    delays = [fit_delay(spectra, source, name, is_command=is_command) for name in outputs if name in spectra.channels]
    sure = [(std, delay) for delay, std in filter(None, delays)]
    if not sure:
        return None
    std, delay = min(sure)
    return delay if delay > max(LEAST_PERIODS * spectra.period, SURE * std) else None


def fit_delay(spectra: Spectra, source: str, output: str, *, is_command: bool) -> tuple[float, float] | None:
    """Return the delay of an output and its standard deviation, s; None where too little is coherent."""
    f, coherence = spectra.frequency_hz[1:-1], spectra.coherence(source, output)[1:-1]
    good = np.flatnonzero(coherence > COHERENT)
    if not good.size:
        return None
    # From the top of the widest coherent stretch down.
    parts = np.split(good, np.flatnonzero(np.diff(good) > 2) + 1)
    widest = max(parts, key=lambda part: f[part[-1]] / f[part[0]])
    rows = widest[f[widest] > f[widest[-1]] / BAND]
    if rows.size < FEWEST_LINES:
        return None
    phase = np.unwrap(np.angle(spectra.cross(source, output)[1:-1][rows]))
    weight = np.sqrt(2.0 * spectra.averages * coherence[rows] / np.maximum(1.0 - coherence[rows], 1e-9))
    # The windows of neighbouring lines overlap: about two of them tell what one would.
    matrix = np.stack([np.ones(rows.size), 1.0 / f[rows], -2.0 * np.pi * f[rows]], axis=1) * weight[:, None]
    solution, left, rank, _ = np.linalg.lstsq(matrix, phase * weight, rcond=None)
    if rank < matrix.shape[1]:
        return None
    scale = max(1.0, float(left[0]) / (rows.size - 3) if left.size else 1.0)
    std = float(np.sqrt(2.0 * scale * np.linalg.inv(matrix.T @ matrix)[2, 2]))
    return float(solution[2]) - 0.5 * spectra.period * is_command, std
