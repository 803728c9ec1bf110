r"""The noise that a residual has of its sensor, and how many times that the residual is.

What a model lacks changes little from one sample to the next, a sensor's noise does. Of white noise the second
difference has six times its variance, so that an output's noise is at least

.. math:: s = \sqrt{\overline{(r_{t-1} - 2 r_t + r_{t+1})^2} / 6}

(differences as of von Neumann, Ann. Math. Statist. 12, 1941), and at least what its quantisation makes, a step over
the root of 12, which a slow signal shows in no difference, with the noise before it (`rounding`). Of an output that was
interpolated from a slower clock the differences are over so many samples as lie between two readings. The noise that a
user states counts where the sensor's is coloured, as behind a filter. The excess, the residual's rms over that noise,
is 1 to 1.1 of right models.

A plant that follows a reading (`Experiment.follow`) is shaken by that sensor's noise, which its outputs then have as
well. How much is seen by shaking it once more by as much: the difference that this makes is added to the noise.

Both are of the residuals as they are fitted: in the band, and as the loss weighs them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from seaopt.estimation.problem.fit_experiment import FitExperiment, FitSegment
from seaopt.estimation.problem.fit_problem import FitProblem
from seaopt.estimation.problem.losses import Loss
from seaopt.estimation.problem.residual_statistics import (
    ExperimentResiduals,
    ResidualsByExperiment,
    compute_experiment_residuals,
    compute_residuals,
)
from seaopt.estimation.problem.rounding import find_noise
from seaopt.estimation.problem.shapes import PerOutput, Vector
from seaopt.logs.quality.faults import find_quantisation
from seaopt.records import record

STATED = 5.0  # times the noise between neighbours that a stated one counts for: more is a weight, not a sensor's noise

COARSE = 8.0  # steps of a reading that an output moves by: fewer lie on lines by chance
STRAIGHT = 1e-9  # of an output's range: a second difference that is rounding
MOST_BENDS, MOST_BETWEEN, FEWEST_MOVES = 0.7, 64, 200  # share of samples off a line, readings' distance, samples
ROUNDING = 1e-6  # of the spread: less than that is no sensor's noise


@record(eq=False)
class NoiseFloor:
    """The noise and the rms of an experiment's residuals, output by output, in sigma of the fit."""

    noise: PerOutput
    rms: PerOutput
    step: PerOutput  # that a reading is rounded to; 0 where it is not, and where residuals are filtered or predicted
    count: PerOutput  # samples that count

    @property
    def excess(self) -> PerOutput:
        """How many times its noise a residual is; 0 where no sample counts."""
        return self.rms / np.maximum(self.noise, 1e-300)


def measure_excess(problem: FitProblem, z: Vector) -> dict[str, float]:
    """Return how many times its sensor's noise each output's residual is, by EXPERIMENT.OUTPUT, at unknowns `z`."""
    return list_excess(problem, measure_floors(problem, compute_residuals(problem, z), z))


def measure_most(problem: FitProblem, z: Vector) -> float:
    """Return how many times its sensor's noise a residual is at most."""
    return max(measure_excess(problem, z).values())


def list_excess(problem: FitProblem, floors: Mapping[str, NoiseFloor]) -> dict[str, float]:
    """Return the excess of each output, by EXPERIMENT.OUTPUT."""
    return {output.label: float(floors[output.experiment.name].excess[output.index]) for output in problem.outputs}


def measure_floors(problem: FitProblem, residuals: ResidualsByExperiment, z: Vector) -> dict[str, NoiseFloor]:
    """Return the noise and the residuals' rms at unknowns `z` of every experiment, by its name."""
    floors = {e.name: measure_floor(e, residuals[e.name]) for e in problem.experiments}
    return {e.name: _add_shaking(e, residuals[e.name], floors[e.name], z) for e in problem.experiments}


@np.errstate(all="ignore")
def _add_shaking(experiment: FitExperiment, residuals: ExperimentResiduals, floor: NoiseFloor, z: Vector) -> NoiseFloor:
    """Return a floor with what the noise of readings makes of the outputs of a plant that follows them;
    the floor as it is of outputs that overflow where they are shaken, or whose readings have no finite noise.
    """
    plant, rng = experiment.model.plant, np.random.default_rng(0)
    followed = [experiment.data.outputs.index(plant.followed[name].state) for name in plant.read_inputs]
    if not followed:
        return floor
    noise = [floor.noise[o] * experiment.sigma[o] / _measure_noise_gain(experiment) for o in followed]

    def shake(segment: FitSegment) -> FitSegment:
        inputs, readings = segment.samples.u[: -len(noise)], segment.samples.u[-len(noise) :]
        more = (each + std * rng.normal(size=each.size) for each, std in zip(readings, noise, strict=True))
        return replace(segment, samples=replace(segment.samples, u=(*inputs, *more)))

    shaken = compute_experiment_residuals(
        replace(experiment, segments=tuple(shake(segment) for segment in experiment.segments)), z
    )
    change = experiment.loss.slope(shaken.weighted) - experiment.loss.slope(residuals.weighted)
    shaking = np.sqrt(np.sum(change**2, axis=0) / np.maximum(floor.count, 1.0))
    finite = np.isfinite(shaking) & np.all(np.isfinite(shaken.weighted), axis=0)
    return replace(floor, noise=np.hypot(floor.noise, np.where(finite, shaking, 0.0)))


def measure_floor(experiment: FitExperiment, residuals: ExperimentResiduals) -> NoiseFloor:
    """Return the noise of an experiment's outputs, and their residuals' rms."""
    loss, gain = experiment.loss, _measure_noise_gain(experiment)
    settle = experiment.weights.settle
    noise, rms, step, count = (np.zeros(len(experiment.sigma)) for _ in range(4))
    for output in experiment.outputs:
        o, name, sigma = output.index, output.name, output.sigma
        used = [segment.mark_counted(settle)[:, o] for segment in experiment.segments]
        count[o] = sum(int(np.count_nonzero(part)) for part in used)
        power = sum(float(np.sum(loss.slope(part) ** 2)) for part in residuals.weighted_of(name))
        rms[o] = np.sqrt(power / max(count[o], 1.0))
        apart = max(map(_count_between, output.measured), default=1)
        # What is held out may be far off, which is no noise.
        raw = [part[mask] for mask, part in zip(used, residuals.raw_of(name), strict=True)]
        seconds = [_take_second(loss.slope(part * (gain / sigma)), apart) for part in raw]
        neighbours = float(np.sqrt(np.mean(np.concatenate(seconds) ** 2) / 6.0)) if any(map(len, seconds)) else 0.0
        stated_step = experiment.data.quantisation.get(name)
        quantum = (stated_step or find_quantisation(np.concatenate(output.measured))) / sigma
        step[o] = 0.0 if settle or experiment.predictor is not None else quantum
        if step[o] and apart == 1 and loss.quadratic and any(part.size > 2 for part in raw):
            before = find_noise(quantum, [part / sigma for part in raw], neighbours)
            neighbours = max(neighbours, float(np.hypot(before, quantum / np.sqrt(12.0))))
        stated = _weigh_gaussian(loss) if name in experiment.data.sigma else 0.0
        rounding = ROUNDING * output.spread * gain / sigma
        noise[o] = max(neighbours, quantum * gain / np.sqrt(12.0), min(stated, STATED * neighbours), rounding)
    return NoiseFloor(noise=noise, rms=rms, step=step, count=count)


def _take_second(values: Float[np.ndarray, " n"], apart: int) -> Float[np.ndarray, " _"]:
    """Return the second differences over samples so far apart."""
    return values[2 * apart :] - 2.0 * values[apart:-apart] + values[: -2 * apart]


def _count_between(measured: Float[np.ndarray, " _"]) -> int:
    """Return how many samples lie between two readings at most, of an output on lines between them; 1 of any other."""
    first, second = np.abs(np.diff(measured)[1:]), np.diff(measured, 2)
    moving = np.isfinite(second) & (first > 0.0)
    if np.count_nonzero(moving) < FEWEST_MOVES:
        return 1
    bent = moving & (np.abs(second) > STRAIGHT * np.ptp(measured[np.isfinite(measured)]))
    if np.count_nonzero(bent) > MOST_BENDS * np.count_nonzero(moving):
        return 1
    if np.median(first[moving]) < COARSE * find_quantisation(measured):  # takes the longest, and few come here
        return 1
    readings = np.count_nonzero(bent & ~np.append(False, bent[:-1]))  # one between two samples bends at both
    return min(max(round(np.count_nonzero(moving) / max(readings, 1)), 1), MOST_BETWEEN)


def _weigh_gaussian(loss: Loss) -> float:
    """Return the rms of what a loss makes of Gaussian residuals of 1 sigma."""
    r = np.linspace(-6.0, 6.0, 601)
    density = np.exp(-0.5 * r**2)
    return float(np.sqrt(np.sum(loss.slope(r) ** 2 * density) / np.sum(density)))


def _measure_noise_gain(experiment: FitExperiment) -> float:
    """Return how many times its rms white noise is behind the filter of the fit's band."""
    sections, settle = experiment.weights.sections, experiment.weights.settle
    if not len(sections):
        return 1.0
    from scipy.signal import sosfilt  # deferred: scipy is slow to load

    impulse = np.zeros(max(settle, 16))
    impulse[0] = 1.0
    filters = np.insert(sections, 3, 1.0, axis=1)  # a0 = 1 is left out of sections
    return float(np.linalg.norm(np.asarray(sosfilt(filters, impulse))))
