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

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from seaopt.estimation.correlation import parzen
from seaopt.estimation.normal import add_gram
from seaopt.estimation.residuals import CHUNK, Huber, Linear, Residuals
from seaopt.simulation import Point, Segment, stream

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


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Errors:
    """What one segment's outputs leave over.

    Parameters
    ----------
    weighted : array, shape (n, ny)
        Filtered residuals in sigma; zero where a sample does not count.
    raw : array, shape (n, ny)
        Model minus measured, neither filtered nor weighted; NaN where missing.

    """

    weighted: Float[np.ndarray, "n ny"]
    raw: Float[np.ndarray, "n ny"]


def errors(problem: Residuals, z: Float[np.ndarray, " n"]) -> list[list[Errors]]:
    """Return the residuals of every experiment and segment."""
    found: list[list[Errors]] = []
    for e, pieces in enumerate(problem.segments):
        row: list[Errors] = []
        for s in range(len(pieces)):
            parts = list(_chunks(problem, e, s, z))
            weighted = np.concatenate([np.where(part.used, part.weighted, 0.0) for part in parts])
            row.append(Errors(weighted=weighted, raw=np.concatenate([part.raw for part in parts])))
        found.append(row)
    return found


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Chunk:
    """Rows of a segment: model minus measured, filtered residuals in sigma, which count, and the measured in a band."""

    rows: slice
    raw: Float[np.ndarray, "m ny"]
    weighted: Float[np.ndarray, "m ny"]
    used: Bool[np.ndarray, "m ny"]
    in_band: Float[np.ndarray, "m ny"] | None


def _chunks(problem: Residuals, e: int, s: int, z: Float[np.ndarray, " n"]) -> Iterator[_Chunk]:
    """Yield what a segment's outputs leave over, chunk by chunk."""
    model, point, weights, piece = (
        problem.unknowns.models[e], problem.point(e, z), problem.weights(e), problem.segments[e][s],
    )  # fmt: skip
    first, filtered = 0, bool(len(weights.sections))
    for part in stream(model, piece, point, problem.start(e, s, z), weights, chunk=CHUNK, columns=filtered):
        assert part.outputs is not None
        rows = slice(first, first + len(part.outputs))
        first = rows.stop
        measured = np.column_stack([channel[rows] for channel in piece.y])
        drift = piece.drift_basis(rows, point.drift_terms) @ point.drift.T
        raw = part.outputs * point.gain + point.offset + drift - measured
        left = raw if part.columns is None else part.columns[:, :, 0]
        yield _Chunk(
            rows=rows, raw=raw, weighted=left / problem.sigma[e], used=counted(piece, weights.settle, rows),
            in_band=None if part.columns is None else _modelled(part.columns, point) - left,
        )  # fmt: skip


def _modelled(columns: Float[np.ndarray, "m ny nc"], point: Point) -> Float[np.ndarray, "m ny"]:
    """Return the filtered model of what is measured, from the filtered columns of 1, drift's polynomials and output."""
    own = columns[:, :, -(2 + point.drift_terms) :]
    drift = np.sum(own[:, :, 1:-1] * point.drift, axis=2)
    return own[:, :, 0] * point.offset + drift + point.gain * own[:, :, -1]


def counted(piece: Segment, settle: int, rows: slice | None = None) -> Bool[np.ndarray, "n ny"]:
    """Return which samples take part in the cost."""
    chosen = rows if rows is not None else slice(0, piece.n)
    present = np.column_stack([np.isfinite(channel[chosen]) for channel in piece.y])
    if piece.keep:
        present &= np.column_stack([mask[chosen] > 0 for mask in piece.keep])
    present[: max(settle - chosen.start, 0)] = False
    return present


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Part:
    """Sums over samples of one output: how many, power and mean of model minus measured, spread of the measured."""

    count: int
    power: float
    spread: float
    bias: float = 0.0

    @property
    def fit_percent(self) -> float | None:
        """100 (1 - |y - yhat| / |y - mean(y)|); None of no samples."""
        return 100.0 * (1.0 - float(np.sqrt(self.power / max(self.spread, 1e-300)))) if self.count else None

    def levelled(self, bias: float) -> Part:
        """Return the sums with an offset taken out of model minus measured."""
        power = self.power - self.count * bias * (2.0 * self.bias - bias)
        return replace(self, power=max(power, 0.0), bias=self.bias - bias)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Leftover:
    """What an experiment's residuals come to, in the memory of a chunk.

    Parameters
    ----------
    correlation : array, shape (lags + 1, ny, ny)
        Sums of r_a(t) r_b(t - k), r what the loss makes of the weighted residuals.
    mean, count : array, shape (ny,)
        Of r, over the samples that count.
    used, rest : tuple of Part
        One an output: samples that count but for the filter's settling, and those held out.
    band : tuple of Part
        The same in the fit's band, of the samples that count, each segment's mean taken out; empty without a band.

    """

    correlation: Float[np.ndarray, "lags1 ny ny"]
    mean: Float[np.ndarray, " ny"]
    count: Float[np.ndarray, " ny"]
    used: tuple[Part, ...]
    rest: tuple[Part, ...]
    band: tuple[Part, ...] = ()

    def whiteness(self, o: int, lags: int = 20) -> float:
        """Return the p-value of the Ljung-Box test that r is white (Biometrika 65, 1978)."""
        from scipy.special import gammaincc  # deferred: scipy.stats takes a second

        n = float(self.count[o])
        lags = min(lags, len(self.correlation) - 1, int(n / 5))
        power = self.correlation[0, o, o] - n * self.mean[o] ** 2
        if lags < 1 or power <= 0.0:
            return 1.0
        rho = (self.correlation[1 : lags + 1, o, o] - n * self.mean[o] ** 2) / power
        statistic = n * (n + 2) * float(np.sum(rho**2 / (n - np.arange(1, lags + 1))))
        return float(gammaincc(lags / 2, statistic / 2))


def leftover(problem: Residuals, e: int, z: Float[np.ndarray, " n"]) -> Leftover:
    """Return what an experiment's residuals come to."""
    pieces, ny = problem.segments[e], len(problem.sigma[e])
    lags = _lags(max(piece.n for piece in pieces))
    correlation, total, count = np.zeros((ny, ny, lags + 1)), np.zeros(ny), np.zeros(ny)
    banded = bool(len(problem.weights(e).sections))
    sums = np.zeros((2 + banded, ny, 5))  # used, rest, in the band; see _sums
    for s, piece in enumerate(pieces):
        tail, here = np.zeros((ny, 0)), np.zeros((2 + banded, ny, 5))
        started = not piece.keep or bool(np.any(piece.keep[0]))  # else it has no initial state: it says nothing
        origin = [float(channel[np.argmax(np.isfinite(channel))]) for channel in piece.y]
        for part in _chunks(problem, e, s, z):
            pull = np.ascontiguousarray(np.where(part.used, pull_of(problem, part.weighted), 0.0).T)
            _correlate(correlation, pull, tail)
            tail = np.concatenate([tail, pull], axis=1)[:, -lags:] if lags else tail
            total += pull.sum(axis=1)
            count += part.used.sum(axis=0)
            kept = counted(piece, 0, part.rows)
            for o, channel in enumerate(piece.y):
                measured = channel[part.rows] - origin[o]
                here[0, o] += _sums(kept[:, o], measured, part.raw[:, o])
                here[1, o] += _sums(~kept[:, o] & np.isfinite(measured) & started, measured, part.raw[:, o])
                if part.in_band is not None:
                    left = part.weighted[:, o] * problem.sigma[e][o]
                    here[2, o] += _sums(part.used[:, o], part.in_band[:, o], left)
        if banded:  # each segment's filter settles at a level of its own
            here[2, :, 3] -= here[2, :, 2] ** 2 / np.maximum(here[2, :, 0], 1.0)
            here[2, :, 2] = 0.0
        sums += here
    used, rest, *band = (tuple(_part(*row) for row in rows) for rows in sums.tolist())
    return Leftover(
        correlation=correlation.transpose(2, 0, 1), mean=total / np.maximum(count, 1.0), count=count, used=used,
        rest=rest, band=band[0] if band else (),
    )  # fmt: skip


def _sums(
    chosen: Bool[np.ndarray, " m"], measured: Float[np.ndarray, " m"], misses: Float[np.ndarray, " m"]
) -> tuple[float, float, float, float, float]:
    """Return of the chosen samples: count, power of the misses, sum and squares of the measured, sum of the misses."""
    if not np.all(chosen):
        measured, misses = measured[chosen], misses[chosen]
    square = float(np.sum(measured**2))
    return measured.size, float(np.sum(misses**2)), float(np.sum(measured)), square, float(np.sum(misses))


def _part(n: float, power: float, first: float, square: float, raw: float) -> Part:
    """Return the part that `_sums` give."""
    count = max(n, 1.0)
    return Part(count=int(n), power=power, spread=square - first**2 / count, bias=raw / count)


def _lags(n: int) -> int:
    return int(min(max(32, 4 * np.sqrt(n)), n // 4))


def _correlate(
    found: Float[np.ndarray, "ny ny lags1"], now: Float[np.ndarray, "ny n"], tail: Float[np.ndarray, "ny past"]
) -> None:
    """Add the sums of now_a(t) before_b(t - k), before being the tail and now."""
    irfft, next_fast_len, rfft = _transforms()
    lags, shift = found.shape[2] - 1, tail.shape[1]
    size = next_fast_len(shift + now.shape[1] + lags, real=True)
    spectrum = rfft(np.concatenate([tail, now], axis=1), size)
    own = spectrum if shift == 0 else rfft(np.concatenate([np.zeros_like(tail), now], axis=1), size)
    for a in range(len(now)):
        for b in range(len(now)):
            found[a, b] += irfft(own[a] * np.conj(spectrum[b]), size)[: lags + 1]


def robust_bread(problem: Residuals, z: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n n"]:
    """Return J^T J with the loss's second derivative as weight."""
    normal = np.zeros((1 + z.size, 1 + z.size))
    for e, pieces in enumerate(problem.segments):
        for s in range(len(pieces)):
            for _, columns, used in column_chunks(problem, e, s, z):
                for o, places in enumerate(problem.columns(e, s)):
                    v = columns[:, o] / problem.sigma[e][o]
                    weight = used[:, o] * _curvature(problem, v[:, 0])
                    add_gram(normal, (v * weight[:, None]).T @ v, places)
    return normal[1:, 1:]


def _curvature(problem: Residuals, r: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    if isinstance(problem.loss, Huber):
        return (np.abs(r) <= problem.loss.threshold).astype(float)
    if isinstance(problem.loss, Linear):
        return np.ones_like(r)
    return (1.0 + (r / problem.loss.threshold) ** 2) ** -1.5


def pull_of(problem: Residuals, r: Float[np.ndarray, "n ny"]) -> Float[np.ndarray, "n ny"]:
    """Return the loss's derivative at each residual."""
    if isinstance(problem.loss, Huber):
        return np.clip(r, -problem.loss.threshold, problem.loss.threshold)
    return r if isinstance(problem.loss, Linear) else r / np.sqrt(1.0 + (r / problem.loss.threshold) ** 2)


def column_chunks(problem: Residuals, e: int, s: int, z: Float[np.ndarray, " n"]) -> Iterator[tuple[slice, Any, Any]]:
    """Yield rows, their columns, and which samples count, chunk by chunk."""
    first, weights, piece = 0, problem.weights(e), problem.segments[e][s]
    arguments = problem.unknowns.models[e], piece, problem.point(e, z), problem.start(e, s, z)
    for part in stream(*arguments, weights, chunk=CHUNK, columns=True):
        assert part.columns is not None
        rows = slice(first, first + len(part.columns))
        first = rows.stop
        yield rows, part.columns, counted(piece, weights.settle, rows)


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


def _transforms() -> tuple[Any, Any, Any]:
    from scipy import fft  # deferred: 0.1 s

    return fft.irfft, fft.next_fast_len, fft.rfft


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
    _, next_fast_len, rfft = _transforms()
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
