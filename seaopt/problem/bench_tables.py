"""Tables of a problem file that describe the bench: parameters, plants, logs and how they are read, and the fit."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import (
    BaseModel,
    ConfigDict,
    Discriminator,
    Field,
    Strict,
    StringConstraints,
    Tag,
    model_validator,
)

from seaopt.documents import Flag, Number, Whole


class StrictTable(BaseModel):
    """A table of a problem file: no other keys, no numbers that are not finite."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, strict=False)


NotNegative = Annotated[Number, Field(ge=0)]
Name = Annotated[str, StringConstraints(pattern=r"^[A-Za-z][A-Za-z0-9_-]*$", max_length=64)]
PlantOrResponse = Annotated[str, StringConstraints(pattern=r"^(frf:)?[A-Za-z][A-Za-z0-9_-]*$", max_length=68)]


class ParameterTable(StrictTable):
    """A value with its unit, and what a fit may do with it."""

    value: Number
    unit: str | None = None
    free: Flag | None = None
    min: Number | None = None
    max: Number | None = None
    prior_std: Number | None = None


class PlantTable(BaseModel):
    """A kind of plant; further keys are the kind's own options."""

    model_config = ConfigDict(extra="allow", frozen=True)

    kind: str


Formula = Annotated[
    Annotated[str, Strict()] | Number,
    Field(description="Numbers, names, + - * / ^, brackets, sin, cos, tan, tanh, exp, log, sqrt, abs, min, max, atan2, "
          "if_else(a > b, then, else), pi."),
]  # fmt: skip


class DefaultTable(StrictTable):
    """A parameter of a plant of the user's own, with what it is where [parameters] does not say."""

    unit: str
    value: Number
    min: Number | None = None
    max: Number | None = None
    description: str = ""


class DerivedTable(StrictTable):
    """A figure that follows from the parameters."""

    value: Formula
    unit: str


class ActuationTable(StrictTable):
    """What a controller commands, and the effort that one unit of it makes, of the parameters."""

    input: str
    effort: Formula
    unit: str = "N"
    efficiency: str | None = None
    speed: Formula | None = None
    largest: Formula | None = None


class SensingTable(StrictTable):
    """Regulated and sensed signals: names of outputs, or of states."""

    regulated: list[str] = []
    motor_position: str | None = None
    motor_speed: str | None = None
    link_position: str | None = None
    from_encoders: list[str] = []


class SpringTable(StrictTable):
    """The elastic element; its deflection is of states and parameters."""

    deflection: Formula
    unit: str
    stiffness: str | None = None
    mass: str | None = None
    damping: str | None = None


class PortTable(StrictTable):
    """Where the world touches the plant; `held` and `probe` are other plants of the file."""

    motion: str | None = None
    coordinate: str | None = None
    rate: str | None = None
    effort: str | None = None
    payload: list[str] = []
    drive: str | None = None
    ratio: Formula = 1.0
    held: Name | None = None
    probe: Name | None = None


class FrictionTable(StrictTable):
    """A dissipative force: of v, the velocity that it opposes, of the parameters, and of loads that it grows with."""

    velocity: Formula
    force: Formula
    unit: str = "N"
    effort: Formula = 1.0
    slopes: tuple[Formula, Formula] | None = None
    jump: Formula | None = None
    smoothing: str | None = None
    loads: dict[str, Formula] = {}
    rated: dict[str, Number] = {}


class ModeTable(StrictTable):
    """A mode whose frequency one parameter sets."""

    name: str
    parameter: str
    state: str


class EquationsTable(StrictTable):
    """A plant of the user's own: names with their SI units, equations as text, roles."""

    states: dict[str, str]
    inputs: dict[str, str] = {}
    outputs: dict[str, str]
    parameters: dict[str, str | DefaultTable] = {}
    optional_inputs: list[str] = []
    definitions: dict[str, Formula] = {}
    f: dict[str, Formula]
    h: dict[str, Formula]
    derived: dict[str, DerivedTable] = {}
    energy: Formula | None = None
    actuation: ActuationTable | None = None
    sensing: SensingTable | None = None
    spring: SpringTable | None = None
    ports: list[PortTable] = []
    friction: dict[str, FrictionTable] = {}
    mode: ModeTable | None = None
    sticks: Flag = False
    parts: list[str] = []


def _choose_plant(table: Any) -> str:
    """Return which table a plant is: one of equations where it has any, and no kind."""
    own = (
        isinstance(table, Mapping) and "kind" not in table and not table.keys().isdisjoint(EquationsTable.model_fields)
    )
    return EquationsTable.__name__ if own or isinstance(table, EquationsTable) else PlantTable.__name__


AnyPlant = Annotated[
    Annotated[PlantTable, Tag(PlantTable.__name__)] | Annotated[EquationsTable, Tag(EquationsTable.__name__)],
    Discriminator(_choose_plant),
]


class HoldTable(StrictTable):
    """The last sample at or before each instant."""

    max_age_s: Annotated[Number, Field(gt=0)] | None = None


class LinearTable(StrictTable):
    """The straight line between the samples on either side."""

    max_gap_s: Annotated[Number, Field(gt=0)] | None = None


class NearestTable(StrictTable):
    """The nearest sample."""

    tolerance_s: Annotated[Number, Field(gt=0)]


class AlignTable(StrictTable):
    """How a channel of another clock comes to the log's: exactly one of these."""

    hold: HoldTable | None = None
    linear: LinearTable | None = None
    nearest: NearestTable | None = None

    @model_validator(mode="after")
    def _one(self) -> AlignTable:
        if sum(rule is not None for rule in (self.hold, self.linear, self.nearest)) != 1:
            raise ValueError("give exactly one of hold, linear and nearest")
        return self


Header = Annotated[str, Strict()] | Annotated[Whole, Field(ge=1)]  # or the column's number


class ClockTable(StrictTable):
    """A time column."""

    column: Header
    unit: str | None = None
    file: str | None = None
    clock_offset_s: Number = 0.0
    where: dict[str, Annotated[str, Strict()] | Number] | None = None


class ColumnTable(StrictTable):
    """A column of a log, the way from its numbers to its unit, and for an output its noise."""

    model_config = ConfigDict(
        extra="forbid", frozen=True, allow_inf_nan=False, strict=False, populate_by_name=True
    )  # fmt: skip

    column: Header
    unit: str | None = None
    scale: Number = 1.0
    offset: Number = 0.0
    wrap_bits: Annotated[Whole, Field(ge=2, le=53)] | None = None
    file: str | None = None
    time: Header | ClockTable | None = None
    clock_offset_s: Number = 0.0
    align: AlignTable | None = None
    where: dict[str, Annotated[str, Strict()] | Number] | None = None
    source: Annotated[Literal["header"] | None, Field(alias="from")] = None
    shared: Flag = False
    sigma: Number | None = None


class CounterTable(StrictTable):
    """A column that counts samples; where it skips, gaps are opened."""

    column: str
    samples_per_count: Annotated[Whole, Field(ge=1)] = 1


class DifferenceTable(StrictTable):
    """A measured speed that a device computed from a position, sample by sample."""

    of: str
    samples: Annotated[Whole, Field(ge=1, le=100)] = 1
    lag_hz: Annotated[Number, Field(gt=0)] | None = None


class UnknownTable(StrictTable):
    """A value of an experiment that may be estimated."""

    value: Number
    free: Flag | None = None
    min: Number | None = None
    max: Number | None = None
    prior_std: Number | None = None


class ChirpTable(StrictTable):
    """A logarithmic chirp over the whole duration."""

    amplitude: Number
    f0_hz: Number
    f1_hz: Number


class NoiseTable(StrictTable):
    """Band-limited Gaussian noise."""

    std: Number
    band_hz: Number


class MultisineTable(StrictTable):
    """A sum of sines; phases are zero where left out."""

    amplitudes: list[Number]
    frequencies_hz: list[Number]
    phases_rad: list[Number] = []


class ExcitationTable(StrictTable):
    """What drives a virtual experiment; the parts are summed."""

    chirp: ChirpTable | None = None
    noise: NoiseTable | None = None
    multisine: MultisineTable | None = None


class SensorsTable(StrictTable):
    """What sensors do to outputs, by name."""

    noise_std: dict[str, NotNegative] = {}
    offset: dict[str, Number] = {}
    quantisation: dict[str, NotNegative] = {}
    saturation: dict[str, NotNegative] = {}


class VirtualTable(SensorsTable):
    """A virtual experiment in place of a log."""

    seed: Annotated[Whole, Field(ge=0)]
    duration_s: Annotated[Number, Field(gt=0, le=1e6)]
    rate_hz: Annotated[Number, Field(gt=0, le=1e6)]
    truth: dict[str, Number] = {}
    excitation: ExcitationTable
    outputs: list[str] = []


class ResampleTable(StrictTable):
    """A uniform clock that a log is interpolated to, by lines where no rule is given."""

    rate_hz: Annotated[Number, Field(gt=0, le=1e9)]
    rule: AlignTable | Literal["restamp"] | None = None
    bridge_s: Annotated[Number, Field(gt=0)] | None = None


class ExperimentTable(StrictTable):
    """One log, or one virtual experiment, of one plant."""

    name: Name
    plant: Name
    use: Literal["fit", "validate"] = "fit"
    log: str | list[str] | None = None
    virtual: VirtualTable | None = None
    time: Header | ClockTable | None = None
    rate_hz: Annotated[Number, Field(gt=0, le=1e9)] | None = None
    inputs: dict[str, Header | ColumnTable] = {}
    outputs: dict[str, Header | ColumnTable] = {}
    differences: dict[str, DifferenceTable] = {}
    align: AlignTable | None = None
    window_s: tuple[Number, Number] | None = None
    counter: CounterTable | None = None
    duplicates: Literal["first", "mean"] | None = None
    sigma: dict[str, Number] = {}
    initial_state: Literal["estimate", "rest"] | dict[str, Number] = "estimate"
    offset: Flag | dict[str, Number] = True
    parameters: dict[str, Number | UnknownTable | ColumnTable] = {}
    delay_s: Number | UnknownTable = 0.0
    gain: dict[str, Number | UnknownTable] = {}
    hold: Literal["zero", "first"] = "zero"
    drift: Annotated[Whole, Field(ge=0, le=5)] = 0
    shots: Annotated[Whole, Field(ge=1, le=100_000)] = 1
    slice_s: tuple[Number, Number] | None = None
    resample: Literal["restamp"] | ResampleTable | None = None
    decimate: Annotated[Whole, Field(ge=1, le=10_000)] = 1
    saturation: dict[str, tuple[Number, Number]] = {}
    mask: Literal["auto", "declared", "none"] = "auto"
    gaps: Literal["split", "error"] = "split"


class FitTable(StrictTable):
    """How the fit is made."""

    method: Literal["output_error", "multiple_shooting", "prediction_error"] = "output_error"
    segments: Annotated[Whole, Field(ge=1, le=100_000)] | None = None
    loss: Literal["linear", "huber", "soft_l1"] = "linear"
    band_hz: tuple[Number, Number] | None = None
    holdout: Annotated[Number, Field(ge=0, lt=1)] = 0.0
