"""The problem file's schema (TOML, validated with pydantic): what may be written, and nothing else.

Here is what is asked of a design, and expected of results; `bench_tables` has plants, logs and the fit.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import (
    AfterValidator,
    ConfigDict,
    Discriminator,
    Field,
    StringConstraints,
    Tag,
    model_validator,
)

from seaopt.control.laws.limits import BY_NAME
from seaopt.control.loops.compensation.ripple_term import MOST_CYCLES, RIPPLE_FRACTION
from seaopt.control.loops.compensation.terms import DEFAULT_FRACTION, FrictionSource
from seaopt.documents import Flag, Number, Whole
from seaopt.problem.bench_tables import (
    AnyPlant,
    ExperimentTable,
    FitTable,
    Name,
    NotNegative,
    ParameterTable,
    PlantOrResponse,
    SensorsTable,
    StrictTable,
)
from seaopt.problem.key_descriptions import KEYS


class NotchTable(StrictTable):
    """A notch in series; what is left out is tuned."""

    frequency_hz: Number | None = None
    width: Number | None = None
    depth: Number | None = None


class PrefilterTable(StrictTable):
    """A low-pass of the reference alone; what is left out is tuned."""

    order: Literal["first_order", "second_order"]
    corner_hz: Number | None = None
    damping: Number | None = None


class LinkFeedforwardTable(StrictTable):
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


class FrictionCompensationTable(StrictTable):
    """Compensation of friction."""

    fraction: Annotated[Number, Field(gt=0.0, le=1.5)] = DEFAULT_FRACTION
    source: Annotated[FrictionSource, Field(alias="from")] = "reference"
    speed: Annotated[Number, Field(gt=0.0)] | None = None


class GravityCompensationTable(StrictTable):
    """Compensation of gravity."""

    fraction: Annotated[Number, Field(gt=0.0, le=1.5)] = 1.0
    plant: Name | None = None


class RippleCompensationTable(StrictTable):
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


class CompensationTable(StrictTable):
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


class ScheduleTable(StrictTable):
    """Gains over a state that is measured, or over a parameter that is known as the law runs."""

    over: Name
    points: Annotated[list[Number], Field(min_length=2, max_length=100)]
    bandwidth_hz: list[Number] | None = None
    min_rate: Annotated[Number, Field(gt=0)] | None = None


class GateTable(StrictTable):
    """Which readings the exported law believes."""

    range_N: tuple[Number, Number]
    max_step_N: Annotated[Number, Field(gt=0.0)] | None = None
    max_held: Annotated[Whole, Field(ge=0)] = 5
    ramp_s: Annotated[Number, Field(gt=0.0)] = 0.1
    margin: Annotated[Number, Field(gt=0.0)] = 3.0


class ControllerTable(StrictTable):
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
    compute_delay_samples: Whole | None = None
    drive_delay_s: Number | None = None
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
    gate: GateTable | None = None

    @property
    def compensation(self) -> CompensationTable:
        """What is compensated; of a list of names, each with its defaults."""
        if isinstance(self.compensate, CompensationTable):
            return self.compensate
        return CompensationTable(
            friction=FrictionCompensationTable() if "friction" in self.compensate else None,
            gravity=GravityCompensationTable() if "gravity" in self.compensate else None,
        )


class NoiseModelTable(StrictTable):
    """What the Kalman filter of predictive control counts on, by name of output and input."""

    sensor_std: dict[str, NotNegative]
    input_noise: dict[str, NotNegative] = {}
    input_drift: dict[str, NotNegative] = {}
    offset: dict[str, Number] = {}


class MPCTable(StrictTable):
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


class ImpedanceTable(StrictTable):
    """Stiffness and damping at the link, around the force loop."""

    plant: Name
    stiffness: NotNegative
    damping: Number | Literal["critical"]
    velocity_filter_s: NotNegative | None = None


class RobustnessTable(StrictTable):
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


class RangeTable(StrictTable):
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


class FiguresTable(StrictTable):
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


class ExpectedCertificateTable(StrictTable):
    """What the certificate is to say."""

    passed: Flag = Field(True, description="Every requirement is met.")
    failure_probability: Number | None = Field(None, description="Its bound; at most.")
    plants: dict[Name, ExpectedPlantTable] = Field({}, description="Figures of a certified plant's loop, by its name.")


class ExpectTable(StrictTable):
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


class ProblemTable(StrictTable):
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
