r"""A measured frequency response as a plant that a digital controller sees: at every frequency a disc of responses.

**Rate, hold and delay.** The log's points are those of a sampled system: continuous plant G, the log's hold
:math:`H_l` (a staircase, or a straight line between samples) and its delay. Where the controller has the log's rate, a
staircase and whole samples more of delay, its plant is the same points times :math:`z^{-d}`, exactly. Otherwise

.. math:: P = (P_l - a_l)\,\frac{H_c}{H_l}\,e^{-2\pi j f \tau} + a_c, \qquad
    |a| \le \sum_{k \ne 0} |G(f + k/T)|\,|H(f + k/T)|

with what folding adds, :math:`a_l` and :math:`a_c`, bounded by the assumption on G above the band, and added to the
radius. :math:`\tau` is the controller's delay, `delay_samples` of it; the drive's is in the log already.

**Between points** centre and radius are straight lines; the radius has an allowance for bends
(`seaopt.frequency.measured`). **Below the band** the response is that of the lowest point, its phase in proportion to
frequency: a static plant with a delay; of a motor's speed that of its position, times :math:`2\pi j f`. One that turns
there by more than a delay does is refused. **Above the band** abs(P) is no larger than at its end and falls at least as
1/f, at any phase: a disc around zero. A resonance there breaks this, and nothing in the points would show it.

A law that reads several outputs has a response of each, from one log; the discs of all hold the truth together.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Complex, Float

from seaopt.control.loops.transfer_function import Frequencies, Response
from seaopt.errors import ControlError
from seaopt.frequency.measured import MeasuredResponse
from seaopt.records import record
from seaopt.signals import VectorK
from seaopt.simulation import Clock

WHOLE = 1e-6  # of a sample: a delay or a period that is off by less is exact
FOLDED = 200  # images of the spectrum that are summed; the rest by its bound
MOST_TURN = 0.5  # rad: phase at the lowest point beyond that of the delays
ASSUMED = (
    "open loop and a linear, stable plant; between points, straight lines with an allowance for bends; below the band, "
    "the lowest point's gain (of a speed, its position's); above it, no more than at its end, falling as 1/f"
)


@record(eq=False)
class MeasuredOutput:
    """Discs over frequency, from effort to one output, with hold and delay of the controller."""

    f: Frequencies  # the measured frequencies (Hz)
    centre: Response
    radius: Frequencies
    end: float  # abs(P) at the end of the band at most, without folding
    folded: float  # what folding adds to that above the band, at most
    is_speed: bool = False  # which is zero at rest, where its position is not

    @property
    def rest(self) -> complex:
        """The lowest point, and of a speed that of its position, in proportion to it."""
        return complex(self.centre[0]) / (1j if self.is_speed else 1.0)

    @property
    def static_gain(self) -> float:
        """That assumed at 0 Hz, of the lowest point's size."""
        return 0.0 if self.is_speed else float(np.abs(self.rest) * np.sign(np.real(self.rest)))

    def response(self, f: VectorK) -> Complex[np.ndarray, " k"]:
        """Return the centres at any frequencies: zero above the band."""
        out = np.interp(f, self.f, np.real(self.centre)) + 1j * np.interp(f, self.f, np.imag(self.centre))
        below = f < self.f[0]
        share, sign = f[below] / self.f[0], np.sign(np.real(self.rest))
        size = sign * np.abs(self.rest) * (1j * share if self.is_speed else 1.0)
        out[below] = size * np.exp(1j * np.angle(self.rest * sign) * share)
        out[f > self.f[-1]] = 0.0
        return out

    def discs(self, f: VectorK) -> VectorK:
        """Return the radii at any frequencies."""
        above = self.end * self.f[-1] / np.maximum(f, self.f[-1]) + self.folded
        return np.where(f > self.f[-1], above, np.interp(f, self.f, self.radius))


@record(eq=False)
class MeasuredPlant:
    """Discs over frequency of each output that a law reads, the regulated one first."""

    name: str  # of the experiment
    outputs: tuple[MeasuredOutput, ...]
    sample_time_s: float  # seconds
    confidence: float  # of all discs

    @property
    def f(self) -> Frequencies:
        """The frequencies at which any output was measured."""
        return np.unique(np.concatenate([output.f for output in self.outputs]))

    @property
    def band_hz(self) -> tuple[float, float]:
        """Where all outputs were measured."""
        return float(max(each.f[0] for each in self.outputs)), float(min(each.f[-1] for each in self.outputs))

    @property
    def nyquist_hz(self) -> float:
        """Half the sample rate."""
        return 0.5 / self.sample_time_s

    @property
    def static_gain(self) -> float:
        """That of the regulated output, assumed at 0 Hz."""
        return self.outputs[0].static_gain

    def response(self, f: VectorK) -> Complex[np.ndarray, " k"]:
        """Return the centres of the regulated output at any frequencies."""
        return self.outputs[0].response(f)

    def responses(self, f: VectorK, signals: int) -> Complex[np.ndarray, "y k"]:
        """Return the centres of as many signals at any frequencies; what is read besides the outputs is zero."""
        read = np.array([output.response(f) for output in self.outputs])
        return np.pad(read, ((0, signals - len(read)), (0, 0)))

    def discs(self, f: VectorK, signals: int) -> Float[np.ndarray, "y k"]:
        """Return the radii of as many signals at any frequencies; what is read besides the outputs is zero."""
        radii = np.array([output.discs(f) for output in self.outputs])
        return np.pad(radii, ((0, signals - len(radii)), (0, 0)))


def sample_measured(
    outputs: Sequence[MeasuredResponse], gain: float, sample_time_s: float, delay_samples: float
) -> MeasuredPlant:
    """Return what a controller sees of measured responses, of one log. `gain`: the input for one unit of what the
    controller gives. `delay_samples`: samples from a reading to the command being put out, besides the hold. What is
    between a command and its effect is in the log. Raises ControlError: a band ends beyond the controller's Nyquist
    frequency, or its lowest point is not at rest.
    """
    return MeasuredPlant(
        name=f"frf:{outputs[0].name}",
        outputs=tuple(_sample_output(output, gain, sample_time_s, delay_samples) for output in outputs),
        sample_time_s=sample_time_s,
        confidence=outputs[0].confidence,
    )


def _sample_output(
    measured: MeasuredResponse, gain: float, sample_time_s: float, delay_samples: float
) -> MeasuredOutput:
    clock, f = measured.clock, measured.frequency_hz
    late = delay_samples * sample_time_s
    nyquist = 0.5 / sample_time_s
    keep = f < 0.9 * nyquist
    f, centre, radius = f[keep], measured.response[keep] * gain, measured.radius[keep] * abs(gain)
    if f.size < 2:
        raise ControlError(
            f"frf:{measured.name}: its band begins at {measured.band_hz[0]:.4g} Hz, and the controller samples at "
            f"{1.0 / sample_time_s:g} Hz; sample faster, or measure lower frequencies"
        )
    samples = late / sample_time_s
    same = abs(clock.period / sample_time_s - 1.0) < WHOLE and clock.hold == "zero"
    end, folded = float(np.abs(centre[-1]) + radius[-1]), 0.0
    turned = centre * np.exp(-2j * np.pi * f * late)
    if not (same and abs(samples - round(samples)) < WHOLE):
        own_clock, old = Clock(period=sample_time_s), hold_response(f, clock)
        ratio = hold_response(f, own_clock) / old
        plain = end / float(np.abs(old[-1]))
        extra = _fold(f, own_clock, plain, f[-1])
        radius = (radius + _fold(f, clock, plain, f[-1])) * np.abs(ratio) + extra
        above = np.linspace(f[-1], nyquist, 50)
        folded = float(np.max(_fold(above, own_clock, plain, f[-1])))
        turned, end = turned * ratio, plain
    sensing = measured.plant.sensing
    is_speed = sensing is not None and sensing.motor_speed == measured.output
    seen = MeasuredOutput(f=f, centre=turned, radius=radius, end=end, folded=folded, is_speed=is_speed)
    _check_rest(measured, seen, late + clock.delay_s + 0.5 * sample_time_s)
    return seen


def _check_rest(measured: MeasuredResponse, seen: MeasuredOutput, delay_s: float) -> None:
    """Refuse a response that is not that of rest and a delay at its lowest frequency."""
    lowest = float(seen.f[0])
    turn = float(np.angle(seen.rest * np.exp(2j * np.pi * lowest * delay_s)))
    turn = min(abs(turn), abs(np.pi - abs(turn)))  # a static gain may be negative
    if turn > MOST_TURN:
        raise ControlError(
            f"frf:{measured.name}: at {lowest:.3g} Hz, the lowest frequency at which {measured.output} was measured, "
            f"the response still turns by {np.degrees(turn):.0f} deg more than its delay does, so that its gain at "
            "rest is not known; excite lower frequencies, or give a model of it"
        )


def hold_response(f: Frequencies, clock: Clock) -> Response:
    """Return the response of the hold alone."""
    if clock.hold == "first":
        return np.sinc(f * clock.period) ** 2 + 0j
    return np.sinc(f * clock.period) * np.exp(-1j * np.pi * f * clock.period)


def _fold(f: Frequencies, clock: Clock, end: float, end_hz: float) -> Frequencies:
    """Return at most what folding adds to sampled responses of a plant that falls as end end_hz/f above end_hz."""
    out = np.zeros(f.size)
    for k in (*range(-FOLDED, 0), *range(1, FOLDED + 1)):
        image = np.abs(f + k / clock.period)
        out += end * np.minimum(end_hz / image, 1.0) * np.abs(hold_response(image, clock))
    # Beyond: end_hz T/k of the plant and 1/(pi k) of the hold, on both sides.
    return out + 2.0 * end * end_hz * clock.period / (np.pi * FOLDED)
