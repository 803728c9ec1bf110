r"""Frequency response of a log: the H1 estimate and its coherence.

Welch's averages of Hann-tapered windows that overlap by half (Bendat and Piersol, Random Data, 4th ed., ch. 6):

.. math:: H_1 = S_{uy} / S_{uu}, \qquad \gamma^2 = |S_{uy}|^2 / (S_{uu} S_{yy}),
          \qquad \sigma_{|H_1|} / |H_1| = \sqrt{(1 - \gamma^2) / (2 \gamma^2 n_d)} .

The window spreads a line over its neighbours, in amplitude by (-1/4, 1/2, -1/4): for an input that is white nearby, H1
estimates the mean of the response over three lines, weighted by the squares (1/6, 2/3, 1/6). That bias is small where
the window is long against the plant's memory; models compared with H1 are spread likewise
(`FrequencyResponse.expected`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from jaxtyping import Bool, Complex, Float

from seaopt import welch
from seaopt.errors import LogError
from seaopt.records import record

BATCH = 1 << 20  # samples
Lines = Float[np.ndarray, " m"]  # one number per frequency
ComplexLines = Complex[np.ndarray, " m"]


@record(eq=False)
class FrequencyResponse:
    """An estimate from one input to one output.

    Parameters
    ----------
    frequency_hz : array, shape (m,)
        Above zero, up to the Nyquist frequency.
    response : complex array, shape (m,)
        Output unit over input unit.
    coherence : array, shape (m,)
        Between 0 and 1.
    averages : int
        Segments averaged.
    """

    frequency_hz: Lines
    response: ComplexLines
    coherence: Lines
    averages: int

    @property
    def relative_std(self) -> Lines:
        """Relative standard deviation of abs(H1)."""
        gamma = np.clip(self.coherence, 1e-6, 1.0)
        return np.sqrt((1.0 - gamma) / (2.0 * gamma * welch.count_averages(self.averages)))

    def expected(self, response: Callable[[Any], Any]) -> Complex[np.ndarray, "m ..."]:
        """Return what H1 is on average where the plant's response is `response`, a function of frequencies in Hz.

        The first line, beside the mean that every window is rid of, is not corrected.
        """
        f = self.frequency_hz
        line = f[1] - f[0]
        everywhere = response(np.concatenate([f, f[1:] - line, f[1:] + line]))
        centre, below, above = np.split(everywhere, [f.size, 2 * f.size - 1])
        return np.concatenate([centre[:1], centre[1:] / 1.5 + (below + above) / 6.0])


def measure_bend(response: Complex[np.ndarray, "*k m"]) -> Float[np.ndarray, "*k m"]:
    """Return the largest size of the second difference of a response about each line, the outermost lines' own zero;
    the lines are its last axis.
    """
    bend = np.zeros(response.shape)
    bend[..., 1:-1] = np.abs(response[..., 2:] - 2.0 * response[..., 1:-1] + response[..., :-2])
    return np.maximum(bend, np.maximum(np.roll(bend, 1, axis=-1), np.roll(bend, -1, axis=-1)))


def find_band(f: Lines, good: Bool[np.ndarray, " m"]) -> slice:
    """Return the lines of the widest run of good ones, on a logarithmic axis; an empty slice where there is none."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], good.astype(int), [0]]))).reshape(-1, 2)
    low, high = max(edges.tolist(), key=lambda run: f[run[1] - 1] / f[run[0]], default=(0, 0))
    return slice(low, high)


def h1(
    u: Float[np.ndarray, " n"], y: Float[np.ndarray, " n"], period: float, *, stretch_s: float | None = None
) -> FrequencyResponse:
    """Estimate the frequency response from u to y.

    Parameters
    ----------
    u, y : array, shape (n,)
        Samples of input and output, none missing.
    period : float
        Seconds between samples.
    stretch_s : float, optional
        Length of a window, which sets the resolution 1/stretch_s; a sixteenth of the record if left out.

    Raises
    ------
    LogError
        The record is shorter than two windows or 32 samples, or the input is constant.

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> u = rng.normal(size=4000)
    >>> estimate = h1(u, 3 * u, 1 / 400)
    >>> bool(np.allclose(estimate.response, 3.0)), bool(np.all(estimate.coherence > 0.999))
    (True, True)
    """
    return responses(u, (y,), period, stretch_s=stretch_s)[0]


def responses(
    u: Float[np.ndarray, " n"],
    outputs: Sequence[Float[np.ndarray, " n"]],
    period: float,
    *,
    stretch_s: float | None = None,
) -> list[FrequencyResponse]:
    """Return `h1` from u to several outputs, the spectra of u made once."""
    n = u.size
    if stretch_s is not None and not 0.0 < stretch_s < n * period:
        raise LogError(f"stretch_s = {stretch_s:g} is not within the log of {n * period:g} s; give a shorter one")
    length = int(n / 16) if stretch_s is None else round(stretch_s / period)
    length = max(length, 16)
    if n < 2 * length:
        raise LogError(f"{n} samples are too few for windows of {length * period:g} s; use a longer log")
    if np.ptp(u) == 0.0:
        raise LogError("the input is constant; a frequency response needs excitation")
    starts = welch.list_starts([slice(0, n)], length)
    taper = welch.hann(length)
    suu, syy = np.zeros(length // 2), np.zeros((len(outputs), length // 2))
    suy = np.zeros(syy.shape, dtype=complex)
    # Long logs are looked at in the memory of a batch.
    for batch in np.array_split(starts, -(-len(starts) * length // BATCH)):
        uf, *spectra = (
            welch.transform(np.stack([x[start : start + length] for start in batch]), taper)[:, 1:]
            for x in (u, *outputs)
        )
        suu += _power(uf) / len(starts)
        against = np.conj(uf)
        for o, yf in enumerate(spectra):
            syy[o] += _power(yf) / len(starts)
            suy[o] += np.sum(against * yf, axis=0) / len(starts)
    frequency = np.fft.rfftfreq(length, period)[1:]
    return [
        FrequencyResponse(
            frequency_hz=frequency,
            response=cross / np.maximum(suu, 1e-300),
            coherence=welch.coherence(cross, suu, power),
            averages=len(starts),
        )
        for cross, power in zip(suy, syy, strict=True)
    ]


def conditioned_responses(
    inputs: Sequence[Float[np.ndarray, " n"]],
    outputs: Sequence[Float[np.ndarray, " n"]],
    period: float,
    *,
    stretch_s: float,
) -> list[list[FrequencyResponse]]:
    """Return the responses of outputs to each of several inputs that move together, input by input.

    They are those of one regression on all of them, line by line, and their coherences the partial ones: what an input
    alone explains of what the others leave (Bendat and Piersol, ch. 7). Inputs that follow each other have little.
    """
    length = max(round(stretch_s / period), 16)
    taper, starts = welch.hann(length), welch.list_starts([slice(0, inputs[0].size)], length)
    if len(starts) <= len(inputs):
        raise LogError(f"{inputs[0].size} samples are too few for windows of {length * period:g} s; use a longer log")

    def average(left: Any, right: Any) -> Any:
        """Return the averaged cross spectra of each of one side with each of the other, lines first."""
        return np.einsum("asm,bsm->mab", np.conj(left), right) / len(starts)

    u, y = (
        np.stack([welch.transform(np.stack([x[s : s + length] for s in starts]), taper)[:, 1:] for x in channels])
        for channels in (inputs, outputs)
    )
    inverse = np.linalg.pinv(average(u, u), hermitian=True)
    cross = average(u, y)
    response = inverse @ cross
    left = np.real(np.einsum("mbb->mb", average(y, y)) - np.einsum("mab,mab->mb", np.conj(cross), response))
    alone = np.abs(response) ** 2 / np.maximum(np.real(np.einsum("maa->ma", inverse)), 1e-300)[:, :, None]
    coherence = alone / np.maximum(alone + np.maximum(left, 0.0)[:, None, :], 1e-300)
    return [
        [
            FrequencyResponse(
                frequency_hz=np.fft.rfftfreq(length, period)[1:],
                response=response[:, i, o],
                coherence=coherence[:, i, o],
                averages=len(starts) - len(inputs) + 1,
            )
            for o in range(len(outputs))
        ]
        for i in range(len(inputs))
    ]


def _power(spectra: Complex[np.ndarray, "d m"]) -> Lines:
    parts = spectra.view(float)  # real and imaginary, side by side
    return np.sum(np.einsum("dm,dm->m", parts, parts).reshape(-1, 2), axis=1)
