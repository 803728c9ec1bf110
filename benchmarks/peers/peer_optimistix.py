"""The JAX residual with optimistix's Levenberg-Marquardt, which takes no bounds; unknowns in units of SCALE."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import optimistix
import simulate_jax
from problem import SCALE, START, Answer, Data, Settings, report


def prepare(data: Data, settings: Settings) -> Callable[[], Answer]:
    """Compile the whole solve."""
    residual, scale = simulate_jax.residual(data, settings.substeps), jnp.asarray(SCALE)
    solver = optimistix.LevenbergMarquardt(rtol=1e-8, atol=1e-8)

    def search(z: jax.Array) -> tuple[jax.Array, jax.Array]:
        found = optimistix.least_squares(
            lambda z, _: residual(z * scale), solver, z, options={"jac": "fwd"}, max_steps=256, throw=False
        )
        return found.value * scale, found.stats["num_steps"]

    start = jnp.asarray(START / SCALE)
    compiled = jax.jit(search).lower(start).compile()

    def solve() -> Answer:
        theta, steps = compiled(start)
        return Answer(theta=np.asarray(theta), evaluations=int(steps), note="no bounds")

    return solve


if __name__ == "__main__":
    report("JAX, optimistix Levenberg-Marquardt", "optimistix", prepare)
