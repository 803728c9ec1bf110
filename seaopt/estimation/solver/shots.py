"""Starts from short shots of a log, each with an initial state of its own, which then grow into the whole.

A mode that is a little off is out of phase with its log after some periods: the cost of a long simulation has as many
minima as the mode rings periods, and the frequency responses of a log shorter than that are blurred by leakage. Over a
shot of a few periods the same guess is nearly in phase, and least squares moves it to where it follows longer ones. Nor
can a simulation that restarts at intervals run away from its log, as that of an unstable plant does.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from seaopt.estimation.problem.fit_problem import Evaluation, FitProblem
from seaopt.estimation.problem.losses import Squares
from seaopt.estimation.problem.shapes import ParameterVector, Vector
from seaopt.estimation.solver.least_squares import Callback, minimise
from seaopt.estimation.solver.prediction import add_predictors
from seaopt.estimation.solver.settle import estimate_sigma

FIRST_COUNT = 64  # shots of a log
LONGEST_FIRST = 4096  # samples of the first shots
SHORTEST_PER_STATE = 8  # samples of a shot, for each state it starts from
GROWTH = 8  # times as long is the next shot
ROUNDS, ITERATIONS = 2, 25  # of each length; sigma is estimated before each round
NEAR = 1.0  # squared standard deviations to the minimum, near enough to go on from


def find_start_on_shots(problem: FitProblem, start: Vector, callback: Callback | None = None) -> Vector | None:
    """Return the unknowns of a linear plant with shared parameters that follow longer and longer shots of the logs.
    None where the logs are too short to be cut, or where the plant runs away even so.
    """
    samples = max(e.longest for e in problem.experiments)
    shortest = SHORTEST_PER_STATE * max(1, *(e.model.nx for e in problem.experiments))
    count = min(max(FIRST_COUNT, samples // LONGEST_FIRST), samples // shortest)
    shared, z = problem.unknowns.shared, start.copy()
    if samples < 2 * shortest:
        return None
    for theta in grow_shots(problem, start, count, callback):
        if theta is None:
            return None
        z[:shared] = theta
    return z


def grow_shots(
    problem: FitProblem, start: Vector, count: int, callback: Callback | None = None
) -> Iterator[ParameterVector | None]:
    """Yield the shared parameters that follow `count` shots per segment, then longer ones; None where they run away."""
    whole = problem.with_each(band_hz=None, loss=Squares())  # a band filter takes longer to settle than a shot
    shared, z = problem.unknowns.shared, start.copy()
    while count > 1:
        shots, values = cut_problem(whole, z, count)
        evaluation = shots.evaluate(values)
        for _ in range(ROUNDS):
            if not np.isfinite(evaluation.cost):
                yield None
                return
            shots = shots.with_values("sigma", estimate_sigma(shots, evaluation.power, evaluation.z))
            evaluation = minimise(
                shots,
                shots.evaluate(evaluation.z),
                shots.unknowns.low,
                shots.unknowns.high,
                decrement=NEAR,
                max_iterations=ITERATIONS,
                callback=_tell_count(callback, count),
            ).evaluation
        z[:shared] = evaluation.z[:shared]
        yield evaluation.z[:shared]
        count //= GROWTH


def _tell_count(callback: Callback | None, count: int) -> Callable[[Evaluation], None] | None:
    return None if callback is None else lambda evaluation: callback(f"{count} shots", evaluation.cost)


def cut_problem(problem: FitProblem, z: Vector, count: int) -> tuple[FitProblem, Float[np.ndarray, " m"]]:
    """Return the problem with `count` shots in place of each, and its unknowns. Shots of a nonlinear plant start where
    a filter that hardly trusts the plant sees the state. Those of a linear one start anywhere: their best initial
    states follow from one evaluation.
    """
    data = {e.name: replace(e.data, shots=e.data.shots * count) for e in problem.experiments}
    shots, values = problem.rebuild(problem.params, z, data)
    predicting = None if problem.all_linear else add_predictors(problem, z, follows=False)
    if predicting is None:
        return shots, values
    for old, new in zip(predicting.experiments, shots.experiments, strict=True):
        seen = np.zeros((len(old.data.log), old.model.nx))
        for segment, rows in zip(old.segments, old.data.segment_rows, strict=True):
            states = old.run(segment, z, sums=False, states=True).states
            assert states is not None
            seen[rows] = np.nan_to_num(states)
        for segment, rows in zip(new.segments, new.data.segment_rows, strict=True):
            for slot, value in zip(segment.initial, seen[rows.start], strict=True):
                if slot.index is not None:
                    values[slot.index] = value
    return shots, values
