"""The problem file's schema (TOML, validated with pydantic): what may be written, and nothing else."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Discriminator,
    Field,
    Strict,
    StringConstraints,
    Tag,
    model_validator,
)

from seaopt.control.laws.limits import BY_NAME
from seaopt.control.loops.compensation.ripple_term import MOST_CYCLES, RIPPLE_FRACTION
from seaopt.control.loops.compensation.terms import DEFAULT_FRACTION, FrictionSource
from seaopt.documents import Flag, Number, Whole
from seaopt.problem.key_descriptions import KEYS


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, strict=False)


NotNegative = Annotated[Number, Field(ge=0)]
Name = Annotated[str, StringConstraints(pattern=r"^[A-Za-z][A-Za-z0-9_-]*$", max_length=64)]
PlantOrResponse = Annotated[str, StringConstraints(pattern=r"^(frf:)?[A-Za-z][A-Za-z0-9_-]*$", max_length=68)]


class ParameterTable(_Strict):
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


class DefaultTable(_Strict):
    """A parameter of a plant of the user's own, with what it is where [parameters] does not say."""

    unit: str
    value: Number
    min: Number | None = None
    max: Number | None = None
    description: str = ""


class DerivedTable(_Strict):
    """A figure that follows from the parameters."""

    value: Formula
    unit: str


class ActuationTable(_Strict):
    """What a controller commands, and the effort that one unit of it makes, of the parameters."""

    input: str
    effort: Formula
    unit: str = "N"
    efficiency: str | None = None
    speed: Formula | None = None
    largest: Formula | None = None


class SensingTable(_Strict):
    """Regulated and sensed signals: names of outputs, or of states."""

    regulated: list[str] = []
    motor_position: str | None = None
    motor_speed: str | None = None
    link_position: str | None = None
    from_encoders: list[str] = []


class SpringTable(_Strict):
    """The elastic element; its deflection is of states and parameters."""

    deflection: Formula
    unit: str
    stiffness: str | None = None
    mass: str | None = None
    damping: str | None = None


class PortTable(_Strict):
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


class FrictionTable(_Strict):
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


class ModeTable(_Strict):
    """A mode whose frequency one parameter sets."""

    name: str
    parameter: str
    state: str


class EquationsTable(_Strict):
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


class HoldTable(_Strict):
    """The last sample at or before each instant."""

    max_age_s: Annotated[Number, Field(gt=0)] | None = None


class LinearTable(_Strict):
    """The straight line between the samples on either side."""

    max_gap_s: Annotated[Number, Field(gt=0)] | None = None


class NearestTable(_Strict):
    """The nearest sample."""

    tolerance_s: Annotated[Number, Field(gt=0)]


class AlignTable(_Strict):
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


class ClockTable(_Strict):
    """A time column."""

    column: Header
    unit: str | None = None
    file: str | None = None
    clock_offset_s: Number = 0.0
    where: dict[str, Annotated[str, Strict()] | Number] | None = None


class ColumnTable(_Strict):
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


class CounterTable(_Strict):
    """A column that counts samples; where it skips, gaps are opened."""

    column: str
    samples_per_count: Annotated[Whole, Field(ge=1)] = 1


class DifferenceTable(_Strict):
    """A measured speed that a device computed from a position, sample by sample."""

    of: str
    samples: Annotated[Whole, Field(ge=1, le=100)] = 1
    lag_hz: Annotated[Number, Field(gt=0)] | None = None


class UnknownTable(_Strict):
    """A value of an experiment that may be estimated."""

    value: Number
    free: Flag | None = None
    min: Number | None = None
    max: Number | None = None
    prior_std: Number | None = None


class ChirpTable(_Strict):
    """A logarithmic chirp over the whole duration."""

    amplitude: Number
    f0_hz: Number
    f1_hz: Number


class NoiseTable(_Strict):
    """Band-limited Gaussian noise."""

    std: Number
    band_hz: Number


class MultisineTable(_Strict):
    """A sum of sines; phases are zero where left out."""

    amplitudes: list[Number]
    frequencies_hz: list[Number]
    phases_rad: list[Number] = []


class ExcitationTable(_Strict):
    """What drives a virtual experiment; the parts are summed."""

    chirp: ChirpTable | None = None
    noise: NoiseTable | None = None
    multisine: MultisineTable | None = None


class SensorsTable(_Strict):
    """What sensors do to outputs, by name."""

    noise_std: dict[str, NotNegative] = {}
    offset: dict[str, Number] = {}
    quantisation: dict[str, NotNegative] = {}
    saturation: dict[str, NotNegative] = {}


class VirtualTable(SensorsTable):
    """A virtual experiment in place of a log."""

    seed: Whole
    duration_s: Annotated[Number, Field(gt=0, le=1e6)]
    rate_hz: Annotated[Number, Field(gt=0, le=1e6)]
    truth: dict[str, Number] = {}
    excitation: ExcitationTable
    outputs: list[str] = []


class ResampleTable(_Strict):
    """A uniform clock that a log is interpolated to, by lines where no rule is given."""

    rate_hz: Annotated[Number, Field(gt=0, le=1e9)]
    rule: AlignTable | Literal["restamp"] | None = None
    bridge_s: Annotated[Number, Field(gt=0)] | None = None


class ExperimentTable(_Strict):
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


class FitTable(_Strict):
    """How the fit is made."""

    method: Literal["output_error", "multiple_shooting", "prediction_error"] = "output_error"
    segments: Annotated[Whole, Field(ge=1, le=100_000)] | None = None
    loss: Literal["linear", "huber", "soft_l1"] = "linear"
    band_hz: tuple[Number, Number] | None = None
    holdout: Annotated[Number, Field(ge=0, lt=1)] = 0.0


class NotchTable(_Strict):
    """A notch in series; what is left out is tuned."""

    frequency_hz: Number | None = None
    width: Number | None = None
    depth: Number | None = None


class PrefilterTable(_Strict):
    """A low-pass of the reference alone; what is left out is tuned."""

    order: Literal["first_order", "second_order"]
    corner_hz: Number | None = None
    damping: Number | None = None


class LinkFeedforwardTable(_Strict):
    """The effort that the link's measured motion needs."""

    measured: str | None = None
    fraction: Number | None = None
    corner_hz: Number | None = None
    high_pass_hz: Number | None = None


def _limit(name: str) -> Any:
    """Return the field of a limit, with default and description of its row."""
    return Field(default=BY_NAME[name].default, description=BY_NAME[name].description)


Level = Number | Literal[False] | None  # of a limit: false lifts it
MPC = "mpc"  # the structure that plans


class FrictionCompensationTable(_Strict):
    """Compensation of friction."""

    fraction: Annotated[Number, Field(gt=0.0, le=1.5)] = DEFAULT_FRACTION
    source: Annotated[FrictionSource, Field(alias="from")] = "reference"
    speed: Annotated[Number, Field(gt=0.0)] | None = None


class GravityCompensationTable(_Strict):
    """Compensation of gravity."""

    fraction: Annotated[Number, Field(gt=0.0, le=1.5)] = 1.0
    plant: Name | None = None


class RippleCompensationTable(_Strict):
    """Compensation of torque ripple and cogging."""

    cycles: Annotated[
        tuple[Annotated[Whole, Field(ge=1, le=MOST_CYCLES)], ...], Field(min_length=1, max_length=MOST_CYCLES)
    ]
    cos: tuple[Number, ...]
    sin: tuple[Number, ...]
    fraction: Annotated[Number, Field(gt=0.0, le=1.5)] = RIPPLE_FRACTION
    period: Annotated[Number, Field(gt=0.0)] | None = None

    @model_validator(mode="after")
    def _require_series(self) -> RippleCompensationTable:
        if not len(set(self.cycles)) == len(self.cycles) == len(self.cos) == len(self.sin):
            raise ValueError("should have each of cycles once, and one cos and one sin for each")
        return self


class CompensationTable(_Strict):
    """What is compensated, and how much of it."""

    friction: FrictionCompensationTable | None = None
    gravity: GravityCompensationTable | None = None
    ripple: RippleCompensationTable | None = None


_NAMES = "list[names]"  # as pydantic names branches of unions, which messages leave out


def _tell_list(value: Any) -> str:
    """Tell a table from a list of names, so that what is wrong in one is not reported of the other."""
    return CompensationTable.__name__ if isinstance(value, Mapping | CompensationTable) else _NAMES


Compensated = Annotated[
    Annotated[list[Literal["friction", "gravity"]], Tag(_NAMES)]
    | Annotated[CompensationTable, Tag(CompensationTable.__name__)],
    Discriminator(_tell_list),
]


class ScheduleTable(_Strict):
    """Gains over a state that is measured, or over a parameter that is known as the law runs."""

    over: Name
    points: Annotated[list[Number], Field(min_length=2, max_length=100)]
    bandwidth_hz: list[Number] | None = None
    min_rate: Annotated[Number, Field(gt=0)] | None = None


class ControllerTable(_Strict):
    """What is asked of the controller."""

    plant: PlantOrResponse
    measured: str | tuple[str, ...] = "F1"
    structure: Literal["pd", "pid", "pid_dob", "cascade", "mpc"] = "pid"
    speed_loop: Literal["P", "PI"] = "P"
    notch: Flag | NotchTable = False
    link_feedforward: Flag | LinkFeedforwardTable = False
    prefilter: Literal["first_order", "second_order"] | PrefilterTable | None = None
    compensate: Compensated = []
    reference_weights: Literal["tuned", "error", "measurement"] = "tuned"
    bandwidth_hz: Annotated[Number, Field(description=BY_NAME["bandwidth_hz"].description)]
    bandwidth_range_hz: tuple[Number, Number] = (15.0, 60.0)
    sample_rate_hz: Number = 1000.0
    delay_samples: Whole | None = None
    max_sensitivity: Level = _limit("max_sensitivity")
    max_complementary: Level = _limit("max_complementary")
    min_disk_margin: Level = _limit("min_disk_margin")
    max_reference_peak: Level = _limit("max_reference_peak")
    max_droop_db: Level = _limit("max_droop_db")
    max_noise_gain: Level = _limit("max_noise_gain")
    max_other_noise_gain: Level = _limit("max_other_noise_gain")
    min_filter_samples: Level = _limit("min_filter_samples")
    min_friction_margin: Level = _limit("min_friction_margin")
    min_sensitivity_bandwidth_hz: Level = _limit("min_sensitivity_bandwidth_hz")
    passive_band_hz: tuple[Number, Number] | None = _limit("passive_band_hz")
    objective: Literal["disturbance", "noise"] = "disturbance"
    robust_to: list[PlantOrResponse] = []
    frf_confidence: Annotated[Number, Field(gt=0.0, lt=1.0)] = 0.95
    draws: Annotated[Whole, Field(ge=0, le=200)] = 0
    current_limit_A: Number | None = None
    command_limit: Number | None = None
    step_N: Number | None = None
    reserve: Number = 0.005
    schedule: ScheduleTable | None = None

    @property
    def compensation(self) -> CompensationTable:
        """What is compensated; of a list of names, each with its defaults."""
        if isinstance(self.compensate, CompensationTable):
            return self.compensate
        return CompensationTable(
            friction=FrictionCompensationTable() if "friction" in self.compensate else None,
            gravity=GravityCompensationTable() if "gravity" in self.compensate else None,
        )


class NoiseModelTable(_Strict):
    """What the Kalman filter of predictive control counts on, by name of output and input."""

    sensor_std: dict[str, NotNegative]
    input_noise: dict[str, NotNegative] = {}
    input_drift: dict[str, NotNegative] = {}
    offset: dict[str, Number] = {}


class MPCTable(_Strict):
    """What only predictive control has; the rest is in [controller]."""

    current_slew_A_per_s: Number | None = None
    decay: Number = 0.8
    horizon_s: Number = 0.05
    moves: Whole = 12
    largest_force_N: Number | None = None
    bounds: dict[str, tuple[Number, Number]] = {}
    preview_samples: Whole = 0
    max_iterations: Whole = 100
    noise: NoiseModelTable | None = None


class ImpedanceTable(_Strict):
    """Stiffness and damping at the link, around the force loop."""

    plant: Name
    stiffness: NotNegative
    damping: Number | Literal["critical"]
    velocity_filter_s: NotNegative | None = None


class RobustnessTable(_Strict):
    """What the controller must survive."""

    plants: list[Name] = []
    parameters: dict[str, tuple[Number, Number]] = {}
    samples: Annotated[Whole, Field(ge=1, le=10_000_000)] = 1375
    seed: Annotated[Whole, Field(ge=0)] = 1
    retune: Annotated[Whole, Field(ge=0, le=20)] = 0
    bounds: Flag = False
    max_failure_probability: Annotated[Number, Field(gt=0, le=1)] | None = None
    min_friction_margin: Annotated[Number, Field(gt=0)] | None = None
    constrained_runs: Annotated[Whole, Field(ge=1, le=100_000)] = 100
    bound_tolerance: NotNegative = 0.1
    sensors: SensorsTable = SensorsTable()
    current_step_A: NotNegative = 0.0
    command_step: NotNegative = 0.0

    @property
    def step(self) -> float:
        """What the command is rounded to, in its unit; 0 for not at all."""
        return self.current_step_A or self.command_step

    @model_validator(mode="after")
    def _check_step(self) -> RobustnessTable:
        if self.current_step_A and self.command_step:
            raise ValueError("should have current_step_A or command_step, which is the same of another command")
        return self


def _check_ends(ends: tuple[float, float]) -> tuple[float, float]:
    if ends[0] > ends[1]:
        raise ValueError("should be [low, high]")
    return ends


Range = Annotated[tuple[Number, Number], AfterValidator(_check_ends)]
Bound = Range | Number  # a number is the end on the bad side of the figure: an Ms at most, a margin at least


class RangeTable(_Strict):
    """The ends of a range, either of which may be left out, in a unit of one's own."""

    min: Number | None = Field(None, description="The low end.")
    max: Number | None = Field(None, description="The high end.")
    unit: str | None = Field(None, description="Of both; that of the figure where it is left out.")

    @model_validator(mode="after")
    def _check_range(self) -> RangeTable:
        if self.min is None and self.max is None:
            raise ValueError("give min, max, or both")
        if self.min is not None and self.max is not None:
            _check_ends((self.min, self.max))
        return self


class FiguresTable(_Strict):
    """Figures of a loop: a number is the limit on the bad side, [low, high] a range."""

    bandwidth_hz: Bound | None = Field(None, description="At least, where a number.")
    tracking_band_hz: Range | None = Field(None, description="The loop follows its reference from here to here.")
    crossover_hz: Bound | None = Field(None, description="At least, where a number.")
    sensitivity_bandwidth_hz: Bound | None = Field(None, description="At least, where a number.")
    ms: Bound | None = Field(None, description="Peak of the sensitivity; at most, where a number.")
    mt: Bound | None = Field(None, description="Peak of the complementary sensitivity; at most, where a number.")
    reference_peak: Bound | None = Field(None, description="At most, where a number.")
    droop_db: Bound | None = Field(None, description="At most, where a number.")
    gain_margin_db: Bound | None = Field(None, description="At least, where a number.")
    phase_margin_deg: Bound | None = Field(None, description="At least, where a number.")
    delay_margin_s: Bound | None = Field(None, description="At least, where a number.")
    disk_margin: Bound | None = Field(None, description="At least, where a number.")
    noise_gain: Bound | None = Field(None, description="At most, where a number.")


class ExpectedControllerTable(FiguresTable):
    """What the tuned controller is to be on its design plant."""

    feasible: Flag = Field(True, description="Every limit of [controller] is met.")


class ExpectedPlantTable(FiguresTable):
    """What a certified plant's loop is to be, at the nominal parameters and at the worst case; sliding and stuck."""

    worst_ms: Bound | None = Field(None, description="Ms at the worst case found; at most, where a number.")
    worst_mt: Bound | None = Field(None, description="Mt at the worst case found; at most, where a number.")


class ExpectedCertificateTable(_Strict):
    """What the certificate is to say."""

    passed: Flag = Field(True, description="Every requirement is met.")
    failure_probability: Number | None = Field(None, description="Its bound; at most.")
    plants: dict[Name, ExpectedPlantTable] = Field({}, description="Figures of a certified plant's loop, by its name.")


class ExpectTable(_Strict):
    """What `seaopt run` and the pytest plugin check of the results."""

    fit_met: Flag = Field(True, description="The fit is met; where there are experiments.")
    parameters: dict[str, Range | RangeTable] = Field(
        {}, description="Ranges of fitted parameters, and of figures that follow from them, in their own units."
    )
    fit_percent: dict[Name, Bound | dict[str, Bound]] = Field(
        {}, description="Of an experiment, fitted or not, or of its outputs; at least, where a number."
    )
    controller: ExpectedControllerTable | None = Field(None, description="The tuned controller, on its design plant.")
    certificate: ExpectedCertificateTable | None = Field(None, description="The certificate.")


class ProblemTable(_Strict):
    """A problem file."""

    model_config = ConfigDict(extra="forbid", frozen=True, populate_by_name=True)

    version: Annotated[Literal[1], Field(alias="schema")]
    title: str = "untitled"
    guessed: list[Annotated[str, StringConstraints(strip_whitespace=True, min_length=1, max_length=200)]] = []
    parameters: dict[str, Number | ParameterTable] = {}
    plant: dict[Name, AnyPlant]
    experiment: list[ExperimentTable] = []
    fit: FitTable = FitTable()
    controller: ControllerTable | None = None
    impedance: ImpedanceTable | None = None
    mpc: MPCTable | None = None
    robustness: RobustnessTable | None = None
    expect: ExpectTable | None = Field(None, description="What `seaopt run` and pytest check of the results.")


def json_schema() -> dict[str, Any]:
    """Return the problem file's JSON Schema, for editors, with what each key means."""
    schema = ProblemTable.model_json_schema(by_alias=True)
    for name, table in (("ProblemTable", schema), *schema["$defs"].items()):
        for key, text in KEYS.get(name, {}).items():
            table["properties"][key].setdefault("description", text)
    return schema
