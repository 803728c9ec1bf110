r"""Covariance of a fit, honest for coloured residuals.

With residuals and derivatives in units of sigma, :math:`H = J^T J + P` (P from the priors), the covariance for white
residuals is :math:`H^{-1}`. Residuals of a real log are coloured; then

.. math:: \Sigma = H^{-1} (B + P) H^{-1}, \qquad B = \sum_{t,s} J_t^T\, R(t - s)\, J_s

with R the correlation of the residuals of all outputs, at all lags (Ljung, System Identification, 2nd ed., Sec. 9.5;
Newey and West 1987). R is estimated from the residuals under a Parzen window, whose spectral matrix is never
indefinite. With a robust loss the residuals in B are what the loss makes of them, and J^T J counts each sample with the
loss's second derivative (Huber, Robust Statistics, 1981, ch. 7).

Only the parameters' part of :math:`\Sigma` is wanted, so that the double sum is over the influence of each sample on
them, :math:`a_t = J_t H^{-1} E`, with as many columns as parameters. R of a few thousand lags acts on it as a filter,
in the frequency domain (overlap-save), chunk by chunk: memory does not grow with the log.
Long sums are NumPy's own, not the linear-algebra library's, whose threads cost more than such sums on a busy machine.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from seaopt.estimation.correlation import parzen, transforms
from seaopt.estimation.leftover import Leftover, column_chunks
from seaopt.estimation.losses import curvature_of
from seaopt.estimation.normal import add_gram
from seaopt.estimation.residuals import Residuals

CHANCE = 2.0  # correlations above CHANCE sqrt(log10(n) / n) are told from chance
LEAST, WIDER = 8, 3.0  # shortest window, and its reach over the last lag that is told from chance


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Covariance:
    """A covariance with names: ``matrix[i, j]`` belongs to ``names[i]``, ``names[j]``, in SI."""

    names: tuple[str, ...]
    matrix: Float[np.ndarray, "p p"]

    def std(self, name: str) -> float:
        """Return the standard deviation of one parameter."""
        i = self.names.index(name)
        return float(np.sqrt(max(self.matrix[i, i], 0.0)))


def robust_bread(problem: Residuals, z: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n n"]:
    """Return J^T J with the loss's second derivative as weight."""
    normal = np.zeros((1 + z.size, 1 + z.size))
    for e, pieces in enumerate(problem.segments):
        for s in range(len(pieces)):
            for _, columns, used in column_chunks(problem, e, s, z):
                for o, places in enumerate(problem.columns(e, s)):
                    v = columns[:, o] / problem.sigma[e][o]
                    weight = used[:, o] * curvature_of(problem.loss, v[:, 0])
                    add_gram(normal, (v * weight[:, None]).T @ v, places)
    return normal[1:, 1:]


def coloured(
    problem: Residuals, z: Float[np.ndarray, " n"], inverse: Float[np.ndarray, "n p"], left: list[Leftover]
) -> Float[np.ndarray, "p p"]:
    """Return E^T H^-1 B H^-1 E of the module docstring, with `inverse` = H^-1 E."""
    p = inverse.shape[1]
    total = np.zeros((p, p))
    for e, (pieces, sums) in enumerate(zip(problem.segments, left, strict=True)):
        density, ny = correlations(sums), len(problem.sigma[e])
        for s in range(len(pieces)):
            tail = np.zeros((ny, p, density.shape[0] - 1))
            for _, columns, used in column_chunks(problem, e, s, z):
                influence = np.empty((ny, p, len(columns)))
                for o, places in enumerate(problem.columns(e, s)):
                    chosen = np.flatnonzero(places >= 0)
                    weights = inverse[places[chosen]] / problem.sigma[e][o]
                    np.einsum("tc,cp->pt", columns[:, o, 1 + chosen], weights, out=influence[o])
                if not np.all(used):
                    influence *= used.T[:, None, :]
                total += _coloured_part(influence, tail, density)
                tail = np.concatenate([tail, influence], axis=2)[:, :, influence.shape[2] :]
    return total


def correlations(left: Leftover) -> Float[np.ndarray, "lags1 ny ny"]:
    """Return R(k)[a, b] = correlation of r_a(t) with r_b(t - k), k = 0..lags, under a Parzen window.

    The window reaches three times as far as correlation can be told from chance (after Politis, J. Nonparametric
    Statistics 15, 2003): a longer one would let noise in, which makes intervals too narrow.
    """
    count = np.maximum(left.count, 1.0)
    found = left.correlation.transpose(1, 2, 0) / np.sqrt(np.outer(count, count))[:, :, None]
    reach = _reach(found, float(np.max(count)))
    return (found[:, :, : reach + 1] * parzen(reach)).transpose(2, 0, 1)


def _reach(r: Float[np.ndarray, "ny ny lags1"], count: float) -> int:
    """Return the last lag of the window: after a run of lags at which no correlation can be told from chance."""
    power = np.sqrt(np.maximum(np.diagonal(r[:, :, 0]), 1e-300))
    size = np.max(np.abs(r) / np.outer(power, power)[:, :, None], axis=(0, 1))[1:]
    seen = np.flatnonzero(size > CHANCE * np.sqrt(np.log10(max(count, 10.0)) / max(count, 1.0)))
    run = max(20, int(np.sqrt(count) / 2))
    before = np.concatenate([[-1], seen])
    quiet = np.flatnonzero(np.diff(np.append(before, size.size + run)) > run)
    last = int(before[quiet[0]]) + 1
    return min(max(LEAST, int(WIDER * last)), size.size)


def _coloured_part(
    now: Float[np.ndarray, "ny p n"], before: Float[np.ndarray, "ny p lags"], r: Float[np.ndarray, "lags1 ny ny"]
) -> Float[np.ndarray, "p p"]:
    """Return the terms of the double sum in which t is now, and s is now or before (twice, for their mirror image)."""
    _, next_fast_len, rfft = transforms()
    ny, p, n = now.shape
    past = before if np.any(before) else before[:, :, :0]
    size = next_fast_len(past.shape[2] + n + len(r), real=True)
    spectrum = rfft(np.concatenate([past, now], axis=2), size)
    own = spectrum if not past.shape[2] else rfft(np.concatenate([np.zeros_like(past), now], axis=2), size)
    lagged = np.array(r.transpose(1, 2, 0))
    lagged[:, :, 0] = 0.0
    kernel = rfft(lagged, size) * (2.0 / size)
    kernel[:, :, 0] *= 0.5
    if size % 2 == 0:
        kernel[:, :, -1] *= 0.5
    later, here = np.zeros((p, p)), np.zeros((p, p))
    for a in range(ny):
        for b in range(ny):
            weighted = spectrum[b] * kernel[a, b]
            for i in range(p):
                for j in range(p):
                    later[i, j] += _real_sum(own[a, i], weighted[j])
                    here[i, j] += r[0, a, b] * float(np.sum(now[a, i] * now[b, j]))
    return here + later + later.T


def _real_sum(x: Any, y: Any) -> float:
    """Return the real part of sum conj(x) y."""
    return float(np.sum(x.real * y.real) + np.sum(x.imag * y.imag))


def with_infinities(matrix: Float[np.ndarray, "p p"], unseen: Float[np.ndarray, " p"]) -> Float[np.ndarray, "p p"]:
    """Return a covariance in which what is not seen has infinite variance."""
    lost = unseen > 1e-6
    found = 0.5 * (matrix + matrix.T)
    found[lost, :] = found[:, lost] = np.inf
    return found
