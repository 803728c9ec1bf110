"""The problem of a fleet as data, the same for all its logs, and the columns of its table."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any

from seaopt.errors import ProblemError
from seaopt.problem import Problem
from seaopt.problem.bench_tables import UnknownTable
from seaopt.problem.columns import list_log_files
from seaopt.problem.reading import make_problem
from seaopt.problem.schema import ProblemTable
from seaopt.records import record

VERSION = version("seaopt")
_PARTS = {"version", "guessed", "parameters", "plant", "fit"}  # of a problem, that a fit reads besides its experiment


@record
class Plan:
    """The task of the workers, sent once: data only, no code."""

    problem: str  # the problem file as JSON, with the one experiment that says how a log is read
    # source, folder: the problem file, for messages, and where relative paths start
    source: str
    folder: str
    time_limit_s: float | None  # for a log
    client: str  # which process asks; that one a worker must not end
    version: str  # of the client's seaopt; a worker of another one would give other results

    @property
    def digest(self) -> str:
        """SHA-256 of the problem."""
        return hashlib.sha256(self.problem.encode()).hexdigest()

    def make_problem(self) -> Problem:
        """Return the problem."""
        table = ProblemTable.model_validate_json(self.problem)
        return make_problem(table, self.source, Path(self.folder))


@record
class Columns:
    """The columns of a fleet's table that the problem gives, in order."""

    units: Mapping[str, str]  # of the parameters and figures, each of which has a column of its standard deviation, too
    outputs: tuple[str, ...]
    # which of the units a fit estimates: free parameters, delay and gains; the others follow from these
    fitted: tuple[str, ...]
    free: tuple[str, ...]  # the parameters among them, of whose covariance a fit tells


def make_plan(problem: Problem, like: str | None, time_limit_s: float | None, client: str) -> Plan:
    """Return the plan of a fleet. Raises ProblemError: no experiment that reads a log, or one of several files."""
    template = problem.choose_template(like)
    if list_log_files(template) != [template.log]:
        raise ProblemError(
            f"{problem.source}: experiment {template.name} reads several files, and a log of a fleet is one; put its "
            "columns into one file"
        )
    table = problem.table.model_dump(mode="json", by_alias=True, exclude_unset=True, include=_PARTS)
    table["experiment"] = [template.model_dump(mode="json", by_alias=True, exclude_unset=True) | {"use": "fit"}]
    return Plan(
        problem=json.dumps(table),
        source=problem.source,
        folder=str(problem.folder.resolve()),
        time_limit_s=time_limit_s,
        client=client,
        version=VERSION,
    )


def list_columns(problem: Problem) -> Columns:
    """Return the columns that a plan's problem gives."""
    template = problem.choose_template()
    plant = problem.plants[template.plant]
    units = {
        name: problem.parameters[name].unit
        for name in problem.parameters.free_names
        if name in plant.parameters and name not in template.parameters
    }
    units |= {name: plant.parameter_unit(name) for name, value in template.parameters.items() if _is_free(value)}
    free = tuple(units)
    units |= {"delay_s": "s"} if _is_free(template.delay_s) else {}
    units |= {f"gain_{name}": "-" for name, value in template.gain.items() if _is_free(value)}
    fitted = tuple(units)
    units |= {name: unit for name, (_, unit) in plant.derived_values().items() if name not in units}
    return Columns(units=units, outputs=tuple(template.outputs), fitted=fitted, free=free)


def name_correlation(first: str, second: str) -> str:
    """Return the column with the correlation of two parameters' errors, whichever is named first."""
    return ":".join(sorted((first, second))) + "_corr"  # no parameter's name has a colon


def _is_free(entry: Any) -> bool:
    return isinstance(entry, UnknownTable) and (entry.free if entry.free is not None else entry.prior_std is not None)
