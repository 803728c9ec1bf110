"""numpyro's NUTS on the problem of problem.py, as `../bench_referee.py` asks it; prior flat within the bounds.

    python peer_nuts.py FILE.npz --draws 4000

The file has current, force, and where and how wide to begin (`center`, `factor`: a Cholesky factor, which scales the
unknowns and changes no posterior). One line of JSON: quantiles of each parameter, and how the chains mixed.
"""

from __future__ import annotations

import argparse
import json

import jax
import jax.numpy as jnp
import numpy as np
import simulate_jax
from numpyro.diagnostics import effective_sample_size, split_gelman_rubin
from numpyro.infer import MCMC, NUTS
from problem import LOWER, NAMES, SUBSTEPS, UPPER, Data

CHAINS = 4


def main() -> None:
    """Sample, and print the quantiles."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("data")
    parser.add_argument("--draws", type=int, default=2000, help="of each of four chains")
    parser.add_argument("--quantiles", type=float, nargs="+", required=True)
    given = parser.parse_args()
    with np.load(given.data) as content:
        data = Data(current=content["current"], force=content["force"], std=content["std"])
        center, factor = jnp.asarray(content["center"]), jnp.asarray(content["factor"])
    residual = simulate_jax.residual(data, SUBSTEPS)

    def potential(u: jax.Array) -> jax.Array:
        theta = center + factor @ u
        inside = jnp.all((theta > LOWER) & (theta < UPPER))
        return jnp.where(inside, 0.5 * jnp.sum(residual(jnp.where(inside, theta, center)) ** 2), jnp.inf)

    kernel = NUTS(potential_fn=potential)
    sampler = MCMC(kernel, num_warmup=300, num_samples=given.draws, num_chains=CHAINS, chain_method="sequential",
                   progress_bar=False)  # fmt: skip
    begin = 0.3 * jax.random.normal(jax.random.key(2), (CHAINS, center.size))
    sampler.run(jax.random.key(1), init_params=begin)
    draws = np.asarray(center + sampler.get_samples(group_by_chain=True) @ factor.T)
    print(json.dumps({
        "quantiles": {
            name: np.quantile(draws[:, :, j], given.quantiles).tolist() for j, name in enumerate(NAMES)
        },
        "effective": min(float(effective_sample_size(draws[:, :, j])) for j in range(len(NAMES))),
        "mixing": max(float(split_gelman_rubin(draws[:, :, j])) for j in range(len(NAMES))),
    }))  # fmt: skip


if __name__ == "__main__":
    main()
