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

They are bounded, and their harmonics have one phase together: where one decides, 95 % of the errors are not within
1.96 but within 1.41 standard deviations. `equate` has the Gaussian whose interval is theirs.

The noise s itself is told by neighbours, which what a model lacks changes little between: with c(k) the mean of
:math:`\sum_m w_m \cos(2 \pi m (y_t - y_{t-k}) / q)`, the second differences of the errors have a mean square of
:math:`6 (s^2 + q^2/12) - 8 c(1) + 2 c(2)`. A slow signal shows hardly any of it, whose readings change near an edge
alone.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Complex, Float

from seaopt.estimation.problem.shapes import ParameterMatrix, ParameterVector, Signal
from seaopt.parameters import QUANTILE
from seaopt.records import record

HARMONICS = 16  # of the sawtooth; what is above, 4 % of its power, counts as white
DITHERED = 0.5  # of a step: noise from which no harmonic is left
ORDER = np.arange(1.0, HARMONICS + 1.0)
HALVINGS = 30  # of the range that a noise or an interval is searched in
LEAST = 1e-3  # of a standard deviation, that is taken for Gaussian at least
PHASES = 256  # of the steps' place


def find_noise(step: float, residuals: Sequence[Signal], neighbours: float) -> float:
    """Return the noise before readings were rounded, whose neighbours differ as those of residuals: by so much, the
    root of a sixth of their second differences' mean square. Zero where rounding alone makes them differ so.
    """
    alike = [np.zeros(HARMONICS), np.zeros(HARMONICS)]
    for apart in (1, 2):
        turned = np.concatenate([np.exp((r[apart:] - r[:-apart]) * (2j * np.pi / step)) for r in residuals])
        turned, power = turned[np.isfinite(turned)], np.ones(1)
        for m in range(HARMONICS if turned.size else 0):
            power = power * turned
            alike[apart - 1][m] = np.mean(power.real)
    falls = (4.0 * alike[0] - alike[1]) / 3.0

    def differ(noise: float) -> float:
        return noise**2 + step**2 / 12.0 - float(weigh_harmonics(step, noise) @ falls)

    low, high = 0.0, neighbours + step
    if differ(low) >= neighbours**2:
        return 0.0
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if differ(middle) < neighbours**2 else (low, middle)
    return high


def weigh_harmonics(step: float, noise: float) -> Float[np.ndarray, " harmonics"]:
    """Return the variance of each harmonic of the errors."""
    return (step / (np.pi * ORDER)) ** 2 / 2.0 * np.exp(-((2.0 * np.pi * ORDER * noise / step) ** 2))


def equate(roundings: Sequence[Rounding], inverse: ParameterMatrix, variances: ParameterVector) -> ParameterVector:
    """Return the variances of Gaussian errors with the 95 % intervals of those that roundings make, each at any place
    of its steps. `inverse`: of the information; `variances`: of all of the errors, what is not the harmonics' being
    Gaussian.
    """
    from scipy.special import ndtr  # deferred: scipy is slow to load

    phases, moved = 2.0 * np.pi * np.arange(PHASES) / PHASES, np.zeros((PHASES, len(variances)))
    for number, each in enumerate(roundings):
        sizes = np.sqrt(2.0 * weigh_harmonics(each.step, each.noise)) * (-1.0) ** ORDER
        waves = np.imag(np.exp(1j * np.outer(phases, ORDER)) @ (sizes[:, None] * (each.sums[0] @ inverse)))
        moved += np.random.default_rng(number).permutation(waves)
    stds = np.sqrt(np.maximum(variances, 1e-300))
    left = np.sqrt(np.maximum(variances - np.mean(moved**2, axis=0), (LEAST * stds) ** 2))
    low, high = np.zeros(len(stds)), 3.0 * stds
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        inside = np.mean(ndtr((middle - moved) / left) - ndtr((-middle - moved) / left), axis=0)
        low, high = np.where(inside < 0.95, middle, low), np.where(inside < 0.95, high, middle)
    return (high / QUANTILE) ** 2


@record(eq=False)
class Rounding:
    """The rounding of one output: its step, and the noise before it, in sigma of the fit. `sums`: of influences times
    the harmonics, over all samples and over parts of them.
    """

    step: float
    noise: float
    sums: Complex[np.ndarray, "parts harmonics q"]

    @classmethod
    def of(cls, step: float, total: float, size: int, parts: int = 0) -> Rounding | None:
        """Return it for a step and a noise that has the rounding's; None where noise has made white what it does.
        `size`: how many values there are; `parts`: how many parts of the samples are looked at besides all of them.
        """
        noise = float(np.sqrt(max(total**2 - step**2 / 12.0, 0.0)))
        if not noise < DITHERED * step:
            return None
        return cls(step=step, noise=noise, sums=np.zeros((1 + parts, HARMONICS, size), dtype=complex))

    def add(
        self, influence: Float[np.ndarray, "q m"], residual: Signal, parts: Bool[np.ndarray, "parts m"] | None = None
    ) -> None:
        """Add samples: their influence, residual in sigma, and in which parts they are."""
        turned = np.exp(residual * (2j * np.pi / self.step))
        powers = np.cumprod(np.tile(turned, (HARMONICS, 1)), axis=0)
        self.sums[0] += powers @ influence.T
        for part, within in zip(self.sums[1:], () if parts is None else parts, strict=True):
            part += powers[:, within] @ influence[:, within].T

    def multiply(self, gram: ParameterMatrix) -> ParameterMatrix:
        """Return the sum over all samples of their influences times the errors' covariance; `gram`: the sum of the
        influences' own products.
        """
        weights = weigh_harmonics(self.step, self.noise)
        white = self.noise**2 + self.step**2 / 12.0 - float(np.sum(weights))
        return self._weigh(self.sums[0], weights) + white * gram

    def compare(self, part: int, inverses: Float[np.ndarray, "parts q q"]) -> ParameterVector:
        """Return the variances by which the harmonics move what one part of the samples and the others differ by, of
        which these are the inverse informations.
        """
        within = self.sums[1 + part]
        apart = within @ inverses[0] - (self.sums[0] - within) @ inverses[1]
        return np.diag(self._weigh(apart, weigh_harmonics(self.step, self.noise)))

    def _weigh(
        self, sums: Complex[np.ndarray, "harmonics q"], weights: Float[np.ndarray, " harmonics"]
    ) -> ParameterMatrix:
        return np.real(np.conj(sums.T) @ (weights[:, None] * sums))
