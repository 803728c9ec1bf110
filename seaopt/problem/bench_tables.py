"""Tables of a problem file that describe the bench: parameters, plants, logs and how they are read, and the fit."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Discriminator, Field, Strict, StringConstraints, Tag, model_validator

from seaopt.bench import Chirp, Multisine, Noise, Sensors
from seaopt.documents import Flag, Number, Whole
from seaopt.estimation import Experiment
from seaopt.logs import Counter
from seaopt.plants import Actuation, Friction, Mode, Port, Sensing, SeriesSpring
from seaopt.problem.option_tables import Formula, Name, StrictTable, key, table_of

NotNegative = Annotated[Number, Field(ge=0)]
PlantOrResponse = Annotated[str, StringConstraints(pattern=r"^(frf:)?[A-Za-z][A-Za-z0-9_-]*$", max_length=68)]


class UnknownTable(StrictTable):
    """A value that may be fitted."""

    value: Number = key("The value, or the start of the fit.")
    free: Flag | None = key("Whether it is fitted; also where prior_std is given.", default=None)
    min: Number | None = key("Least value of the fit.", default=None)
    max: Number | None = key("Largest value of the fit.", default=None)
    prior_std: Number | None = key(
        "Known within this standard deviation: a prior of the fit, and drawn by the certificate.", default=None
    )


class ParameterTable(UnknownTable):
    """A value with its unit, and what a fit may do with it."""

    unit: str | None = key('Such as "N/mm", "kg m^2", "mN m"; the parameter\'s own if left out.', default=None)


class PlantTable(BaseModel):
    """A kind of plant; further keys are the kind's own options."""

    model_config = ConfigDict(extra="allow", frozen=True)

    kind: str = key("high_impedance, moving_output, two_link, rotary, winding, or one of an installed package.")


class DefaultTable(StrictTable):
    """A parameter of a plant of the user's own, with what it is where [parameters] does not say."""

    unit: str = key("SI.")
    value: Number = key("Where [parameters] does not say.")
    min: Number | None = key("Least value.", default=None)
    max: Number | None = key("Largest value.", default=None)
    description: str = key("In words, for tables.", default="")


class DerivedTable(StrictTable):
    """A figure that follows from the parameters."""

    value: Formula = key("The figure, in terms of the parameters.")
    unit: str = key("SI.")


class ActuationTable(table_of(Actuation)):
    """What a controller commands, and the effort that one unit of it makes, of the parameters."""


class SensingTable(table_of(Sensing, leave_out=("still",))):
    """Regulated and sensed signals: names of outputs, or of states."""


class SpringTable(table_of(SeriesSpring, leave_out=("play",))):
    """The elastic element; its deflection is of states and parameters."""


class PortTable(table_of(Port)):
    """Where the world touches the plant; `held` and `probe` are other plants of the file."""


class FrictionTable(table_of(Friction, leave_out=("bristles",))):
    """A dissipative force: of v, the velocity that it opposes, of the parameters, and of loads that it grows with."""


class ModeTable(table_of(Mode)):
    """A mode whose frequency one parameter sets."""


class EquationsTable(StrictTable):
    """A plant of the user's own: names with their SI units, equations as text, roles.

    Text may have numbers, names, + - * / ^, brackets, sin, cos, tan, tanh, exp, log, sqrt, abs, min, max, atan2,
    if_else(a > b, then, else) and pi.
    """

    states: dict[str, str] = key("Names with units.")
    inputs: dict[str, str] = key("Names with units.", default={})
    outputs: dict[str, str] = key("Names with units.")
    parameters: dict[str, str | DefaultTable] = key("Names with a unit, or with unit and default.", default={})
    optional_inputs: list[str] = key("Inputs that are zero where a log leaves them out.", default=[])
    definitions: dict[str, Formula] = key("Abbreviations, in order.", default={})
    f: dict[str, Formula] = key("Rate of each state.")
    h: dict[str, Formula] = key("Each output.")
    derived: dict[str, DerivedTable] = key("Figures that follow from the parameters.", default={})
    energy: Formula | None = key("Energy in terms of states and parameters, to check the equations by.", default=None)
    actuation: ActuationTable | None = key("What a controller commands.", default=None)
    sensing: SensingTable | None = key("What is regulated and sensed.", default=None)
    spring: SpringTable | None = key("The elastic element.", default=None)
    ports: list[PortTable] = key("Where the world touches the plant.", default=[])
    friction: dict[str, FrictionTable] = key("Dissipative forces by name; f uses them by it.", default={})
    mode: ModeTable | None = key("A mode whose frequency one parameter sets.", default=None)
    sticks: Flag = key("Simulate and fit friction as it jumps at rest, in place of its smoothed curve.", default=False)
    parts: list[str] = key("Effects around the plant: load_cell, current_loop, position_servo, ...", default=[])


def _choose_plant(table: Any) -> str:
    """Return which table a plant is: one of equations where it has any, and no kind."""
    stated = (
        isinstance(table, Mapping) and "kind" not in table and not table.keys().isdisjoint(EquationsTable.model_fields)
    )
    return EquationsTable.__name__ if stated or isinstance(table, EquationsTable) else PlantTable.__name__


AnyPlant = Annotated[
    Annotated[PlantTable, Tag(PlantTable.__name__)] | Annotated[EquationsTable, Tag(EquationsTable.__name__)],
    Discriminator(_choose_plant),
]


class CounterTable(table_of(Counter)):
    """A column that counts samples; where it skips, gaps are opened."""


class ChirpTable(table_of(Chirp)):
    """A logarithmic chirp over the whole duration."""


class NoiseTable(table_of(Noise)):
    """Band-limited Gaussian noise."""


class MultisineTable(table_of(Multisine)):
    """A sum of sines; phases are zero where left out."""


class HoldTable(StrictTable):
    """The last sample at or before each instant."""

    max_age_s: Number | None = key("Oldest sample that still holds.", default=None, gt=0)


class LinearTable(StrictTable):
    """The straight line between the samples on either side."""

    max_gap_s: Number | None = key("Longest step that is interpolated across.", default=None, gt=0)


class NearestTable(StrictTable):
    """The nearest sample."""

    tolerance_s: Number = key("Farthest sample that counts.", gt=0)


class ReadingsTable(StrictTable):
    """Each sample once, at the instant nearest to it; elsewhere there is none."""


class AlignTable(StrictTable):
    """How a channel of another clock comes to the log's: exactly one of these."""

    hold: HoldTable | None = key("The last sample at or before each instant.", default=None)
    linear: LinearTable | None = key("Interpolation between neighbours.", default=None)
    nearest: NearestTable | None = key("The nearest sample.", default=None)
    readings: ReadingsTable | None = key("Each sample once: outputs of a slower or a shifted clock.", default=None)

    @model_validator(mode="after")
    def _one(self) -> AlignTable:
        if sum(rule is not None for rule in (self.hold, self.linear, self.nearest, self.readings)) != 1:
            raise ValueError("give exactly one of hold, linear, nearest and readings")
        return self


Header = Annotated[str, Strict()] | Annotated[Whole, Field(ge=1)]  # or the column's number


class ClockTable(StrictTable):
    """A time column."""

    column: Header = key("Header, or number from 1.")
    unit: str | None = key("Unit of its numbers; that in the header's brackets if left out.", default=None)
    file: str | None = key("The file that has it, of several logs.", default=None)
    clock_offset_s: Number = key("Added to the times of its clock.", default=0.0)
    where: dict[str, Annotated[str, Strict()] | Number] | None = key("Rows that count: column and value.", default=None)


class ColumnTable(ClockTable):
    """A column of a log, the conversion of its numbers to its unit, and for an output its noise."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, strict=False, populate_by_name=True)

    scale: Number = key("Numbers are multiplied by it before their unit.", default=1.0)
    offset: Number = key("Added after the scale, in the unit.", default=0.0)
    wrap_bits: Whole | None = key("Numbers are two's complement of so many bits.", default=None, ge=2, le=53)
    time: Header | ClockTable | None = key("Its own clock, where it has one.", default=None)
    align: AlignTable | None = key("How it is aligned to the log's clock.", default=None)
    source: Literal["header"] | None = key(
        '"header": a constant that the log\'s header states.', default=None, alias="from"
    )
    shared: Flag = key("Whether another channel uses this column, too.", default=False)
    sigma: Number | None = key("Standard deviation of the noise, SI; estimated where left out.", default=None)


class ExcitationTable(StrictTable):
    """What drives a virtual experiment; the parts are summed."""

    chirp: ChirpTable | None = key("Logarithmic, over the whole duration.", default=None)
    noise: NoiseTable | None = key("Gaussian and band-limited.", default=None)
    multisine: MultisineTable | None = key("A sum of sines.", default=None)


class SensorsTable(table_of(Sensors)):
    """What sensors do to outputs, by name."""


class VirtualTable(SensorsTable):
    """A virtual experiment in place of a log."""

    seed: Whole = key("Seed of noise and excitation.", ge=0)
    duration_s: Number = key("Length.", gt=0, le=1e6)
    rate_hz: Number = key("Samples per second.", gt=0, le=1e6)
    truth: dict[str, Number] = key("Parameters that differ from the file's.", default={})
    excitation: ExcitationTable = key("What drives it.")
    outputs: list[str] = key("Outputs that are measured; those with noise where left out.", default=[])


class ResampleTable(StrictTable):
    """A uniform clock that a log is interpolated to: where no rule is given by lines, a held input by means."""

    rate_hz: Number = key("Sample rate of the uniform clock.", gt=0, le=1e9)
    rule: AlignTable | Literal["restamp"] | None = key(
        'How; where left out the mean over each period of inputs with hold = "zero", and linear; "restamp" for samples '
        "that were taken evenly.",
        default=None,
    )
    bridge_s: Number | None = key("Longest step of time that is interpolated across.", default=None, gt=0)


class HeldTable(StrictTable):
    """A command that firmware takes only every few rows of the log, which it then holds."""

    samples: Whole = key("Over how many rows each value stands.", ge=1, le=10_000)
    first: Whole = key("A row at which one is taken, counted from 0, of the log as it is used.", default=0, ge=0)


class LogTable(StrictTable):
    """A log, or a virtual one, of one plant: how it is read, and what only a file says of it."""

    name: Name = key("For results: letters, digits, _ and -.")
    plant: Name = key("A [plant.NAME] of this file.")
    use: Literal["fit", "validate"] = key('"validate": not fitted, only scored.', default="fit")
    log: str | list[str] | None = key("File, or files, relative to this one and below its folder.", default=None)
    virtual: VirtualTable | None = key("In place of a log: a simulated one.", default=None)
    time: Header | ClockTable | None = key("Column of the clock.", default=None)
    rate_hz: Number | None = key("Samples per second of a log without a clock.", default=None, gt=0, le=1e9)
    inputs: dict[str, Header | ColumnTable] = key("The plant's inputs, and their columns.", default={})
    outputs: dict[str, Header | ColumnTable] = key(
        "The plant's outputs that were measured, and their columns.", default={}
    )
    align: AlignTable | None = key("How columns of other clocks are aligned to the log's.", default=None)
    window_s: tuple[Number, Number] | None = key("Read only what lies between these times.", default=None)
    counter: CounterTable | None = key("A column that counts samples, which shows lost ones.", default=None)
    duplicates: Literal["first", "mean"] | None = key("Which of several samples at one time counts.", default=None)
    slice_s: tuple[Number, Number] | None = key("Part that is used, in seconds from the log's start.", default=None)
    resample: Literal["restamp"] | ResampleTable | None = key(
        '"restamp" for rounded timestamps; a rate for uneven ones.', default=None
    )
    decimate: Whole = key("Keep every n-th sample, behind a filter.", default=1, ge=1, le=10_000)
    held: HeldTable | None = key(
        "The plant's command is taken every so many rows; part servo_sample reads the position with it.", default=None
    )
    parameters: dict[str, Number | UnknownTable | ColumnTable] = key(
        "Values, or free ones, of this log alone.", default={}
    )
    delay_s: Number | UnknownTable = key("Delay from the input's column to its effect.", default=0.0)
    gain: dict[str, Number | UnknownTable] = key("Gain of each output's sensor.", default={})


class ExperimentTable(table_of(Experiment, leave_out=frozenset(LogTable.model_fields), base=LogTable)):
    """One log, or one virtual experiment, of one plant."""


class AcceptanceTable(StrictTable):
    """Which columns a log taken under the exported law has, where they are not those of the plant's experiment."""

    reference: Header | ColumnTable | None = key(
        "What the law was given as its reference; a column called reference or ref if left out.", default=None
    )
    columns: dict[str, Header | ColumnTable] = key(
        "Columns of the command and of what the law reads; else those of the controller's plant's experiment, or of "
        "the same name.",
        default={},
    )
    time: Header | ClockTable | None = key("Column of the clock.", default=None)
    rate_hz: Number | None = key(
        "Ticks per second of a log without a clock, or with one that stamps them unevenly.", default=None, gt=0, le=1e9
    )


class FitTable(StrictTable):
    """How the fit is made."""

    method: Literal["output_error", "multiple_shooting", "prediction_error"] = key(
        "output_error first; multiple_shooting where it fails; prediction_error with process noise.",
        default="output_error",
    )
    segments: Whole | None = key("Number of segments of multiple shooting.", default=None, ge=1, le=100_000)
    loss: Literal["linear", "huber", "soft_l1"] = key('"huber" or "soft_l1" with outliers.', default="linear")
    band_hz: tuple[Number, Number] | None = key("Residuals count in this band only.", default=None)
    holdout: Number = key("Last share of each log that is kept back, to judge the fit by.", default=0.0, ge=0, lt=1)
    causes: bool = key("What the model may lack is looked for where the fit leaves something.", default=True)
