"""The plant in JAX: one `lax.scan` over the samples with classical Runge-Kutta steps."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
from problem import NOISE_N, STEP_S, V_S, Data, K

jax.config.update("jax_enable_x64", True)


def advance(
    x: jax.Array, v: jax.Array, u: jax.Array, z: Sequence[jax.Array] | jax.Array, substeps: int
) -> tuple[jax.Array, jax.Array]:
    """Return position and speed one sample later.

    In scalars: arrays of two make the gradient of jax 0.4.31, which jax-sysid needs, a hundred times slower.
    """

    def rate(v: jax.Array, x: jax.Array) -> jax.Array:
        return (z[2] * u - z[1] * v - z[3] * jnp.tanh(v / V_S) - K * x) / z[0]

    h = STEP_S / substeps
    for _ in range(substeps):
        a1 = rate(v, x)
        v2 = v + h / 2 * a1
        a2 = rate(v2, x + h / 2 * v)
        v3 = v + h / 2 * a2
        a3 = rate(v3, x + h / 2 * v2)
        v4 = v + h * a3
        a4 = rate(v4, x + h * v3)
        x, v = x + h / 6 * (v + 2 * v2 + 2 * v3 + v4), v + h / 6 * (a1 + 2 * a2 + 2 * a3 + a4)
    return x, v


def residual(data: Data, substeps: int) -> Callable[[jax.Array], jax.Array]:
    """Return the function of the seven unknowns that gives the residuals in units of the noise."""
    current, force = jnp.asarray(data.current), jnp.asarray(data.force)

    def evaluate(z: jax.Array) -> jax.Array:
        _, x = jax.lax.scan(lambda x, u: (jnp.stack(advance(x[0], x[1], u, z, substeps)), x[0]), z[5:], current)
        return (K * x + z[4] - force) / NOISE_N

    return evaluate
