"""MuJoCo's `minimize.least_squares`, the engine of `mujoco.sysid`, with its finite differences.

It runs on the JAX simulation of the same plant: MuJoCo's own `rollout` has no tanh friction (its friction loss is a
constraint with another law) and its estimates on these data would be of another model. So this row is its minimiser
alone. Columns of the finite differences are simulated together.
"""

from __future__ import annotations

from collections.abc import Callable

import jax
import numpy as np
import simulate_jax
from mujoco import minimize
from problem import LOWER, START, UPPER, Answer, Data, Settings, report


def prepare(data: Data, settings: Settings) -> Callable[[], Answer]:
    """Compile the simulation of one column and of seven."""
    simulation = jax.jit(jax.vmap(simulate_jax.residual(data, settings.substeps), in_axes=1, out_axes=1))
    for columns in (1, START.size):
        simulation(np.tile(START[:, None], columns)).block_until_ready()
    count = 0

    def residual(z: np.ndarray) -> np.ndarray:
        nonlocal count
        count += z.shape[1]
        return np.asarray(simulation(z))

    def solve() -> Answer:
        nonlocal count
        count = 0
        theta, trace = minimize.least_squares(
            START, residual, bounds=[LOWER, UPPER], x_scale="jac", verbose=minimize.Verbosity.SILENT
        )
        return Answer(theta=theta, evaluations=count, note=f"{len(trace)} iterations; on a JAX simulation")

    return solve


if __name__ == "__main__":
    report("MuJoCo minimize.least_squares", "mujoco", prepare)
