"""The posterior of problem.py in JAX, prior flat within the bounds, of a file as `../bench_referee.py` writes it.

The file has current, force, and where and how wide to begin (`center`, `factor`: a Cholesky factor, which scales the
unknowns and changes no posterior).
"""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import simulate_jax
from problem import LOWER, SUBSTEPS, UPPER, Data


def read_posterior(path: str) -> tuple[Callable[[jax.Array], jax.Array], jax.Array, jax.Array]:
    """Return minus the logarithm of the posterior's density, up to a constant, over u; center and factor of the
    unknowns, which are center + factor u.
    """
    with np.load(path) as content:
        data = Data(current=content["current"], force=content["force"], std=content["std"])
        center, factor = jnp.asarray(content["center"]), jnp.asarray(content["factor"])
    residual = simulate_jax.residual(data, SUBSTEPS)

    def potential(u: jax.Array) -> jax.Array:
        theta = center + factor @ u
        inside = jnp.all((theta > LOWER) & (theta < UPPER))
        return jnp.where(inside, 0.5 * jnp.sum(residual(jnp.where(inside, theta, center)) ** 2), jnp.inf)

    return potential, center, factor
