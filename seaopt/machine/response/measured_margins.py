r"""Gain, phase and delay margin of a measured loop, between the lines where it crosses -180 degrees and a gain of one.

Between neighbouring lines the loop gain is taken as a straight line in :math:`\ln|L|` and phase over
:math:`\ln f`. A disc of radius R about L allows :math:`\rho = R/|L|` of gain and as many radians of phase, so that

.. math:: |\Delta \ln g| \le \rho\,(1 + |\mathrm d\ln|L|/\mathrm d\varphi|), \qquad
          |\Delta\varphi| \le \rho\,(1 + |\mathrm d\varphi/\mathrm d\ln|L||) .

The specification has no limit of these margins: they stand beside what was predicted. An interval as wide as three
quarters of the margin to each side tells nothing of it; then the row has none, and the periods that would make it as
narrow.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from seaopt.control import Controller
from seaopt.machine.response.judged import Judged, Measured

DECIBEL = 20.0 / math.log(10.0)
MARGINS = ("gain margin", "phase margin", "delay margin")
STEEPEST = 10.0  # of one over the other, beyond which a crossing is not told
WIDEST = 0.75  # of a margin, to each side of it: an interval as wide tells nothing


def list_margins(controller: Controller, measured: Sequence[Measured], alpha: float) -> list[Judged]:
    """Return the margins of a measured loop, the smallest by size of all amplitudes; those that it crosses for."""
    figures = controller.achieved
    delay = None if figures.delay_margin_s is None else 1e3 * figures.delay_margin_s
    predicted = dict(zip(MARGINS, (figures.gain_margin_db, figures.phase_margin_deg, delay), strict=True))
    smallest: dict[str, Judged] = {}
    for row in (row for part in measured for row in _find_margins(part, alpha)):
        before = smallest.get(row.name)
        if before is None or (
            row.value is not None and before.value is not None and abs(row.value) < abs(before.value)
        ):
            smallest[row.name] = row
    return [_predict(smallest[name], value) for name, value in predicted.items() if name in smallest]


def _predict(row: Judged, predicted: float | None) -> Judged:
    """Return a row with what was predicted, where that is a number."""
    return replace(row, predicted=predicted if predicted is not None and math.isfinite(predicted) else None)


def _find_margins(part: Measured, alpha: float) -> Iterator[Judged]:
    """Yield the margins at each crossing of a loop."""
    loop, radius = part.loop.disc(alpha)
    size, phase, at = np.log(np.abs(loop)), np.unwrap(np.angle(loop)), np.log(part.f)
    turns = np.floor((phase + np.pi) / (2.0 * np.pi))  # changes where the loop crosses -180 degrees
    share = radius / np.abs(loop)
    for k in range(part.f.size - 1):
        rise, turn, error = size[k + 1] - size[k], phase[k + 1] - phase[k], float(max(share[k], share[k + 1]))
        if turns[k] != turns[k + 1]:
            t = (math.pi * (2.0 * max(turns[k], turns[k + 1]) - 1.0) - phase[k]) / turn
            wide = DECIBEL * error * (1.0 + min(abs(rise / turn), STEEPEST))
            margin = -DECIBEL * float(size[k] + t * rise)
            yield _make("gain margin", margin, wide, "dB", _hertz(at, k, t), part.periods)
        if size[k] * size[k + 1] <= 0.0 and rise:
            t = -size[k] / rise
            left = (math.pi + float(phase[k] + t * turn)) % (2.0 * math.pi)  # until the loop is later by a turn
            wide, hertz = error * (1.0 + min(abs(turn / rise), STEEPEST)), _hertz(at, k, t)
            margin = math.degrees(left - 2.0 * math.pi * (left > math.pi))
            yield _make("phase margin", margin, math.degrees(wide), "deg", hertz, part.periods)
            per = 1e3 / (2.0 * math.pi * hertz)
            yield _make("delay margin", per * left, per * (wide + abs(left) * error), "ms", hertz, part.periods)


def _hertz(at: np.ndarray, k: int, t: float) -> float:
    return float(np.exp(at[k] + t * (at[k + 1] - at[k])))


def _make(name: str, value: float, wide: float, unit: str, hertz: float, periods: int) -> Judged:
    told = wide < WIDEST * abs(value)
    low, high = (value - wide, value + wide) if told else (None, None)
    share = math.inf if told or not value else wide / (WIDEST * abs(value))
    needed = math.ceil(periods * share**2) if math.isfinite(share) else None
    return Judged(
        name=name, limit=None, sense="at least", value=value, low=low, high=high, unit=unit, outcome="undecided",
        where_hz=hertz, periods=needed,
    )  # fmt: skip
