"""Least squares on the time-domain logs: parameters, their uncertainty, and what the data cannot tell."""

from seaopt.estimation.covariance import Covariance
from seaopt.estimation.experiment import Experiment
from seaopt.estimation.fit import fit
from seaopt.estimation.identifiability import Identifiability
from seaopt.estimation.methods import Method, MultipleShooting, OutputError, PredictionError
from seaopt.estimation.residuals import Huber, Linear, SoftL1
from seaopt.estimation.result import Derived, Fit, Nuisance, OutputFit, Prediction

__all__ = [
    "Covariance", "Derived", "Experiment", "Fit", "Huber", "Identifiability", "Linear", "Method", "MultipleShooting",
    "Nuisance", "OutputError", "OutputFit", "Prediction", "PredictionError", "SoftL1", "fit",
]  # fmt: skip
