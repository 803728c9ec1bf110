"""An experiment's own unknowns: as a fit found them, and those of another log under parameters that are known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from seaopt.estimation.problem.experiment import Experiment
from seaopt.estimation.problem.fit_experiment import FitExperiment
from seaopt.estimation.problem.fit_problem import pose_problem
from seaopt.estimation.problem.losses import Squares
from seaopt.estimation.problem.residual_statistics import StatisticsByExperiment, compute_statistics
from seaopt.estimation.problem.shapes import Vector
from seaopt.estimation.result.findings import Nuisance
from seaopt.estimation.solver.settle import settle
from seaopt.parameters import ParameterSet

ITERATIONS = 40  # that initial states of a nonlinear plant may take


def estimate_nuisance(
    experiment: Experiment, params: ParameterSet, band_hz: tuple[float, float] | None = None
) -> tuple[Nuisance, dict[str, float | None]]:
    """Return a log's own initial state, offset and what else it leaves free, the plant's parameters being known.

    The second result is the fit percent of each output in the band; None without one.
    """
    values = experiment.plant.complete(experiment.apply_own(params))
    fixed = ParameterSet(values.values()).fix()
    problem = pose_problem((replace(experiment, parameters={}),), fixed, loss=Squares(), band_hz=band_hz)
    solved = settle(problem, problem.evaluate(problem.unknowns.start), ITERATIONS, None)
    problem, z = solved.problem, solved.solution.z
    statistics = compute_statistics(problem, z)
    (fitted,) = problem.experiments
    in_band = statistics[experiment.name].in_band
    shares = {name: in_band[name].fit_percent if in_band else None for name in experiment.outputs}
    return describe_nuisance(fitted, z, statistics, np.zeros(z.size)), shares


def take_sensors(experiment: Experiment, fitted: Nuisance | None) -> Experiment:
    """Return an experiment with the delay and gains that a fit estimated on the same plant, where it states none."""
    if fitted is None or not fitted.std:
        return experiment
    gains = {
        name: fitted.gain[name] for name in experiment.outputs if f"gain.{name}" in fitted.std and name in fitted.gain
    }
    changed = replace(experiment, gain=gains | dict(experiment.gain))
    return replace(changed, delay_s=fitted.delay_s) if "delay_s" in fitted.std and not experiment.delay_s else changed


def describe_nuisance(
    experiment: FitExperiment,
    z: Vector,
    statistics: StatisticsByExperiment | None,
    variance: Vector,
) -> Nuisance:
    """Return an experiment's own unknowns; offsets that the fit did not see are what is left over on average."""
    slots, outputs, states = experiment.slots, experiment.data.outputs, experiment.data.plant.states
    offset = {name: slot.at(z) for name, slot in zip(outputs, slots.offset, strict=True)}
    if statistics is not None and experiment.level_unseen:
        used = statistics[experiment.name].used
        offset = {name: level - used[name].bias for name, level in offset.items()}
    free = {"delay_s": slots.delay} | {f"gain.{name}": s for name, s in zip(outputs, slots.gain, strict=True)}
    return Nuisance(
        delay_s=slots.delay.at(z),
        gain={name: slot.at(z) for name, slot in zip(outputs, slots.gain, strict=True)},
        offset=offset,
        drift={name: tuple(slot.at(z) for slot in row) for name, row in zip(outputs, slots.drift, strict=True)},
        initial_state=tuple(
            {name: slot.at(z) for name, slot in zip(states, segment.initial, strict=True)}
            for segment in experiment.segments
        ),
        noise={name: slot.at(z) for name, slot in zip(states, slots.noise, strict=False)},
        std={
            key: float(np.sqrt(max(variance[slot.index], 0.0))) for key, slot in free.items() if slot.index is not None
        },
        substeps=experiment.count_steps(z),
        plant=experiment.data.plant.name,
        hold=experiment.data.hold,
    )
