r"""What a model leaves of a log, as a frequency response from the input, in discs at a confidence.

With the simulated outputs :math:`\hat y` of a model, the outputs' errors :math:`e = y - \hat y` have the response

.. math:: \hat E = \frac{\sum_d \bar U_d E_d}{\sum_d |U_d|^2}, \qquad
          |\hat E - E|^2 \le \frac{\sum_d |E_d - \hat E U_d|^2}{\sum_d |U_d|^2}\,\big(\alpha^{-1/(n-1)} - 1\big)

over windows d, with the probability :math:`1 - \alpha` for whatever input, the noise being as strong throughout (Ljung,
Model validation and model error modeling, 1999). What the model explains leaves no transients in e, so that chirps and
short logs can be read; of the linear plant the truth is then :math:`G(\theta) + E`. The mean of three lines that a
window takes, and the straight line to the next, add :math:`(1/6 + 1/8)|\Delta^2 \hat E|`.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from jaxtyping import Complex, Float

from seaopt import welch
from seaopt.frequency.measured import OCTAVES, PARTS, UNSEEN
from seaopt.frequency.response import Lines
from seaopt.records import record

LENGTHS = 4  # of windows, each half of the one before
FEWEST = 8  # windows
MOST = 1000
SHORTEST = 64  # samples of a window
ALPHA = 1e-4  # at which the lengths are compared


@record(eq=False)
class ResidualResponse:
    """At each line the response of the model's outputs, of their errors, and how well that is known."""

    frequency_hz: Lines
    model: Complex[np.ndarray, "y m"]  # H1 of the simulated outputs, by the same windows
    error: Complex[np.ndarray, "y m"]
    noise: Complex[
        np.ndarray, "y y m"
    ]  # of the errors' powers, what the input does not explain, over that of the input
    unseen: Float[np.ndarray, "y m"]
    windows: Float[np.ndarray, " m"]  # independent ones
    lines: int  # of all lengths that were compared

    def read(self, c: Complex[np.ndarray, "y m"]) -> tuple[Any, Any, Any, Any]:
        """Return responses of the model and of its error in a sum of the outputs, the std of the latter, and what is
        unseen.
        """
        power = np.real(np.einsum("im,ijm,jm->m", c, self.noise, np.conj(c)))
        std = np.sqrt(np.maximum(power, 0.0) / (self.windows - 1.0))
        return (
            np.sum(c * self.model, axis=0),
            np.sum(c * self.error, axis=0),
            std,
            np.sum(np.abs(c) * self.unseen, axis=0),
        )

    def widen(self, alpha: float) -> Lines:
        """Return the radius of a disc, each of which misses the truth with `alpha`, over the std."""
        rest = self.windows - 1.0
        return np.sqrt(rest * np.expm1(-np.log(alpha) / rest))


def measure_residual(
    u: Float[np.ndarray, " n"],
    model: Float[np.ndarray, "y n"],
    error: Float[np.ndarray, "y n"],
    period: float,
    runs: Sequence[slice],
    *,
    longest_s: float,
    highest_hz: float,
) -> ResidualResponse | None:
    """Return the response of a model's errors in runs of rows without a gap; in every third of an octave by the windows
    of the smallest discs, none of them longer than `longest_s`. None where the log is too short.
    """
    length = min(round(longest_s / period), max((run.stop - run.start for run in runs), default=0) // (FEWEST // 2))
    estimates: list[ResidualResponse] = []
    while len(estimates) < LENGTHS and length >= SHORTEST:
        starts = welch.thin(welch.list_starts(runs, length), MOST)
        if len(starts) >= FEWEST - 1:
            estimates.append(_average(u, model, error, period, starts, length, highest_hz))
        length //= 2
    if not estimates:
        return None
    radii = [each.widen(ALPHA) * each.read(_regulated(each))[2] + each.unseen[0] for each in estimates]
    chosen: list[tuple[ResidualResponse, Any]] = []
    for low, high in pairwise(highest_hz * 2.0 ** (-np.arange(PARTS * OCTAVES, -1, -1) / PARTS)):
        inside = [(each.frequency_hz >= low) & (each.frequency_hz < high) for each in estimates]
        scored = [
            (float(np.mean(np.log(radius[rows]))), each, rows)
            for each, radius, rows in zip(estimates, radii, inside, strict=True)
            if np.any(rows)
        ]
        if scored:
            chosen.append(min(scored, key=lambda entry: entry[0])[1:])
    lines = sum(each.frequency_hz.size for each in estimates)
    names = ("frequency_hz", "model", "error", "noise", "unseen", "windows")
    parts = {name: np.concatenate([getattr(each, name)[..., rows] for each, rows in chosen], axis=-1) for name in names}
    return ResidualResponse(**parts, lines=lines)


def _regulated(each: ResidualResponse) -> Complex[np.ndarray, "y m"]:
    """Return the sum of outputs that is the first alone."""
    c = np.zeros(each.error.shape, dtype=complex)
    c[0] = 1.0
    return c


def _average(u: Any, model: Any, error: Any, period: float, starts: Any, length: int, highest: float) -> Any:
    """Return the response by windows of one length; the first line, beside the mean, is left out."""
    f = np.fft.rfftfreq(length, period)
    last = int(np.searchsorted(f, highest)) + 1
    window, rows = welch.hann(length), np.asarray(starts)[:, None] + np.arange(length)
    uf, *others = (welch.transform(x[rows], window)[:, 1 : last + 1] for x in (u, *model, *error))
    power = np.maximum(np.sum(welch.square(uf), axis=0), 1e-300)
    outputs = np.array(others)
    response = np.sum(np.conj(uf) * outputs, axis=1) / power
    h, e = response[: len(model)], response[len(model) :]
    left = outputs[len(model) :] - e[:, None] * uf
    bend = np.zeros(e.shape)
    bend[:, 1:-1] = np.abs(e[:, 2:] - 2.0 * e[:, 1:-1] + e[:, :-2])
    near = np.maximum(bend, np.maximum(np.roll(bend, 1, axis=-1), np.roll(bend, -1, axis=-1)))
    inner = slice(1, -1)  # the outermost lines have no neighbours
    f = f[1 : last + 1][inner]
    return ResidualResponse(
        frequency_hz=f,
        model=h[:, inner],
        error=e[:, inner],
        noise=(np.einsum("idm,jdm->ijm", left, np.conj(left)) / power)[..., inner],
        unseen=UNSEEN * near[:, inner],
        windows=np.full(f.size, welch.count_averages(len(starts))),
        lines=0,
    )
