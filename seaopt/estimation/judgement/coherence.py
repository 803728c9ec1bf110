r"""How much of each output and of its residual the inputs account for, line by line of their spectra, without a model.

With the spectra U (stretches by inputs) and Y (stretches) of K Hann-windowed stretches that overlap by half, what the
inputs account for at one line is the projection of Y on U's columns, and

.. math:: \gamma^2 = \frac{Y^H U (U^H U)^{-1} U^H Y}{Y^H Y}

the multiple coherence (Bendat and Piersol, Random Data, 4th ed., ch. 7). Of noise that follows no input,
:math:`1 - \gamma^2` is a beta variable of (K - m, m) for m inputs, whatever the noise's colour: its mean is taken off,
and a residual's coherence is compared with it. Stretches long and short are looked at: long ones resolve modes, short
ones average more.

A lightly damped mode rings longer than any stretch: there the coherence is a lower bound of what a model could explain.

Under a law the inputs carry the outputs' noise, and are coherent with it at all lines where the law reads it: only
what was commanded before tells of the plant (Ljung, System Identification, 2nd ed., sec. 16.6). There what the past of
all residuals leaves of one is regressed on the inputs' sums over lags of 1, 2 to 3, 4, 5 to 7 ... samples. What the
inputs account for of the output is then what the model does, and what they do of the residual.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Complex, Float, Int

from seaopt import welch
from seaopt.estimation.problem.chance import exceeds
from seaopt.estimation.problem.correlation import find_quick_size_within
from seaopt.estimation.problem.fit_experiment import FitExperiment
from seaopt.estimation.problem.noise_floor import NoiseFloor
from seaopt.estimation.problem.residual_statistics import ExperimentResiduals
from seaopt.records import record
from seaopt.signals import bridge, median

STRETCHES = (16, 64)  # how many half-overlapping pairs of them the samples make
SHORTEST = 32  # samples of a stretch
FEWEST_LINES = 4  # of an octave of which a mean is told
FEWEST, MOST = 6, 256  # stretches that are averaged
TOGETHER = 16384  # samples of as many stretches as are transformed at once: they stay in the cache
OUTLIER = 4.0  # robust standard deviations beyond which a residual is an outlier of its spectrum
OCTAVES = 24  # below the Nyquist frequency, at most
SILENT = 1e-9  # of an input's largest line
PAST = 32  # samples of the residuals' own past, before sums over longer ones
LAG_RATIO, LONGEST_LAG = 2.0**0.5, 0.125  # of the ends of the sums of an input, and the last of them over the log
ALIKE = 1e-10  # of the power of inputs that differ by less there is nothing left to rounding


@record(eq=False)
class CoherentShare:
    """How much the inputs account for, of one output and of its residual."""

    output: float  # share of the output's energy that they account for
    residual: float  # the same of the residual
    p: float  # probability that a residual that follows no input has so coherent an octave (Bonferroni's bound)
    band_hz: tuple[float, float]  # the octave whose residual is the least likely to be chance
    power: float  # power of the residual that the inputs account for, over the output's that they account for


@record(eq=False)
class Octave:
    """What of an output's power follows the inputs in an octave, and how loud these are."""

    band_hz: tuple[float, float]
    lines: int
    follows: float  # share of the output's power, the mean of its lines
    noise: float  # its sensor's over the output's power
    input: float  # power of the inputs' lines over that of the last octave's


def measure_octaves(experiment: FitExperiment, residuals: ExperimentResiduals, floor: NoiseFloor) -> Iterator[Octave]:
    """Yield what the inputs account for of each output, octave by octave; nothing where the log is too short to tell.
    `floor`: of the residuals.
    """
    inputs, outputs = _gather(experiment, residuals)
    total, ny = sum(rows.shape[1] for rows in inputs), len(experiment.data.outputs)
    if not inputs:
        return
    rng, std = np.random.default_rng(0), floor.noise * experiment.sigma
    beside = (std[:, None] * rng.normal(size=(ny, rows.shape[1])) for rows in outputs)
    signals = [np.vstack([y[:ny], noise, u]) for u, y, noise in zip(inputs, outputs, beside, strict=True)]
    length = 2 * find_quick_size_within(min(max(2 * total // STRETCHES[0], SHORTEST), total) // 2)
    spectra = _make_spectra(inputs, signals, length, experiment)
    if spectra is None:
        return
    f, power = spectra.frequency_hz, np.maximum(spectra.power, 1e-300)
    chance = spectra.inputs / spectra.averages
    follows = (spectra.coherent / power - chance) / (1.0 - chance)
    loud = np.sum(power[:, 2 * ny :], axis=1)
    octave = np.floor(np.log2(f[-1] / f)).astype(int)
    last = float(np.mean(loud[octave == 0]))
    for o in range(ny):
        for number in range(min(int(octave[0]), OCTAVES)):
            lines = octave == number
            if np.count_nonzero(lines) < FEWEST_LINES:
                continue
            yield Octave(
                band_hz=(float(f[lines][0]), float(f[lines][-1])),
                lines=int(np.count_nonzero(lines)),
                follows=float(np.mean(follows[lines, o])),
                noise=float(np.mean(power[lines, ny + o]) / np.mean(power[lines, o])),
                input=float(np.mean(loud[lines])) / last,
            )


def measure_coherence(experiment: FitExperiment, residuals: ExperimentResiduals) -> dict[str, CoherentShare]:
    """Return what the inputs account for, by output; empty where the log is too short to tell, or nothing moves."""
    inputs, outputs = _gather(experiment, residuals)
    shares: dict[str, CoherentShare] = {}
    if not inputs:
        return shares
    total = sum(rows.shape[1] for rows in inputs)
    if experiment.data.feedback:
        found = zip(experiment.data.outputs, _look_back(inputs, outputs, experiment.period), strict=True)
        return {name: share for o, (name, share) in enumerate(found) if experiment.spread[o] > 0.0}
    # Even, for stretches overlap by half, and without a prime factor above 5, for transforms are quick then.
    longest = (min(max(2 * total // count, SHORTEST), total) for count in STRETCHES)
    lengths = sorted({2 * find_quick_size_within(samples // 2) for samples in longest})
    spectra = [
        spectrum for length in lengths if (spectrum := _make_spectra(inputs, outputs, length, experiment)) is not None
    ]
    for o, name in enumerate(experiment.data.outputs):
        rows = [spectrum.compare(o, len(lengths)) for spectrum in spectra]
        if not rows or not experiment.spread[o] > 0.0:
            continue
        largest = {field: max(getattr(row, field) for row in rows) for field in ("output", "residual", "power")}
        shares[name] = replace(min(rows, key=lambda row: row.p), **largest)
    return shares


def _gather(
    experiment: FitExperiment, residuals: ExperimentResiduals
) -> tuple[list[Float[np.ndarray, "m n"]], list[Float[np.ndarray, "ny2 n"]]]:
    """Return the inputs that move and [measured, residual] of each output, of each segment's samples that count. A
    sample that does not count is replaced by the model's, and a missing one by those beside it.
    """
    moving: list[Float[np.ndarray, "m n"]] = []
    signals: list[Float[np.ndarray, "ny2 n"]] = []
    delay = round(experiment.slots.delay.value / experiment.period)
    for segment, left in zip(experiment.segments, residuals.segments, strict=True):
        samples, raw = segment.samples, left.raw.T
        u = np.stack(samples.inputs[: max(len(experiment.data.plant.inputs), 1)])  # no readings
        if delay:
            n = u.shape[1]
            u = np.hstack([np.repeat(u[:, :1], min(delay, n), axis=1), u[:, : max(n - delay, 0)]])
        used = np.ascontiguousarray(segment.mark_counted(0).T)
        last = max((row.size - int(np.argmax(row[::-1])) for row in used if row.any()), default=0)
        error = np.where(used | np.isnan(raw), -raw, 0.0)
        measured = np.stack(samples.y)
        measured = np.where(used, measured, measured + raw)
        error, measured = (np.stack([bridge(row) for row in rows]) for rows in (error, measured))
        if last > 1 and np.all(np.isfinite(measured[:, :last])):
            moving.append(u[:, :last])
            signals.append(np.concatenate([measured, _tame(error, used)])[:, :last])
    if not moving:
        return [], []
    whole = np.hstack(moving)
    chosen = np.flatnonzero(np.ptp(whole, axis=1) > 1e-12 * np.max(np.abs(whole), axis=1, initial=1e-300))
    return ([rows[chosen] for rows in moving], signals) if chosen.size else ([], [])


def _tame(error: Float[np.ndarray, "ny n"], used: Bool[np.ndarray, "ny n"]) -> Float[np.ndarray, "ny n"]:
    """Return a residual whose outliers are cut: one sample of heavy-tailed noise is all of a short stretch's power."""
    tamed = error.copy()
    for row, kept in zip(tamed, used, strict=True):
        if kept.any():
            middle = median(row[kept])
            scale = OUTLIER * 1.4826 * median(np.abs(row[kept] - middle))
            if scale > 0.0:
                np.clip(row, middle - scale, middle + scale, out=row)
    return tamed


def _look_back(
    inputs: Sequence[Float[np.ndarray, "m _"]], outputs: Sequence[Float[np.ndarray, "s _"]], period: float
) -> list[CoherentShare]:
    """Return what the inputs before each sample account for, of each output of a log that was taken under a law."""
    m, ny, total = len(inputs[0]), len(outputs[0]) // 2, sum(rows.shape[1] for rows in inputs)
    edges = np.unique(np.floor(LAG_RATIO ** np.arange(2.0 * np.log2(max(LONGEST_LAG * total, 4.0)))).astype(int))
    far = edges[np.searchsorted(edges, PAST) :]
    errors = [rows[ny:] - np.mean(rows[ny:], axis=1, keepdims=True) for rows in outputs]
    count = m * (edges.size - 1)
    parts = [_Past.make(u, error, edges, far) for u, error in zip(inputs, errors, strict=True)]
    gram = np.sum([rows.T @ rows for part in parts for rows in part.list_rows()], axis=0)
    own = len(gram) - count - ny
    kept, across = _invert(gram[:own, :own]), gram[:own, own:]
    left = gram[own:, own:] - across.T @ kept @ across  # of inputs and residuals, what the residuals' past leaves
    inverse = _invert(left[:count, :count])
    rank = round(float(np.trace(inverse @ left[:count, :count])))
    free = max(total - own - rank, 1)
    gains = inverse @ left[:count, count:]
    made = np.concatenate([rows[:, own : own + count] @ gains for part in parts for rows in part.list_rows()])
    f = np.fft.rfftfreq(total, period)[1:]
    octave = np.floor(np.log2(f[-1] / f)).astype(int)
    shares = list[CoherentShare]()
    for o, gain in enumerate(gains.T):
        r2 = float(np.clip(gain @ left[:count, count + o] / max(left[count + o, count + o], 1e-300), 0.0, 1.0 - 1e-12))
        residual = max((r2 - rank / total) / max(1.0 - rank / total, 1e-12), 0.0)
        power = np.abs(np.fft.rfft(made[:, o])[1:]) ** 2
        most = f[octave == int(np.argmax(np.bincount(octave, weights=power)[:OCTAVES]))]
        measured = np.concatenate([rows[o] - np.mean(rows[o]) for rows in outputs])
        error, whole = gram[own + count + o, own + count + o], max(float(measured @ measured), 1e-300)
        share = float(np.clip(1.0 - (1.0 - residual) * error / whole, 0.0, 1.0))
        shares.append(
            CoherentShare(
                output=share,
                residual=residual,
                p=exceeds(0.5 * rank, 0.5 * free * r2 / (1.0 - r2)) if rank else 1.0,
                band_hz=(float(most[0]), float(most[-1])),
                power=float(residual * error / max(share * whole, 1e-300)),
            )
        )
    return shares


@record(eq=False)
class _Past:
    """What was before each sample of a segment: sums of signals up to each one, and their lags."""

    error: Float[np.ndarray, "ny n"]
    sums: tuple[tuple[Float[np.ndarray, "m _"], Int[np.ndarray, " k"]], ...]
    whole: Float[np.ndarray, "w n"]  # a constant, and the integrals of the residuals, once and again

    @classmethod
    def make(
        cls,
        u: Float[np.ndarray, "m n"],
        error: Float[np.ndarray, "ny n"],
        edges: Int[np.ndarray, " k"],
        far: Int[np.ndarray, " _"],
    ) -> _Past:
        integral = np.cumsum(error, axis=1) - error  # which a law may have, and again
        near = np.arange(1, PAST + 2)
        sums = [(error, near), *([(error, far)] if far.size > 1 else []), (u, edges)]
        return cls(
            error=error,
            sums=tuple((_sum_up(signals, int(lags[-1])), lags) for signals, lags in sums),
            whole=np.vstack([np.ones(error.shape[1]), integral, np.cumsum(integral, axis=1)]),
        )

    def list_rows(self) -> Iterator[Float[np.ndarray, "n c"]]:
        """Yield rows, some at a time: what is known of the residuals, the sums of the inputs, and the residuals."""
        n = self.error.shape[1]
        for a in range(0, n, TOGETHER):
            b = min(a + TOGETHER, n)
            *own, inputs = (_cut_lags(sums, lags, a, b) for sums, lags in self.sums)
            yield np.vstack([*own, self.whole[:, a:b], inputs, self.error[:, a:b]]).T


def _sum_up(signals: Float[np.ndarray, "m n"], last: int) -> Float[np.ndarray, "m _"]:
    """Return sums of signals, about their means; ahead of the first sample they are zero for `last` + 1 columns."""
    sums = np.cumsum(signals - signals.mean(axis=1, keepdims=True), axis=1)
    return np.hstack([np.zeros((len(signals), last + 1)), sums])


def _cut_lags(sums: Float[np.ndarray, "m _"], lags: Int[np.ndarray, " k"], a: int, b: int) -> Float[np.ndarray, "c n"]:
    """Return the sums of each signal over the samples before each of some, from a lag to the next."""
    first = int(lags[-1]) + 1
    parts = [sums[:, first - lag + a : first - lag + b] for lag in lags]
    return np.vstack([near - far for near, far in pairwise(parts)])


def _invert(gram: Float[np.ndarray, "k k"]) -> Float[np.ndarray, "k k"]:
    """Return the inverse of sums of products, without directions that rounding alone keeps apart."""
    size = np.sqrt(np.maximum(np.diag(gram), 1e-300))
    return np.linalg.pinv(gram / np.outer(size, size), rcond=ALIKE, hermitian=True) / np.outer(size, size)


@record(eq=False)
class _Spectra:
    """Power of each signal at each line, the part that the inputs account for, and how many averages they are of."""

    frequency_hz: Float[np.ndarray, " f"]
    power: Float[np.ndarray, "f s"]
    coherent: Float[np.ndarray, "f s"]
    averages: float
    inputs: int

    def compare(self, o: int, trials: int) -> CoherentShare:
        """Return what the inputs account for of an output and of its residual; `trials`: lengths that are tried."""
        by_chance = self.inputs / self.averages
        ny = self.power.shape[1] // 2
        unbiased = np.clip((self.coherent - by_chance * self.power) / (1.0 - by_chance), None, self.power)
        of_output, of_residual = (
            float(np.sum(unbiased[:, s])) / max(float(np.sum(self.power[:, s])), 1e-300) for s in (o, ny + o)
        )
        left = max(float(np.sum(unbiased[:, ny + o])), 0.0) / max(float(np.sum(unbiased[:, o])), 1e-300)
        p, band = self._test(ny + o, trials)
        return CoherentShare(output=max(of_output, 0.0), residual=max(of_residual, 0.0), p=p, band_hz=band, power=left)

    def _test(self, s: int, trials: int) -> tuple[float, tuple[float, float]]:
        """Return the least p of the octaves, and its octave."""
        f = self.frequency_hz
        gamma2 = np.clip(self.coherent[:, s] / np.maximum(self.power[:, s], 1e-300), 0.0, 1.0 - 1e-12)
        gamma2[self.power[:, s] <= 1e-20 * np.sum(self.power[:, s])] = 0.0
        statistic = -np.log1p(-gamma2)
        # Of one line: the sums that differences of the digamma and the trigamma functions are, of a whole number apart.
        terms = 1.0 / (self.averages - 1.0 - np.arange(self.inputs))
        mean, variance = float(np.sum(terms)), float(np.sum(terms**2))
        octave = np.floor(np.log2(f[-1] / f)).astype(int)
        starts = np.flatnonzero(np.diff(octave, prepend=octave[0] + 1))[-OCTAVES:]  # from the lowest one on
        ends, sums = np.append(starts[1:], f.size), np.add.reduceat(statistic, starts)
        best, band = 1.0, (float(f[0]), float(f[-1]))
        for start, end, total in zip(starts[::-1], ends[::-1], sums[::-1], strict=True):
            # Neighbouring lines of a Hann window share two thirds of their amplitude: two lines tell as much as one.
            n = max(0.5 * (end - start), 1.0)
            shape, scale = n * mean**2 / variance, variance / mean
            x = n * float(total) / (end - start) / scale
            p = exceeds(shape, x) if x > shape else 1.0  # less than the mean is chance
            if p < best:
                best, band = p, (float(f[start]), float(f[end - 1]))
        return min(best * starts.size * trials, 1.0), band


def _make_spectra(
    inputs: Sequence[Float[np.ndarray, "m _"]],
    outputs: Sequence[Float[np.ndarray, "s _"]],
    length: int,
    experiment: FitExperiment,
) -> _Spectra | None:
    """Return the spectra over stretches of one length; None where there are too few of them. Stretches are summed as
    they come, short ones several at a time: the memory is small, however long the logs are.
    """
    every = [(i, row) for i, rows in enumerate(inputs) for row in welch.list_starts([slice(0, rows.shape[1])], length)]
    starts = welch.thin(every, MOST)
    averages, m = welch.INDEPENDENT * len(starts), len(inputs[0])
    if len(starts) < FEWEST or averages < 2.0 * m + 1.0:
        return None
    frequency = np.fft.rfftfreq(length, experiment.period)
    low, high = experiment.band_hz or (0.0, np.inf)
    kept = slice(max(int(np.searchsorted(frequency, low)), 1), int(np.searchsorted(frequency, high, side="right")))
    lines = frequency[kept].size
    if lines < 3:
        return None
    window = welch.hann(length)
    s = len(outputs[0])
    of_inputs, across = np.zeros((m, m, lines), dtype=complex), np.zeros((m, s, lines), dtype=complex)
    power = np.zeros((s, lines))
    together = max(TOGETHER // length, 1)
    for first in range(0, len(starts), together):
        cuts = starts[first : first + together]
        u, y = (
            welch.transform(np.stack([rows[i][:, a : a + length] for i, a in cuts]), window)[..., kept]
            for rows in (inputs, outputs)
        )
        conjugate = np.conj(u)[:, :, None]
        of_inputs += np.sum(conjugate * u[:, None], axis=0)
        across += np.sum(conjugate * y[:, None], axis=0)
        power += np.sum(welch.square(y), axis=0)
    coherent = _project(np.moveaxis(of_inputs, 2, 0), np.moveaxis(across, 2, 0))
    return _Spectra(frequency_hz=frequency[kept], power=power.T, coherent=coherent, averages=averages, inputs=m)


def _project(of_inputs: Complex[np.ndarray, "f m m"], across: Complex[np.ndarray, "f m s"]) -> Float[np.ndarray, "f s"]:
    """Return the power of the projections of the outputs on the inputs, line by line, from U^H U and U^H Y. An input
    that is silent at a line, or says there what others say, accounts for nothing more.
    """
    size = np.sqrt(np.einsum("fmm->fm", np.real(of_inputs)))
    size = np.where(size > SILENT * np.max(size, axis=0), size, np.inf)
    values, vectors = np.linalg.eigh(of_inputs / (size[:, :, None] * size[:, None, :]))
    inside = np.conj(np.swapaxes(vectors, 1, 2)) @ (across / size[:, :, None])
    values = np.where(values > ALIKE, values, np.inf)
    return np.sum(np.abs(inside) ** 2 / values[:, :, None], axis=1)
