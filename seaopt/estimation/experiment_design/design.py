r"""Experiment design: the excitation, within the limits of the bench, after which the parameters are known best.

The expected covariance of a fit is the inverse of the Fisher information at the guess,
:math:`F = \sum_t \sum_o \sigma_o^{-2} s_o(t) s_o(t)^T` with the sensitivities s of the outputs to the parameters, the
offsets of the sensors and the initial state (Ljung, System Identification, 2nd ed., Sec. 13.3; Goodwin and Payne 1977).
The reported figures always come from that sum over the samples of the excitation itself, simulated from rest.

A design is as good as its guess: design, measure, fit, and design again.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import field, replace
from typing import Literal

import numpy as np

from seaopt.bench import Chirp, Excitation, Multisine, scale
from seaopt.errors import EstimationError, suggestion
from seaopt.estimation.experiment_design.excitation_search import (
    Chirps,
    ExcitationCandidate,
    ExcitationSearch,
    Limits,
    Multisines,
    best_chirp,
    best_multisine,
    make_measure,
    with_fine_steps,
)
from seaopt.estimation.experiment_design.information import Bench, make_bench
from seaopt.estimation.result.covariance import Covariance
from seaopt.formatting import format_count, html_text
from seaopt.parameters import ParameterSet
from seaopt.plants import Plant
from seaopt.plants.plant import find_range
from seaopt.records import record


@record(eq=False, repr=False)
class ExcitationComparison:
    """The expected result of another excitation, scaled to the design's rms.

    Parameters
    ----------
    excitation : tuple of Chirp, Noise, Multisine
        The other, scaled.
    covariance : Covariance
        Expected after it.
    ratio : mapping of parameter to float
        Its standard deviation over the design's: above 1, the design is better.
    peaks : mapping of signal to float
        Its peaks; those of the limited signals and the input.
    """

    excitation: Excitation
    covariance: Covariance
    ratio: Mapping[str, float]
    peaks: Mapping[str, float]

    def __repr__(self) -> str:
        figures = ", ".join(f"{name} {value:.3g}x" for name, value in self.ratio.items())
        peaks = ", ".join(f"{name} {value:.4g}" for name, value in self.peaks.items())
        return f"Comparison at equal rms: expected std {figures} the design's; peaks {peaks}"


@record(eq=False, repr=False)
class Design:
    """An excitation and the standard deviations to expect of it; ``print(design)`` is a summary.

    Parameters
    ----------
    excitation : tuple of Multisine or Chirp
        Ready for `virtual_log`, or for the bench: ``excite(design.excitation, ...)`` gives its samples.
    criterion : str
        The criterion that was minimised.
    parameters : ParameterSet
        The guess; the free ones carry the std to be expected.
    covariance : Covariance
        Expected after a fit of the log, offsets and initial state being estimated too; priors count.
    rms : float
        Of the input.
    peaks : mapping of signal to float
        Largest magnitude of the input and of each limited signal.
    limits : Limits
        As given, the input's peak within its range.
    """

    excitation: Excitation
    criterion: str
    parameters: ParameterSet
    covariance: Covariance
    rms: float
    peaks: Mapping[str, float]
    limits: Limits
    bench: Bench = field(repr=False)

    @property
    def std(self) -> dict[str, float]:
        """The expected standard deviation of each free parameter."""
        return {name: self.covariance.std(name) for name in self.covariance.names}

    @property
    def half(self) -> Excitation:
        """The excitation at half its amplitude, for a second log on which the fit of the first is validated.

        A model that lacks friction, play or a motor that saturates fits one amplitude and misses the other.
        """
        return scale(self.excitation, 0.5)

    def against(self, excitation: Excitation, *, seed: int = 0) -> ExcitationComparison:
        """Compare with another excitation of equal rms, whatever its peaks.

        Parameters
        ----------
        excitation : tuple of Chirp, Noise, Multisine
            Such as `seaopt.bench.PAPER_STAND`.
        seed : int
            Of its noise.
        """
        u = self.bench.samples(excitation, seed)
        factor = self.rms / float(np.sqrt(np.mean(u**2)))
        trial = self.bench.refine_steps(u * factor).run(u * factor)
        names = self.covariance.names
        covariance = Covariance(names=names, matrix=trial.covariance)
        return ExcitationComparison(
            excitation=scale(excitation, factor),
            covariance=covariance,
            ratio={name: covariance.std(name) / self.covariance.std(name) for name in names},
            peaks=trial.peaks,
        )

    def __repr__(self) -> str:
        limits, at = self.limits, f"{self.limits.duration_s:g} s at {self.limits.rate_hz:g} Hz"
        lines = [f"Design: {_describe(self.excitation)}, {at}; criterion {self.criterion}", "  expected of a fit:"]
        free = ParameterSet(parameter for parameter in self.parameters.values() if parameter.free)
        lines += [f"    {line}" for line in repr(free).splitlines()]
        unit = self.bench.plant.inputs[self.bench.input_name]
        allowed = {self.bench.input_name: limits.peak, **limits.peaks}
        lines.append(f"  {self.bench.input_name}: rms {self.rms:.4g}{_format_limit(limits.rms)} {unit}")
        lines += [f"  {name}: peak {value:.4g}{_format_limit(allowed[name])}" for name, value in self.peaks.items()]
        lines.append("  then a second log at half the amplitude (design.half), on which to validate the fit: a model")
        lines.append("  that lacks friction, play or a motor that saturates fits one amplitude and misses the other")
        return "\n".join(lines)

    _repr_html_ = html_text


def _format_limit(limit: float | None) -> str:
    return "" if limit is None else f" of {limit:.4g}"


def _describe(excitation: Excitation) -> str:
    part = excitation[0]
    if isinstance(part, Multisine):
        f = part.frequencies_hz
        return f"multisine of {format_count(len(f), 'line')}, {f[0]:.3g} to {f[-1]:.3g} Hz"
    assert isinstance(part, Chirp)
    return f"chirp of {part.amplitude:.4g} from {part.f0_hz:.3g} to {part.f1_hz:.3g} Hz"


def design_experiment(
    plant: Plant,
    params: ParameterSet,
    limits: Limits,
    *,
    sigma: Mapping[str, float],
    criterion: str = "A",
    signal: Multisines | Chirps | None = None,
    offset: bool = True,
    initial_state: Literal["estimate", "rest"] = "estimate",
    input_name: str | None = None,
) -> Design:
    """Find the excitation after which the free parameters of `params` are known best.

    Parameters
    ----------
    plant : Plant
        The actuator on the bench, excited at one input from rest, its command held between samples.
    params : ParameterSet
        The guess; priors count as information.
    limits : Limits
        What the bench allows.
    sigma : mapping of output to float
        The outputs that are measured and the standard deviation of their noise, which is taken as white.
    criterion : str
        "A": the sum of the relative variances; "D": the determinant of the covariance; or the name of one free
        parameter, whose variance alone counts.
    signal : Multisines or Chirps, optional
        The kind of signal. If left out, multisines; and where a peak limits the result, chirps as well,
        whose peaks are low: the better is returned.
    offset : bool
        Whether the fit estimates an offset of each output.
    initial_state : {"estimate", "rest"}
        Whether the fit estimates the initial state.
    input_name : str, optional
        The input that is excited; the plant's first if left out. The others are zero.

    Returns
    -------
    Design
        Within the limits, checked by simulating it.

    Raises
    ------
    EstimationError
        Nothing is free, a name is unknown, or the outputs cannot identify the free parameters.

    References
    ----------
    G. C. Goodwin and R. L. Payne, Dynamic System Identification, 1977; L. Ljung, System Identification, 2nd ed., 1999.

    Examples
    --------
    >>> import seaopt as so
    >>> from seaopt.bench import PAPER_STAND
    >>> design = design_experiment(
    ...     so.plants.high_impedance(), so.plants.thor().free("J", "b_r"), Limits(duration_s=20, rate_hz=400, rms=1.7),
    ...     sigma={"F1": 2.0, "F2": 2.0})
    >>> round(design.rms, 6), design.against(PAPER_STAND).ratio["J"] > 2
    (1.7, True)
    """
    limits = _keep_range(limits, plant, params, input_name)
    bench = make_bench(
        plant,
        params,
        sigma,
        duration_s=limits.duration_s,
        rate_hz=limits.rate_hz,
        offset=offset,
        initial_state=initial_state,
        input_name=input_name,
        watched=_limited_signals(plant, limits),
    )
    measure = make_measure(bench, criterion)
    search = ExcitationSearch(bench=bench, limits=limits, measure=measure)
    band = _band(None if signal is None else signal.band_hz, limits)
    search = with_fine_steps(search, band)
    if isinstance(signal, Chirps):
        candidate = best_chirp(search, band)
    else:
        candidate = best_multisine(search, band, signal if signal is not None else Multisines())
    if signal is None and search.is_peak_limited(candidate.trial):
        candidate = min(candidate, best_chirp(search, band), key=lambda option: option.value)
    return _design(search, candidate, criterion)


def expected_covariance(
    plant: Plant,
    params: ParameterSet,
    excitation: Excitation,
    *,
    sigma: Mapping[str, float],
    duration_s: float,
    rate_hz: float,
    seed: int = 0,
    offset: bool = True,
    initial_state: Literal["estimate", "rest"] = "estimate",
    input_name: str | None = None,
) -> Covariance:
    """Return the covariance to be expected of a fit to a log of any excitation, from rest.

    Parameters
    ----------
    plant, params, sigma, offset, initial_state, input_name
        As for `design_experiment`.
    excitation : tuple of Chirp, Noise, Multisine
        Summed, held between samples.
    duration_s, rate_hz : float
        Length and sample rate.
    seed : int
        Of the excitation's noise.

    Examples
    --------
    >>> import seaopt as so
    >>> from seaopt.bench import PAPER_STAND
    >>> plant, params = so.plants.high_impedance(), so.plants.thor().free("J")
    >>> short, long = (
    ...     expected_covariance(plant, params, PAPER_STAND, sigma={"F1": 2.0}, duration_s=s, rate_hz=400).std("J")
    ...     for s in (10, 40))
    >>> 1.8 < short / long < 2.2
    True
    """
    bench = make_bench(
        plant,
        params,
        sigma,
        duration_s=duration_s,
        rate_hz=rate_hz,
        offset=offset,
        initial_state=initial_state,
        input_name=input_name,
    )
    u = bench.samples(excitation, seed)
    return Covariance(names=bench.model.free, matrix=bench.refine_steps(u).run(u).covariance)


def _keep_range(limits: Limits, plant: Plant, params: ParameterSet, input_name: str | None) -> Limits:
    """Return limits whose peak is no more than acts on the plant: of a duty, 1."""
    most = find_range(plant, params) if input_name in (None, next(iter(plant.inputs), None)) else None
    if most is None:
        return limits
    return replace(limits, peak=most if limits.peak is None else min(limits.peak, most))


def _limited_signals(plant: Plant, limits: Limits) -> tuple[str, ...]:
    signals = (*plant.outputs, *plant.states)
    for name in limits.peaks:
        if name not in signals:
            raise EstimationError(
                f'limits: peaks names "{name}", which is not an output or state of {plant.name}; '
                f"{suggestion(name, signals)}"
            )
    return tuple(limits.peaks)


def _band(band_hz: tuple[float, float] | None, limits: Limits) -> tuple[float, float]:
    low, high = band_hz if band_hz is not None else (4.0 / limits.duration_s, 0.4 * limits.rate_hz)
    if not 0.0 < low < high < 0.5 * limits.rate_hz:
        raise EstimationError(
            f"band_hz = [{low:g}, {high:g}] is not a band below half the sample rate ({0.5 * limits.rate_hz:g} Hz); "
            "give [low, high] with 0 < low < high"
        )
    return low, high


def _design(search: ExcitationSearch, candidate: ExcitationCandidate, criterion: str) -> Design:
    """Report a search's best candidate, simulated with steps that are fine enough."""
    bench = search.bench.refine_steps(search.bench.samples(candidate.excitation))
    final = replace(search, bench=bench).scale_to_limits(candidate.excitation)
    names = bench.model.free
    covariance = Covariance(names=names, matrix=final.trial.covariance)
    for name in names:
        if not np.isfinite(covariance.std(name)):
            raise EstimationError(
                f"{name} cannot be distinguished from the other unknowns by any excitation that was tried; "
                "fix one, give it a prior, or measure another output"
            )
    figures = (replace(bench.problem.params[name], std=covariance.std(name)) for name in names)
    return Design(
        excitation=final.excitation,
        criterion=criterion,
        parameters=bench.problem.params.with_parameters(*figures),
        covariance=covariance,
        rms=final.trial.rms,
        peaks=final.trial.peaks,
        limits=search.limits,
        bench=bench,
    )
