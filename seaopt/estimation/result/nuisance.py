"""An experiment's own unknowns: those of a fit, and those of another log under known parameters."""

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
    """Return a log's own initial state, offset and what else it leaves free, the plant's parameters being known. The
    second result is the fit percent of each output in the band; None without one.
    """
    problem = pose_problem((experiment,), params.fix(), loss=Squares(), band_hz=band_hz)
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
    gains = {name: gain for name, gain in fitted.gain.items() if f"gain.{name}" in fitted.std}
    gains = {name: gain for name, gain in gains.items() if name in experiment.outputs}
    delay = fitted.delay_s if "delay_s" in fitted.std and not experiment.delay_s else experiment.delay_s
    return replace(experiment, gain={**gains, **experiment.gain}, delay_s=delay)


def describe_nuisance(
    experiment: FitExperiment, z: Vector, statistics: StatisticsByExperiment | None, variance: Vector
) -> Nuisance:
    """Return an experiment's own unknowns; offsets that the fit did not see are what is left over on average."""
    data, slots, point = experiment.data, experiment.slots, experiment.point(z)
    offset = dict(zip(data.outputs, point.offset.tolist(), strict=True))
    if statistics is not None and experiment.level_unseen:
        used = statistics[experiment.name].used
        offset = {name: level - used[name].bias for name, level in offset.items()}
    free = {"delay_s": slots.delay, **{f"gain.{name}": s for name, s in zip(data.outputs, slots.gain, strict=True)}}
    return Nuisance(
        delay_s=point.clock.delay_s,
        gain=dict(zip(data.outputs, point.gain.tolist(), strict=True)),
        offset=offset,
        drift={name: tuple(row) for name, row in zip(data.outputs, point.drift.tolist(), strict=True)},
        initial_state=tuple(
            dict(zip(data.plant.states, segment.start(z).tolist(), strict=True)) for segment in experiment.segments
        ),
        noise={name: slot.at(z) for name, slot in zip(data.plant.states, slots.noise, strict=False)},
        std={
            key: float(np.sqrt(max(variance[slot.index], 0.0))) for key, slot in free.items() if slot.index is not None
        },
        substeps=experiment.count_even_steps(z),
        plant=data.plant.name,
        hold=data.hold,
    )
