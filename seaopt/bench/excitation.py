"""Excitations: the paper's logarithmic chirp and band-limited noise (Orekhov et al. 2015, Sec. III-A)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from seaopt.errors import SimulationError


@dataclass(frozen=True, slots=True, kw_only=True)
class Chirp:
    """A sine whose frequency grows exponentially from f0_hz to f1_hz over the whole duration.

    Parameters
    ----------
    amplitude : float
        In the input's unit (A).
    f0_hz, f1_hz : float
        First and last frequency.

    """

    amplitude: float
    f0_hz: float
    f1_hz: float

    def samples(self, time: Float[np.ndarray, " n"], rng: np.random.Generator) -> Float[np.ndarray, " n"]:
        """Return the excitation at `time`, which starts at 0."""
        if not 0.0 < self.f0_hz < self.f1_hz:
            raise SimulationError(f"chirp: f0_hz = {self.f0_hz:g}, f1_hz = {self.f1_hz:g}; 0 < f0_hz < f1_hz is needed")
        duration = time[-1] + (time[1] - time[0])
        growth = np.log(self.f1_hz / self.f0_hz)
        phase = 2 * np.pi * self.f0_hz * duration / growth * np.expm1(growth * time / duration)
        return self.amplitude * np.sin(phase)


@dataclass(frozen=True, slots=True, kw_only=True)
class Noise:
    """Gaussian noise, white up to band_hz and nothing above it.

    Parameters
    ----------
    std : float
        Standard deviation, in the input's unit (A).
    band_hz : float
        Highest frequency.

    """

    std: float
    band_hz: float

    def samples(self, time: Float[np.ndarray, " n"], rng: np.random.Generator) -> Float[np.ndarray, " n"]:
        """Return the excitation at `time`, drawn from `rng`."""
        if self.band_hz <= 0.0 or self.std < 0.0:
            raise SimulationError(f"noise: std = {self.std:g}, band_hz = {self.band_hz:g}; both must be positive")
        n, period = time.size, time[1] - time[0]
        spectrum = np.fft.rfft(rng.normal(size=n))
        inside = np.fft.rfftfreq(n, period) <= self.band_hz
        noise = np.fft.irfft(spectrum * inside, n)
        return self.std * noise / np.sqrt(np.mean(inside))


Excitation = tuple[Chirp | Noise, ...]

# The paper's two experiments: chirp of 480.6 N (2 A) with noise of 240.3 N (1 A); noise of 841 N, which is 3.5 A
# (printed as 3 A).
PAPER_STAND: Excitation = (Chirp(amplitude=2.0, f0_hz=0.01, f1_hz=150.0), Noise(std=1.0, band_hz=150.0))
PAPER_SWING: Excitation = (Noise(std=3.5, band_hz=150.0),)


def excite(
    parts: Excitation, *, duration_s: float, rate_hz: float, rng: np.random.Generator
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Return time and the sum of the parts.

    Examples
    --------
    >>> time, current = excite(PAPER_STAND, duration_s=164, rate_hz=400, rng=np.random.default_rng(1))
    >>> time.size
    65600

    """
    n = round(duration_s * rate_hz)
    if n < 2:
        raise SimulationError(f"duration_s = {duration_s:g} at rate_hz = {rate_hz:g} gives {n} samples; lengthen it")
    if not parts:
        raise SimulationError("excitation is empty; give a chirp, a noise, or both")
    time = np.arange(n) / rate_hz
    return time, np.sum([part.samples(time, rng) for part in parts], axis=0)
