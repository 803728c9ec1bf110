r"""Searches for an excitation: the limits of the bench, the criterion, and the best multisines and chirps.

A multisine is found in three steps: the powers of its lines, a convex problem for the linearised plant
(`seaopt.estimation.experiment_design.spectrum`); phases for low peaks; and, where the plant is not linear, a search
over amplitudes and phases on the information of the samples themselves. A peak is not convex in powers: it is a
multiple of the rms, guessed first and then taken from the signals that were found.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import field, replace

import numpy as np
from jaxtyping import Bool, Float

from seaopt.bench import Chirp, Excitation, Multisine, scale
from seaopt.errors import EstimationError, require_memory, suggestion
from seaopt.estimation.experiment_design.information import Bench, Trial
from seaopt.estimation.experiment_design.spectrum import (
    Lines,
    Signals,
    Spectrum,
    choose_harmonics,
    low_peak_phases,
    make_spectrum,
    optimal_powers,
    schroeder_phases,
)
from seaopt.estimation.problem.shapes import ParameterMatrix
from seaopt.records import record

POWER_ROUNDS = 4  # of powers, phases, and the peaks that they give
FAINT = 1e-3  # lines with less than this part of the largest power are left out
BAND_NODES = 8  # of the coarse grids of bands
REFINED_LINES = 8  # of a multisine for a plant that is not linear
SCALINGS = 20
SCALING_MARGIN = 1e-9


@record
class Limits:
    """The limits of the bench.

    Parameters
    ----------
    duration_s, rate_hz : float
        Length and sample rate of the log.
    rms, peak : float, optional
        Of the input over the log, in its unit (A).
    peaks : mapping of output or state to float
        Largest magnitude of each, from rest, in its unit (N, rad, ...).

    Raises
    ------
    EstimationError
        A limit is not positive, or none limits the size of the excitation.
    """

    duration_s: float
    rate_hz: float
    rms: float | None = None
    peak: float | None = None
    peaks: Mapping[str, float] = field(default_factory=dict[str, float])

    def __post_init__(self) -> None:
        numbers = {"duration_s": self.duration_s, "rate_hz": self.rate_hz, "rms": self.rms, "peak": self.peak}
        for name, value in (*numbers.items(), *self.peaks.items()):
            if value is not None and not 0.0 < value < np.inf:
                raise EstimationError(f"limits: {name} = {value} is not a limit; give a positive number")
        if self.rms is None and self.peak is None and not self.peaks:
            raise EstimationError("limits: nothing bounds the excitation; give rms, peak, or peaks = {output: value}")
        argument = f"limits: duration_s = {self.duration_s:g} at rate_hz = {self.rate_hz:g}"
        require_memory(20.0 * self.duration_s * self.rate_hz, argument, EstimationError)
        if round(self.duration_s * self.rate_hz) < 8:
            raise EstimationError(
                f"limits: {self.duration_s:g} s at {self.rate_hz:g} Hz are fewer than 8 samples; lengthen duration_s"
            )


@record
class Multisines:
    """Look for a sum of sines on multiples of 1/duration.

    Parameters
    ----------
    lines : int
        Candidates, log-spaced over the band; a design uses few of them.
    band_hz : (low, high), optional
        From four periods in the log to 0.4 of the sample rate if left out.
    spread : float
        The part of the power that is spread evenly over all candidates, 0 to below 1: a log with
        power everywhere also shows what the model lacks, and depends less on the guess.
    """

    lines: int = 60
    band_hz: tuple[float, float] | None = None
    spread: float = 0.0


@record
class Chirps:
    """Look for the ends and the amplitude of a logarithmic chirp, the simple alternative.

    Parameters
    ----------
    band_hz : (low, high), optional
        As for `Multisines`.
    """

    band_hz: tuple[float, float] | None = None


@record(eq=False)
class Measure:
    """A criterion: log of trace(W C), or of det C without W; and the power of the amplitude that it falls with."""

    weight: ParameterMatrix | None
    order: float

    def __call__(self, covariance: ParameterMatrix) -> float:
        """Return the criterion of a covariance; infinite where something cannot be identified."""
        if not np.all(np.isfinite(covariance)):
            return np.inf
        if self.weight is None:
            return float(np.linalg.slogdet(covariance)[1])
        return float(np.log(np.trace(self.weight @ covariance)))


def make_measure(bench: Bench, criterion: str) -> Measure:
    """Return the criterion "A", "D" or a free parameter's. Raises EstimationError: unknown, or relative to zero."""
    names = bench.model.free
    if criterion == "D":
        return Measure(weight=None, order=2.0 * len(names))
    if criterion in names:
        return Measure(weight=np.diag([float(name == criterion) for name in names]), order=2.0)
    if criterion != "A":
        raise EstimationError(f'criterion = "{criterion}" is not known; {suggestion(criterion, ("A", "D", *names))}')
    for name, value in zip(names, bench.theta, strict=True):
        if value == 0.0:
            raise EstimationError(
                f'{name} = 0 has no relative variance, which criterion = "A" adds up; '
                f'give the size expected, update({name}=...), or use criterion = "D"'
            )
    return Measure(weight=np.diag(bench.theta**-2.0), order=2.0)


@record(eq=False)
class ExcitationCandidate:
    """An excitation within the limits, the trial of it, and its criterion."""

    excitation: Excitation
    trial: Trial
    value: float


@record(eq=False)
class ExcitationSearch:
    """The bench, the limits and the criterion of a search."""

    bench: Bench
    limits: Limits
    measure: Measure

    def is_peak_limited(self, trial: Trial) -> bool:
        """Tell whether a peak, not the rms, limits the excitation."""
        return self.limits.rms is None or bool(trial.rms < 0.99 * self.limits.rms)

    def largest_use(self, trial: Trial) -> float:
        """Return the largest of all limited quantities over their limits."""
        shares = [0.0 if self.limits.rms is None else trial.rms / self.limits.rms]
        if self.limits.peak is not None:
            shares.append(trial.peaks[self.bench.input_name] / self.limits.peak)
        shares += [trial.peaks[name] / limit for name, limit in self.limits.peaks.items()]
        return float(np.max(shares)) if np.all(np.isfinite(shares)) else np.inf

    def scale_to_limits(self, excitation: Excitation) -> ExcitationCandidate:
        """Scale the excitation to be as large as the limits allow. Raises EstimationError: no size is within."""
        u = self.bench.samples(excitation)
        low, high, factor = 0.0, np.inf, 1.0
        best: ExcitationCandidate | None = None
        for _ in range(SCALINGS):
            trial = self.bench.run(factor * u)
            use = self.largest_use(trial)
            if use <= 1.0:
                low = factor
                best = ExcitationCandidate(
                    excitation=scale(excitation, factor), trial=trial, value=self.measure(trial.covariance)
                )
                if use > 0.999:
                    break
            else:
                high = factor
            guess = factor / use * (1.0 - SCALING_MARGIN) if 0.0 < use < np.inf else 0.0
            factor = guess if low < guess < high else (np.sqrt(low * high) if low > 0.0 else 0.1 * high)
            if not np.isfinite(factor):
                break
        if best is None:
            raise EstimationError("no amplitude keeps the plant within its limits; check limits and parameters")
        return best


def _choose_better(best: ExcitationCandidate | None, candidate: ExcitationCandidate) -> ExcitationCandidate:
    return candidate if best is None or candidate.value < best.value else best


def best_multisine(search: ExcitationSearch, band: tuple[float, float], chosen: Multisines) -> ExcitationCandidate:
    """Return the best multisine within the limits. Raises EstimationError: nothing in the band distinguishes the free
    parameters, or a setting is out of range.
    """
    bench = search.bench
    if chosen.lines < 1 or not 0.0 <= chosen.spread < 1.0:
        raise EstimationError(
            f"lines = {chosen.lines}, spread = {chosen.spread:g}; give at least 1 line and a spread of 0 to below 1"
        )
    rate = 1.0 / bench.clock.period
    multiples = choose_harmonics(bench.n, rate, band, chosen.lines)
    signals = [-1, *(bench.place(name) for name in search.limits.peaks)]
    lines = make_spectrum(
        bench.model,
        bench.theta,
        bench.clock,
        multiples,
        n=bench.n,
        sigma=bench.sigma,
        channel=bench.channel,
        signals=signals,
    )
    if bench.model.linear:
        return _solve_convex(search, lines, chosen.spread)
    return _refine(search, _best_start(search, lines, chosen.spread))


def _best_start(search: ExcitationSearch, lines: Spectrum, spread: float) -> ExcitationCandidate:
    """Return the best of the linearised plant's optimum, if any, and even spectra between any two of BAND_NODES."""
    best: ExcitationCandidate | None = None
    with suppress(EstimationError):  # linearised, a friction and a damping are one
        best = _solve_convex(search, lines, spread)
    nodes = np.linspace(0, lines.harmonics.size - 1, BAND_NODES)
    for i, low in enumerate(nodes):
        for high in nodes[i:]:
            chosen = np.unique(np.linspace(low, high, REFINED_LINES).round().astype(int))
            powers = np.full(lines.harmonics.size, spread / lines.harmonics.size)
            powers[chosen] += (1.0 - spread) / chosen.size
            kept = powers > 0.0
            candidate = search.scale_to_limits(
                _multisine(search.bench, _select_lines(lines, kept), powers[kept], schroeder_phases(powers[kept]))
            )
            best = _choose_better(best, candidate)
    assert best is not None
    return best


def _solve_convex(search: ExcitationSearch, lines: Spectrum, spread: float) -> ExcitationCandidate:
    """Alternate powers, within peaks guessed as multiples of each rms, and phases, which give those multiples."""
    limits, problem = search.limits, search.bench.problem
    prior = np.diag(problem.unknowns.precision[: problem.unknowns.shared])
    share = (1.0 - spread) * np.eye(lines.harmonics.size) + spread / lines.harmonics.size
    information = np.einsum("jk,jab->kab", share, lines.information)
    caps = np.array([np.inf if limits.peak is None else limits.peak, *limits.peaks.values()])
    crest = np.full(caps.size, 2.0)
    best: ExcitationCandidate | None = None
    for _ in range(POWER_ROUNDS if np.any(np.isfinite(caps)) else 1):
        rows = np.abs(lines.gains) ** 2 * (crest / caps)[:, None] ** 2
        rows = rows[np.isfinite(caps)]
        if limits.rms is not None:
            rows = np.vstack([rows, np.full(lines.harmonics.size, limits.rms**-2.0)])
        powers = share @ optimal_powers(information, rows @ share, weight=search.measure.weight, prior=prior)
        kept = powers > FAINT * np.max(powers)
        candidate = search.scale_to_limits(_low_peaks(search, _select_lines(lines, kept), powers[kept], caps))
        if best is not None and candidate.value >= best.value:
            break
        best = candidate
        part = candidate.excitation[0]
        assert isinstance(part, Multisine)
        rms = np.sqrt(np.abs(lines.gains[:, kept]) ** 2 @ (np.array(part.amplitudes) ** 2 / 2))
        peaks = candidate.trial.peaks
        crest = np.array([peaks[search.bench.input_name], *(peaks[name] for name in limits.peaks)]) / rms
    assert best is not None
    return best


def _select_lines(lines: Spectrum, kept: Bool[np.ndarray, " K"]) -> Spectrum:
    return replace(
        lines, harmonics=lines.harmonics[kept], information=lines.information[kept], gains=lines.gains[:, kept]
    )


def _low_peaks(search: ExcitationSearch, lines: Spectrum, powers: Lines, caps: Float[np.ndarray, " m"]) -> Excitation:
    """Return the multisine of given powers whose limited signals have the lowest peaks; the input's if none is."""
    sizes = np.where(np.isfinite(caps), caps, 1.0)
    kept = np.isfinite(caps) if np.any(np.isfinite(caps)) else np.arange(caps.size) == 0
    signals: Signals = (lines.gains * np.sqrt(2.0 * powers) / sizes[:, None])[kept]
    phases = low_peak_phases(signals, lines.harmonics, search.bench.n, schroeder_phases(powers))
    return _multisine(search.bench, lines, powers, phases)


def _multisine(bench: Bench, lines: Spectrum, powers: Lines, phases: Lines) -> Excitation:
    base = 1.0 / (bench.n * bench.clock.period)
    part = Multisine(
        amplitudes=tuple(float(a) for a in np.sqrt(2.0 * powers)),
        frequencies_hz=tuple(float(base * h) for h in lines.harmonics),
        phases_rad=tuple(float(phase) for phase in np.mod(phases, 2 * np.pi)),
    )
    return (part,)


def _refine(search: ExcitationSearch, start: ExcitationCandidate) -> ExcitationCandidate:
    """Improve amplitudes and phases of the strongest lines on the information of the samples themselves."""
    search = replace(search, bench=search.bench.refine_steps(search.bench.samples(start.excitation)))
    part = start.excitation[0]
    assert isinstance(part, Multisine)
    best = search.scale_to_limits(start.excitation)
    amplitudes, phases = np.array(part.amplitudes), np.array(part.phases_rad)
    free = np.sort(np.argsort(amplitudes, kind="stable")[::-1][:REFINED_LINES])

    def build(x: Float[np.ndarray, " m"]) -> Excitation:
        a, phi = amplitudes.copy(), phases.copy()
        a[free], phi[free] = np.exp(x[: free.size]), x[free.size :]
        return (replace(part, amplitudes=tuple(map(float, a)), phases_rad=tuple(map(float, phi))),)

    from scipy.optimize import minimize  # deferred: 0.3 s

    x = minimize(
        lambda x: _smooth_criterion(search, build(x)),
        np.concatenate([np.log(amplitudes[free]), phases[free]]),
        method="L-BFGS-B",
        jac="2-point",
        options={"maxiter": 15, "eps": 1e-4, "maxfun": 300},
    ).x
    return _choose_better(best, search.scale_to_limits(build(np.asarray(x))))


def _smooth_criterion(search: ExcitationSearch, excitation: Excitation) -> float:
    """Return the criterion of an excitation scaled to its limits, but for two steps: smooth, and right in the limit."""
    u = search.bench.samples(excitation)
    first = search.largest_use(search.bench.run(u))
    if not 0.0 < first < np.inf:
        return 1e6
    second = search.bench.run(u / first)
    use = search.largest_use(second)
    value = search.measure(second.covariance)
    return value + search.measure.order * np.log(use) if np.isfinite(value) and np.isfinite(use) else 1e6


def with_fine_steps(search: ExcitationSearch, band: tuple[float, float]) -> ExcitationSearch:
    """Return the search with integration steps that are fine enough for a chirp over the whole band."""
    if search.bench.model.linear:
        return search
    candidate = search.scale_to_limits(_chirp(np.log(band[0]), np.log(band[1])))
    return replace(search, bench=search.bench.refine_steps(search.bench.samples(candidate.excitation)))


def best_chirp(search: ExcitationSearch, band: tuple[float, float]) -> ExcitationCandidate:
    """Look over a coarse grid of both ends, then refine the best by Nelder and Mead's simplex."""
    from scipy.optimize import minimize  # deferred: 0.3 s

    nodes = np.linspace(np.log(band[0]), np.log(band[1]), BAND_NODES)
    best: ExcitationCandidate | None = None
    ends = np.zeros(2)
    for i, low in enumerate(nodes):
        for high in nodes[i + 1 :]:
            candidate = search.scale_to_limits(_chirp(low, high))
            if best is None or candidate.value < best.value:
                best, ends = candidate, np.array([low, high])
    assert best is not None

    def cost(x: Float[np.ndarray, " 2"]) -> float:
        if not nodes[0] <= x[0] < x[1] - 0.01 or x[1] > nodes[-1]:
            return 1e6
        return search.scale_to_limits(_chirp(x[0], x[1])).value

    x = np.asarray(minimize(cost, ends, method="Nelder-Mead", options={"maxfev": 80, "xatol": 1e-3}).x)
    return _choose_better(best, search.scale_to_limits(_chirp(x[0], x[1])))


def _chirp(low: float, high: float) -> Excitation:
    return (Chirp(amplitude=1.0, f0_hz=float(np.exp(low)), f1_hz=float(np.exp(high))),)
