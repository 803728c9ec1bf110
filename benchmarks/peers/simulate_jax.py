"""The plant in JAX: one `lax.scan` over the samples with classical Runge-Kutta steps."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
from problem import NOISE_N, STEP_S, V_S, Data, K

jax.config.update("jax_enable_x64", True)


def rates(x: jax.Array, u: jax.Array, z: jax.Array) -> jax.Array:
    """Return dx/dt of x = (position, speed)."""
    return jnp.stack([x[1], (z[2] * u - z[1] * x[1] - z[3] * jnp.tanh(x[1] / V_S) - K * x[0]) / z[0]])


def advance(x: jax.Array, u: jax.Array, z: jax.Array, substeps: int) -> jax.Array:
    """Return the state one sample later."""
    h = STEP_S / substeps
    for _ in range(substeps):
        k1 = rates(x, u, z)
        k2 = rates(x + h / 2 * k1, u, z)
        k3 = rates(x + h / 2 * k2, u, z)
        k4 = rates(x + h * k3, u, z)
        x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    return x


def residual(data: Data, substeps: int) -> Callable[[jax.Array], jax.Array]:
    """Return the function of the seven unknowns that gives the residuals in units of the noise."""
    current, force = jnp.asarray(data.current), jnp.asarray(data.force)

    def evaluate(z: jax.Array) -> jax.Array:
        _, x = jax.lax.scan(lambda x, u: (advance(x, u, z, substeps), x[0]), z[5:], current)
        return (K * x + z[4] - force) / NOISE_N

    return evaluate
