"""The residuals of each experiment, and sums over them that show how well it is explained."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float

from seaopt.estimation.problem.correlation import LaggedSums, ljung_box
from seaopt.estimation.problem.fit_experiment import CACHED_SAMPLES, FitExperiment, FitSegment
from seaopt.estimation.problem.fit_problem import FitProblem
from seaopt.estimation.problem.shapes import Parts, PerOutput, Vector
from seaopt.records import record
from seaopt.simulation import Point


@record(eq=False)
class SegmentResiduals:
    """The residuals of one segment."""

    weighted: Float[np.ndarray, "n ny"]  # filtered residuals in sigma; zero where a sample does not count
    raw: Float[np.ndarray, "n ny"]  # model minus measured, neither filtered nor weighted; NaN where missing


@record(eq=False)
class ExperimentResiduals:
    """The residuals of one experiment, segment by segment."""

    outputs: tuple[str, ...]
    segments: tuple[SegmentResiduals, ...]

    @property
    def weighted(self) -> Float[np.ndarray, "n ny"]:
        """Those of all segments, filtered and in sigma; zero where a sample does not count."""
        return np.concatenate([segment.weighted for segment in self.segments])

    @property
    def raw(self) -> Float[np.ndarray, "n ny"]:
        """Model minus measured of all segments; NaN where missing."""
        return np.concatenate([segment.raw for segment in self.segments])

    def weighted_of(self, output: str) -> Parts:
        """Return the weighted residuals of one output, segment by segment."""
        return [segment.weighted[:, self.outputs.index(output)] for segment in self.segments]

    def raw_of(self, output: str) -> Parts:
        """Return model minus measured of one output, segment by segment."""
        return [segment.raw[:, self.outputs.index(output)] for segment in self.segments]


ResidualsByExperiment = Mapping[str, ExperimentResiduals]


def compute_residuals(problem: FitProblem, z: Vector) -> dict[str, ExperimentResiduals]:
    """Return the residuals of every experiment, by its name."""
    return {experiment.name: compute_experiment_residuals(experiment, z) for experiment in problem.experiments}


def compute_experiment_residuals(experiment: FitExperiment, z: Vector) -> ExperimentResiduals:
    """Return the residuals of one experiment."""
    rows: list[SegmentResiduals] = []
    for segment in experiment.segments:
        chunks = list(_stream_residuals(experiment, segment, z))
        weighted = np.concatenate([chunk.where_used(chunk.weighted) for chunk in chunks], axis=1)
        raw = np.concatenate([chunk.raw for chunk in chunks], axis=1)
        rows.append(SegmentResiduals(weighted=weighted.T, raw=raw.T))
    return ExperimentResiduals(outputs=experiment.data.outputs, segments=tuple(rows))


@record(eq=False)
class _Chunk:
    """Rows of a segment: model minus measured, filtered residuals in sigma, which count, and the measured in a band.
    Arrays have one row per output. `used` is None where every sample counts.
    """

    rows: slice
    raw: Float[np.ndarray, "ny m"]
    weighted: Float[np.ndarray, "ny m"]
    used: Bool[np.ndarray, "ny m"] | None
    in_band: Float[np.ndarray, "ny m"] | None

    def where_used(self, values: Float[np.ndarray, "ny m"]) -> Float[np.ndarray, "ny m"]:
        """Return the values, zero where a sample does not count."""
        return values if self.used is None else np.where(self.used, values, 0.0)


def _stream_residuals(
    experiment: FitExperiment, segment: FitSegment, z: Vector, chunk: int = CACHED_SAMPLES
) -> Iterator[_Chunk]:
    """Yield the residuals of a segment, chunk by chunk."""
    point, weights, samples = experiment.point(z), experiment.weights, segment.samples
    filtered, sigma = bool(len(weights.sections)), experiment.sigma[:, None]
    for rows, part in experiment.stream(segment, z, point, chunk=chunk, columns=filtered):
        assert part.outputs is not None
        raw = point.read(part.outputs.T, samples, rows)
        for o, channel in enumerate(samples.y):
            raw[o] -= channel[rows]
        residual = raw if part.columns is None else part.columns[:, :, 0].T
        every = not samples.keep and rows.start >= weights.settle and bool(np.all(np.isfinite(np.sum(raw, axis=1))))
        yield _Chunk(
            rows=rows,
            raw=raw,
            weighted=residual / sigma,
            used=None if every else segment.mark_counted(weights.settle, rows).T,
            in_band=None if part.columns is None else _model_in_band(part.columns, point).T - residual,
        )


def _model_in_band(columns: Float[np.ndarray, "m ny nc"], point: Point) -> Float[np.ndarray, "m ny"]:
    """Return the filtered model of what is measured, from the filtered columns of 1, drift's polynomials and output."""
    sensor = columns[:, :, -(2 + point.drift_terms) :]
    drift = np.sum(sensor[:, :, 1:-1] * point.drift, axis=2)
    return sensor[:, :, 0] * point.offset + drift + point.gain * sensor[:, :, -1]


@record(eq=False)
class MisfitSums:
    """Sums over samples of one output: how many, power and mean of model minus measured, spread of the measured."""

    count: int
    power: float
    spread: float
    bias: float = 0.0

    @property
    def fit_percent(self) -> float | None:
        """100 (1 - |y - yhat| / |y - mean(y)|); None of no samples."""
        return 100.0 * (1.0 - float(np.sqrt(self.power / max(self.spread, 1e-300)))) if self.count else None

    def shift(self, offset: float) -> MisfitSums:
        """Return the sums with an offset taken out of model minus measured."""
        power = self.power - self.count * offset * (2.0 * self.bias - offset)
        return replace(self, power=max(power, 0.0), bias=self.bias - offset)


@record(eq=False)
class ResidualStatistics:
    """Sums over an experiment's residuals, made in the memory of a chunk."""

    outputs: tuple[str, ...]  # in the order of the arrays
    # sums of r_a(t) r_b(t - k), r what the loss makes of the weighted residuals
    correlation: Float[np.ndarray, "lags1 ny ny"]
    mean: PerOutput  # mean, count: of r, over the samples that count
    count: PerOutput
    # used, held_out: over the samples that count, those in which the filter settles included, and over those held out
    used: Mapping[str, MisfitSums]
    held_out: Mapping[str, MisfitSums]
    # the same in the fit's band, of the samples that count, each segment's mean taken out; empty without a band
    in_band: Mapping[str, MisfitSums]

    def count_of(self, output: str) -> float:
        """Return how many samples of an output count."""
        return float(self.count[self.outputs.index(output)])

    def whiteness(self, output: str, lags: int = 20) -> float:
        """Return the p-value of the Ljung-Box test that r is white (Biometrika 65, 1978)."""
        o, n = self.outputs.index(output), self.count_of(output)
        lags = min(lags, len(self.correlation) - 1, int(n / 5))
        power = self.correlation[0, o, o] - n * self.mean[o] ** 2
        if lags < 1 or power <= 0.0:
            return 1.0
        rho = (self.correlation[1 : lags + 1, o, o] - n * self.mean[o] ** 2) / power
        return ljung_box(rho, n)


StatisticsByExperiment = Mapping[str, ResidualStatistics]


def compute_statistics(problem: FitProblem, z: Vector) -> dict[str, ResidualStatistics]:
    """Return the sums over the residuals of every experiment, by its name."""
    return {experiment.name: _compute_statistics(experiment, z) for experiment in problem.experiments}


def _compute_statistics(experiment: FitExperiment, z: Vector) -> ResidualStatistics:
    names, longest = experiment.data.outputs, experiment.longest
    ny, banded = len(names), bool(len(experiment.weights.sections))
    lags = int(min(max(32, 4 * np.sqrt(longest)), longest // 4))
    # Chunks are of even lengths: transforms are of the longest.
    length = -(-longest // max(round(longest / max(CACHED_SAMPLES, 4 * lags)), 1))
    whole = LaggedSums(ny, lags + length, lags)  # of the last chunk's tail and a chunk
    twice = LaggedSums(ny, lags, lags)  # of the tails, which `whole` counts twice
    total, count = np.zeros(ny), np.zeros(ny)
    misfits = np.zeros((2 + banded, ny, 5))  # used, held out, in the band; see _sum_misfits
    for segment in experiment.segments:
        tail, added = np.zeros((ny, 0)), np.zeros_like(misfits)
        origins = [float(channel[np.argmax(np.isfinite(channel))]) for channel in segment.samples.y]
        for chunk in _stream_residuals(experiment, segment, z, length):
            slopes = chunk.where_used(experiment.loss.slope(chunk.weighted))
            with_tail = np.concatenate([tail, slopes], axis=1)
            whole.add(with_tail)
            if tail.size:
                twice.add(tail)
            tail = with_tail[:, max(with_tail.shape[1] - lags, 0) :]
            total += np.sum(slopes, axis=1)
            count += slopes.shape[1] if chunk.used is None else np.count_nonzero(chunk.used, axis=1)
            _add_misfits(added, experiment, segment, chunk, origins)
        if banded:  # each segment's filter settles at a level of its own
            added[2, :, 3] -= added[2, :, 2] ** 2 / np.maximum(added[2, :, 0], 1.0)
            added[2, :, 2] = 0.0
        misfits += added
    used, held_out, *in_band = (
        {name: _make_sums(*row) for name, row in zip(names, rows, strict=True)} for rows in misfits.tolist()
    )
    return ResidualStatistics(
        outputs=names,
        correlation=whole.sums() - twice.sums(),
        mean=total / np.maximum(count, 1.0),
        count=count,
        used=used,
        held_out=held_out,
        in_band=in_band[0] if in_band else {},
    )


def _add_misfits(
    added: Float[np.ndarray, "parts ny 5"],
    experiment: FitExperiment,
    segment: FitSegment,
    chunk: _Chunk,
    origins: list[float],
) -> None:
    """Add a chunk's sums to those of the samples used, of those held out, and of those used in the band."""
    kept = None if chunk.used is None else segment.mark_counted(0, chunk.rows).T
    for o, channel in enumerate(segment.samples.y):
        measured, used = channel[chunk.rows] - origins[o], None if chunk.used is None else chunk.used[o]
        added[0, o] += _sum_misfits(None if kept is None else kept[o], measured, chunk.raw[o])
        if kept is not None:
            held_out = ~kept[o] & np.isfinite(measured) & segment.has_start
            added[1, o] += _sum_misfits(held_out, measured, chunk.raw[o])
        if chunk.in_band is not None:
            added[2, o] += _sum_misfits(used, chunk.in_band[o], chunk.weighted[o] * experiment.sigma[o])


def _sum_misfits(
    chosen: Bool[np.ndarray, " m"] | None, measured: Float[np.ndarray, " m"], misfits: Float[np.ndarray, " m"]
) -> tuple[float, float, float, float, float]:
    """Return of the chosen samples: count, power of the misfits, sum and squares of the measured, sum of misfits."""
    if chosen is not None:
        measured, misfits = measured[chosen], misfits[chosen]
    power, square = (float(np.einsum("m,m->", x, x)) for x in (misfits, measured))
    return measured.size, power, float(np.sum(measured)), square, float(np.sum(misfits))


def _make_sums(n: float, power: float, level: float, square: float, misfit: float) -> MisfitSums:
    """Return the record of what `_sum_misfits` gave."""
    count = max(n, 1.0)
    return MisfitSums(count=int(n), power=power, spread=square - level**2 / count, bias=misfit / count)


def stream_columns(
    experiment: FitExperiment, segment: FitSegment, z: Vector, chunk: int = CACHED_SAMPLES
) -> Iterator[tuple[slice, Float[np.ndarray, "m ny nc"], Bool[np.ndarray, "m ny"]]]:
    """Yield rows, their columns, and which samples count, chunk by chunk."""
    settle = experiment.weights.settle
    for rows, part in experiment.stream(segment, z, experiment.point(z), chunk=chunk, columns=True):
        assert part.columns is not None
        yield rows, part.columns, segment.mark_counted(settle, rows)
