r"""Ratios of measured Fourier coefficients, each in a disc that holds the truth at a stated confidence.

With :math:`Z_p, W_p` of P blocks, of one true ratio :math:`H = Z/W`,

.. math:: \hat H = \bar Z/\bar W, \qquad s^2 = \frac{\sum_p |Z_p - \hat H W_p|^2}{P (P-1) |\bar W|^2}, \qquad
          R(a)^2 = s^2 (P-1) \big(a^{-1/(P-1)} - 1\big) .

The blocks are periods of a run, scattered by the noise about each line (`seaopt.machine.response.periods`), or means of
periods. The error of :math:`\hat H` is complex normal, and :math:`|\hat H - H|^2 > R(a)^2` has the probability a. One
side of it, along a radius, is a t distribution of 2P - 2 degrees of freedom: :math:`x = s\,t_{1-a;\,2P-2}/\sqrt 2`.

That takes :math:`\bar W` for known, which it is not where it is below five of its own std. There the set is that of
Fieller (J. R. Stat. Soc. B 16, 1954): every H for which :math:`\bar Z - H \bar W` is no further from zero than its own
blocks allow,

.. math:: |\bar Z - H \bar W|^2 \le c \sum_p |(Z_p - \bar Z) - H (W_p - \bar W)|^2, \qquad
          c = \frac{a^{-1/(P-1)} - 1}{P},

which is a disc, or, where W may be zero, everything outside of one: then nothing is known.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Complex, Float

from seaopt.records import record

EXACT = 1e-12  # of what is divided by, of periods that are all alike
SURE = 5.0  # std of what is divided by


@record(eq=False)
class Ratio:
    """Ratios at lines, from blocks."""

    numerator: Complex[np.ndarray, "b m"]
    denominator: Complex[np.ndarray, "b m"]

    @property
    def blocks(self) -> int:
        """How many blocks there are."""
        return len(self.numerator)

    @property
    def value(self) -> Complex[np.ndarray, " m"]:
        """The ratio of the means."""
        return self.numerator.mean(axis=0) / self.denominator.mean(axis=0)

    @property
    def std(self) -> Float[np.ndarray, " m"]:
        """s: the root of the mean square of the ratio's error."""
        left = self.numerator - self.value * self.denominator
        p = self.blocks
        return np.sqrt(np.sum(np.abs(left) ** 2, axis=0) / (p * (p - 1))) / np.abs(self.denominator.mean(axis=0))

    @property
    def surety(self) -> Float[np.ndarray, " m"]:
        """How far from zero what is divided by is, over how far makes it sure; it grows with the root of the blocks."""
        mean, p = self.denominator.mean(axis=0), self.blocks
        spread = np.sqrt(np.sum(np.abs(self.denominator - mean) ** 2, axis=0) / (p * (p - 1)))
        return np.abs(mean) / np.maximum(SURE * spread, EXACT * np.abs(mean) + np.finfo(float).tiny)

    @property
    def sure(self) -> Bool[np.ndarray, " m"]:
        """Whether what is divided by is far from zero."""
        return self.surety >= 1.0

    def disc(self, alpha: float) -> tuple[Complex[np.ndarray, " m"], Float[np.ndarray, " m"]]:
        """Return centres and radii of discs, each of which misses the truth with `alpha`; infinite where nothing is
        known.
        """
        spread = np.expm1(-np.log(alpha) / (self.blocks - 1))
        centre, radius = self.value, self.std * np.sqrt((self.blocks - 1) * spread)
        sure = self.sure
        if not np.all(sure):
            fieller = self._find_fieller(spread / self.blocks)
            centre, radius = np.where(sure, centre, fieller[0]), np.where(sure, radius, fieller[1])
        return centre, radius

    def _find_fieller(self, c: float) -> tuple[Complex[np.ndarray, " m"], Float[np.ndarray, " m"]]:
        z, w = self.numerator.mean(axis=0), self.denominator.mean(axis=0)
        dz, dw = self.numerator - z, self.denominator - w
        square = np.abs(w) ** 2 - c * np.sum(np.abs(dw) ** 2, axis=0)
        cross = z * np.conj(w) - c * np.sum(dz * np.conj(dw), axis=0)
        constant = np.abs(z) ** 2 - c * np.sum(np.abs(dz) ** 2, axis=0)
        known = square > 0.0
        safe = np.where(known, square, 1.0)
        reach = np.sqrt(np.maximum(np.abs(cross / safe) ** 2 - constant / safe, 0.0))
        return np.where(known, cross / safe, self.value), np.where(known, reach, np.inf)

    def radial(self, alpha: float) -> Float[np.ndarray, " m"]:
        """Return x, the one-sided bound of the error along a radius."""
        from scipy.special import stdtrit  # deferred: 0.1 s

        return self.std * float(stdtrit(2 * self.blocks - 2, 1.0 - alpha)) / np.sqrt(2.0)
