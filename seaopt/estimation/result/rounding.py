r"""What a coarse sensor's rounding moves estimates by: its errors follow the signal, and are not white.

A reading that is rounded to steps q is off by a sawtooth of the signal y, whose phase, where the steps lie, is as good
as random. Its Fourier series gives the covariance of the errors of two samples,

.. math:: \operatorname{cov}(e_t, e_s) = \sum_m w_m \cos\big(2 \pi m (y_t - y_s) / q\big), \qquad
          w_m = \frac{q^2}{2 \pi^2 m^2} e^{-(2 \pi m s / q)^2}

with Gaussian noise of std s before the rounding, which adds what is left of :math:`s^2 + q^2/12` to each sample's own
variance (Widrow and Kollar, Quantization Noise, 2008, chs. 4 and 9). So estimates whose influences are :math:`a_t` vary
by :math:`\sum_m w_m |\sum_t a_t e^{2 \pi i m y_t / q}|^2`, in one pass. Readings are whole steps apart, and of y the
model's residual remains: :math:`y_t \equiv r_t`.

A joint at rest has one error all the while, and an encoder that sees a few steps of a slow swing has one that scales
with it. White errors, or those of a time correlation, would give a tenth of the interval.
"""

from __future__ import annotations

from dataclasses import field

import numpy as np
from jaxtyping import Complex, Float

from seaopt.estimation.problem.shapes import ParameterMatrix, Signal
from seaopt.records import record

HARMONICS = 16  # of the sawtooth; what is above, 4 % of its power, counts as white
DITHERED = 0.5  # of a step: noise from which no harmonic is left
ORDER = np.arange(1.0, HARMONICS + 1.0)


@record(eq=False)
class Rounding:
    """The rounding of one output: its step, and the noise before it, in sigma of the fit."""

    step: float
    noise: float
    sums: Complex[np.ndarray, "harmonics q"] = field(default_factory=lambda: np.zeros((HARMONICS, 0), dtype=complex))

    @classmethod
    def of(cls, step: float, total: float, size: int) -> Rounding | None:
        """Return it for a step and a noise that has the rounding's; None where noise has made white what it does."""
        noise = float(np.sqrt(max(total**2 - step**2 / 12.0, 0.0)))
        if not noise < DITHERED * step:
            return None
        return cls(step=step, noise=noise, sums=np.zeros((HARMONICS, size), dtype=complex))

    def add(self, influence: Float[np.ndarray, "q m"], residual: Signal) -> None:
        """Add samples: their influence, and residual in sigma."""
        turned = np.exp(residual * (2j * np.pi / self.step))
        self.sums[:] += np.cumprod(np.tile(turned, (HARMONICS, 1)), axis=0) @ influence.T

    def multiply(self, gram: ParameterMatrix) -> ParameterMatrix:
        """Return the sum over all samples of their influences times the errors' covariance; `gram`: the sum of the
        influences' own products.
        """
        weights = (self.step / (np.pi * ORDER)) ** 2 / 2.0
        weights *= np.exp(-((2.0 * np.pi * ORDER * self.noise / self.step) ** 2))
        white = self.noise**2 + self.step**2 / 12.0 - float(np.sum(weights))
        return np.real(np.conj(self.sums.T) @ (weights[:, None] * self.sums)) + white * gram
