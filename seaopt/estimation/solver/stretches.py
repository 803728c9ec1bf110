"""Starts found on short stretches of a log, each from a state of its own, which then grow into the whole.

A mode that is a little off is out of phase with its log after some periods: the cost of a long simulation has as many
minima as the mode rings periods, and the frequency responses of a log shorter than that are blurred by leakage. Over a
stretch of a few periods the same guess is nearly in phase, and least squares moves it to where it follows longer ones.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from seaopt.estimation.problem.fit_problem import FitProblem
from seaopt.estimation.problem.losses import Squares
from seaopt.estimation.solver.least_squares import minimise
from seaopt.estimation.solver.settle import estimate_sigma

FIRST_COUNT = 64  # stretches of a log
LONGEST_FIRST = 4096  # samples of the first stretches
SHORTEST_PER_STATE = 8  # samples of a stretch, for each state it starts from
GROWTH = 8  # times as long is the next stretch
ROUNDS, ITERATIONS = 2, 25  # of each length; sigma is estimated before each round
NEAR = 1.0  # squared standard deviations to the minimum, near enough to go on from


def find_start_on_stretches(problem: FitProblem, start: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"] | None:
    """Return the unknowns with shared parameters that follow longer and longer stretches of the logs.

    None where the logs are too short to be cut, or where the plant runs away even so.
    """
    whole = problem.with_each(band_hz=None, loss=Squares())  # a band filter takes longer to settle than a stretch
    shared, z = problem.unknowns.shared, start.copy()
    samples = max(e.longest for e in problem.experiments)
    states = max(e.model.nx for e in problem.experiments)
    count = min(max(FIRST_COUNT, samples // LONGEST_FIRST), samples // (SHORTEST_PER_STATE * max(states, 1)))
    while count > 1:
        cut = {e.name: replace(e.data, shots=e.data.shots * count) for e in whole.experiments}
        pieces, values = whole.rebuild(whole.params, z, cut)
        values[:shared] = z[:shared]
        here = pieces.evaluate(values)
        for _ in range(ROUNDS):
            if not np.isfinite(here.cost):
                return None
            pieces = pieces.with_sigma(estimate_sigma(pieces, here.power, here.z))
            here = minimise(
                pieces, pieces.evaluate(here.z), pieces.unknowns.low, pieces.unknowns.high, decrement=NEAR,
                max_iterations=ITERATIONS,
            ).evaluation  # fmt: skip
        z[:shared] = here.z[:shared]
        count //= GROWTH
    return z if samples >= 2 * SHORTEST_PER_STATE * max(states, 1) else None
