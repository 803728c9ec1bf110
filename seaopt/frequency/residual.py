r"""What a model leaves of a log, as a frequency response from the input, in discs at a confidence.

With the simulated outputs :math:`\hat y` of a model, the outputs' errors :math:`e = y - \hat y` have the response

.. math:: \hat E = \frac{\sum_d \bar U_d E_d}{\sum_d |U_d|^2}, \qquad
          |\hat E - E|^2 \le \frac{\sum_d |E_d - \hat E U_d|^2}{\sum_d |U_d|^2}\,\big(\alpha^{-1/(n-1)} - 1\big)

over windows d, with the probability :math:`1 - \alpha` for whatever input that does not depend on the noise, the noise
being as strong throughout (Ljung,
Model validation and model error modeling, 1999). The power of what is left is averaged over neighbouring lines, each of
which counts as about half a line more, unless it is larger at its own, as of a hum. What the model explains leaves no
transients in e, so that chirps and short logs can be read; of the linear plant the truth is then
:math:`G(\theta) + E`. The mean of three lines that a window takes, and the straight line to the next, add
:math:`(1/6 + 1/8)|\Delta^2 \hat E|`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Complex, Float

from seaopt import welch
from seaopt.frequency.measured import UNSEEN
from seaopt.frequency.response import Lines, measure_bend
from seaopt.records import record

LAGS = 64  # samples that predict errors and input
AHEAD, FAR = 16, 256  # samples within which a law answers, and up to which the input is looked at
WINDOW, MOST_WINDOWS = 2000, 20  # samples that a law's answer is sought in, and how many times
FALSE_ALARM = 1e-4
UNFELT = 1e-4  # of the input's std: less of it is not taken for an answer
LENGTHS = 4  # of windows, each half of the one before
FEWEST = 8  # windows
MOST = 1000
SHORTEST = 64  # samples of a window
NEAR, ALIKE = 9, 1.83  # lines that the power of the noise is averaged over, and how many of them count as one


@record(eq=False)
class ResidualResponse:
    """The response of the model's outputs and of what they leave, at each line of windows of one length."""

    frequency_hz: Lines
    model: Complex[np.ndarray, "y m"]  # H1 of the simulated outputs, by the same windows
    error: Complex[np.ndarray, "y m"]
    noise: Complex[np.ndarray, "y y m"]  # covariance of the error
    unseen: Float[np.ndarray, "y m"]
    rough: Float[np.ndarray, "y m"]  # variance of `model`, where its outputs are not linear in the input
    freedom: float  # complex degrees of it, of `noise`

    def read(self, c: Complex[np.ndarray, "y m"]) -> tuple[Any, Any, Any, Any]:
        """Return responses of the model and of its error in a sum of the outputs, the std of the latter, and what is
        unseen.
        """
        power = np.real(np.einsum("im,ijm,jm->m", c, self.noise, np.conj(c)))
        sums = (np.sum(c * part, axis=0) for part in (self.model, self.error))
        return *sums, np.sqrt(np.maximum(power, 0.0)), np.sum(np.abs(c) * self.unseen, axis=0)

    def widen(self, alpha: float) -> float:
        """Return the radius of a disc, each of which misses the truth with `alpha`, over the std."""
        return float(np.sqrt(self.freedom * np.expm1(-np.log(alpha) / self.freedom)))


def measure_residual(
    u: Float[np.ndarray, " n"],
    model: Float[np.ndarray, "y n"],
    error: Float[np.ndarray, "y n"],
    period: float,
    runs: Sequence[slice],
    *,
    longest_s: float,
    highest_hz: float,
) -> list[ResidualResponse]:
    """Return the response of a model's errors in runs of rows without a gap, by windows of several lengths, none of
    them longer than `longest_s`; none where the log is too short.
    """
    length = min(round(longest_s / period), max((run.stop - run.start for run in runs), default=0) // (FEWEST // 2))
    estimates: list[ResidualResponse] = []
    while len(estimates) < LENGTHS and length >= SHORTEST:
        starts = welch.thin(welch.list_starts(runs, length), MOST)
        if len(starts) >= FEWEST - 1:
            estimates.append(_average(u, model, error, period, starts, length, highest_hz))
        length //= 2
    return estimates


def _average(u: Any, model: Any, error: Any, period: float, starts: Any, length: int, highest: float) -> Any:
    """Return the response by windows of one length; the first line, beside the mean, is left out."""
    from scipy.ndimage import uniform_filter1d  # deferred: 0.2 s

    f = np.fft.rfftfreq(length, period)
    last = int(np.searchsorted(f, highest)) + 1
    taper, rows = welch.hann(length), np.asarray(starts)[:, None] + np.arange(length)
    uf, *spectra = (welch.transform(x[rows], taper)[:, 1 : last + 1] for x in (u, *model, *error))
    power = np.maximum(np.sum(welch.square(uf), axis=0), 1e-300)
    outputs, y, freedom = np.array(spectra), len(model), welch.count_averages(len(starts)) - 1.0
    response = np.sum(np.conj(uf) * outputs, axis=1) / power
    left = outputs - response[:, None] * uf
    each = np.einsum("idm,jdm->ijm", left[y:], np.conj(left[y:])) / freedom
    near = uniform_filter1d(np.real(each), NEAR, mode="nearest") + 1j * uniform_filter1d(
        np.imag(each), NEAR, mode="nearest"
    )
    of_each, of_near = (np.maximum(np.real(np.einsum("iim->im", part)), 1e-300) for part in (each, near))
    near = near * np.maximum(np.max(of_each / of_near, axis=0), 1.0)
    e = response[y:]
    inner = slice(1, -1)  # the outermost lines have no neighbours
    return ResidualResponse(
        frequency_hz=f[1 : last + 1][inner],
        model=response[:y, inner],
        error=e[:, inner],
        noise=(near / power)[..., inner],
        unseen=UNSEEN * measure_bend(e)[:, inner],
        rough=(np.sum(welch.square(left[:y]), axis=1) / power / freedom)[:, inner],
        freedom=freedom * NEAR / ALIKE,
    )


def find_feedback(u: Float[np.ndarray, " n"], error: Float[np.ndarray, "y n"], runs: Sequence[slice]) -> bool:
    """Tell whether the input answers the noise: whether what past input and errors do not predict of an error is
    correlated with what the past of input soon after does not predict of it.

    In an open loop the first is noise, and independent of later input, whatever that is. What a nonlinear plant leaves
    in it is as much correlated with input long after, which the soon correlations are compared with.

    Counted on simulated screws of ten seconds (chirp, chirp and noise, multisine, steps; dry friction, hardening, a
    current loop, a lag or a noisy reading of the current that the fitted model lacks): of 1200 logs in open loop none
    was found, and the largest correlation was 0.8 of the threshold. Of 336 under a law of 30 Hz with 2 N of noise all
    were; of 192 under one of 8 Hz with as little as 0.5 N, 157: those missed had a reference as wide as noise.
    """
    from scipy.special import chdtri  # deferred: 0.1 s

    windows = [(a, min(a + WINDOW, run.stop)) for run in runs for a in range(run.start, run.stop, WINDOW)]
    windows = [(a, b) for a, b in windows if b - a >= WINDOW // 2][:MOST_WINDOWS]
    if not windows:
        return False
    floor, outputs = UNFELT * float(np.nanstd(u)), len(error)
    sums, powers = np.zeros((outputs, FAR)), np.zeros((outputs, FAR))
    for a, b in windows:  # a prediction of each follows a chirp
        view = np.lib.stride_tricks.sliding_window_view(np.vstack([u[a:b], error[:, a:b]]), LAGS + 1, axis=1)
        later = _leave(view[0, :, :-1], view[0, :, -1])
        noises = _leave(np.hstack([view[0], *view[1:, :, :-1]]), view[1:, :, -1].T).T
        for lag in range(1, FAR + 1):
            product = noises[:, :-lag] * later[lag:]
            sums[:, lag - 1] += np.sum(product, axis=1)
            powers[:, lag - 1] += np.sum(np.maximum(product**2, (noises[:, :-lag] * floor) ** 2), axis=1)
    each = sums**2 / np.maximum(powers, 1e-300)
    beside = np.maximum(np.mean(each[:, LAGS:], axis=1), 1.0)
    return bool(np.any(np.max(each[:, :AHEAD], axis=1) > beside * chdtri(1, FALSE_ALARM / (AHEAD * outputs))))


def _leave(regressors: Any, target: Any) -> Any:
    """Return what a linear prediction with a mean leaves of a target."""
    a = np.column_stack([regressors, np.ones(len(regressors))])
    return target - a @ np.linalg.lstsq(a, target, rcond=1e-10)[0]
