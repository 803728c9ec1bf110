r"""Leverage: the share of each experiment in the information on the parameters.

The share of an experiment e in parameter i is that of its noise in the estimate's variance,

.. math:: (S^{-1} S_e S^{-1})_{ii} / (S^{-1})_{ii}, \qquad S = \sum_e S_e + P,

with S_e its information on the plants' parameters, its own unknowns eliminated, and P the priors'; the shares of all
experiments and of the priors add up to one. Of all p parameters together it is tr(S_e S^{-1})/p.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from seaopt.estimation.problem.fit_experiment import FitExperiment
from seaopt.estimation.problem.normal_equations import eliminate, invert
from seaopt.estimation.problem.shapes import ParameterMatrix
from seaopt.estimation.result.fit_result import Minimum
from seaopt.records import record

PRIORS = "priors"


@record
class Leverage:
    """The share of one experiment, or of the priors, in the information on each parameter, and in all of it."""

    parameters: Mapping[str, float]
    whole: float


def measure_leverage(minimum: Minimum) -> dict[str, Leverage]:
    """Return the share of each experiment, and of the priors where there are some; nothing where nothing is free."""
    problem, unknowns, p = minimum.problem, minimum.problem.unknowns, minimum.problem.unknowns.shared
    if not p:
        return {}
    parts = {experiment.name: _compute_information(minimum, experiment) for experiment in problem.experiments}
    prior = unknowns.precision[:p]
    if np.any(prior > 0.0):
        parts[PRIORS] = np.diag(prior)
    inverse, _ = invert(np.sum(list(parts.values()), axis=0), 1e-10)
    leverage: dict[str, Leverage] = {}
    for name, part in parts.items():
        shares = np.diag(inverse @ part @ inverse) / np.maximum(np.diag(inverse), 1e-300)
        leverage[name] = Leverage(
            parameters=dict(zip(unknowns.names[:p], shares.tolist(), strict=True)),
            whole=float(np.trace(part @ inverse)) / p,
        )
    return leverage


def _compute_information(minimum: Minimum, experiment: FitExperiment) -> ParameterMatrix:
    """Return an experiment's information on the plants' parameters, its own unknowns eliminated."""
    unknowns, z = minimum.problem.unknowns, minimum.z
    hessian = experiment.normal(experiment.run_all(z), z.size)[1:, 1:]
    columns = (places for segment in experiment.segments for places in experiment.columns(segment))
    touched = np.unique(np.concatenate(list(columns)))
    nuisance = touched[touched >= unknowns.shared]
    hessian[nuisance, nuisance] += unknowns.precision[nuisance]
    kept = np.concatenate([np.arange(unknowns.shared), nuisance])
    return eliminate(hessian[kept][:, kept], unknowns.shared)
