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
frequency: a static plant with a delay. One that turns there by more than a delay does is refused. **Above the band**
abs(P) is no larger than at its end and falls at least as 1/f, at any phase: a disc around zero. A resonance there
breaks this, and nothing in the points would show it.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Complex

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
    "the lowest point's gain; above it, no more than at its end, falling as 1/f"
)


@record(eq=False)
class MeasuredPlant:
    """Discs over frequency, from effort to what is measured, with hold and delay of the controller."""

    name: str  # of the experiment
    f: Frequencies  # the measured frequencies (Hz)
    centre: Response
    radius: Frequencies
    sample_time_s: float  # seconds
    end: float  # abs(P) at the end of the band at most, without folding
    folded: float  # what folding adds to that above the band, at most
    confidence: float  # of all discs

    @property
    def nyquist_hz(self) -> float:
        """Half the sample rate."""
        return 0.5 / self.sample_time_s

    @property
    def static_gain(self) -> float:
        """That assumed at 0 Hz, of the lowest point's size."""
        return float(np.abs(self.centre[0]) * np.sign(np.real(self.centre[0])))

    def response(self, f: VectorK) -> Complex[np.ndarray, " k"]:
        """Return the centres at any frequencies: zero above the band."""
        out = np.interp(f, self.f, np.real(self.centre)) + 1j * np.interp(f, self.f, np.imag(self.centre))
        below = f < self.f[0]
        turn = np.angle(self.centre[0] * np.sign(np.real(self.centre[0])))
        out[below] = self.static_gain * np.exp(1j * turn * f[below] / self.f[0])
        out[f > self.f[-1]] = 0.0
        return out

    def discs(self, f: VectorK) -> VectorK:
        """Return the radii at any frequencies."""
        above = self.end * self.f[-1] / np.maximum(f, self.f[-1]) + self.folded
        return np.where(f > self.f[-1], above, np.interp(f, self.f, self.radius))


def sample_measured(
    measured: MeasuredResponse, gain: float, sample_time_s: float, delay_samples: float
) -> MeasuredPlant:
    """Return what a controller sees of a measured response. `gain`: the input for one unit of what the controller
    gives. `delay_samples`: samples from a reading to the command being put out, besides the hold. What is between a
    command and its effect is in the log. Raises ControlError: its band ends beyond the controller's Nyquist frequency,
    or its lowest point is not at rest.
    """
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
    _check_rest(measured, f, turned, late + clock.delay_s + 0.5 * sample_time_s)
    return MeasuredPlant(
        name=f"frf:{measured.name}",
        f=f,
        centre=turned,
        radius=radius,
        sample_time_s=sample_time_s,
        end=end,
        folded=folded,
        confidence=measured.confidence,
    )


def _check_rest(measured: MeasuredResponse, f: Frequencies, centre: Response, delay_s: float) -> None:
    """Refuse a response that is not that of rest and a delay at its lowest frequency."""
    turn = float(np.angle(centre[0] * np.exp(2j * np.pi * f[0] * delay_s)))
    turn = min(abs(turn), abs(np.pi - abs(turn)))  # a static gain may be negative
    if turn > MOST_TURN:
        raise ControlError(
            f"frf:{measured.name}: at {f[0]:.3g} Hz, the lowest frequency that was measured, the response still turns "
            f"by {np.degrees(turn):.0f} deg more than its delay does, so that its gain at rest is not known; excite "
            "lower frequencies, or give a model of it"
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
