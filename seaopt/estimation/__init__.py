"""Least squares on the time-domain logs: parameters, their uncertainty, what the data cannot tell, what to measure."""

from seaopt.estimation.advice.compare import compare
from seaopt.estimation.advice.diagnostics import Diagnostics, diagnose
from seaopt.estimation.advice.ranking import Ranking
from seaopt.estimation.experiment_design.design import (
    Chirps,
    Comparison,
    Design,
    Limits,
    Multisines,
    design_experiment,
    expected_covariance,
)
from seaopt.estimation.problem.experiment import Experiment
from seaopt.estimation.problem.losses import Huber, Linear, SoftL1
from seaopt.estimation.problem.methods import Method, MultipleShooting, OutputError, PredictionError
from seaopt.estimation.result.covariance import Covariance
from seaopt.estimation.result.findings import Derived, Nuisance, OutputFit, Prediction
from seaopt.estimation.result.fit import fit
from seaopt.estimation.result.fit_result import Fit
from seaopt.estimation.result.identifiability import Identifiability, resting_on
from seaopt.estimation.uncertainty.bootstrap import Bootstrap, bootstrap
from seaopt.estimation.uncertainty.profile import Profile, profile

__all__ = [
    "Bootstrap", "Chirps", "Comparison", "Covariance", "Derived", "Design", "Diagnostics", "Experiment", "Fit",
    "Huber", "Identifiability", "Limits", "Linear", "Method", "MultipleShooting", "Multisines", "Nuisance",
    "OutputError", "OutputFit", "Prediction", "PredictionError", "Profile", "Ranking", "SoftL1", "bootstrap",
    "compare", "design_experiment", "diagnose", "expected_covariance", "fit", "profile",
    "resting_on",
]  # fmt: skip
