r"""Where what is known of the parameters comes from.

The share of an experiment e in parameter i is that of its noise in the estimate's variance,

.. math:: (S^{-1} S_e S^{-1})_{ii} / (S^{-1})_{ii}, \qquad S = \sum_e S_e + P,

with S_e its information on the plants' parameters, its own unknowns eliminated, and P the priors'; the shares of all
experiments and of the priors add up to one. Of all p parameters together it is tr(S_e S^{-1})/p.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from seaopt.estimation.identifiability import reduced
from seaopt.estimation.result import Minimum

PRIORS = "priors"


@dataclass(frozen=True, slots=True, kw_only=True)
class Leverage:
    """The share of one experiment, or of the priors, in what is known of each parameter, and in all of it."""

    parameters: Mapping[str, float]
    whole: float


def leverage(minimum: Minimum) -> dict[str, Leverage]:
    """Return the share of each experiment, and of the priors where there are some."""
    problem, unknowns, p = minimum.problem, minimum.problem.unknowns, minimum.problem.unknowns.shared
    parts = {
        experiment.name: _information(minimum, e) for e, experiment in enumerate(problem.experiments)
    }  # fmt: skip
    prior = unknowns.prior_std[:p] ** -2.0
    if np.any(prior > 0.0):
        parts[PRIORS] = np.diag(prior)
    whole = np.sum(list(parts.values()), axis=0)
    size = np.sqrt(np.maximum(np.diag(whole), 1e-300))
    back = np.linalg.pinv(whole / np.outer(size, size), rcond=1e-10, hermitian=True)
    found: dict[str, Leverage] = {}
    for name, part in parts.items():
        scaled = part / np.outer(size, size)
        shares = np.diag(back @ scaled @ back) / np.maximum(np.diag(back), 1e-300)
        found[name] = Leverage(
            parameters=dict(zip(unknowns.names[:p], shares.tolist(), strict=True)),
            whole=float(np.trace(scaled @ back)) / p,
        )
    return found


def _information(minimum: Minimum, e: int) -> Float[np.ndarray, "p p"]:
    """Return an experiment's information on the plants' parameters, its own unknowns eliminated."""
    problem, unknowns, n = minimum.problem, minimum.problem.unknowns, minimum.z.size
    hessian = np.zeros((n, n))
    own = np.zeros(n, dtype=bool)
    for s in range(len(problem.segments[e])):
        found = problem.run(e, s, minimum.z)
        for o, places in enumerate(problem.columns(e, s)):
            used = np.flatnonzero(places >= 0)
            index = places[used]
            own[index] = True
            hessian[np.ix_(index, index)] += found.gram[0, o][np.ix_(1 + used, 1 + used)] / problem.sigma[e][o] ** 2
    rest = own & (np.arange(n) >= unknowns.shared)
    hessian[rest, rest] += unknowns.prior_std[rest] ** -2.0
    kept = np.concatenate([np.arange(unknowns.shared), np.flatnonzero(rest)])
    return reduced(hessian[np.ix_(kept, kept)], unknowns.shared)
