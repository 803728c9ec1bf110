"""Least squares on the time-domain logs: parameters, their uncertainty, and what the data cannot tell."""

from seaopt.estimation.covariance import Covariance, Identifiability
from seaopt.estimation.experiment import Experiment
from seaopt.estimation.fit import OutputError, fit
from seaopt.estimation.residuals import Huber, Linear
from seaopt.estimation.result import Derived, Fit, Nuisance, OutputFit, Prediction

__all__ = [
    "Covariance", "Derived", "Experiment", "Fit", "Huber", "Identifiability", "Linear", "Nuisance", "OutputError",
    "OutputFit", "Prediction", "fit",
]  # fmt: skip
