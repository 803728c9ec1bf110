"""What a fit.json holds, as pydantic models, and how the fields of a `Fit` are read from it.

Null stands for what is infinite: the std of a parameter that the data do not identify, a bound that is not there, and
the step error of a fit that overflows.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Literal

import numpy as np

from seaopt.documents import (
    Flag,
    NullIsInfinite,
    NullIsMinusInfinite,
    NullIsNaN,
    Number,
    ResultTable,
    Whole,
    check_result,
)
from seaopt.errors import FileError
from seaopt.estimation.result.covariance import Covariance
from seaopt.estimation.result.findings import DerivedFigure, FitFinding, Nuisance, OutputFit
from seaopt.estimation.result.identifiability import Identifiability
from seaopt.parameters import Parameter, ParameterSet

FIT_AGAIN = "run the fit again"


class StoredParameter(ResultTable):
    """A parameter: its value, what the fit might do with it, and the std that it found."""

    value: Number
    unit: str
    free: Flag
    std: Number | None
    min: NullIsMinusInfinite = -math.inf
    max: NullIsInfinite = math.inf
    prior_std: Number | None = None
    description: str = ""
    identified: Flag | None = None
    plausible: tuple[Number, Number] | None = None

    def restore(self, name: str) -> Parameter:
        """Return the parameter; one that is free and has no std has an infinite one."""
        std = (math.inf if self.std is None else self.std) if self.free else None
        identified = std != math.inf if self.identified is None else self.identified
        return Parameter(
            name=name, value=self.value, unit=self.unit, free=self.free, min=self.min, max=self.max,
            prior_std=self.prior_std, description=self.description, std=std, identified=identified,
            plausible=self.plausible,
        )  # fmt: skip


class StoredDerived(ResultTable):
    """A figure that follows from the parameters."""

    value: Number
    unit: str
    std: NullIsInfinite


class StoredCovariance(ResultTable):
    """A covariance, its rows and columns in the order of the names."""

    names: list[str]
    matrix: list[list[NullIsInfinite]]

    def restore(self, place: str) -> Covariance:
        """Return the covariance.

        Raises
        ------
        FileError
            The matrix is not square, or has a negative variance.

        """
        n = len(self.names)
        if [len(row) for row in self.matrix] != [n] * n:
            raise FileError(f"fit.json: {place}.matrix is not {n} by {n}, as names is long; {FIT_AGAIN}")
        matrix = np.array(self.matrix, dtype=float).reshape(n, n)
        finite = np.isfinite(np.diag(matrix))
        least = np.linalg.eigvalsh(matrix[finite][:, finite])
        if np.any(least < -1e-9 * np.max(np.diag(matrix)[finite], initial=0.0)):
            raise FileError(f"fit.json: {place} has a negative variance; {FIT_AGAIN}")
        return Covariance(names=tuple(self.names), matrix=matrix)


class StoredFinding(ResultTable):
    """What is wrong with a fit."""

    severity: Literal["error", "warning", "note"]
    kind: str
    where: str
    text: str
    preferred: dict[str, tuple[float, float]] = {}


class StoredOutput(ResultTable):
    """How well an output is explained."""

    fit_percent: NullIsNaN
    holdout_fit_percent: Number | None
    rms_residual: NullIsNaN
    sigma: NullIsNaN
    unit: str
    whiteness_p: NullIsNaN
    band_fit_percent: Number | None = None
    one_step_fit_percent: Number | None = None
    explained: Number | None = None
    explainable: Number | None = None


class StoredExperiment(ResultTable):
    """An experiment's own unknowns."""

    delay_s: Number
    gain: dict[str, Number]
    offset: dict[str, Number]
    initial_state: list[dict[str, Number]]
    substeps: Whole = 1
    drift: dict[str, list[Number]] = {}
    noise: dict[str, Number] = {}
    std: dict[str, NullIsInfinite] = {}
    plant: str = ""
    hold: Literal["zero", "first"] = "zero"

    def restore(self) -> Nuisance:
        """Return the unknowns."""
        content = {name: getattr(self, name) for name in StoredExperiment.model_fields}
        content["initial_state"] = tuple(self.initial_state)
        content["drift"] = {output: tuple(coefficients) for output, coefficients in self.drift.items()}
        return Nuisance(**content)


class StoredIdentifiability(ResultTable):
    """Which of the free parameters the data identify."""

    rank: Whole
    free: Whole
    condition: NullIsInfinite
    unidentifiable: list[dict[str, Number]]
    weak: list[dict[str, Number]] = []
    structural_rank: Whole = -1

    def restore(self) -> Identifiability:
        """Return the findings."""
        return Identifiability(
            rank=self.rank, free=self.free, condition=self.condition, unidentifiable=tuple(self.unidentifiable),
            weak=tuple(self.weak), structural_rank=self.structural_rank,
        )  # fmt: skip


class StoredProvenance(ResultTable):
    """What a fit's provenance says of it; the rest is of the machine."""

    wall_s: Number


class StoredFit(ResultTable):
    """A fit.json."""

    met: Flag
    findings: list[StoredFinding]
    status: Literal["converged", "max_iterations", "stalled", "not_identifiable"]
    message: str
    parameters: dict[str, StoredParameter]
    covariance: StoredCovariance
    white_covariance: StoredCovariance | None = None
    delay_covariance: StoredCovariance | None = None
    derived: dict[str, StoredDerived]
    outputs: dict[str, dict[str, StoredOutput]]
    experiments: dict[str, StoredExperiment] = {}
    identifiability: StoredIdentifiability
    cost: NullIsInfinite
    iterations: Whole
    samples: Whole
    provenance: StoredProvenance
    step_error_sigma: NullIsInfinite = 0.0
    step_error_parameter: NullIsInfinite = 0.0
    log_likelihood: NullIsNaN = math.nan
    unknowns: Whole = 0
    method: str = "output_error"
    notes: list[str] = []


def read_fit(content: Mapping[str, Any]) -> dict[str, Any]:
    """Return the fields of a `Fit` that a fit.json holds.

    Raises
    ------
    FileError
        A field is missing or malformed, or the covariance is not that of the free parameters.

    """
    stored = check_result(StoredFit, content, "fit.json", remedy=FIT_AGAIN)
    parameters = ParameterSet(parameter.restore(name) for name, parameter in stored.parameters.items())
    covariance = stored.covariance.restore("covariance")
    if set(covariance.names) != set(parameters.free_names):
        raise FileError(
            f"fit.json: covariance.names = {', '.join(covariance.names)} is not what parameters has free, "
            f"{', '.join(parameters.free_names)}; {FIT_AGAIN}"
        )
    white = covariance if stored.white_covariance is None else stored.white_covariance.restore("white_covariance")
    joint = stored.delay_covariance
    kept = (
        "status", "message", "cost", "iterations", "samples", "step_error_sigma", "step_error_parameter",
        "log_likelihood", "unknowns", "method",
    )  # fmt: skip
    return {name: getattr(stored, name) for name in kept} | {
        "wall_s": stored.provenance.wall_s,
        "parameters": parameters,
        "covariance": covariance,
        "white_covariance": white,
        "delay_covariance": None if joint is None else joint.restore("delay_covariance"),
        "derived": {name: DerivedFigure(**figure.model_dump()) for name, figure in stored.derived.items()},
        "outputs": {
            name: {output: OutputFit(**row.model_dump()) for output, row in outputs.items()}
            for name, outputs in stored.outputs.items()
        },
        "nuisance": {name: experiment.restore() for name, experiment in stored.experiments.items()},
        "identifiability": stored.identifiability.restore(),
        "findings": tuple(FitFinding(**finding.model_dump()) for finding in stored.findings),
        "notes": tuple(stored.notes),
    }
