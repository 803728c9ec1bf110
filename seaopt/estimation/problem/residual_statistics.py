"""What a fit leaves over, chunk by chunk: residuals, their derivatives, and the sums that say how well it explains."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from seaopt.estimation.problem.correlation import LaggedSums, ljung_box
from seaopt.estimation.problem.losses import pull_of
from seaopt.estimation.problem.residuals import CHUNK, Residuals
from seaopt.records import record
from seaopt.simulation import Point, Segment, stream


@record(eq=False)
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
            weighted = np.concatenate([part.where_used(part.weighted) for part in parts], axis=1)
            row.append(Errors(weighted=weighted.T, raw=np.concatenate([part.raw for part in parts], axis=1).T))
        found.append(row)
    return found


@record(eq=False)
class _Chunk:
    """Rows of a segment: model minus measured, filtered residuals in sigma, which count, and the measured in a band.

    Arrays have one row an output. `used` is None where every sample counts.
    """

    rows: slice
    raw: Float[np.ndarray, "ny m"]
    weighted: Float[np.ndarray, "ny m"]
    used: Bool[np.ndarray, "ny m"] | None
    in_band: Float[np.ndarray, "ny m"] | None

    def where_used(self, values: Float[np.ndarray, "ny m"]) -> Float[np.ndarray, "ny m"]:
        """Return the values, zero where a sample does not count."""
        return values if self.used is None else np.where(self.used, values, 0.0)


def _chunks(problem: Residuals, e: int, s: int, z: Float[np.ndarray, " n"], chunk: int = CHUNK) -> Iterator[_Chunk]:
    """Yield what a segment's outputs leave over, chunk by chunk."""
    model, point, weights, piece = (
        problem.unknowns.models[e], problem.point(e, z), problem.weights(e), problem.segments[e][s],
    )  # fmt: skip
    first, filtered, sigma = 0, bool(len(weights.sections)), problem.sigma[e][:, None]
    for part in stream(model, piece, point, problem.start(e, s, z), weights, chunk=chunk, columns=filtered):
        assert part.outputs is not None
        rows = slice(first, first + len(part.outputs))
        first = rows.stop
        raw = np.multiply(part.outputs.T, point.gain[:, None], order="C")
        raw += point.offset[:, None]
        for o, channel in enumerate(piece.y):
            raw[o] -= channel[rows]
        if point.drift_terms:
            raw += point.drift @ piece.drift_basis(rows, point.drift_terms).T
        left = raw if part.columns is None else part.columns[:, :, 0].T
        every = not piece.keep and rows.start >= weights.settle and bool(np.all(np.isfinite(np.sum(raw, axis=1))))
        yield _Chunk(
            rows=rows, raw=raw, weighted=left / sigma,
            used=None if every else counted(piece, weights.settle, rows).T,
            in_band=None if part.columns is None else _modelled(part.columns, point).T - left,
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


def count_of(piece: Segment) -> Int[np.ndarray, " ny"]:
    """Return how many samples of each output are there and have a weight."""
    present = [np.isfinite(channel) for channel in piece.y]
    if piece.keep:
        present = [own & (mask > 0) for own, mask in zip(present, piece.keep, strict=True)]
    return np.array([np.count_nonzero(own) for own in present])


@record(eq=False)
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


@record(eq=False)
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
        n = float(self.count[o])
        lags = min(lags, len(self.correlation) - 1, int(n / 5))
        power = self.correlation[0, o, o] - n * self.mean[o] ** 2
        if lags < 1 or power <= 0.0:
            return 1.0
        rho = (self.correlation[1 : lags + 1, o, o] - n * self.mean[o] ** 2) / power
        return ljung_box(rho, n)


def leftover(problem: Residuals, e: int, z: Float[np.ndarray, " n"]) -> Leftover:
    """Return what an experiment's residuals come to."""
    pieces, ny = problem.segments[e], len(problem.sigma[e])
    lags = _lags(max(piece.n for piece in pieces))
    total, count = np.zeros(ny), np.zeros(ny)
    longest = max(piece.n for piece in pieces)
    chunk = -(
        -longest // max(round(longest / max(CHUNK, 4 * lags)), 1)
    )  # of even lengths: transforms are of the longest
    whole, again = LaggedSums(ny, lags + chunk, lags), LaggedSums(ny, lags, lags)  # tail and chunk, and the tail
    banded = bool(len(problem.weights(e).sections))
    sums = np.zeros((2 + banded, ny, 5))  # used, rest, in the band; see _sums
    for s, piece in enumerate(pieces):
        tail, here = np.zeros((ny, 0)), np.zeros((2 + banded, ny, 5))
        started = not piece.keep or bool(np.any(piece.keep[0]))  # else it has no initial state: it says nothing
        origin = [float(channel[np.argmax(np.isfinite(channel))]) for channel in piece.y]
        for part in _chunks(problem, e, s, z, chunk):
            pull = part.where_used(pull_of(problem.loss, part.weighted))
            with_tail = np.concatenate([tail, pull], axis=1)
            whole.add(with_tail)
            if tail.size:
                again.add(tail)
            tail = with_tail[:, max(with_tail.shape[1] - lags, 0) :]
            total += np.sum(pull, axis=1)
            count += pull.shape[1] if part.used is None else np.count_nonzero(part.used, axis=1)
            kept = None if part.used is None else counted(piece, 0, part.rows).T
            for o, channel in enumerate(piece.y):
                measured = channel[part.rows] - origin[o]
                if part.used is None or kept is None:
                    here[0, o] += _sums(None, measured, part.raw[o])
                else:
                    here[0, o] += _sums(kept[o], measured, part.raw[o])
                    here[1, o] += _sums(~kept[o] & np.isfinite(measured) & started, measured, part.raw[o])
                if part.in_band is not None:
                    left = part.weighted[o] * problem.sigma[e][o]
                    here[2, o] += _sums(None if part.used is None else part.used[o], part.in_band[o], left)
        if banded:  # each segment's filter settles at a level of its own
            here[2, :, 3] -= here[2, :, 2] ** 2 / np.maximum(here[2, :, 0], 1.0)
            here[2, :, 2] = 0.0
        sums += here
    used, rest, *band = (tuple(_part(*row) for row in rows) for rows in sums.tolist())
    return Leftover(
        correlation=whole.sums() - again.sums(), mean=total / np.maximum(count, 1.0), count=count, used=used,
        rest=rest, band=band[0] if band else (),
    )  # fmt: skip


def _sums(
    chosen: Bool[np.ndarray, " m"] | None, measured: Float[np.ndarray, " m"], misses: Float[np.ndarray, " m"]
) -> tuple[float, float, float, float, float]:
    """Return of the chosen samples: count, power of the misses, sum and squares of the measured, sum of the misses."""
    if chosen is not None:
        measured, misses = measured[chosen], misses[chosen]
    power, square = (float(np.einsum("m,m->", x, x)) for x in (misses, measured))
    return measured.size, power, float(np.sum(measured)), square, float(np.sum(misses))


def _part(n: float, power: float, first: float, square: float, raw: float) -> Part:
    """Return the part that `_sums` give."""
    count = max(n, 1.0)
    return Part(count=int(n), power=power, spread=square - first**2 / count, bias=raw / count)


def _lags(n: int) -> int:
    return int(min(max(32, 4 * np.sqrt(n)), n // 4))


def column_chunks(
    problem: Residuals, e: int, s: int, z: Float[np.ndarray, " n"], chunk: int = CHUNK
) -> Iterator[tuple[slice, Any, Any]]:
    """Yield rows, their columns, and which samples count, chunk by chunk."""
    first, weights, piece = 0, problem.weights(e), problem.segments[e][s]
    arguments = problem.unknowns.models[e], piece, problem.point(e, z), problem.start(e, s, z)
    for part in stream(*arguments, weights, chunk=chunk, columns=True):
        assert part.columns is not None
        rows = slice(first, first + len(part.columns))
        first = rows.stop
        yield rows, part.columns, counted(piece, weights.settle, rows)
