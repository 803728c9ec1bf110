"""numpyro's NUTS on the posterior of posterior_jax.py, as `../bench_referee.py` asks it.

    python peer_nuts.py FILE.npz --draws 4000

One line of JSON: quantiles of each parameter, and how the chains mixed.
"""

from __future__ import annotations

import argparse
import json

import jax
import numpy as np
from numpyro.diagnostics import effective_sample_size, split_gelman_rubin
from numpyro.infer import MCMC, NUTS
from posterior_jax import read_posterior
from problem import NAMES

CHAINS = 4


def main() -> None:
    """Sample, and print the quantiles."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("data")
    parser.add_argument("--draws", type=int, default=2000, help="of each of four chains")
    parser.add_argument("--quantiles", type=float, nargs="+", required=True)
    given = parser.parse_args()
    potential, center, factor = read_posterior(given.data)
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
