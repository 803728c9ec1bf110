"""Least squares on the time-domain logs: parameters, their uncertainty, what the data cannot tell, what to measure."""

from seaopt.estimation.covariance import Covariance, Identifiability
from seaopt.estimation.design import (
    Chirps,
    Comparison,
    Design,
    Limits,
    Multisines,
    design_experiment,
    expected_covariance,
)
from seaopt.estimation.experiment import Experiment
from seaopt.estimation.fit import OutputError, fit
from seaopt.estimation.residuals import Huber, Linear
from seaopt.estimation.result import Derived, Fit, Nuisance, OutputFit, Prediction

__all__ = [
    "Chirps", "Comparison", "Covariance", "Derived", "Design", "Experiment", "Fit", "Huber", "Identifiability",
    "Limits", "Linear", "Multisines", "Nuisance", "OutputError", "OutputFit", "Prediction", "design_experiment",
    "expected_covariance", "fit",
]  # fmt: skip
