r"""Correlations of a residual: with itself, and with an input.

The residual of a right model follows no input. Its correlation with each is compared with what chance would give
(Ljung, System Identification, 2nd ed., sec. 16.6): for N samples

.. math:: \hat R_{eu}(\tau) = \frac1N \sum_t e(t)\, u(t - \tau), \qquad
          \operatorname{var} \hat R_{eu}(\tau) = \frac1N \sum_k R_e(k)\, R_u(k),

at any lag, for any input and a residual of any colour. R_u is the input's own; R_e is estimated
under a Parzen window. Lags above zero show dynamics that the model lacks, lags below feedback, or of an input that was
logged late.
"""

from __future__ import annotations

import math
from functools import cache, reduce

import numpy as np
from jaxtyping import Float, Int

from seaopt.estimation.problem.chance import exceeds
from seaopt.estimation.problem.shapes import Parts, Signal
from seaopt.records import record

INPUT_LAGS = 25
QUANTILE = 2.5758293  # of the standard normal, 99 % two-sided


@record(eq=False)
class CrossCorrelation:
    """The correlation of a residual with an input."""

    json_keys = ("lags", "values", "bound", "p", "worst_lag", "outside")

    lags: Signal  # the residual is compared with the input so many samples before
    values: Signal  # correlation, -1 to 1
    bound: float  # what chance exceeds at one lag with a probability of 1 %
    p: float  # probability that chance exceeds the largest value at some lag (Bonferroni's bound)

    @property
    def worst_lag(self) -> int:
        """Lag of the largest correlation."""
        return int(self.lags[int(np.argmax(np.abs(self.values)))])

    @property
    def worst(self) -> float:
        """Largest correlation over its bound."""
        return float(np.max(np.abs(self.values))) / self.bound

    @property
    def outside(self) -> bool:
        """Whether the largest correlation is outside the bound."""
        return self.worst > 1.0


@cache
def _list_quick() -> Int[np.ndarray, " sizes"]:
    """Return the numbers without a prime factor above 5: transforms of such lengths are quick."""
    powers = (base ** np.arange(count) for base, count in ((2.0, 31), (3.0, 20), (5.0, 14)))
    sizes = reduce(np.multiply.outer, powers).ravel()
    return np.sort(sizes[sizes < 2.0**31]).astype(int)


def find_quick_size(samples: int) -> int:
    """Return the least length of quick transforms of so many samples or more."""
    return int(_list_quick()[np.searchsorted(_list_quick(), samples)])


def find_quick_size_within(samples: int) -> int:
    """Return the largest length of quick transforms of so many samples or fewer, of at least one."""
    return int(_list_quick()[np.searchsorted(_list_quick(), max(samples, 1), side="right") - 1])


class LaggedSums:
    """Sums over t of x_a(t) x_b(t - k), k = 0..lags, of parts of at most `longest` samples, added one by one."""

    def __init__(self, rows: int, longest: int, lags: int) -> None:
        self.lags, self.size = lags, find_quick_size(longest + lags)
        lines = self.size // 2 + 1
        self.power = np.zeros((rows, 2 * lines))  # squares of real and imaginary parts, side by side
        self.cross = {(a, b): np.zeros(lines, dtype=complex) for a in range(rows) for b in range(a)}

    def add(self, x: Float[np.ndarray, "rows n"]) -> None:
        """Add a part."""
        spectrum = np.fft.rfft(x, self.size)
        self.power += np.square(spectrum.view(float))
        for (a, b), total in self.cross.items():
            total += spectrum[a] * np.conj(spectrum[b])

    def sums(self) -> Float[np.ndarray, "lags1 rows rows"]:
        """Return the sums by lag."""
        rows, count = len(self.power), self.lags + 1
        sums = np.empty((count, rows, rows))
        power = np.sum(self.power.reshape(rows, -1, 2), axis=2)
        for a, auto in enumerate(np.fft.irfft(power, self.size)):
            sums[:, a, a] = auto[:count]
        for (a, b), total in self.cross.items():
            both = np.fft.irfft(total, self.size)
            sums[:, a, b] = both[:count]
            sums[0, b, a], sums[1:, b, a] = both[0], both[:-count:-1]
        return sums


def parzen(reach: int) -> Float[np.ndarray, " reach1"]:
    """Return Parzen's lag window at lags 0 to `reach`, where it ends; its spectrum is nowhere negative."""
    x = np.arange(reach + 1) / max(reach, 1)
    return np.where(x <= 0.5, 1 - 6 * x**2 * (1 - x), 2 * (1 - x) ** 3)


def autocorrelation(r: Signal, lags: int) -> Float[np.ndarray, " lags1"]:
    """Return the autocorrelation of a residual at lags 0 to `lags`; zero where there is no power."""
    size = find_quick_size(len(r) + lags + 1)
    used = r != 0.0
    centred = np.where(used, r - (r[used].mean() if np.any(used) else 0.0), 0.0)
    sums = np.fft.irfft(np.abs(np.fft.rfft(centred, size)) ** 2, size)[: lags + 1]
    return sums / sums[0] if sums[0] > 0.0 else np.zeros(lags + 1)


def cross_correlation(residuals: Parts, inputs: Parts, lags: int = INPUT_LAGS) -> CrossCorrelation | None:
    """Return the correlation of a residual with an input (zero residuals do not count); None if either is still."""
    used = [r != 0.0 for r in residuals]
    count = sum(int(np.sum(mask)) for mask in used)
    if count < 2 * lags:
        return None
    mean_e = sum(float(np.sum(r)) for r in residuals) / count
    mean_u = float(np.mean(np.concatenate([u[mask] for u, mask in zip(inputs, used, strict=True)])))
    longest = max(len(r) for r in residuals)
    long = int(min(max(32, 4 * np.sqrt(longest)), longest - 1))
    cross, own_e, own_u = np.zeros(2 * lags + 1), np.zeros(long + 1), np.zeros(long + 1)
    for r, u, mask in zip(residuals, inputs, used, strict=True):
        e, v = np.where(mask, r - mean_e, 0.0), u - mean_u
        cross += _products(e, v, lags) / count
        own_e += _products(e, e, long)[long:] / count
        own_u += _products(v * mask, v * mask, long)[long:] / count
    if own_e[0] <= 0.0 or own_u[0] <= 1e-24 * max(mean_u**2, 1e-300):
        return None
    own_e *= parzen(long)
    variance = (own_e[0] * own_u[0] + 2.0 * float(own_e[1:] @ own_u[1:])) / count
    size = float(np.sqrt(own_e[0] * own_u[0]))
    deviation = float(np.sqrt(max(variance, 1e-12 * own_e[0] * own_u[0] / count)))
    worst = float(np.max(np.abs(cross))) / deviation
    return CrossCorrelation(
        lags=np.arange(-lags, lags + 1.0),
        values=cross / size,
        bound=QUANTILE * deviation / size,
        p=min(cross.size * math.erfc(worst / math.sqrt(2.0)), 1.0),
    )


def _products(a: Signal, b: Signal, lags: int) -> Float[np.ndarray, " m"]:
    """Return the sums over t of a(t) b(t - k), k = -lags..lags."""
    size = find_quick_size(len(a) + lags + 1)
    whole = np.fft.irfft(np.fft.rfft(a, size) * np.conj(np.fft.rfft(b, size)), size)
    return np.concatenate([whole[-lags:], whole[: lags + 1]]) if lags else whole[:1]


def ljung_box(rho: Float[np.ndarray, " lags"], n: float) -> float:
    """Return the p-value of the Ljung-Box test (1978) that correlations at lags 1, 2, ... of n samples are chance."""
    statistic = n * (n + 2) * float(np.sum(rho**2 / (n - np.arange(1, rho.size + 1))))
    return exceeds(rho.size / 2, statistic / 2)
