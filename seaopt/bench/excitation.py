"""Excitations: the paper's chirp and band-limited noise (Orekhov et al. 2015, Sec. III-A), and multisines."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from seaopt.errors import SimulationError, require_memory
from seaopt.options import option
from seaopt.records import record
from seaopt.signals import VectorN


@record
class Chirp:
    """A sine whose frequency grows exponentially from f0_hz to f1_hz over the whole duration."""

    amplitude: float = option("In the input's unit.")
    f0_hz: float = option("At the start.", unit="Hz")
    f1_hz: float = option("At the end.", unit="Hz")

    def samples(self, time: VectorN, rng: np.random.Generator) -> VectorN:
        """Return the excitation at `time`, which starts at 0."""
        if not 0.0 < self.f0_hz < self.f1_hz:
            raise SimulationError(f"chirp: f0_hz = {self.f0_hz:g}, f1_hz = {self.f1_hz:g}; 0 < f0_hz < f1_hz is needed")
        duration = time[-1] + (time[1] - time[0])
        growth = np.log(self.f1_hz / self.f0_hz)
        phase = 2 * np.pi * self.f0_hz * duration / growth * np.expm1(growth * time / duration)
        return self.amplitude * np.sin(phase)


@record
class Noise:
    """Gaussian noise, white up to band_hz and nothing above it."""

    std: float = option("Standard deviation, in the input's unit.")
    band_hz: float = option("Highest frequency.", unit="Hz")

    def samples(self, time: VectorN, rng: np.random.Generator) -> VectorN:
        """Return the excitation at `time`, drawn from `rng`."""
        if self.band_hz <= 0.0 or self.std < 0.0:
            raise SimulationError(f"noise: std = {self.std:g}, band_hz = {self.band_hz:g}; both must be positive")
        n, period = time.size, time[1] - time[0]
        spectrum = np.fft.rfft(rng.normal(size=n))
        inside = np.fft.rfftfreq(n, period) <= self.band_hz
        noise = np.fft.irfft(spectrum * inside, n)
        return self.std * noise / np.sqrt(np.mean(inside))


@record
class Multisine:
    """A sum of sines, sum_k a_k sin(2 pi f_k t + phi_k).

    Examples
    --------
    >>> import numpy as np
    >>> sine = Multisine(amplitudes=(2.0,), frequencies_hz=(1.0,))
    >>> sine.samples(np.array([0.0, 0.25, 0.5]), np.random.default_rng(0)).round(6)
    array([0., 2., 0.])
    """

    amplitudes: tuple[float, ...] = option("In the input's unit.")
    frequencies_hz: tuple[float, ...] = option(
        "One for each amplitude, positive and below half the sample rate; multiples of 1/duration make the whole log "
        "one period.",
        unit="Hz",
    )
    phases_rad: tuple[float, ...] = option("Zero for each where left out.", default=(), unit="rad")

    def __post_init__(self) -> None:
        count = len(self.amplitudes)
        if not count or len(self.frequencies_hz) != count or len(self.phases_rad) not in (0, count):
            raise SimulationError(
                f"multisine: {count} amplitudes, {len(self.frequencies_hz)} frequencies, "
                f"{len(self.phases_rad)} phases; give as many of each, phases_rad may be left out"
            )

    def samples(self, time: VectorN, rng: np.random.Generator) -> VectorN:
        """Return the excitation at `time`."""
        nyquist = 0.5 / (time[1] - time[0])
        for frequency in self.frequencies_hz:
            if not 0.0 < frequency < nyquist:
                raise SimulationError(
                    f"multisine: frequencies_hz has {frequency:g}, outside 0 to half the sample rate ({nyquist:g} Hz); "
                    "leave it out or raise the rate"
                )
        out = np.zeros(time.size)
        phases = self.phases_rad or (0.0,) * len(self.amplitudes)
        for a, f, phase in zip(self.amplitudes, self.frequencies_hz, phases, strict=True):
            out += a * np.sin(2 * np.pi * f * time + phase)
        return out


Excitation = tuple[Chirp | Noise | Multisine, ...]

# The paper's two experiments: chirp of 480.6 N (2 A) with noise of 240.3 N (1 A); noise of 841 N, which is 3.5 A
# (printed as 3 A).
PAPER_STAND: Excitation = (Chirp(amplitude=2.0, f0_hz=0.01, f1_hz=150.0), Noise(std=1.0, band_hz=150.0))
PAPER_SWING: Excitation = (Noise(std=3.5, band_hz=150.0),)


def scale(parts: Excitation, factor: float) -> Excitation:
    """Return the excitation `factor` times as large.

    Examples
    --------
    >>> scale(PAPER_STAND, 0.5)[1]
    Noise(std=0.5, band_hz=150.0)
    """
    out: list[Chirp | Noise | Multisine] = []
    for part in parts:
        if isinstance(part, Chirp):
            out.append(replace(part, amplitude=part.amplitude * factor))
        elif isinstance(part, Noise):
            out.append(replace(part, std=part.std * factor))
        else:
            out.append(replace(part, amplitudes=tuple(a * factor for a in part.amplitudes)))
    return tuple(out)


def excite(
    parts: Excitation, *, duration_s: float, rate_hz: float, rng: np.random.Generator
) -> tuple[VectorN, VectorN]:
    """Return time and the sum of the parts.

    Examples
    --------
    >>> time, current = excite(PAPER_STAND, duration_s=164, rate_hz=400, rng=np.random.default_rng(1))
    >>> time.size
    65600
    """
    require_memory(4.0 * duration_s * rate_hz, f"duration_s = {duration_s:g} at rate_hz = {rate_hz:g}", SimulationError)
    n = round(duration_s * rate_hz)
    if n < 2:
        raise SimulationError(f"duration_s = {duration_s:g} at rate_hz = {rate_hz:g} gives {n} samples; lengthen it")
    if not parts:
        raise SimulationError("excitation is empty; give a chirp, a noise, a multisine, or several")
    time = np.arange(n) / rate_hz
    return time, np.sum([part.samples(time, rng) for part in parts], axis=0)
