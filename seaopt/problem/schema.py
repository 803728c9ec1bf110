"""The problem file's schema (TOML, validated with pydantic): what may be written, and nothing else.

Here is what is asked of a design, and expected of results; `bench_tables` has plants, logs and the fit.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import (
    AfterValidator,
    AliasChoices,
    BeforeValidator,
    ConfigDict,
    Discriminator,
    StringConstraints,
    Tag,
    create_model,
    model_validator,
)
from pydantic_core import PydanticCustomError

from seaopt.control import CompensateFriction, CompensateGravity, CompensateRipple, ControllerSpec, Impedance, MPCSpec
from seaopt.control.laws.plausibility import GateSpec
from seaopt.documents import Flag, Number, Whole
from seaopt.problem.bench_tables import (
    AcceptanceTable,
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
from seaopt.problem.option_tables import key, table_of

MPC = "mpc"  # the structure that plans


class FrictionCompensationTable(table_of(CompensateFriction)):
    """Compensation of friction."""


class GravityCompensationTable(table_of(CompensateGravity)):
    """Compensation of gravity."""

    plant: Name | None = key("Whose link it is; the design plant where left out.", default=None)


class RippleCompensationTable(table_of(CompensateRipple)):
    """Compensation of torque ripple and cogging."""

    @model_validator(mode="after")
    def _require_series(self) -> RippleCompensationTable:
        if not 0 < len(set(self.cycles)) == len(self.cycles) == len(self.cos) == len(self.sin):
            raise ValueError("should have each of cycles once, and one cos and one sin for each")
        return self


class CompensationTable(StrictTable):
    """What is compensated, and how much of it."""

    friction: FrictionCompensationTable | None = key("Coulomb friction at the motor.", default=None)
    gravity: GravityCompensationTable | None = key("The weight of a link that hangs, by its position.", default=None)
    ripple: RippleCompensationTable | None = key("Torque ripple and cogging, by the motor's position.", default=None)


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

    over: Name = key(
        "A state that is measured, such as an angle; or a parameter known as the law runs, such as a load."
    )
    points: list[Number] = key(
        "Its values, ascending, in its SI unit; the ends are the range.", min_length=2, max_length=100
    )
    bandwidth_hz: list[Number] | None = key("One per point, in place of the controller's.", default=None)
    min_rate: Number | None = key(
        "Its units per second that sweeps, and plants that move it, must reach; stated only if left out.",
        default=None,
        gt=0,
    )


class GateTable(table_of(GateSpec)):
    """Which readings the exported law believes."""


class ControllerTable(table_of(ControllerSpec, leave_out=("bandwidth_tolerance",))):
    """What is asked of the controller."""

    plant: PlantOrResponse = key(
        'The plant that it is designed on; or "frf:NAME", the frequency response of the experiment NAME.'
    )
    structure: Literal["pd", "pid", "pid_dob", "cascade", "mpc"] = key(
        "pid_dob has a disturbance observer, cascade a loop on the motor's speed; mpc plans, see [mpc].", default="pid"
    )
    compensate: Compensated = key(
        'What is added because the plant is known, ["friction", "gravity"]; or a table: how much.', default=[]
    )
    robust_to: list[PlantOrResponse] = key(
        'Plants on which stability, Ms and Mt hold too; "frf:NAME" for a measured frequency response.', default=[]
    )
    frf_confidence: Number = key(
        "Probability that all discs about measured frequency responses hold the truth.", default=0.95, gt=0.0, lt=1.0
    )
    draws: Whole = key(
        "How many draws of the uncertain parameters must keep stability, Ms and Mt while it is tuned.",
        default=0,
        ge=0,
        le=200,
    )
    schedule: ScheduleTable | None = key(
        "One controller per point of a variable, with lines between their gains, in place of one for all.", default=None
    )
    gate: GateTable | None = key(
        "Which readings the exported law believes, and what it does about the others.", default=None
    )
    derate: bool = key(
        'Whether the exported law lowers its limit as the winding warms up; the design plant needs the part "thermal".',
        default=False,
    )

    @property
    def compensation(self) -> CompensationTable:
        """What is compensated; of a list of names, each with its defaults."""
        if isinstance(self.compensate, CompensationTable):
            return self.compensate
        return CompensationTable(
            friction=FrictionCompensationTable() if "friction" in self.compensate else None,
            gravity=GravityCompensationTable() if "gravity" in self.compensate else None,
        )


class MPCTable(table_of(MPCSpec, leave_out=frozenset(ControllerTable.model_fields))):
    """What only predictive control has; the rest is in [controller]."""


class ImpedanceTable(table_of(Impedance, leave_out=("damping",))):
    """Stiffness and damping at the link, around the force loop."""

    plant: Name = key("Whose link is moved: a plant that does not hold it.")
    damping: Number | Literal["critical"] = key(
        'D_v, N s/m or N m s/rad; "critical": what makes the stiffness critically damped.'
    )


class RobustnessTable(StrictTable):
    """What the controller must survive."""

    plants: list[Name] = key("Plants that are certified, besides the design plant and those of robust_to.", default=[])
    parameters: dict[str, tuple[Number, Number]] = key("Ranges of what the fit does not tell.", default={})
    samples: Whole = key(
        "Draws; 1375 without failure mean below 1 % at a confidence of 1 - 1e-6.", default=1375, ge=1, le=10_000_000
    )
    seed: Whole = key("Seed of draws and simulations.", default=1, ge=0)
    retune: Whole | None = key(
        "Rounds of tuning for the worst case that was found; left out, 3 where a first look at the draws finds one "
        "that is over a limit.",
        default=None,
        ge=0,
        le=20,
    )
    bounds: Flag = key("Whether the worst case is enclosed, and not only searched for.", default=False)
    max_failure_probability: Number | None = key(
        "Bound on the probability of a failure that the draws must show.", default=None, gt=0, le=1
    )
    min_friction_margin: Number | None = key("Steepest friction for which stability must be shown.", default=None, gt=0)
    constrained_runs: Whole = key(
        "Runs of predictive control that are simulated with its limits active.", default=100, ge=1, le=100_000
    )
    bound_tolerance: NotNegative = key(
        "By how much they may leave the bounds of [mpc], as a share of half their width.", default=0.1
    )
    sensors: SensorsTable = key("With which loops are simulated.", default=SensorsTable())
    current_step_A: NotNegative = key("What the current is rounded to.", default=0.0)
    command_step: NotNegative = key("The same of another command.", default=0.0)

    @property
    def step(self) -> float:
        """What the command is rounded to, in its unit; 0 for not at all."""
        return self.current_step_A or self.command_step

    @model_validator(mode="after")
    def _check_step(self) -> RobustnessTable:
        if self.current_step_A and self.command_step:
            raise ValueError("give current_step_A, or command_step for a command that is not a current, not both")
        return self


def _check_ends(ends: tuple[float, float]) -> tuple[float, float]:
    if ends[0] > ends[1]:
        raise ValueError("should be [low, high]")
    return ends


Range = Annotated[tuple[Number, Number], AfterValidator(_check_ends)]
OptionalRange = Range | None
Bound = Range | Number  # a number is the end on the bad side of the figure: an Ms at most, a margin at least


class RangeTable(StrictTable):
    """The ends of a range, either of which may be left out, in a unit of one's own."""

    min: Number | None = key("The low end.", default=None)
    max: Number | None = key("The high end.", default=None)
    unit: str | None = key("Unit of both; that of the figure where it is left out.", default=None)

    @model_validator(mode="after")
    def _check_range(self) -> RangeTable:
        if self.min is None and self.max is None:
            raise ValueError("give min, max, or both")
        if self.min is not None and self.max is not None:
            _check_ends((self.min, self.max))
        return self


FIGURES = {  # of a loop: what a number in [expect] is to each; a band is given by both ends
    "bandwidth_hz": "at least", "tracking_band_hz": "", "crossover_hz": "at least",
    "sensitivity_bandwidth_hz": "at least", "ms": "at most", "mt": "at most", "reference_peak": "at most",
    "droop_db": "at most", "gain_margin_db": "at least", "phase_margin_deg": "at least", "delay_margin_s": "at least",
    "disk_margin": "at least", "noise_gain": "at most",
}  # fmt: skip
WORST_FIGURES = {"worst_ms": "at most", "worst_mt": "at most"}  # at the worst case of a plant


def _make_figures(name: str, figures: Mapping[str, str], base: type[StrictTable] = StrictTable) -> Any:
    """Return a table of figures: a number is the limit on the bad side, [low, high] a range."""
    keys: dict[str, Any] = {}
    for figure, end in figures.items():
        text = f"{end.capitalize()}, where a number." if end else "The loop tracks its reference from here to here."
        keys[figure] = (Bound | None if end else OptionalRange, key(text, default=None))
    return create_model(name, __base__=base, __module__=__name__, **keys)


class FiguresTable(_make_figures("LoopFiguresTable", FIGURES)):
    """Figures of a loop: a number is the limit on the bad side, [low, high] a range."""


class ExpectedControllerTable(FiguresTable):
    """Figures of the tuned controller on its design plant."""

    met: Flag = key(
        "Every limit of [controller] is met.", default=True, validation_alias=AliasChoices("met", "feasible")
    )


class ExpectedPlantTable(_make_figures("WorstFiguresTable", WORST_FIGURES, FiguresTable)):
    """Figures of a certified plant's loop, sliding and stuck, at the nominal parameters and at the worst case found."""


class ExpectedCertificateTable(StrictTable):
    """What the certificate is to say."""

    met: Flag = key("Every requirement is met.", default=True, validation_alias=AliasChoices("met", "passed"))
    failure_probability: Number | None = key("Its bound; at most.", default=None)
    plants: dict[Name, ExpectedPlantTable] = key("Figures of a certified plant's loop, by its name.", default={})


class ExpectTable(StrictTable):
    """What `seaopt run` and the pytest plugin check of the results."""

    fit_met: Flag = key("The fit is met; where there are experiments.", default=True)
    parameters: dict[str, Range | RangeTable] = key(
        "Ranges of fitted parameters, and of figures that follow from them, in their own units.", default={}
    )
    fit_percent: dict[Name, Bound | dict[str, Bound]] = key(
        "Fit percent of an experiment, fitted or not, or of its outputs; at least, where a number.", default={}
    )
    controller: ExpectedControllerTable | None = key("The tuned controller, on its design plant.", default=None)
    certificate: ExpectedCertificateTable | None = key("The certificate.", default=None)


def _require_whole(value: object) -> object:
    if type(value) is not int:  # true == 1 for Python
        raise PydanticCustomError("literal_error", "should be 1", {"expected": "1"})
    return value


class ProblemTable(StrictTable):
    """A problem file."""

    model_config = ConfigDict(extra="forbid", frozen=True, populate_by_name=True)

    version: Annotated[Literal[1], BeforeValidator(_require_whole)] = key("Version of this format: 1.", alias="schema")
    title: str = key("Heading of the report.", default="untitled")
    guessed: list[Annotated[str, StringConstraints(strip_whitespace=True, min_length=1, max_length=200)]] = key(
        "Unverified values: names of parameters, or words for other entries. Each verdict lists them; remove an entry "
        "once you have measured it.",
        default=[],
    )
    parameters: dict[str, Number | ParameterTable] = key(
        "Values of the plants' parameters, in their own SI units where no unit is given; what is left out "
        "has the plant's default.",
        default={},
    )
    plant: dict[Name, AnyPlant] = key("Plants by name: a kind with its options, or equations.")
    experiment: list[ExperimentTable] = key("Logs, or virtual experiments, each of one plant.", default=[])
    fit: FitTable = key("How parameters are estimated.", default=FitTable())
    controller: ControllerTable | None = key(
        "What is asked of the controller; without it nothing is tuned.", default=None
    )
    impedance: ImpedanceTable | None = key(
        "Stiffness and damping at the link, rendered around the force loop.", default=None
    )
    mpc: MPCTable | None = key(
        'What only predictive control has, of a [controller] with structure = "mpc".', default=None
    )
    robustness: RobustnessTable | None = key("What the certificate covers besides the fit's uncertainty.", default=None)
    acceptance: AcceptanceTable = key("Logs taken under the exported law.", default=AcceptanceTable())
    expect: ExpectTable | None = key("What `seaopt run` and pytest check of the results.", default=None)


def json_schema() -> dict[str, Any]:
    """Return the problem file's JSON Schema, for editors, with what each key means."""
    schema = ProblemTable.model_json_schema(by_alias=True)
    for table in (ExpectedControllerTable, ExpectedCertificateTable):  # which are read under older names, too
        properties, other = schema["$defs"][table.__name__]["properties"], table.model_fields["met"].validation_alias
        assert isinstance(other, AliasChoices)
        properties |= {str(name): properties["met"] | {"deprecated": True} for name in other.choices if name != "met"}
    return schema
