r"""Feedforward of a link's measured motion: the effort that the motor needs to follow the link with its spring at rest.

A link that moves drags the motor along through the spring, so that a force follows no slow reference where nothing
holds the link. With the link's motion y as an input, the regulated force of the linear actuator is
:math:`F = G_{11} u + G_{12} \dot y` (`seaopt.control.loops.port`), and stays as it is where

.. math:: u = -\frac{G_{12}}{G_{11}}\, s\, y = (M s^2 + b s)\, y :

of the actuators here the inertia and the damping of the drive, seen at the link; of others both are fitted from a
tenth of the bandwidth up to it, and refused where that leaves too much. On what is measured, x, y is a number times x
or times its integral, and the path is made causal by a low-pass and taken away at low frequencies by a high-pass,

.. math::
    u = \lambda\, (M s^2 + b s)\, \frac{\omega^2}{s^2 + \sqrt2\, \omega s + \omega^2}\, \frac{s}{s + \omega_h}\, x,

by Tustin's rule, each corner prewarped.

**Why a high-pass and a fraction.** With P_x from effort to x, the loop broken at the command has
:math:`1 + L = B + P C_y`, :math:`B = 1 - \lambda (M s^2 + b s) P_x \cdots`. Where a link swings freely, at the zero of
P, all effort moves the drive and none the spring: :math:`(M s^2 + b s) P_x = 1`, :math:`P C_y` is nothing, and
:math:`S = 1/B = 1/(1 - \lambda)` without a high-pass: Ms of 1.6 leaves a fraction of 0.37. That zero is at a hertz or
so, below what is followed, and there the high-pass takes the path away.

**Where friction sticks.** The path is that of the drive as it slides, of the damping b. Friction of the slope
:math:`\beta` makes another loop: P and P_x are of :math:`b + \beta`, and where the link swings freely
:math:`(M s^2 + (b + \beta) s) P_x = 1`, so that

.. math:: B = 1 - \lambda\, \frac{M s + b}{M s + b + \beta} \cdots .

The steeper the friction, the less the path does: a drive that stands feeds nothing back, B is 1. So what bounds
:math:`\lambda` is the sliding loop, with the flattest slope, and a loop may be stable as it sticks and not as it
slides. Between the two :math:`K G_y` of `seaopt.control.loops.absolute_stability` has the path among its sum.

**At the port** (`seaopt.control.laws.passivity`) x is what the world imposes: with :math:`C_x` of u = - C_x x, delayed
and held, P_x is nothing and

.. math:: Z = \frac{G_{22} + \Delta\, C' - G_{21} C_x'/s}{1 + G_{11} C'} ,

of the actuators here :math:`1 - \lambda H` times what it is under the same feedback without the path, H its filters
with delay and hold. Sampled, :math:`C_x/s_l` stands beside :math:`W/s_l` in `seaopt.control.impedance.sampled_port`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Annotated, Any

import numpy as np
from jaxtyping import Bool, Complex

from seaopt.codec import Constraints
from seaopt.control.loops.law import Law
from seaopt.control.loops.port import port_of
from seaopt.control.loops.sampled_plant import linearise_sets
from seaopt.control.loops.transfer_function import Frequencies, Response, TransferFunction
from seaopt.errors import ControlError
from seaopt.formatting import format_percent
from seaopt.options import option
from seaopt.parameters import ParameterSet
from seaopt.plants import Plant
from seaopt.plants.friction import take_sliding
from seaopt.plants.memo import memo
from seaopt.plants.roles import Sensing
from seaopt.records import record
from seaopt.units import Mechanics

LOWEST_HZ = 1e-3  # limits are kept from here
FIT_FREQUENCIES = 12
LARGEST_MISFIT = 0.2  # of the effort, between a tenth of the bandwidth and it
FRACTIONS = np.round(np.linspace(0.0, 1.0, 101), 2)
ROOM = 0.95  # of Ms, that the path alone may use
OTHER_STATES = 1e-9  # of a signal's slopes: less is rounding
LEAST_COST = 1e-3  # share of the objective: less is the search's
LEAST_OCTAVES = 0.01  # of a band won or lost: less is none


@record
class LinkFeedforward:
    """Which motion of the link is fed forward, and how; what is left out has its default."""

    measured: str | None = option(
        "The output that is the link's position or speed; where the plant says what that is, it may be left out.",
        default=None,
    )
    fraction: float | None = option(
        "Share of the effort that the model says; as much as the limits leave where left out.",
        default=None,
        above=0.0,
        most=2.0,
    )
    corner_hz: float | None = option(
        "Corner of the low-pass; the bandwidth where left out. Noise on the signal grows with its square and more.",
        default=None,
        unit="Hz",
        least=LOWEST_HZ,
    )
    high_pass_hz: float | None = option(
        "Frequency below which nothing is fed forward; a tenth of the bandwidth where left out, 0 for none.",
        default=None,
        unit="Hz",
        least=0.0,
    )

    def place(self, path: LinkPath, bandwidth_hz: float) -> LinkPath:
        """Return a path with the corners asked, or their defaults at a bandwidth."""
        return replace(
            path,
            corner_hz=self.corner_hz or bandwidth_hz,
            high_pass_hz=0.1 * bandwidth_hz if self.high_pass_hz is None else self.high_pass_hz,
        )


@record
class FollowedBand:
    """The band in which abs(F/F_ref) stays within 3 dB of 1 on a plant whose link moves; None where it does nowhere."""

    plant: str
    band_hz: tuple[float, float] | None
    without_hz: tuple[float, float] | None  # of the law without the path

    @property
    def octaves_won(self) -> float:
        """By how many octaves it is wider than without the path."""
        return _count_octaves(self.band_hz) - _count_octaves(self.without_hz)

    def describe(self) -> str:
        """Say where references are followed, with the path and without."""
        return f"{self.plant} follows {_say(self.band_hz)}, without it {_say(self.without_hz)}"


@record
class LinkEffect:
    """What the path changes beside the law tuned without it, from this one on, to the same limits."""

    objective: str  # what the tuner makes least: "disturbance", the integral of abs(S), or "noise", the noise gain
    cost: float  # by which share that is larger
    bands: tuple[FollowedBand, ...]  # of every plant whose link moves

    def describe(self) -> str:
        """Say in one line what it costs, and where references are followed: on the first plant whose link moves, and on
        the one that loses most of the band.
        """
        what = "noise gain" if self.objective == "noise" else "integral of abs(S)"
        change = "larger" if self.cost > 0 else "smaller"
        text = f"the {what} is {format_percent(abs(self.cost), 2)} {change} than without it"
        if not self.bands:
            return text
        first, least = self.bands[0], min(self.bands, key=lambda band: band.octaves_won)
        text += f", and {first.describe()}"
        if least is not first and least.octaves_won < -LEAST_OCTAVES:
            text += f"; {least.describe()}"
        worth = self.cost < LEAST_COST or any(band.octaves_won > LEAST_OCTAVES for band in self.bands)
        return text if worth else f"{text}: no more of the band, so leave link_feedforward out"


def _count_octaves(band_hz: tuple[float, float] | None) -> float:
    return 0.0 if band_hz is None else math.log2(band_hz[1] / max(band_hz[0], LOWEST_HZ))


def _say(band_hz: tuple[float, float] | None) -> str:
    return "nowhere" if band_hz is None else f"from {band_hz[0]:.3g} to {band_hz[1]:.3g} Hz"


@record
class LinkPath:
    """The path from the link's measured motion to the effort.

    Parameters
    ----------
    measured, unit : str
        The signal that is read, and its unit.
    inertia, damping : float
        Effort per acceleration and per speed of what is measured; where that is a speed, per its rate and per it.
    is_speed : bool
        Whether a speed is measured.
    fraction : float
        Of the effort that the model says.
    corner_hz, high_pass_hz : float
        Of the low-pass and of the high-pass; a high-pass of zero is none.
    effect : LinkEffect or None
        What it changes; None where the law was not tuned with it, or no law near it keeps the limits without it.
    """

    measured: str
    unit: str
    inertia: float
    damping: float
    is_speed: bool
    fraction: float
    corner_hz: Annotated[float, Constraints(gt=0.0)]
    high_pass_hz: Annotated[float, Constraints(ge=0.0)]
    effect: LinkEffect | None = None

    def feedback(self, sample_time_s: float) -> TransferFunction:
        """Return C of u = - C x, in q = 1/z."""
        delta, double = np.array([1.0, -1.0]), np.array([1.0, 1.0])  # of s = (2/T_s) delta/double
        rate, w = 2.0 / sample_time_s, math.tan(math.pi * self.corner_hz * sample_time_s)
        pairs = ((delta, delta), (delta, double), (double, double))
        squares = np.array([np.convolve(first, second) for first, second in pairs])
        first = self.inertia * rate, self.damping
        numbers = (0.0, *first) if self.is_speed else (first[0] * rate, first[1] * rate, 0.0)
        num = w * w * (np.array(numbers) @ squares)
        den = squares[0] + math.sqrt(2.0) * w * squares[1] + w * w * squares[2]
        if self.high_pass_hz:
            slow = math.tan(math.pi * self.high_pass_hz * sample_time_s)
            num, den = np.convolve(num, delta), np.convolve(den, delta + slow * double)
        return TransferFunction(num=-self.fraction * num / den[0], den=den / den[0])

    def describe(self, noise_gain: float | None, called: Mechanics) -> str:
        """Say in one line what is fed forward, and what noise on it makes where that gain is known."""
        per = ("its rate", "it") if self.is_speed else ("its acceleration", "its speed")
        low = f"from {self.high_pass_hz:.3g} " if self.high_pass_hz else ""
        text = (
            f"link feedforward of {self.measured} [{self.unit}], {low}to {self.corner_hz:.3g} Hz: "
            f"{format_percent(self.fraction)} of {self.inertia:.4g} times {per[0]} "
            f"and {self.damping:.4g} times {per[1]}"
        )
        if noise_gain is None:
            return text
        return (
            f"{text}; 1e-6 {self.unit} of noise on it makes up to {1e-6 * noise_gain:.3g} {called.unit} of motor "
            f"{called.word}, less with a lower corner_hz"
        )

    def see(self, plant: Plant) -> Plant:
        """Return a plant with the signal among its outputs: it is zero where the plant holds its link. Raises
        ControlError: the plant has it in another unit, or its link moves and it has no such output.
        """
        unit = plant.outputs.get(self.measured)
        if unit is None and plant.port is not None and plant.port.motion is not None:
            raise ControlError(
                f'link_feedforward.measured = "{self.measured}" is not an output of {plant.name}, whose link moves; '
                f'give link_feedforward = {{ measured = "{plant.port.motion}" }}, or the plant an output of that name'
            )
        if unit not in (None, self.unit):
            raise ControlError(
                f'link_feedforward.unit = "{self.unit}", and {self.measured} of {plant.name} is in {unit}; tune again'
            )
        return plant if unit is not None else _hold_output(plant, self.measured, self.unit)


def multiply_out(law: Law, link: LinkPath | None) -> tuple[TransferFunction, ...]:
    """Return C_r and C_y of every signal, multiplied out; the link's, the last, with its own poles alone. Its double
    zero at 0 Hz would lose all digits there beside the poles of the rest.
    """
    whole = law.transfer_functions()
    return whole if link is None else (*whole[:-1], link.feedback(law.sample_time_s))


@memo
def _hold_output(plant: Plant, name: str, unit: str) -> Plant:
    """Return a plant with an output that stays at zero."""

    def h(t: Any, x: Any, u: Any, p: Any) -> Mapping[str, Any]:
        return {**plant.h(t, x, u, p), name: 0.0}

    sensing = plant.sensing or Sensing(regulated=())
    still = (*sensing.still, name)
    return replace(plant, h=h, outputs={**plant.outputs, name: unit}, sensing=replace(sensing, still=still))


def name_link_signal(feedforward: LinkFeedforward, plant: Plant) -> str | None:
    """Return the output of a plant that is its link's motion; None where it holds its link, or has another."""
    sensing = plant.sensing
    name = feedforward.measured or (None if sensing is None else sensing.link_position)
    moves = plant.port is not None and plant.port.motion is not None
    return name if moves and name in plant.outputs else None


def model_link_path(
    feedforward: LinkFeedforward,
    plant: Plant,
    params: ParameterSet,
    regulated: str,
    per_effort: float,
    bandwidth_hz: float,
) -> LinkPath:
    """Return the path of a plant whose link moves, of a fraction of 1 where none is asked. Raises ControlError: what is
    measured is not the link's position or speed, or the effort is not that of an inertia and a damper.
    """
    name = name_link_signal(feedforward, plant)
    assert name is not None, "the plant has been asked"
    sliding = take_sliding(plant, params)
    values = sliding.complete(params)
    per_signal, is_speed = _relate(sliding, values, name, per_effort)
    f = np.geomspace(0.1 * bandwidth_hz, bandwidth_hz, FIT_FREQUENCIES)
    response = port_of(sliding, values, regulated, per_effort).response(f)
    inertia, damping = _fit(-response.motion_to_read[0] / response.motor_to_read[0], f, plant.name)
    path = LinkPath(
        measured=name,
        unit=plant.outputs[name],
        inertia=per_signal * inertia,
        damping=per_signal * damping,
        is_speed=is_speed,
        fraction=1.0 if feedforward.fraction is None else feedforward.fraction,
        corner_hz=bandwidth_hz,
        high_pass_hz=0.0,
    )
    return feedforward.place(path, bandwidth_hz)


def _relate(plant: Plant, params: ParameterSet, name: str, per_effort: float) -> tuple[float, bool]:
    """Return how far the port moves per unit of a signal, and whether the signal is a speed."""
    port = plant.port
    assert port is not None and port.motion is not None
    (_, _, c, _), _ = linearise_sets(plant, [plant.complete(params)], (port.motion, name), per_effort)
    states, (motion, signal) = list(plant.states), c[0]
    link_states = [states.index(state) for state in (port.coordinate, port.rate) if state is not None]
    elsewhere = np.delete(signal, link_states)
    speed = signal[link_states[1]] if len(link_states) > 1 else 0.0
    position = signal[link_states[0]]
    if np.any(np.abs(elsewhere) > OTHER_STATES * np.max(np.abs(signal))) or (position != 0.0) == (speed != 0.0):
        raise ControlError(
            f'link_feedforward: measured = "{name}" of {plant.name} is not its link\'s position or speed alone; '
            f'measure the link: link_feedforward = {{ measured = "{port.motion}" }}'
        )
    return float(motion[link_states[0]] / (position or speed)), bool(position == 0.0)


def _fit(effort: Response, f: Frequencies, name: str) -> tuple[float, float]:
    """Return inertia and damping of an effort per speed, by least squares."""
    s = 2j * np.pi * f
    terms = np.column_stack([s, np.ones_like(s)]) / np.abs(effort)[:, None]
    seen = effort / np.abs(effort)
    rows, wanted = np.vstack([terms.real, terms.imag]), np.concatenate([seen.real, seen.imag])
    scale = np.linalg.norm(rows, axis=0)
    inertia, damping = np.linalg.lstsq(rows / scale, wanted, rcond=None)[0] / scale
    misfit = float(np.max(np.abs(terms @ np.array([inertia, damping]) - seen)))
    if misfit > LARGEST_MISFIT:
        raise ControlError(
            f"link_feedforward: the effort that moves the drive of {name} is not that of an inertia and a damper, by "
            f"{100 * misfit:.0f} %: leave link_feedforward out, or command a current"
        )
    return float(inertia), float(damping)


def limit_fraction(
    path: LinkPath,
    motions: Complex[np.ndarray, "n m"],
    beyond: Bool[np.ndarray, "n m"],
    f: Frequencies,
    sample_time_s: float,
    max_sensitivity: float,
) -> float:
    """Return the largest fraction, in hundredths, that leaves Ms where the loop has next to nothing but the path.
    `motions`: responses of what is measured, from the command, of every plant. `beyond`: where the regulated force does
    not answer to the command, so that S is 1/B. `f`: frequencies in Hz.
    """
    whole = replace(path, fraction=1.0).feedback(sample_time_s).response(f, sample_time_s) * motions
    least = np.array([np.min(np.abs(1.0 + share * whole), where=beyond, initial=np.inf) for share in FRACTIONS])
    broken = np.flatnonzero(least < 1.0 / (ROOM * max_sensitivity))
    return float(FRACTIONS[broken[0] - 1] if broken.size else FRACTIONS[-1])
