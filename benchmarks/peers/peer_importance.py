"""Importance sampling of the posterior of posterior_jax.py, as `../bench_referee.py` asks it: its quantiles exactly, up
to chance, from draws of a multivariate t that are weighted with the posterior over the t's own density.

    python peer_importance.py FILE.npz --draws 40000

One line of JSON: quantiles of each parameter, and how many independent draws of the posterior they are worth.
"""

from __future__ import annotations

import argparse
import json

import jax
import jax.numpy as jnp
import numpy as np
from posterior_jax import read_posterior
from problem import NAMES

FREEDOM, WIDER = 8.0, 1.1  # of the t: its tails are wider than the posterior's, or weights there would be few and large
BLOCK = 250  # draws at once


def main() -> None:
    """Sample, and print the quantiles."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("data")
    parser.add_argument("--draws", type=int, default=40000)
    parser.add_argument("--quantiles", type=float, nargs="+", required=True)
    parser.add_argument("--wider", type=float, default=WIDER)
    given = parser.parse_args()
    potential, center, factor = read_posterior(given.data)
    rng = np.random.default_rng(1)
    spread = given.wider / np.sqrt(rng.chisquare(FREEDOM, size=(given.draws, 1)) / FREEDOM)
    u = rng.normal(size=(given.draws, center.size)) * spread
    squares = np.sum((u / given.wider) ** 2, axis=1)
    evaluate = jax.jit(jax.vmap(potential))
    parts = [evaluate(jnp.asarray(u[k : k + BLOCK])) for k in range(0, given.draws, BLOCK)]
    logarithm = 0.5 * (FREEDOM + center.size) * np.log1p(squares / FREEDOM) - np.concatenate(parts)
    weights = np.nan_to_num(np.exp(logarithm - np.nanmax(logarithm)))
    weights /= np.sum(weights)
    draws = np.asarray(center + u @ factor.T)
    quantiles: dict[str, list[float]] = {}
    for j, name in enumerate(NAMES):
        order = np.argsort(draws[:, j])
        reached = np.cumsum(weights[order]) - 0.5 * weights[order]
        quantiles[name] = np.interp(given.quantiles, reached, draws[order, j]).tolist()
    # A heavy weight would be a part of the posterior that the t hardly reaches.
    print(json.dumps({
        "quantiles": quantiles, "effective": float(1.0 / np.sum(weights**2)), "heaviest": float(np.max(weights)),
    }))  # fmt: skip


if __name__ == "__main__":
    main()
