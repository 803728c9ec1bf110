r"""A measured frequency response with its uncertainty: at every line a disc that holds the truth, at a confidence.

With :math:`n_d` averages of windows the error of the H1 estimate of a log with a known input is a complex normal one,
and at one line (Goodman 1965; Bendat and Piersol, Random Data, 4th ed., ch. 9)

.. math:: P\Big(|H - H_1|^2 > |H_1|^2\,\frac{1-\gamma^2}{\gamma^2}\,\big(\alpha^{-1/(n_d-1)} - 1\big)\Big) = \alpha .

All discs together hold the truth with the confidence stated: :math:`\alpha = (1 - \text{confidence})/m` at each of m
lines (Bonferroni), those of all lengths of windows that are compared. The radius includes what the estimate
cannot see: Hann's window takes the mean of three lines, which is off by :math:`|\Delta^2 H|/6`, and a straight line
from one frequency to the next by :math:`|\Delta^2 H|/8`, with :math:`\Delta^2` the second difference over neighbouring
lines. A resonance narrower than a line is not seen.

Further assumptions: the log was taken in open loop (under feedback H1 tends to -1/C), its input is known without
noise, and what disturbed it is as strong throughout.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import field, replace
from itertools import pairwise
from typing import Any

import numpy as np
from jaxtyping import Int

from seaopt.errors import LogError, require_number
from seaopt.frequency.response import ComplexLines, FrequencyResponse, Lines, find_band, h1, measure_bend
from seaopt.frequency.survey import check_record
from seaopt.logs import Log
from seaopt.plants import Plant
from seaopt.records import record
from seaopt.simulation import Clock
from seaopt.welch import INDEPENDENT

LARGEST_DISC = 0.5  # radius over response: where it is larger, nothing is known
HIGHEST = 0.9  # of the log's Nyquist frequency: above, what is sampled is folded
SMOOTH = 5  # lines of which the median radius decides where the band ends
LEAST_LINES = 8
UNSEEN = 1.0 / 6.0 + 1.0 / 8.0  # of the second difference: window and interpolation
LONGEST, SHORTEST = 16, 64  # windows in a log; samples in a window
PARTS, OCTAVES = 3, 20  # windows are chosen anew in every third of an octave


@record(eq=False)
class MeasuredResponse:
    """The response of a log from one input to one output, disc by disc, as its own samples see it.

    Parameters
    ----------
    name : str
        Of the experiment.
    plant : Plant
        The plant on the bench, for the meaning of input and output; its dynamics are not used.
    source, output : str
        Names of input and output.
    clock : Clock
        Period and hold of the log, and the delay that is known to be in it.
    frequency_hz : array, shape (m,)
        The band that was measured.
    response : complex array, shape (m,)
        The centres, output unit over input unit, with the log's hold and delay.
    radius : array, shape (m,)
        All discs hold the truth with the `confidence` stated.
    confidence : float
        Between 0 and 1.
    averages : array, shape (m,)
        Windows averaged: many short ones where the response is smooth, few long ones where it is not.
    further : tuple of MeasuredResponse
        Of the same log, of the other outputs that a law reads; their discs and these hold the truth together.
    values : mapping of name to float
        Of the plant's parameters and states, what is known to have been otherwise there than in the rest of the data: a
        schedule places the response by its variable here.

    Examples
    --------
    >>> import seaopt as so
    >>> from seaopt.bench import PAPER_STAND
    >>> stand, thor = so.plants.high_impedance(), so.plants.thor()
    >>> log = so.virtual_log(
    ...     stand, thor, PAPER_STAND, duration_s=60, rate_hz=1000, seed=1, sensors=so.Sensors(noise_std={"F1": 2.0})
    ... )
    >>> measured = measure_response(stand, log, "F1")
    >>> measured.confidence, bool(measured.frequency_hz[-1] > 100.0)
    (0.95, True)
    """

    name: str
    plant: Plant
    source: str
    output: str
    clock: Clock
    frequency_hz: Lines
    response: ComplexLines
    radius: Lines
    confidence: float
    averages: Int[np.ndarray, " m"]
    further: tuple[MeasuredResponse, ...] = ()
    values: Mapping[str, float] = field(default_factory=dict[str, float])

    @property
    def band_hz(self) -> tuple[float, float]:
        """The first frequency and the last."""
        return float(self.frequency_hz[0]), float(self.frequency_hz[-1])

    def __repr__(self) -> str:
        low, high = self.band_hz
        relative, averages = self.radius / np.abs(self.response), self.averages
        return (
            f"MeasuredResponse {self.name}: {self.output}/{self.source} at {self.frequency_hz.size} frequencies from "
            f"{low:.3g} to {high:.3g} Hz, {np.min(averages)} to {np.max(averages)} averages; discs of "
            f"{np.median(relative):.2%} (median) to {np.max(relative):.2%} hold the truth at {self.confidence:.4g}"
            + "".join(f"\n{other!r}" for other in self.further)
        )

    def to_dict(self) -> dict[str, Any]:
        """Return the fields for JSON."""
        return {
            "experiment": self.name,
            "input": self.source,
            "output": self.output,
            "confidence": self.confidence,
            "averages": self.averages,
            "period_s": self.clock.period,
            "hold": self.clock.hold,
            "delay_s": self.clock.delay_s,
            "frequency_hz": self.frequency_hz,
            "real": np.real(self.response),
            "imag": np.imag(self.response),
            "radius": self.radius,
        } | ({"further": [other.to_dict() for other in self.further]} if self.further else {})


def measure_response(
    plant: Plant,
    log: Log,
    output: str | Sequence[str],
    *,
    source: str | None = None,
    name: str = "log",
    clock: Clock | None = None,
    confidence: float = 0.95,
    stretch_s: float | None = None,
) -> MeasuredResponse:
    """Estimate a frequency response with discs that hold the truth.

    Parameters
    ----------
    plant : Plant
        Its input and output names are those of the log's channels.
    log : Log
        One segment without gaps, taken in open loop.
    output : str or sequence of str
        What a controller would measure; of a law that reads several outputs all of them, the regulated one first.
    source : str, optional
        The input; what a controller commands, the plant's first, if left out.
    name : str
        Of the experiment, in messages and results.
    clock : Clock, optional
        The log's period and hold, and the delay that is known to be in it; a zero-order hold without delay if left out.
    confidence : float
        Of all discs together.
    stretch_s : float, optional
        Length of a window; if left out, in every third of an octave the one of n/16, n/32, ... samples whose discs
        are smallest.

    Raises
    ------
    LogError
        The log is too short, has gaps or missing samples, nothing is excited, other inputs are excited too, or too few
        frequencies are coherent.
    """
    require_number(confidence, "confidence", LogError)
    if not 0.0 < confidence < 1.0:
        raise LogError(f"confidence = {confidence:g} is not between 0 and 1; give 0.95, say")
    source = next(iter(plant.inputs)) if source is None else source
    output, *further = (output,) if isinstance(output, str) else output
    check_record(log, (source, output, *further))
    if np.ptp(log[source]) == 0.0:
        raise LogError(f"{log.source}: {source} is constant; a frequency response needs excitation")
    moving = [rival for rival in plant.inputs if rival != source and rival in log.signals and np.ptp(log[rival]) > 0.0]
    if moving:
        raise LogError(
            f"{log.source}: {', '.join(moving)} moves besides {source}, which counts as noise, and not as even noise; "
            f"take a log in which {source} alone is excited"
        )
    if further:
        each = 1.0 - (1.0 - confidence) / (1 + len(further))  # so that all together have the confidence asked
        options: dict[str, Any] = {"source": source, "name": name, "clock": clock, "stretch_s": stretch_s}
        first, *responses = (
            measure_response(plant, log, out, confidence=each, **options) for out in (output, *further)
        )
        responses = (replace(response, confidence=float(confidence)) for response in responses)
        return replace(first, confidence=float(confidence), further=tuple(responses))
    chosen = Clock(period=log.period) if clock is None else clock
    lengths = [stretch_s] if stretch_s is not None else _list_windows(len(log), log.period)
    estimates = [h1(log[source], log[output], log.period, stretch_s=length) for length in lengths]
    f, response, radius, averages = _choose_discs(estimates, confidence, HIGHEST * 0.5 / log.period)
    if f.size < LEAST_LINES:
        raise LogError(
            f"{log.source}: {output}/{source} is coherent at {f.size} frequencies in a row, fewer than {LEAST_LINES}; "
            "excite more, or longer"
        )
    return MeasuredResponse(
        name=name,
        plant=plant,
        source=source,
        output=output,
        clock=replace(chosen, delay_free=False),
        frequency_hz=f,
        response=response,
        radius=radius,
        confidence=float(confidence),
        averages=averages,
    )


Discs = tuple[Lines, ComplexLines, Lines, Int[np.ndarray, " m"]]


def _list_windows(samples: int, period: float) -> list[float]:
    """Return lengths of windows to try, in seconds, each half of the one before."""
    lengths = [samples // LONGEST]
    while lengths[-1] // 2 >= SHORTEST:
        lengths.append(lengths[-1] // 2)
    return [length * period for length in lengths]


def _choose_discs(estimates: Sequence[FrequencyResponse], confidence: float, highest_hz: float) -> Discs:
    """Return frequencies, centres, radii and averages: in every part of an octave those of the smallest discs. As the
    discs of all estimates hold the truth together, any choice among them does.
    """
    lines = sum(np.count_nonzero(estimate.frequency_hz < highest_hz) for estimate in estimates)
    discs: list[Discs] = []
    for _ in range(2):  # of all lines, then of those in the bands alone
        discs = [_place_discs(estimate, (1.0 - confidence) / max(lines, 1), highest_hz) for estimate in estimates]
        lines = sum(f.size for f, *_ in discs)
    parts = [_select(discs[0], slice(0, 0))]
    for low, high in pairwise(highest_hz * 2.0 ** (-np.arange(PARTS * OCTAVES, -1, -1) / PARTS)):
        inside = [_select(each, (each[0] >= low) & (each[0] < high)) for each in discs]
        candidates = [each for each in inside if each[0].size]
        if candidates:
            parts.append(min(candidates, key=lambda part: float(np.mean(np.log(part[2] / np.abs(part[1]))))))
    f, response, radius, averages = (np.concatenate(column) for column in zip(*parts, strict=True))
    return f, response, radius, averages


def _select(discs: Any, chosen: Any) -> Discs:  # whose lengths differ
    f, response, radius, averages = discs
    return f[chosen], response[chosen], radius[chosen], averages[chosen]


def _place_discs(estimate: FrequencyResponse, alpha: float, highest_hz: float) -> Discs:
    """Return band, centres, radii and averages of small discs, each of which misses the truth with `alpha`."""
    from scipy.ndimage import median_filter  # deferred: 0.2 s

    f, response = estimate.frequency_hz, estimate.response
    gamma, effective = np.clip(estimate.coherence, 1e-9, 1.0 - 1e-12), INDEPENDENT * estimate.averages
    spread = np.expm1(-np.log(alpha) / max(effective - 1.0, 0.1))
    radius = np.abs(response) * np.sqrt((1.0 - gamma) / gamma * spread) + UNSEEN * measure_bend(response)
    inside = (f < highest_hz) & (np.arange(f.size) > 1)  # beside the mean, which is taken out, lines are off
    size = np.maximum(np.abs(response), 1e-300)
    sharp = inside & (median_filter(radius / size, SMOOTH, mode="nearest") < LARGEST_DISC)
    return _select((f, response, radius, np.full(f.size, estimate.averages)), find_band(f, sharp))
