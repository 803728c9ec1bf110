"""Least squares on time-domain logs: parameters, their uncertainty, what cannot be identified, what to measure."""

from seaopt.estimation.advice.compare import Ranking, compare
from seaopt.estimation.advice.diagnostics import Diagnostics, diagnose
from seaopt.estimation.experiment_design.design import (
    Chirps,
    Design,
    ExcitationComparison,
    Limits,
    Multisines,
    design_experiment,
    expected_covariance,
)
from seaopt.estimation.fit import fit
from seaopt.estimation.judgement.second_log import LogComparison, compare_with_log
from seaopt.estimation.problem.experiment import Experiment
from seaopt.estimation.problem.losses import Huber, SoftL1, Squares
from seaopt.estimation.result.covariance import Covariance
from seaopt.estimation.result.findings import DerivedFigure, ModelledOutputs, Nuisance, OutputFit
from seaopt.estimation.result.fit_result import Fit
from seaopt.estimation.result.identifiability import Identifiability, warn_unidentified
from seaopt.estimation.solver.methods import Method, MultipleShooting, OutputError, PredictionError
from seaopt.estimation.uncertainty.bootstrap import Bootstrap, bootstrap
from seaopt.estimation.uncertainty.profile import Profile, profile

__all__ = [
    "Bootstrap",
    "Chirps",
    "Covariance",
    "DerivedFigure",
    "Design",
    "Diagnostics",
    "ExcitationComparison",
    "Experiment",
    "Fit",
    "Huber",
    "Identifiability",
    "Limits",
    "LogComparison",
    "Method",
    "ModelledOutputs",
    "MultipleShooting",
    "Multisines",
    "Nuisance",
    "OutputError",
    "OutputFit",
    "PredictionError",
    "Profile",
    "Ranking",
    "SoftL1",
    "Squares",
    "bootstrap",
    "compare",
    "compare_with_log",
    "design_experiment",
    "diagnose",
    "expected_covariance",
    "fit",
    "profile",
    "warn_unidentified",
]
