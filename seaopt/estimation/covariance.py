r"""Covariance of a fit, honest for coloured residuals, and what the data cannot tell.

With residuals and derivatives in units of sigma, :math:`H = J^T J + P` (P from the priors), the covariance for white
residuals is :math:`H^{-1}`. Residuals of a real log are coloured; then

.. math:: \Sigma = H^{-1} (B + P) H^{-1}, \qquad B = \sum_{t,s} J_t^T\, R(t - s)\, J_s

with R the residuals' autocorrelation (Ljung, System Identification, 2nd ed., Sec. 9.5; Newey and West 1987). R is
estimated from the residuals under a Parzen window, whose spectrum is never negative, so that B is never indefinite,
and the double sum is done in the frequency domain.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from seaopt.estimation.residuals import Residuals

RANK = 1e-10  # eigenvalues of the normalised Hessian below this part of the largest are zero


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Covariance:
    """A covariance with names: ``matrix[i, j]`` belongs to ``names[i]``, ``names[j]``, in SI."""

    names: tuple[str, ...]
    matrix: Float[np.ndarray, "p p"]

    def std(self, name: str) -> float:
        """Return the standard deviation of one parameter."""
        i = self.names.index(name)
        return float(np.sqrt(max(self.matrix[i, i], 0.0)))


@dataclass(frozen=True, slots=True, kw_only=True)
class Identifiability:
    """What the data tell of the free parameters.

    Parameters
    ----------
    rank, free : int
        Directions seen in the data (and priors), and free parameters.
    condition : float
        Ratio of the largest to the smallest singular value of the normalised sensitivities.
    unidentifiable : tuple of mappings
        One a direction that is not seen: relative changes {NAME: weight} that leave every output as it is.

    """

    rank: int
    free: int
    condition: float
    unidentifiable: tuple[dict[str, float], ...]


def meat(problem: Residuals, z: Float[np.ndarray, " n"]) -> tuple[Float[np.ndarray, "n n"], list[list[float]]]:
    """Return B of the module docstring, and the whiteness p-value of each experiment's outputs."""
    n = z.size
    total = np.zeros((n, n))
    whiteness: list[list[float]] = []
    for e, pieces in enumerate(problem.segments):
        weights, row = problem.weights(e), [1.0] * len(problem.sigma[e])
        for s in range(len(pieces)):
            columns = problem.run(e, s, z, columns=True).columns
            assert columns is not None
            present = counted(problem, e, s, weights.settle)
            for o, sigma in enumerate(problem.sigma[e]):
                v = columns[:, o] / sigma * present[:, o][:, None]
                if np.count_nonzero(present[:, o]) < 8:
                    continue
                if np.isfinite(weights.knee[o]):
                    v[:, 0] = np.clip(v[:, 0], -weights.knee[o] / sigma, weights.knee[o] / sigma)
                index = problem.columns_of(e, s, o)
                kept = [i for i, k in enumerate(index) if k is not None]
                place = [k for k in index if k is not None]
                total[np.ix_(place, place)] += coloured_gram(v[:, 1:][:, kept], v[:, 0])
                row[o] = min(row[o], ljung_box(v[present[:, o] > 0.0, 0]))
        whiteness.append(row)
    return total, whiteness


def counted(problem: Residuals, e: int, s: int, settle: int) -> Float[np.ndarray, "n ny"]:
    """Return 1 for each sample that takes part in the cost, 0 for the others."""
    segment = problem.segments[e][s]
    assert segment.y is not None
    present = np.isfinite(segment.y).astype(float)
    if segment.keep is not None:
        present *= segment.keep
    present[:settle] = 0.0
    return present


def autocorrelation(r: Float[np.ndarray, " n"], lags: int) -> Float[np.ndarray, " m"]:
    """Return sum_t r_t r_(t+k) / n for k = 0..lags."""
    size = 1 << int(np.ceil(np.log2(r.size + lags + 1)))
    spectrum = np.abs(np.fft.rfft(r, size)) ** 2
    return np.fft.irfft(spectrum, size)[: lags + 1] / r.size


def coloured_gram(j: Float[np.ndarray, "n p"], r: Float[np.ndarray, " n"]) -> Float[np.ndarray, "p p"]:
    """Return sum over t, s of J_t R(t - s) J_s', with R estimated from r under a Parzen window."""
    n = r.size
    lags = int(min(max(32, 4 * np.sqrt(n)), n // 4))
    counted = max(np.count_nonzero(r), 1)
    r_of = autocorrelation(r, lags) * (n / counted)
    x = np.arange(lags + 1) / lags
    parzen = np.where(x <= 0.5, 1 - 6 * x**2 * (1 - x), 2 * (1 - x) ** 3)
    size = 1 << int(np.ceil(np.log2(n + lags + 1)))
    kernel = np.zeros(size)
    kernel[: lags + 1] = r_of * parzen
    kernel[size - lags :] = (r_of * parzen)[1:][::-1]
    density = np.maximum(np.fft.rfft(kernel).real, 0.0)
    weight = np.full(density.size, 2.0)
    weight[0] = weight[-1] = 1.0
    jf = np.fft.rfft(j, size, axis=0)
    scaled = jf * np.sqrt(density * weight / size)[:, None]
    return (scaled.conj().T @ scaled).real


def ljung_box(r: Float[np.ndarray, " n"], lags: int = 20) -> float:
    """Return the p-value of the Ljung-Box test that r is white (Biometrika 65, 1978)."""
    from scipy.special import gammaincc  # deferred: scipy.stats takes a second

    n = r.size
    lags = min(lags, n // 5)
    centred = r - r.mean()
    r_of = autocorrelation(centred, lags)
    if lags < 1 or r_of[0] <= 0.0:
        return 1.0
    rho = r_of[1:] / r_of[0]
    statistic = n * (n + 2) * float(np.sum(rho**2 / (n - np.arange(1, lags + 1))))
    return float(gammaincc(lags / 2, statistic / 2))


def posterior(
    hessian: Float[np.ndarray, "n n"], b: Float[np.ndarray, "n n"], prior: Float[np.ndarray, " n"],
    held: Float[np.ndarray, " n"],
) -> Float[np.ndarray, "n n"]:  # fmt: skip
    """Return H^-1 (B + P) H^-1 over what is seen and not `held` on a bound; the rest has infinite variance.

    An unknown that takes part in an unseen direction has no finite variance; one held on its bound has none to give
    (NaN).
    """
    n = hessian.shape[0]
    free = np.flatnonzero(held == 0.0)
    out = np.full((n, n), np.nan)
    scale = np.sqrt(np.maximum(np.diag(hessian)[free], 1e-300))
    values, vectors = np.linalg.eigh(hessian[np.ix_(free, free)] / np.outer(scale, scale))
    seen = values > RANK * max(values[-1], 1e-300)
    inverse = (vectors[:, seen] / values[seen]) @ vectors[:, seen].T / np.outer(scale, scale)
    inner = b[np.ix_(free, free)] + np.diag(prior[free])
    covariance = inverse @ inner @ inverse
    lost = np.sum(vectors[:, ~seen] ** 2, axis=1) > 1e-8
    covariance[lost, :] = covariance[:, lost] = np.inf
    out[np.ix_(free, free)] = covariance
    return out


def identifiability(
    hessian: Float[np.ndarray, "n n"], names: tuple[str, ...], values: Float[np.ndarray, " p"]
) -> Identifiability:
    """Return what the normalised Hessian says of the first ``len(names)`` unknowns, the others eliminated.

    `values` are the unknowns' own, to which changes along an unseen direction are relative.
    """
    p = len(names)
    reduced = hessian[:p, :p].copy()
    if hessian.shape[0] > p:
        rest = hessian[p:, p:]
        scale = np.sqrt(np.maximum(np.diag(rest), 1e-300))
        inverse = np.linalg.pinv(rest / np.outer(scale, scale), rcond=1e-10, hermitian=True) / np.outer(scale, scale)
        reduced -= hessian[:p, p:] @ inverse @ hessian[p:, :p]
    own = np.diag(hessian)[:p]
    size = np.sqrt(np.where(own > 0.0, own, 1.0))
    eigenvalues, vectors = np.linalg.eigh(reduced / np.outer(size, size))
    largest = max(float(eigenvalues[-1]), 1e-300)
    unseen = np.flatnonzero(eigenvalues <= RANK * largest)
    smallest = max(float(eigenvalues[0]), 0.0)
    relative = size * np.where(values != 0.0, np.abs(values), 1.0)
    directions: list[dict[str, float]] = []
    for k in unseen:
        weights = vectors[:, k] / relative
        weights = weights / np.max(np.abs(weights))
        directions.append({name: float(w) for name, w in zip(names, weights, strict=True) if abs(w) > 1e-3})
    return Identifiability(
        rank=p - unseen.size,
        free=p,
        condition=float(np.sqrt(largest / smallest)) if smallest > RANK * largest else np.inf,
        unidentifiable=tuple(directions),
    )
