"""A fit with its model covariance: what parameters, delays and derived figures have besides the std of noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from seaopt.estimation.problem.shapes import ParameterMatrix
from seaopt.estimation.result.covariance import Covariance
from seaopt.estimation.result.fit_result import Fit
from seaopt.estimation.result.summary import derive_figures


def widen(fit: Fit, added: ParameterMatrix) -> Fit:
    """Return the fit with more model covariance: of its free parameters, and of the delays that were fitted. `added`:
    over the names of `fit.delay_covariance`, or of `fit.covariance` where no delay was fitted, in SI.
    """
    noise = fit.covariance if fit.delay_covariance is None else fit.delay_covariance
    before = fit.model_covariance
    model = Covariance(names=noise.names, matrix=added if before is None else before.matrix + added)
    stds = dict(zip(model.names, np.sqrt(np.maximum(np.diag(model.matrix), 0.0)).tolist(), strict=True))
    free = fit.covariance.names
    nuisance = {
        name: replace(each, model_std={"delay_s": stds[f"{name}.delay_s"]}) if f"{name}.delay_s" in stds else each
        for name, each in fit.nuisance.items()
    }
    of_parameters = Covariance(names=free, matrix=model.matrix[: len(free), : len(free)])
    figures = derive_figures(fit.experiments, fit.parameters, of_parameters, fit.identifiability)
    return replace(
        fit,
        model_covariance=model,
        parameters=fit.parameters.with_parameters(
            *(replace(fit.parameters[name], model_std=stds[name]) for name in free)
        ),
        nuisance=nuisance,
        derived={name: replace(figure, model_std=figures[name].std) for name, figure in fit.derived.items()},
    )
