"""Least squares on the time-domain logs: parameters, their uncertainty, what the data cannot tell, what to measure."""

from seaopt.estimation.bootstrap import Bootstrap, bootstrap
from seaopt.estimation.compare import compare
from seaopt.estimation.covariance import Covariance
from seaopt.estimation.design import (
    Chirps,
    Comparison,
    Design,
    Limits,
    Multisines,
    design_experiment,
    expected_covariance,
)
from seaopt.estimation.diagnostics import Diagnostics, diagnose
from seaopt.estimation.experiment import Experiment
from seaopt.estimation.findings import Derived, Nuisance, OutputFit, Prediction
from seaopt.estimation.fit import fit
from seaopt.estimation.identifiability import Identifiability, resting_on
from seaopt.estimation.losses import Huber, Linear, SoftL1
from seaopt.estimation.methods import Method, MultipleShooting, OutputError, PredictionError
from seaopt.estimation.profile import Profile, profile
from seaopt.estimation.ranking import Ranking
from seaopt.estimation.result import Fit

__all__ = [
    "Bootstrap", "Chirps", "Comparison", "Covariance", "Derived", "Design", "Diagnostics", "Experiment", "Fit",
    "Huber", "Identifiability", "Limits", "Linear", "Method", "MultipleShooting", "Multisines", "Nuisance",
    "OutputError", "OutputFit", "Prediction", "PredictionError", "Profile", "Ranking", "SoftL1", "bootstrap",
    "compare", "design_experiment", "diagnose", "expected_covariance", "fit", "profile",
    "resting_on",
]  # fmt: skip
