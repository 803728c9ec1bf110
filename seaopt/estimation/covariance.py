r"""Covariance of a fit, honest for coloured residuals, and what the data cannot tell.

With residuals and derivatives in units of sigma, :math:`H = J^T J + P` (P from the priors), the covariance for white
residuals is :math:`H^{-1}`. Residuals of a real log are coloured; then

.. math:: \Sigma = H^{-1} (B + P) H^{-1}, \qquad B = \sum_{t,s} J_t^T\, R(t - s)\, J_s

with R the correlation of the residuals of all outputs, at all lags (Ljung, System Identification, 2nd ed., Sec. 9.5;
Newey and West 1987). R is estimated from the residuals under a Parzen window, whose spectral matrix is never
indefinite, and the double sum is done in the frequency domain. With Huber's loss the residuals in B are clipped, and
J^T J counts only those that are not (Huber, Robust Statistics, 1981, ch. 7).
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


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Sandwich:
    """B and J^T J (without priors) at the minimum, and the whiteness p-value of each experiment's outputs."""

    meat: Float[np.ndarray, "n n"]
    bread: Float[np.ndarray, "n n"]
    whiteness: list[list[float]]


def sandwich(problem: Residuals, z: Float[np.ndarray, " n"]) -> Sandwich:
    """Return the parts of the covariance of the module docstring."""
    n = z.size
    meat, bread = np.zeros((n, n)), np.zeros((n, n))
    whiteness: list[list[float]] = []
    for e, pieces in enumerate(problem.segments):
        weights, sigma = problem.weights(e), problem.sigma[e]
        row = [1.0] * len(sigma)
        for s in range(len(pieces)):
            columns = problem.run(e, s, z, columns=True).columns
            assert columns is not None
            present = counted(problem, e, s, weights.settle)
            residual = columns[:, :, 0] / sigma * present
            knee = weights.knee / sigma
            jacobians: list[Float[np.ndarray, "m n"]] = []
            for o in range(len(sigma)):
                j = np.zeros((residual.shape[0], n))
                for column, k in enumerate(problem.columns_of(e, s, o), start=1):
                    if k is not None:
                        j[:, k] = columns[:, o, column] / sigma[o] * present[:, o]
                jacobians.append(j)
                inside = j[np.abs(residual[:, o]) <= knee[o]]
                bread += inside.T @ inside
                used = present[:, o] > 0.0
                if np.count_nonzero(used) >= 8:
                    row[o] = min(row[o], ljung_box(residual[used, o]))
            if residual.shape[0] >= 8:
                meat += coloured_gram(jacobians, np.clip(residual, -knee, knee))
        whiteness.append(row)
    return Sandwich(meat=meat, bread=bread, whiteness=whiteness)


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


def coloured_gram(j: list[Float[np.ndarray, "n p"]], r: Float[np.ndarray, "n ny"]) -> Float[np.ndarray, "p p"]:
    """Return the sum over outputs a, b and times t, s of J_a(t) R_ab(t - s) J_b(s)'.

    Parameters
    ----------
    j : list of ny arrays, shape (n, p)
        Derivatives of each output's residuals.
    r : array, shape (n, ny)
        Residuals; zero where missing.

    """
    n, ny = r.shape
    lags = int(min(max(32, 4 * np.sqrt(n)), n // 4))
    x = np.arange(lags + 1) / lags
    parzen = np.where(x <= 0.5, 1 - 6 * x**2 * (1 - x), 2 * (1 - x) ** 3)
    size = 1 << int(np.ceil(np.log2(n + lags + 1)))
    window = np.zeros(size)
    window[: lags + 1], window[size - lags :] = parzen, parzen[1:][::-1]
    counted_samples = np.maximum(np.count_nonzero(r, axis=0), 1)
    rf = np.fft.rfft(r, size, axis=0)
    half = np.full(rf.shape[0], 2.0)
    half[0] = half[-1] = 1.0
    jf = [np.fft.rfft(item, size, axis=0) for item in j]
    total = np.zeros((j[0].shape[1],) * 2)
    for a in range(ny):
        for b in range(ny):
            correlation = np.fft.irfft(rf[:, a] * np.conj(rf[:, b]), size) * window
            density = np.fft.rfft(correlation) / np.sqrt(counted_samples[a] * counted_samples[b])
            total += (jf[a].conj().T @ (jf[b] * (density * half / size)[:, None])).real
    return 0.5 * (total + total.T)


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
    bread: Float[np.ndarray, "n n"], meat: Float[np.ndarray, "n n"], prior: Float[np.ndarray, " n"]
) -> Float[np.ndarray, "n n"]:
    """Return H^-1 (B + P) H^-1 with H = bread + P, over what is seen; the rest has infinite variance.

    Bounds are not taken into account: the value of a parameter on its bound has the variance that the curvature there
    gives it, to be truncated at the bound.
    """
    hessian = bread + np.diag(prior)
    scale = np.sqrt(np.maximum(np.diag(hessian), 1e-300))
    values, vectors = np.linalg.eigh(hessian / np.outer(scale, scale))
    seen = values > RANK * max(values[-1], 1e-300)
    inverse = (vectors[:, seen] / values[seen]) @ vectors[:, seen].T / np.outer(scale, scale)
    covariance = inverse @ (meat + np.diag(prior)) @ inverse
    lost = np.sum(vectors[:, ~seen] ** 2, axis=1) > 1e-8
    covariance[lost, :] = covariance[:, lost] = np.inf
    return covariance


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
