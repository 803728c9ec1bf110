r"""Frequency response of a log: the H1 estimate and its coherence.

Welch's averages of Hann-windowed stretches that overlap by half (Bendat and Piersol, Random Data, 4th ed., ch. 6):

.. math:: H_1 = S_{uy} / S_{uu}, \qquad \gamma^2 = |S_{uy}|^2 / (S_{uu} S_{yy}),
          \qquad \sigma_{|H_1|} / |H_1| = \sqrt{(1 - \gamma^2) / (2 \gamma^2 n_d)} .

The window spreads a line over its neighbours, in amplitude by (-1/4, 1/2, -1/4): for an input that is white nearby, H1
estimates the mean of the response over three lines, weighted by the squares (1/6, 2/3, 1/6). That bias is small where
the stretch is long against the plant's memory; models compared with H1 are spread likewise
(`FrequencyResponse.expected`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from jaxtyping import Complex, Float, Int

from seaopt.errors import LogError
from seaopt.records import record

BATCH = 1 << 20  # samples


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
        Stretches averaged.

    """

    frequency_hz: Float[np.ndarray, " m"]
    response: Complex[np.ndarray, " m"]
    coherence: Float[np.ndarray, " m"]
    averages: int

    @property
    def relative_std(self) -> Float[np.ndarray, " m"]:
        """Relative standard deviation of abs(H1); overlapping neighbours count as 0.947 averages (Welch 1967, Hann)."""
        effective = max(1.0, 0.947 * self.averages)
        gamma = np.clip(self.coherence, 1e-6, 1.0)
        return np.sqrt((1.0 - gamma) / (2.0 * gamma * effective))

    def expected(self, response: Callable[[Any], Any]) -> Complex[np.ndarray, "m ..."]:
        """Return what H1 is on average where the plant's response is `response`, a function of frequencies in Hz.

        The first line, beside the mean that every stretch is rid of, is not corrected.
        """
        f = self.frequency_hz
        line = f[1] - f[0]
        everywhere = response(np.concatenate([f, f[1:] - line, f[1:] + line]))
        centre, below, above = np.split(everywhere, [f.size, 2 * f.size - 1])
        return np.concatenate([centre[:1], centre[1:] / 1.5 + (below + above) / 6.0])


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
        Length of a stretch, which sets the resolution 1/stretch_s; a sixteenth of the record if left out.

    Raises
    ------
    LogError
        The record is shorter than two stretches or 32 samples, or the input is constant.

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
    u: Float[np.ndarray, " n"], outputs: Sequence[Float[np.ndarray, " n"]], period: float, *,
    stretch_s: float | None = None, rough: bool = False,
) -> list[FrequencyResponse]:  # fmt: skip
    """Estimate the frequency responses from u to several outputs: `h1`, with the spectra of u made once.

    A rough estimate is made in single precision, in half the time.
    """
    n = u.size
    if stretch_s is not None and not 0.0 < stretch_s < n * period:
        raise LogError(f"stretch_s = {stretch_s:g} is not within the log of {n * period:g} s; give a shorter one")
    length = int(n / 16) if stretch_s is None else round(stretch_s / period)
    length = max(length, 16)
    if n < 2 * length:
        raise LogError(f"{n} samples are too few for stretches of {length * period:g} s; use a longer log")
    if np.ptp(u) == 0.0:
        raise LogError("the input is constant; a frequency response needs excitation")
    starts = np.arange(0, n - length + 1, length // 2)
    window, scale = np.hanning(length), [1.0] * (1 + len(outputs))
    if rough:
        scale = [float(np.ptp(channel)) or 1.0 for channel in (u, *outputs)]
        window = window.astype(np.float32)
        u, *outputs = (((x - x[0]) / size).astype(np.float32) for x, size in zip((u, *outputs), scale, strict=True))
    suu, syy = np.zeros(length // 2), np.zeros((len(outputs), length // 2))
    suy = np.zeros(syy.shape, dtype=complex)
    for batch in np.array_split(starts, -(-starts.size * length // BATCH)):  # long logs in the memory of a batch
        uf = _spectra(u, batch, window)
        suu += _power(uf) / starts.size
        against = np.conj(uf)
        for o, y in enumerate(outputs):
            yf = _spectra(y, batch, window)
            syy[o] += _power(yf) / starts.size
            suy[o] += np.sum(against * yf, axis=0) / starts.size
    frequency, floor = np.fft.rfftfreq(length, period)[1:], 1e-300
    return [
        FrequencyResponse(
            frequency_hz=frequency,
            response=cross / np.maximum(suu, floor) * (size / scale[0]),
            coherence=_square(cross) / np.maximum(suu * power, floor),
            averages=int(starts.size),
        )
        for cross, power, size in zip(suy, syy, scale[1:], strict=True)
    ]


def _square(values: Complex[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
    """Return |values|^2; np.abs takes a root first."""
    return np.real(values) ** 2 + np.imag(values) ** 2


def _power(spectra: Complex[np.ndarray, "d m"]) -> Float[np.ndarray, " m"]:
    parts = spectra.view(np.real(spectra).dtype)  # real and imaginary, side by side
    return np.sum(np.einsum("dm,dm->m", parts, parts).reshape(-1, 2), axis=1)


def _spectra(
    values: Float[np.ndarray, " n"], starts: Int[np.ndarray, " d"], window: Float[np.ndarray, " length"]
) -> Complex[np.ndarray, "d m"]:
    """Return the spectra above zero of windowed stretches without their means, in the window's precision."""
    from scipy.fft import rfft  # deferred: scipy is slow to load

    pieces = np.stack([values[start : start + window.size] for start in starts], dtype=window.dtype)
    pieces -= pieces.mean(axis=1, keepdims=True)
    pieces *= window  # in place: fresh memory costs more than the transform
    return np.asarray(rfft(pieces, axis=1))[:, 1:]
