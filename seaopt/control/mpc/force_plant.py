"""The sampled plant that a plan is made for, what a start and commands make of its state, and where these are free."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float, Int

from seaopt.records import record
from seaopt.signals import MatrixNN, VectorN

State = Float[np.ndarray, " nx"]


@record(eq=False)
class ForcePlant:
    """The plant x+ = A x + b u + b' u-, u- the command before, whose measured force is c x."""

    a: Float[np.ndarray, "nx nx"]
    b: State
    late: State  # b', where the drive's delay leaves a part of a sample
    c: State
    w: State  # the row whose square the cost weighs: force and lag times its rate
    lag_s: float
    gain: float  # N/A at rest
    sample_time_s: float

    @property
    def rest(self) -> State:
        """The state at rest per unit of command."""
        return np.linalg.solve(np.eye(self.b.size) - self.a, self.b + self.late)

    def add_command(self) -> tuple[MatrixNN, VectorN]:
        """Return A and b of the plant with its last command as a state, driven by the command's increments."""
        nx = self.b.size
        A = np.eye(nx + 1)
        A[:nx, :nx], A[:nx, nx] = self.a, self.b + self.late
        return A, np.append(self.b, 1.0)

    def respond(self, samples: int) -> Iterator[tuple[Float[np.ndarray, "nx nx1"], Float[np.ndarray, "nx samples"]]]:
        """Yield the state at samples 0 to `samples`, by the start (state, last command) and by the commands."""
        nx = self.b.size
        free, forced = np.eye(nx, nx + 1), np.zeros((nx, samples))
        yield free, forced
        for j in range(samples):
            free, forced = self.a @ free, self.a @ forced
            forced[:, j] += self.b
            if j:
                forced[:, j - 1] += self.late
            else:
                free[:, -1] += self.late
            yield free, forced


def spread_knots(samples: int, moves: int) -> Int[np.ndarray, " n"]:
    """Return `moves` samples from 0 to samples - 1, each step longer than the last by about a constant factor."""
    low, high = 1.0, 10.0
    for _ in range(80):  # the factor for which `moves` - 1 steps reach the end
        factor = 0.5 * (low + high)
        if _space_knots(factor, moves)[-1] < samples - 1:
            low = factor
        else:
            high = factor
    knots = np.round(_space_knots(high, moves)).astype(int)
    knots[-1] = samples - 1
    return np.maximum(knots, np.arange(moves))


def _space_knots(factor: float, moves: int) -> VectorN:
    return np.concatenate([[0.0], np.cumsum(factor ** np.arange(moves - 1))])


def interpolate_knots(knots: Int[np.ndarray, " n"]) -> Float[np.ndarray, "samples n"]:
    """Return W, which draws straight lines between the knots."""
    samples = np.arange(knots[-1] + 1)
    return np.column_stack([np.interp(samples, knots, row) for row in np.eye(knots.size)])
