"""The measured plant and a model of it, as one vector of lines.

With dry friction the model's response is that of the same law on the nonlinear plant, simulated under the logged
reference and cut as the log is, since it depends on amplitude; two periods of each set of phases do. Noise of what the
law reads, which is in its command, shakes the motor through its friction: where it makes much of the command the model
has as much of it, twice, once turned about zero. In the mean of both what noise adds to the lines is gone to first
order, and what it makes of friction is left, which depends on the noise. All models have the same, so that they differ
by what they are; what it makes of them beside the mean over several draws is told once, of the nominal one
(`Comparison.settle`): by that factor all are corrected, and the std of that mean is part of what the lines are off by.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Complex, Float

from seaopt.bench import Sensors
from seaopt.control import Controller, sample
from seaopt.control.loops.sampled_plant import DELAY
from seaopt.errors import LogError
from seaopt.machine.decimated import count_ticks_per_row
from seaopt.machine.design_run import RTOL, run_design
from seaopt.machine.differences.few_periods import find_most_noise, find_widening
from seaopt.machine.response.discs import Ratio
from seaopt.machine.response.judged import Measured
from seaopt.machine.response.periods import Blocks, cut_periods, find_again, find_period, join_blocks
from seaopt.machine.response.verdicts import has_dry_friction
from seaopt.machine.ticks import Ticks
from seaopt.parameters import ParameterSet
from seaopt.plants import Plant
from seaopt.plants.friction import take_sliding
from seaopt.records import record
from seaopt.signals import measure_white

TOLERATED = 0.02  # of the response, by which a machine may be off everything drawn
SHAKES = 0.3  # of the command's rms, from which on noise is simulated, too
SHAKEN = 4  # draws of such noise
GRID = 400  # frequencies over which a law's response to noise is averaged
Lines = Complex[np.ndarray, " m"]


@record(eq=False)
class Comparison:
    """The measured responses of some outputs to the effort, and a model of them, as one vector of lines."""

    controller: Controller
    measured: Sequence[Measured]
    logs: Sequence[Ticks]
    names: tuple[str, ...]  # of the outputs
    rate: float = 1.0  # at which the model's law is stepped, over what the clock of the logs says
    simulated: bool = False  # whether the model is, without dry friction too
    apart: Controller | None = None  # the law and its outer loop as they run, where `controller` has both in one
    shaking: tuple[Sensors | None, ...] | None = None  # of each log, where it was measured: `_find_shaking`
    correction: Lines | float = 1.0  # of the model, from one draw of the noise that shakes it to the mean of several
    scatter: Float[np.ndarray, " m"] | float = 0.0  # std of that mean

    @property
    def plant(self) -> Plant:
        """The controller's design plant."""
        assert self.controller.design is not None
        return self.controller.design[0]

    @property
    def simulates(self) -> bool:
        """Whether the model's response depends on what was played, and is simulated therefore."""
        return self.simulated or has_dry_friction(self.controller)

    @property
    def ratios(self) -> list[Ratio]:
        """The measured responses, signal by signal, amplitude by amplitude."""
        return [part.outputs[name] for part in self.measured for name in self.names]

    @property
    def response(self) -> Lines:
        """The measured response."""
        return np.concatenate([ratio.value for ratio in self.ratios])

    @property
    def std(self) -> Float[np.ndarray, " m"]:
        """Its std, or the accuracy of the model where the periods of a log are more alike than that; with that of the
        mean of what noise makes of the model.
        """
        measured = np.concatenate([np.maximum(ratio.std, RTOL * np.abs(ratio.value)) for ratio in self.ratios])
        return np.hypot(measured, self.scatter)

    @property
    def widening(self) -> float:
        """By how much sizes that are fitted with weights of :math:`1/s^2` spread more than these tell."""
        return find_widening(min(ratio.blocks for ratio in self.ratios), self.response.size)

    @property
    def most_noise(self) -> float:
        """The misfit by line that noise leaves of a right model with 95 % at most."""
        return find_most_noise(min(ratio.blocks for ratio in self.ratios), self.response.size)

    @property
    def f(self) -> Float[np.ndarray, " m"]:
        """Hz, of each of its lines."""
        return np.concatenate([part.f for part in self.measured for _ in self.names])

    def radius(self, alpha: float) -> Float[np.ndarray, " m"]:
        """Return the radii of its discs, all of which hold the truth but with the probability `alpha`."""
        each = alpha / self.f.size
        measured = np.concatenate([ratio.disc(each)[1] for ratio in self.ratios])
        return np.hypot(measured, math.sqrt(-math.log(each)) * self.scatter)

    def misfit(self, model: Lines) -> float:
        """Return the sum of squares of a model's difference, over the std."""
        return float(np.sum(np.abs((self.response - model) / self.std) ** 2))

    def predict(self, sets: Sequence[ParameterSet]) -> list[Lines]:
        """Return the responses of the model with each of some values."""
        if self.simulates and sets:
            return [self.read(groups) for groups in self.simulate(sets)]
        return [self.linearise(values) for values in sets]

    def linearise(self, values: ParameterSet) -> Lines:
        """Return the response of the model, linear as it slides."""
        law, seen = self.controller, self.controller.see(take_sliding(self.plant, values))
        period = law.sample_time_s / self.rate
        ticks, values = _shift_early(values, period)
        timing = period, law.compute_delay_samples - ticks
        sampled = sample(seen, law.delay(values), self.names, law.per_effort, *timing)
        return np.concatenate([sampled.responses(self.rate * part.f).ravel() for part in self.measured])

    def listen(self) -> Comparison:
        """Return the comparison with the noise of its logs measured, once for all models."""
        return replace(self, shaking=tuple(map(self._find_shaking, self.logs)))

    def settle(self, values: ParameterSet, first: list[Blocks]) -> Comparison:
        """Return the comparison with the mean of what noise that shakes the machine makes of the model with some
        values, and how sure that mean is. `first`: what is simulated with them, with the noise of seed 0.
        """
        if self.shaking is None:
            return self.listen().settle(values, first)
        if all(each is None for each in self.shaking):
            return self
        draws = [first, *(self.simulate([values], seed)[0] for seed in range(1, SHAKEN))]
        drawn = np.array([*map(self.read, draws)])
        mean, std = np.mean(drawn, axis=0), np.sqrt(np.var(drawn, axis=0, ddof=1) / SHAKEN)
        return replace(self, correction=self.correction * mean / drawn[0], scatter=std)

    def simulate(self, sets: Sequence[ParameterSet], seed: int = 0) -> list[list[Blocks]]:
        """Return the periods of the law on the nonlinear plant with each of some values, under the logged references
        and cut as the logs are, by amplitude. `seed`: of the noise, where that shakes the machine.
        """
        source, share = replace(self.controller, outer=None), 1.0  # what was given is the force law's reference
        if self.apart is not None and self.apart.outer is not None:
            source, share = replace(self.apart, design=source.design), 1.0 / self.apart.outer.per_given
        heard = self.shaking if self.shaking is not None else map(self._find_shaking, self.logs)
        pairs = zip(self.logs, heard, strict=True)
        runs = [self._run(source, sets, share, ticks, shaking, seed) for ticks, shaking in pairs]
        return [self._cut(runs, k) for k in range(len(sets))]

    def _run(
        self,
        source: Controller,
        sets: Sequence[ParameterSet],
        share: float,
        ticks: Ticks,
        shaking: Sensors | None,
        seed: int,
    ) -> Mapping[str, Float[np.ndarray, "runs n"]]:
        """Return the outputs of runs under a share of a log's reference, with the noise of its readings where that
        shakes the motor.
        """
        every = count_ticks_per_row(self.controller, ticks)
        reference = share * _fill_ticks(ticks, every)
        if shaking is None:
            alone = run_design(source, sets, reference, rate=self.rate).outputs
            return {name: rows[:, ::every] for name, rows in alone.items()}
        turned = np.repeat([1.0, -1.0], len(sets))
        twice = [*sets, *sets]
        both = run_design(source, twice, reference, sensors=shaking, seed=seed, noise_gain=turned, rate=self.rate)
        return {name: rows.reshape(2, len(sets), -1).mean(axis=0)[:, ::every] for name, rows in both.outputs.items()}

    def _find_shaking(self, ticks: Ticks) -> Sensors | None:
        """Return the noise of a log's readings where it shakes the motor through dry friction."""
        if not has_dry_friction(self.controller):
            return None
        noise = _measure_noise(ticks)
        if _find_share(self.controller, ticks, noise) < SHAKES:
            return None
        stds = zip(self.controller.signals, noise.tolist(), strict=True)
        return Sensors(noise_std={name: std for name, std in stds if name in self.plant.outputs})

    def _cut(self, outputs: Sequence[Mapping[str, Float[np.ndarray, "runs n"]]], k: int) -> list[Blocks]:
        """Return the periods of the k-th of some runs, but those in which the logged command is at its limit."""
        signals, blocks = self.controller.signals, list[Blocks]()
        for ticks, run in zip(self.logs, outputs, strict=True):
            readings = np.column_stack([run[name][k] for name in signals])
            beside = {name: run[name][k] for name in self.names if name not in signals}
            simulated = replace(ticks, measured=readings, beside=beside)
            try:
                blocks.append(cut_periods(self.controller, simulated))
            except LogError:  # of each set of phases, the periods that were not at the limit are others
                blocks.append(cut_periods(self.controller, replace(simulated, command=0.0 * ticks.command)))
        responses = self.controller.law.responses
        return [group.follow(responses(group.f)) for group in join_blocks(blocks)]

    def read(self, groups: Sequence[Blocks]) -> Lines:
        """Return the responses of periods to the effort, signal by signal, amplitude by amplitude."""
        parts = list[Lines]()
        for group in groups:
            rows = group.average()
            shown = dict(zip(self.controller.signals, rows.measured.swapaxes(0, 1), strict=True)) | dict(rows.beside)
            effort = np.mean(rows.effort / rows.reference, axis=0)
            parts += [np.mean(shown[name] / rows.reference, axis=0) / effort for name in self.names]
        return self.correction * np.concatenate(parts)


def _shift_early(values: ParameterSet, period_s: float) -> tuple[int, ParameterSet]:
    """Return by how many whole ticks a loop is earlier, and the values with what is left of its delay, which is none or
    later.
    """
    late = [parameter for name, parameter in values.items() if name == DELAY and parameter.value < 0.0]
    ticks = sum(math.ceil(-parameter.value / period_s) for parameter in late)
    left = (replace(parameter, value=parameter.value + ticks * period_s) for parameter in late)
    return ticks, values.with_parameters(*left)


def _fill_ticks(ticks: Ticks, every: int) -> Float[np.ndarray, " n"]:
    """Return the reference of each tick of a law, of rows that have every n-th of whole periods: its lines lie below
    half of their rate.
    """
    if every == 1:
        return ticks.reference
    period = find_period(ticks.reference)
    assert period is not None
    spectra = np.fft.rfft(ticks.reference.reshape(-1, period), axis=1)
    return every * np.fft.irfft(spectra, every * period, axis=1).ravel()


def _measure_noise(ticks: Ticks) -> Float[np.ndarray, " y"]:
    """Return the std of the noise of each signal that is read, taken as white, by what differs from one period of the
    reference to the next that is like it.
    """
    again, period = find_again(ticks.reference)
    apart = (ticks.measured[period:] - ticks.measured[:-period])[again] / math.sqrt(2.0)
    return np.array([measure_white(reading[np.isfinite(reading)]) for reading in apart.T])


def _find_share(controller: Controller, ticks: Ticks, noise: Float[np.ndarray, " y"]) -> float:
    """Return the share of the command's rms that the noise of what is read makes."""
    f = np.linspace(0.0, 0.5 / controller.sample_time_s, GRID + 2)[1:-1]
    power = np.mean(np.abs(controller.law.responses(f)[1:]) ** 2, axis=1)
    made = abs(controller.per_effort) * float(np.sqrt(noise**2 @ power))
    return made / max(float(np.nanstd(ticks.command)), 1e-300)
