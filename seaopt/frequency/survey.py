"""The frequency responses of one log, from each excited input to each measured output, for `seaopt frf` and the report.

A pair has its H1 estimate, the band in which it can be trusted, its peak and its second-order form. The form is read as
the source paper reads (16) where the plant says so: two poles, no zero, b = k/m_k.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
from jaxtyping import Bool

from seaopt import welch
from seaopt.codec import to_content
from seaopt.errors import LogError
from seaopt.frequency.response import ComplexLines, FrequencyResponse, Lines, find_band, h1
from seaopt.frequency.sampled import sampled_response
from seaopt.frequency.second_order import (
    MIN_COHERENCE,
    MIN_LINES,
    DriveEstimate,
    SecondOrder,
    coherent_lines,
    second_order,
)
from seaopt.logs import Log
from seaopt.parameters import Parameter, ParameterSet
from seaopt.plants import CompletedParameters, Plant, SeriesSpring
from seaopt.plants.friction import take_sliding
from seaopt.plants.plant import evaluate
from seaopt.records import record
from seaopt.simulation import Clock, linearise, make_model
from seaopt.units import mechanics_of

MIN_RESPONSE_SAMPLES = 256  # samples
SMOOTH = 5  # lines of which the median coherence decides where a band ends
ResponseFunction = Callable[[Any], Any]


@record
class Peak:
    """The largest response inside the good band; `magnitude` has the pair's unit."""

    frequency_hz: float
    magnitude: float
    std: float


@record(eq=False)
class Pair:
    """From one input to one output.

    Parameters
    ----------
    source, output : str
        Names of input and output.
    unit : str
        Output unit over input unit.
    estimate : FrequencyResponse
        H1 and coherence.
    good_band_hz : (low, high) or None
        The widest band, on a logarithmic axis, in which the coherence stays above 0.8.
    peak : Peak or None
        None where the response is largest at an end of the good band.
    second_order : SecondOrder or None
        None where too few frequencies are coherent.
    """

    source: str
    output: str
    unit: str
    estimate: FrequencyResponse
    good_band_hz: tuple[float, float] | None
    peak: Peak | None
    second_order: SecondOrder | None

    @property
    def name(self) -> str:
        """Output over input, such as F1/I."""
        return f"{self.output}/{self.source}"

    @property
    def used(self) -> Bool[np.ndarray, " m"]:
        """The coherent frequencies, those that are compared with models."""
        return coherent_lines(self.estimate)

    def misfit(self, response: ResponseFunction) -> float:
        """Return how far a response, a function of frequencies in Hz, lies from the estimate.

        The root mean square over the coherent frequencies in standard deviations of the estimate; 1 explains the log.
        """
        used = self.used
        if not np.any(used):
            return float("nan")
        measured = self.estimate.response[used]
        sigma = np.maximum(self.estimate.relative_std[used], 1e-9) * np.abs(measured)
        away = (self.estimate.expected(response)[used] - measured) / sigma
        return float(np.sqrt(np.mean(np.abs(away) ** 2) / 2.0))


@record(eq=False)
class StoredPair:
    """What frf.json has of a pair besides what is made of it."""

    input: str
    output: str
    unit: str
    averages: int
    good_band_hz: tuple[float, float] | None
    peak: Peak | None
    second_order: SecondOrder | None
    frequency_hz: Lines
    real: Lines
    imag: Lines
    coherence: Lines

    def make(self) -> Pair:
        """Return the pair."""
        estimate = FrequencyResponse(
            frequency_hz=self.frequency_hz,
            response=self.real + 1j * self.imag,
            coherence=self.coherence,
            averages=self.averages,
        )
        return Pair(
            source=self.input,
            output=self.output,
            unit=self.unit,
            estimate=estimate,
            good_band_hz=self.good_band_hz,
            peak=self.peak,
            second_order=self.second_order,
        )


@record(eq=False)
class StoredSurvey:
    """What frf.json has of a survey besides what is made of it."""

    clock: Clock
    gain: Mapping[str, float]
    own: Mapping[str, float]  # values of parameters of this log alone
    pairs: tuple[StoredPair, ...]

    def make(self, plant: Plant) -> Survey:
        """Return the survey of a plant's log."""

        def adapt(params: ParameterSet) -> ParameterSet:
            own = {
                name: Parameter(name=name, value=at, unit=plant.parameter_unit(name)) for name, at in self.own.items()
            }
            return params.with_parameters(*own.values())

        pairs = tuple(pair.make() for pair in self.pairs)
        return Survey(plant=plant, clock=self.clock, gain=self.gain, pairs=pairs, adapt=adapt)


@record(eq=False)
class Survey:
    """The pairs of one log.

    Parameters
    ----------
    plant : Plant
        The plant on the bench.
    clock : Clock
        Of the log.
    gain : mapping of output to float
        Of the sensors: measured = gain * output.
    pairs : tuple of Pair
        Input by input.
    adapt : callable ``params -> params``
        Puts parameters of this log alone in their places.
    """

    plant: Plant
    clock: Clock
    gain: Mapping[str, float]
    pairs: tuple[Pair, ...]
    adapt: Callable[[ParameterSet], ParameterSet] = lambda params: params

    def model(self, pair: Pair, params: ParameterSet) -> ResponseFunction:
        """Return the plant's response as the sensors see it, linearised at rest, as a function of frequencies in Hz.

        A plant with dry friction slides: what moves enough to be measured does, and at rest it would be a damper.
        """
        params = self.adapt(params)
        model = linearise(make_model(take_sliding(self.plant, params), params, (), (pair.output,)))
        clock = replace(self.clock, delay_free=False)
        source, gain = list(self.plant.inputs).index(pair.source), self.gain.get(pair.output, 1.0)

        def response(f: Lines) -> ComplexLines:
            return gain * sampled_response(model, np.zeros(0), clock, f, source)[0][:, 0]

        return response

    def drive(self, pair: Pair, params: ParameterSet) -> DriveEstimate | None:
        """Return the actuator's parameters that a pair's second-order form implies, with k known, as in (16).

        None where the plant does not have the form k/(m_k s^2 + b_m s + k) from this input to this output, a force or a
        torque.
        """
        plant, values = self.plant, self.plant.complete(self.adapt(params))
        actuation, spring, sensing = plant.actuation, plant.spring, plant.sensing
        if pair.second_order is None or actuation is None or spring is None or spring.stiffness is None:
            return None
        if (sensing is not None and pair.output not in sensing.regulated) or not _is_form(plant, spring, values, pair):
            return None
        k, lossless = values[spring.stiffness], values
        if actuation.efficiency is not None:
            lossless = plant.complete(values.update(**{actuation.efficiency: 1.0}))
        per_input = evaluate(actuation.effort, lossless) * self.gain.get(pair.output, 1.0)
        return pair.second_order.drive(
            k.value, per_input, k_std=k.std or k.prior_std or 0.0, called=mechanics_of(actuation.unit)
        )

    def to_dict(self, params: ParameterSet) -> dict[str, Any]:
        """Return one experiment's part of frf.json; `params` are the values that models are drawn with."""
        adapted = self.adapt(params)
        own = {name: each.value for name, each in adapted.items() if name not in params or each is not params[name]}
        return {
            "period_s": self.clock.period,
            "hold": self.clock.hold,
            "clock": to_content(self.clock),
            "gain": self.gain,
            "own": own,
            "pairs": [_pair_dict(self, pair, params) for pair in self.pairs],
        }


def survey(
    plant: Plant,
    log: Log,
    *,
    outputs: Sequence[str] = (),
    clock: Clock | None = None,
    gain: Mapping[str, float] | None = None,
    stretch_s: float | None = None,
) -> Survey:
    """Estimate the frequency responses of a log.

    Parameters
    ----------
    plant : Plant
        Its input and output names are those of the log's channels.
    log : Log
        One segment without gaps. Inputs excited together count as noise to one another.
    outputs : sequence of str, optional
        Every output of the plant that the log has, if left out.
    clock : Clock, optional
        The log's period and hold and the input's delay, estimated where ``delay_free``; no delay and a zero-order hold
        if left out.
    gain : mapping of output to float, optional
        Of the sensors; 1 where left out.
    stretch_s : float, optional
        Length of a window, as of `h1`.

    Raises
    ------
    LogError
        No input is excited, an output has missing samples, or the log is too short or has gaps.

    Examples
    --------
    >>> import seaopt as so
    >>> from seaopt.bench import PAPER_STAND
    >>> plant = so.plants.high_impedance()
    >>> log = so.virtual_log(plant, so.plants.thor(), PAPER_STAND, duration_s=20, rate_hz=400, seed=1)
    >>> [pair.name for pair in survey(plant, log, outputs=("F1", "F2")).pairs]
    ['F1/I', 'F2/I']
    """
    names = tuple(outputs) or tuple(name for name in plant.outputs if name in log.signals)
    present = [name for name in plant.inputs if name in log.signals]
    sources = [name for name in present if np.ptp(log[name]) != 0.0]
    if not sources:
        what = ", ".join(present) or "an input"
        raise LogError(f"{log.source}: {what} is constant or absent; a frequency response needs excitation")
    check_record(log, (*sources, *names))
    chosen = clock if clock is not None else Clock(period=log.period)
    pairs = [_pair(plant, log, chosen, source, name, stretch_s) for source in sources for name in names]
    return Survey(plant=plant, clock=chosen, gain=dict(gain or {}), pairs=tuple(pairs))


def check_record(log: Log, names: Sequence[str]) -> None:
    """Refuse a log that has gaps, is too short for a frequency response, or lacks samples of some channels."""
    if len(log.segments) != 1:
        raise LogError(
            f"{log.source}: the log has {len(log.segments)} segments between gaps and a frequency response takes one; "
            "choose one with slice_s"
        )
    if len(log) < MIN_RESPONSE_SAMPLES:
        raise LogError(
            f"{log.source}: {len(log)} samples are too few for a frequency response; use a log of "
            f"{MIN_RESPONSE_SAMPLES} or more"
        )
    for name in names:
        lost = int(np.count_nonzero(~np.isfinite(log[name])))
        if lost:
            raise LogError(
                f"{log.source}: {lost} samples of {name} are missing or masked and a frequency response takes all; "
                "choose a segment with slice_s"
            )


def _pair(plant: Plant, log: Log, clock: Clock, source: str, output: str, stretch_s: float | None) -> Pair:
    from scipy.ndimage import median_filter  # deferred: 0.2 s

    estimate = h1(log[source], log[output], log.period, stretch_s=stretch_s)
    divisor = plant.inputs[source]
    unit = f"{plant.outputs[output]}/" + (f"({divisor})" if " " in divisor or "/" in divisor else divisor)
    used = coherent_lines(estimate)
    form = second_order(estimate, clock, unit=unit, use=used) if np.count_nonzero(used) >= MIN_LINES else None
    good = median_filter(estimate.coherence, SMOOTH, mode="nearest") > MIN_COHERENCE  # a line that strays ends no band
    lines = estimate.frequency_hz[find_band(estimate.frequency_hz, good)]
    band = (float(lines[0]), float(lines[-1])) if lines.size else None
    return Pair(
        source=source,
        output=output,
        unit=unit,
        estimate=estimate,
        good_band_hz=band,
        peak=_peak(estimate, band),
        second_order=form,
    )


def _peak(estimate: FrequencyResponse, band: tuple[float, float] | None) -> Peak | None:
    """Return the top of the lines of a band; None where the response is largest at an end of it."""
    if band is None:
        return None
    inside = np.flatnonzero((estimate.frequency_hz >= band[0]) & (estimate.frequency_hz <= band[1]))
    size, std = np.abs(estimate.response[inside]), estimate.relative_std[inside]
    top = int(np.argmax(size))
    if top in (0, size.size - 1):
        return None
    at, height = welch.find_top(estimate.frequency_hz[inside], size, std)
    return Peak(frequency_hz=at, magnitude=height, std=float(std[top]) * height)


def _is_form(plant: Plant, spring: SeriesSpring, values: CompletedParameters, pair: Pair) -> bool:
    """Tell whether the plant at rest has two poles, no zero from input to output, and b = k/m_k."""
    if len(plant.states) != 2 or spring.mass is None or spring.stiffness is None:
        return False
    g, _ = linearise(make_model(plant, values, (), (pair.output,))).matrices(np.zeros(0))
    column = 2 + list(plant.inputs).index(pair.source)
    a, b, c, through = g[:2, :2], g[:2, column], g[2, :2], g[2, column]
    mass, _ = plant.derived_values()[spring.mass]
    stiff = values[spring.stiffness].value / float(ca.Function("mass", [plant.p], [mass])(values.vector))
    if not np.isclose(np.linalg.det(a), stiff, rtol=1e-6):
        return False
    static = float(c @ np.linalg.solve(a, b))
    return bool(through == 0.0 and abs(c @ b) <= 1e-9 * abs(static) * np.sqrt(stiff))


def _pair_dict(measured: Survey, pair: Pair, params: ParameterSet) -> dict[str, Any]:
    estimate = pair.estimate
    return {
        "input": pair.source,
        "output": pair.output,
        "unit": pair.unit,
        "averages": estimate.averages,
        "good_band_hz": pair.good_band_hz,
        "peak": to_content(pair.peak),
        "second_order": to_content(pair.second_order),
        "actuator": to_content(measured.drive(pair, params)),
        "model_misfit": pair.misfit(measured.model(pair, params)),
        "frequency_hz": estimate.frequency_hz,
        "real": np.real(estimate.response),
        "imag": np.imag(estimate.response),
        "relative_std": estimate.relative_std,
        "coherence": estimate.coherence,
    }
