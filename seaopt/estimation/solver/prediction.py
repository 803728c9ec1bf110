"""Filters that hold a plant to its log, and starts found by predicting with them.

A plant that is far off runs away in simulation, or is out of phase after some periods; its predictions one sample
ahead by a filter that hardly trusts it are only bad, so that least squares of their errors finds its way.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from seaopt.estimation.problem.fit_experiment import FIRST_SAMPLES, FitExperiment
from seaopt.estimation.problem.fit_problem import FitProblem
from seaopt.estimation.problem.losses import Squares
from seaopt.estimation.problem.shapes import PerOutput, Vector
from seaopt.estimation.problem.steady_state_filter import SteadyStateFilter
from seaopt.estimation.solver.least_squares import Callback, minimise
from seaopt.estimation.solver.settle import FLAT, estimate_sigma
from seaopt.estimation.solver.step_size import EXACT, bound_steps
from seaopt.signals import measure_white
from seaopt.simulation import Point, Segment, run_passes

PREDICTION_RADIUS = 100.0  # a plant that is held to the log may be moved far at once
LINEARISED_AT = 48  # over which a nonlinear plant is linearised for its filter


def find_predicting_start(
    problem: FitProblem, start: Vector, iterations: int, callback: Callback | None = None
) -> Vector | None:
    """Return the minimum of the errors of prediction by a filter of fixed gain, which holds the plant to the log. The
    filter does not trust the plant, so that a plant that is far off predicts badly but cannot run away; its gain is
    recomputed from the states visited, a few times. None where no step is finite.
    """
    problem = problem.with_each(substeps=1, loss=Squares(), band_hz=None)
    z = start.copy()
    for _ in range(4):
        predicting = add_predictors(problem, z, follows=False)
        if predicting is None:
            return None
        low, high = problem.unknowns.low, problem.unknowns.high
        first = predicting.evaluate(np.clip(z, low, high))
        solution = minimise(
            bound_steps(predicting, first),
            first,
            low,
            high,
            first_radius=PREDICTION_RADIUS,
            max_iterations=iterations,
            callback=None if callback is None else lambda each: callback("predicting", each.cost),
            flat=FLAT,  # for a start, and with so few steps smoothed friction has kinks as what sticks has jumps
        )
        if not np.isfinite(solution.evaluation.cost):
            return None
        last, z = z, solution.z
        problem = problem.with_values("sigma", estimate_sigma(predicting, solution.evaluation.power, z))
        if np.allclose(z, last, rtol=1e-3, atol=0.0):
            break
    return z


def add_predictors(problem: FitProblem, z: Vector, *, follows: bool) -> FitProblem | None:
    """Return the problem whose residuals are errors of prediction; None where the filter finds no finite state."""
    predictors: dict[str, SteadyStateFilter] = {}
    for experiment in problem.experiments:
        predictor = _make_predictor(experiment, z)
        if predictor is None:
            return None
        predictors[experiment.name] = replace(predictor, follows=follows)
    return problem.with_values("predictor", predictors)


def _estimate_noise(experiment: FitExperiment) -> PerOutput:
    """Return the standard deviation of white noise on each output, from its first samples that are not held out."""
    used, noise = experiment.segments[0].mark_counted(0, slice(0, FIRST_SAMPLES)), list[float]()
    for o, channel in enumerate(experiment.segments[0].samples.y):
        noise.append(measure_white(channel[:FIRST_SAMPLES][used[:, o]]))
    return np.maximum(noise, np.maximum(EXACT * experiment.spread, 1e-300))


@np.errstate(all="ignore")
def _make_predictor(experiment: FitExperiment, z: Vector) -> SteadyStateFilter | None:
    """Return a filter whose sizes and places come from its own estimates of the state, after a few rounds."""
    model, samples, point = experiment.model, experiment.segments[0].samples, experiment.point(z)
    predictor = SteadyStateFilter(
        size=np.ones(model.nx),
        sensors=_estimate_noise(experiment),
        places=np.zeros((LINEARISED_AT, model.nx + model.nu)),
        gain=point.gain,
        follows=False,
    )
    size = _guess_state_size(experiment, predictor, point)
    predictor = replace(predictor, size=size)
    rows = np.linspace(0, min(samples.n, FIRST_SAMPLES) - 1, LINEARISED_AT).astype(int)
    u, y, keep = (tuple(c[:FIRST_SAMPLES] for c in channels) for channels in (samples.inputs, samples.y, samples.keep))
    short = Segment(u=u, y=y, keep=keep, start_s=samples.start_s)
    still = replace(point, clock=replace(point.clock, delay_free=False))
    for _ in range(3):
        correction = predictor.correction(model, still, np.zeros(0))
        if not np.all(np.isfinite(correction)):
            return None
        settings = replace(still, correction=correction)
        states = run_passes(model, short, settings, np.zeros(model.nx), sums=False, states=True).states
        assert states is not None
        if not np.all(np.isfinite(states)):
            return None
        places = np.column_stack([states[rows], *(channel[rows] for channel in short.u)])
        size = np.maximum(np.std(states, axis=0), 1e-9 * np.max(np.abs(size)))
        predictor = replace(predictor, size=size, places=places)
    return predictor


def _guess_state_size(
    experiment: FitExperiment, predictor: SteadyStateFilter, point: Point
) -> Float[np.ndarray, " nx"]:
    """Return the size of each state that would show as the outputs' spread within ten samples."""
    a, c = predictor.linearise(experiment.model, point, point.theta[None])
    rows, power = [], np.eye(experiment.model.nx)
    for _ in range(10):
        rows.append(np.max(np.abs(c[0] @ power) / experiment.spread[:, None], axis=0))
        power = a[0] @ power
    seen = np.max(rows, axis=0)
    return 1.0 / np.where(np.isfinite(seen) & (seen > 0.0), seen, 1.0)
