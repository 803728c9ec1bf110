"""The problem file's schema (TOML, validated with pydantic): what may be written, and nothing else."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, StringConstraints


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, strict=False)


Name = Annotated[str, StringConstraints(pattern=r"^[A-Za-z][A-Za-z0-9_-]*$", max_length=64)]


class ParameterTable(_Strict):
    """A value with its unit, and what a fit may do with it."""

    value: float
    unit: str | None = None
    free: bool | None = None
    min: float | None = None
    max: float | None = None
    prior_std: float | None = None


class PlantTable(BaseModel):
    """A kind of plant; further keys are the kind's own options."""

    model_config = ConfigDict(extra="allow", frozen=True)

    kind: str


class ColumnTable(_Strict):
    """A column of a log, its unit, and for an output its noise."""

    column: str
    unit: str | None = None
    sigma: float | None = None


class UnknownTable(_Strict):
    """A value of an experiment that may be estimated."""

    value: float
    free: bool = False
    min: float | None = None
    max: float | None = None
    prior_std: float | None = None


class ChirpTable(_Strict):
    """A logarithmic chirp over the whole duration."""

    amplitude: float
    f0_hz: float
    f1_hz: float


class NoiseTable(_Strict):
    """Band-limited Gaussian noise."""

    std: float
    band_hz: float


class ExcitationTable(_Strict):
    """What drives a virtual experiment; the parts are summed."""

    chirp: ChirpTable | None = None
    noise: NoiseTable | None = None


class VirtualTable(_Strict):
    """A virtual experiment in place of a log."""

    seed: int
    duration_s: Annotated[float, Field(gt=0, le=1e6)]
    rate_hz: Annotated[float, Field(gt=0, le=1e6)]
    noise_std: dict[str, float] = {}
    offset: dict[str, float] = {}
    quantisation: dict[str, float] = {}
    saturation: dict[str, float] = {}
    truth: dict[str, float] = {}
    excitation: ExcitationTable
    outputs: list[str] = []


class ExperimentTable(_Strict):
    """One log, or one virtual experiment, of one plant."""

    name: Name
    plant: Name
    log: str | None = None
    virtual: VirtualTable | None = None
    time: str | ColumnTable | None = None
    inputs: dict[str, str | ColumnTable] = {}
    outputs: dict[str, str | ColumnTable] = {}
    sigma: dict[str, float] = {}
    initial_state: Literal["estimate", "rest"] | dict[str, float] = "estimate"
    offset: bool | dict[str, float] = True
    delay_s: float | UnknownTable = 0.0
    gain: dict[str, float | UnknownTable] = {}
    hold: Literal["zero", "first"] = "zero"
    slice_s: tuple[float, float] | None = None
    gaps: Literal["split", "error"] = "split"


class FitTable(_Strict):
    """How the fit is made."""

    method: Literal["output_error"] = "output_error"
    loss: Literal["linear", "huber"] = "linear"
    band_hz: tuple[float, float] | None = None
    holdout: Annotated[float, Field(ge=0, lt=1)] = 0.0


class ControllerTable(_Strict):
    """What is asked of the controller."""

    plant: Name
    measured: str = "F1"
    structure: Literal["pd", "pid"] = "pid"
    derivative: Literal["error", "measurement"] = "error"
    bandwidth_hz: float
    bandwidth_range_hz: tuple[float, float] = (15.0, 60.0)
    sample_rate_hz: float = 1000.0
    delay_samples: int = 1
    max_sensitivity: float | None = None
    max_complementary: float | None = None
    max_reference_peak: float | None = None
    max_noise_gain: float | None = None
    min_sensitivity_bandwidth_hz: float | None = None
    objective: Literal["disturbance", "noise"] = "disturbance"
    robust_to: list[Name] = []
    current_limit_A: float | None = None
    reserve: float = 0.005


class RobustnessTable(_Strict):
    """What the controller must survive."""

    plants: list[Name] = []
    parameters: dict[str, tuple[float, float]] = {}
    samples: Annotated[int, Field(ge=1, le=10_000_000)] = 1375
    seed: int = 1


class ProblemTable(_Strict):
    """A problem file."""

    model_config = ConfigDict(extra="forbid", frozen=True, populate_by_name=True)

    version: Annotated[Literal[1], Field(alias="schema")]
    title: str = "untitled"
    parameters: dict[str, float | ParameterTable] = {}
    plant: dict[Name, PlantTable]
    experiment: list[ExperimentTable] = []
    fit: FitTable = FitTable()
    controller: ControllerTable | None = None
    robustness: RobustnessTable | None = None


def json_schema() -> dict[str, Any]:
    """Return the problem file's JSON Schema, for editors."""
    return ProblemTable.model_json_schema(by_alias=True)
