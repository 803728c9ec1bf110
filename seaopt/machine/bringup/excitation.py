r"""The reference of a stage: a periodic multisine whose command, readings and motions stay within their limits.

The lines lie evenly over the logarithm of frequency, from a thirtieth of the bandwidth to five times it, or to where
acceptance needs them, and more closely about it. Up to where the command per reference, :math:`|C_r S|`, exceeds its
value at the lowest line, all are equal; beyond, they fall as its root rises, so that fast lines do not use up the
command. Of several sets of random phases the one with the smallest peak of the command is taken, and all is scaled so
that each peak stays within its share of its limit, on the design plant: the sum of sines is played through the model's
response, line by line.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from jaxtyping import Complex, Float, Int

from seaopt.control import Controller
from seaopt.control.loops.sampled_plant import sample
from seaopt.errors import ControlError
from seaopt.machine.response.reach import NYQUIST, find_reach
from seaopt.plants.friction import take_sliding
from seaopt.records import record

LINES = 36
LOWEST, HIGHEST = 1.0 / 30.0, 5.0  # of the bandwidth
CLOSE = (0.85, 0.9, 0.95, 1.0, 1.05, 1.1)  # of the bandwidth: lines besides
TRIES = 30  # sets of phases
JOINED = 4  # ticks to either side of where a set of phases follows another, that are to be alike
LONGEST_S = 4.0  # of a period, but where lines have to lie lower
FADES = 2  # periods: one that fades in, and one that fades out


def count_periods(phases: int, periods: int) -> int:
    """Return how many periods so many of each set of phases are with those that fade."""
    return phases * periods + FADES


@record(eq=False)
class Excitation:
    """A periodic reference, one period for each set of phases, and what it does on the design plant."""

    sample_time_s: float
    bias: float
    amplitude: float  # the largest magnitude about the bias
    period: int  # ticks
    phases: int  # sets of them
    lines: Int[np.ndarray, " m"]  # of a period
    periods: int  # of each set of phases
    peaks: Mapping[str, float]  # largest magnitudes: of the command and of each output of the plant
    limits: Mapping[str, float]  # of those that are limited
    waves: Float[np.ndarray, "phases period"] | None = None  # about the bias; not read back from a file

    @property
    def frequency_hz(self) -> Float[np.ndarray, " m"]:
        """The lines, in Hz."""
        return self.lines / self.period_s

    @property
    def period_s(self) -> float:
        """How long a period lasts."""
        return self.period * self.sample_time_s

    @property
    def lasts_s(self) -> float:
        """How long all of it lasts."""
        return count_periods(self.phases, self.periods) * self.period_s

    @property
    def fade(self) -> Float[np.ndarray, " period"]:
        """What a period that fades in is multiplied by."""
        share = np.arange(self.period) / self.period
        return share**2 * (3.0 - 2.0 * share)  # which a target computes without a library

    def list_waves(self) -> Float[np.ndarray, "phases period"]:
        """Return one period about the bias for each set of phases. Raises ControlError: it was read from a file, which
        has none of them.
        """
        if self.waves is None:
            raise ControlError(
                "the reference was read from bringup.json, which has its size and lines alone; it is in reference.csv "
                "of its stage, or plan it again: seaopt bringup"
            )
        return self.waves

    @property
    def reference(self) -> Float[np.ndarray, " n"]:
        """All of it: a period that fades in, then every set of phases for its periods, then a period that fades out."""
        waves, rise = self.list_waves(), self.fade
        first, last = waves[0], waves[-1]
        played = np.concatenate([np.tile(wave, self.periods) for wave in waves])
        return np.concatenate([rise * (self.bias + first), self.bias + played, rise[::-1] * (self.bias + last)])


def design_excitation(
    controller: Controller,
    *,
    share: float,
    bias: float,
    phases: int,
    periods: int,
    limits: Mapping[str, float],
    seed: int,
) -> Excitation:
    """Return the reference of a controller's stage. `share`: of each limit that a peak may take. `limits`: of outputs
    of the design plant, besides that of the command. Raises ControlError: nothing is limited, or a bias alone is over.
    """
    assert controller.design is not None
    band, rate = controller.spec.bandwidth_hz, 1.0 / controller.sample_time_s
    low, high = find_reach(controller)
    period = round(rate * min(max(1.0 / (LOWEST * band), 1.0), max(LONGEST_S, 1.0 / low)))
    lines = _choose_lines(band, high, rate, period)
    f = lines * rate / period
    loop = controller.close(*controller.design)
    names, responses = _list_responses(controller, f)
    effort = loop.law.reference_response(f) * loop.sensitivity(f)
    per_reference = {controller.command.input: controller.per_effort * effort}
    per_reference |= {name: response * effort for name, response in zip(names, responses, strict=True)}
    size = np.abs(effort) / abs(effort[0])
    shape = 1.0 / np.sqrt(np.maximum(size, 1.0))
    rng, waves, peaks = np.random.default_rng(seed), list[Float[np.ndarray, " n"]](), dict[str, float]()
    for _ in range(phases):
        tried = [shape * np.exp(2j * np.pi * rng.uniform(size=lines.size)) for _ in range(TRIES)]
        command = per_reference[controller.command.input]
        best = min(tried, key=lambda sines: np.ptp(_play(sines * command, lines, period)))
        wave = _play(best, lines, period)
        waves.append(_follow(waves[-1], wave) if waves else wave)
        for name, response in per_reference.items():
            peak = float(np.max(np.abs(_play(best * response, lines, period))))
            peaks[name] = max(peaks.get(name, 0.0), peak)
    allowed = dict(limits)
    if controller.command_limit is not None:
        allowed[controller.command.input] = controller.command_limit
    if not allowed:
        raise ControlError(
            f"nothing limits {controller.command.input} or an output, so that no amplitude follows; give the "
            "controller a current_limit_A (command_limit), or limits"
        )
    at_bias = {name: abs(bias * float(np.real(response[0]))) for name, response in per_reference.items()}
    room = {name: share * value - at_bias[name] for name, value in allowed.items()}
    over = [name for name, left in room.items() if left <= 0.0]
    if over:
        raise ControlError(
            f"bias = {bias:g} takes more than {100.0 * share:g} % of the limit of {over[0]}; lower it, or give a "
            "larger share"
        )
    scale = min(left / max(peaks[name], 1e-300) for name, left in room.items())
    played = scale * np.array(waves)
    return Excitation(
        sample_time_s=controller.sample_time_s,
        bias=bias,
        amplitude=float(np.max(np.abs(played))),
        period=period,
        phases=phases,
        waves=played,
        lines=lines,
        periods=periods,
        peaks={name: at_bias[name] + scale * peak for name, peak in peaks.items()},
        limits=allowed,
    )


def _choose_lines(band: float, high: float, rate: float, period: int) -> Int[np.ndarray, " m"]:
    top = max(min(HIGHEST * band, NYQUIST * 0.5 * rate), high)
    wanted = np.concatenate([np.geomspace(max(LOWEST * band, rate / period), top, LINES), band * np.array(CLOSE)])
    lines = np.unique(np.round(wanted * period / rate).astype(int))
    return lines[lines >= 1]


def _play(sines: Complex[np.ndarray, " m"], lines: Int[np.ndarray, " m"], period: int) -> Float[np.ndarray, " n"]:
    """Return one period of a sum of sines, given their complex amplitudes."""
    spectrum = np.zeros(period // 2 + 1, dtype=complex)
    spectrum[lines] = 0.5 * period * sines
    return np.fft.irfft(spectrum, period)


def _follow(before: Float[np.ndarray, " n"], wave: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Return a period that begins where it goes on from another the most smoothly: a jump would take the command."""
    around = np.arange(-JOINED, JOINED + 1)
    starts = np.arange(wave.size)[:, None] + around
    apart = np.sum((wave[starts % wave.size] - before[around]) ** 2, axis=1)
    return np.roll(wave, -int(np.argmin(apart)))


def _list_responses(controller: Controller, f: Float[np.ndarray, " m"]) -> tuple[list[str], Complex[np.ndarray, "y m"]]:
    """Return the outputs of the design plant, and their responses per effort."""
    assert controller.design is not None
    plant, values = controller.design
    seen = controller.see(plant)
    names = [name for name in seen.outputs if name]
    sampled = sample(
        take_sliding(seen, values), controller.delay(values), tuple(names), controller.per_effort,
        controller.sample_time_s, controller.compute_delay_samples,
    )  # fmt: skip
    responses = sampled.responses(f)
    return [*names], responses if math.isfinite(float(np.max(np.abs(responses)))) else np.nan_to_num(responses)
