r"""Where what is known of the parameters comes from.

The share of an experiment e in parameter i is that of its noise in the estimate's variance,

.. math:: (S^{-1} S_e S^{-1})_{ii} / (S^{-1})_{ii}, \qquad S = \sum_e S_e + P,

with S_e its information on the plants' parameters, its own unknowns eliminated, and P the priors'; the shares of all
experiments and of the priors add up to one. Of all p parameters together it is tr(S_e S^{-1})/p.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float

from seaopt.estimation.problem.normal_equations import eliminated, inverse
from seaopt.estimation.result.fit_result import Minimum
from seaopt.records import record

PRIORS = "priors"


@record
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
    prior = unknowns.precision[:p]
    if np.any(prior > 0.0):
        parts[PRIORS] = np.diag(prior)
    whole = np.sum(list(parts.values()), axis=0)
    back, _ = inverse(whole, 1e-10)
    found: dict[str, Leverage] = {}
    for name, part in parts.items():
        shares = np.diag(back @ part @ back) / np.maximum(np.diag(back), 1e-300)
        found[name] = Leverage(
            parameters=dict(zip(unknowns.names[:p], shares.tolist(), strict=True)),
            whole=float(np.trace(part @ back)) / p,
        )
    return found


def _information(minimum: Minimum, e: int) -> Float[np.ndarray, "p p"]:
    """Return an experiment's information on the plants' parameters, its own unknowns eliminated."""
    problem, p = minimum.problem, minimum.problem.unknowns.shared
    passes = problem.passes_of(e, minimum.z)
    hessian = problem.normal(e, passes)[1:, 1:]
    touched = np.unique(np.concatenate([places for s in range(len(passes)) for places in problem.columns(e, s)]))
    rest = touched[touched >= p]
    hessian[rest, rest] += problem.unknowns.precision[rest]
    kept = np.concatenate([np.arange(p), rest])
    return eliminated(hessian[np.ix_(kept, kept)], p)
