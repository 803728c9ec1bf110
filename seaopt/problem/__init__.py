"""Problem files (TOML) to plants, parameters, experiments and specifications, and their stages in one call each."""

from seaopt.problem.problem import Problem
from seaopt.problem.reading import demo_path, read_problem
from seaopt.problem.schema import json_schema
from seaopt.problem.stages import Stages, certify_problem, fit_problem, tune_problem

__all__ = [
    "Problem", "Stages", "certify_problem", "demo_path", "fit_problem", "json_schema", "read_problem",
    "tune_problem",
]  # fmt: skip
