"""The sampled plant that a plan is made for, what a start and commands make of its state, and where these are free."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float, Int

from seaopt.control.loops.sampled_plant import DigitalPlant
from seaopt.control.mpc.spec import MPCSpec
from seaopt.errors import ControlError
from seaopt.parameters import ParameterSet
from seaopt.plants import Plant
from seaopt.plants.plant import find_range, name_input
from seaopt.records import record
from seaopt.signals import MatrixNN, VectorN
from seaopt.units import mechanics_of, name_command, show_command

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
    def rest_state(self) -> State:
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


def limit_command(spec: MPCSpec, plant: Plant, values: ParameterSet) -> float:
    """Return the limit of the command: what is asked for, and no more than the plant's actuation takes."""
    return min(spec.limit_asked or np.inf, find_range(plant, values) or np.inf)


def find_static_gain(plant: Plant, digital: DigitalPlant, spec: MPCSpec, limit: float) -> float:
    """Return N/A of the measured force, or say why it cannot be controlled so."""
    unit = plant.outputs[spec.measured]
    word, source = mechanics_of(unit).word, name_command(*name_input(plant))
    if np.max(np.abs(np.linalg.eigvals(digital.a))) > 1.0 - 1e-9:
        raise ControlError(
            f"{plant.name} does not come to rest by itself, so that no {source} belongs to a {word}; design on the "
            "stand"
        )
    gain = float(digital.c[0] @ np.linalg.solve(np.eye(digital.b.size) - digital.a, digital.b))
    if abs(gain) < 1e-9:
        raise ControlError(f"{spec.measured} of {plant.name} does not follow a constant {source}; design on the stand")
    if digital.d[0] != 0.0:
        raise ControlError(
            f"{spec.measured} of {plant.name} follows the {source} at once (d = {digital.d[0]:.3g}); "
            f"control the spring's {word}"
        )
    largest = abs(gain) * limit
    if spec.largest_force_N is not None and spec.largest_force_N > largest:
        raise ControlError(
            f"a limit of {show_command(limit, *name_input(plant))} holds {largest:.4g} {unit}, less than "
            f"largest_force_N = {spec.largest_force_N:g}; raise the one or lower the other"
        )
    return gain
