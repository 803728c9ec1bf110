"""Problem files (TOML) to plants, parameters, experiments and specifications."""

from seaopt.problem.problem import Problem, demo_path, read_problem
from seaopt.problem.schema import json_schema

__all__ = ["Problem", "demo_path", "json_schema", "read_problem"]
