"""What a controller needs of its controller.json, as pydantic models, and whether its fields agree with each other."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, replace
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, ConfigDict, Field, FiniteFloat, Strict, model_validator

from seaopt.control.laws.command import Command
from seaopt.control.laws.plausibility import PlausibilityGate
from seaopt.control.laws.spec import ControllerSpec
from seaopt.control.laws.structures import (
    AGREES,
    COMPARED,
    CUSTOM,
    INNER_GAINS,
    LAW_GAINS,
    PREFILTER,
    DisturbanceObserver,
    Gains,
    Nominal,
    Notch,
    Prefilter,
)
from seaopt.control.laws.verdict import PossibleBandwidths
from seaopt.control.loops.absolute_stability import MARGIN_PRECISION, FrictionMargin
from seaopt.control.loops.compensation.link_feedforward import LinkFeedforward, LinkPath
from seaopt.control.loops.compensation.ripple_term import MOST_CYCLES, RippleTerm
from seaopt.control.loops.compensation.terms import Compensation, FrictionTerm, GravityTerm
from seaopt.control.loops.law import Law
from seaopt.control.loops.measured.figures import MeasuredFigures
from seaopt.control.loops.outer_loop import OuterLoop
from seaopt.control.loops.sampled_plant import list_names
from seaopt.control.loops.transfer_function import TransferFunction
from seaopt.documents import Flag, ResultTable, Whole, check_result
from seaopt.errors import ControlError, FileError
from seaopt.plants import Plant

NOTCH_GAINS = ("notch_frequency_hz", "notch_width", "notch_depth")
PREFILTER_GAINS = {PREFILTER, "prefilter_damping"}
FIGURES_AGREE = 1e-4  # a bandwidth where abs(F/F_ref) is flat is known to the root of rounding
ROUNDINGS = 1024 * float(np.finfo(float).eps)
TUNE_AGAIN = "tune again"

Finite = Annotated[FiniteFloat, Strict()]
Coefficients = Annotated[list[Finite], Field(min_length=1)]


def _begin_with_one(values: list[float]) -> list[float]:
    if values[0] != 1.0:
        raise ValueError("should begin with 1")
    return values


class StoredTransferFunction(ResultTable):
    """num(q)/den(q), ascending powers of q = z^-1."""

    num: Coefficients
    den: Coefficients

    def build(self) -> TransferFunction:
        """Return the transfer function."""
        return TransferFunction(num=np.array(self.num), den=np.array(self.den))


class StoredLaw(ResultTable):
    """The law: a state space from (reference, measured) to effort."""

    A: list[list[Finite]]
    B: list[list[Finite]]
    C: list[list[Finite]]
    D: list[list[Finite]]

    def build(self, sample_time_s: float) -> Law:
        """Return the law."""
        n, k = len(self.A), len(self.D[0]) if self.D else 0
        shapes = {"A": (n, n), "B": (n, k), "C": (1, n), "D": (1, max(k, 2))}
        matrices: dict[str, np.ndarray] = {}
        for name, shape in shapes.items():
            rows = getattr(self, name)
            if len(rows) != shape[0] or any(len(row) != shape[1] for row in rows):
                raise _contradict(f"law.{name}", f"is not a matrix of {shape[0]} x {shape[1]}")
            matrices[name] = np.array(rows, dtype=float).reshape(shape)
        return Law(
            a=matrices["A"], b=matrices["B"], c=matrices["C"][0], d=matrices["D"][0], sample_time_s=sample_time_s
        )


class StoredReading(StoredTransferFunction):
    """One of the law's two transfer functions."""

    den: Annotated[Coefficients, AfterValidator(_begin_with_one)]


class StoredObserver(ResultTable):
    """A disturbance observer: the two parts of its nominal plant, and the time constant of Q."""

    kept: Coefficients
    inverse: list[StoredTransferFunction]
    T_q: Finite
    bandwidth_hz: Finite
    Q: StoredTransferFunction
    Q_over_P_n: StoredTransferFunction

    def build(self, sample_time_s: float) -> DisturbanceObserver:
        """Return the observer; refuse what is for reading where it is not that of T_q, kept and inverse."""
        nominal = Nominal(kept=np.array(self.kept), inverse=tuple(part.build() for part in self.inverse))
        observer = DisturbanceObserver(nominal=nominal, T_q=self.T_q)
        if not abs(self.bandwidth_hz - observer.bandwidth_hz) <= AGREES * observer.bandwidth_hz:
            raise _contradict("observer.bandwidth_hz", f"is {self.bandwidth_hz:g}, and T_q says otherwise")
        filters = zip(("Q", "Q_over_P_n"), (self.Q, self.Q_over_P_n), observer.filters(sample_time_s), strict=True)
        for name, stated, made in filters:
            for end in ("num", "den"):
                one, other = np.array(getattr(stated, end)), getattr(made, end)
                if one.shape != other.shape or np.any(np.abs(one - other) > AGREES * np.max(np.abs(other))):
                    raise _contradict(f"observer.{name}.{end}", "is not what T_q, kept and inverse give")
        return observer


class StoredNumber(ResultTable):
    """A gain as a drive is set."""

    value: Finite
    unit: str


class StoredCommand(ResultTable):
    """What the controller sends to the motor for an effort."""

    input: str
    unit: str
    per_effort: Annotated[Finite, Field(gt=0.0)]
    effort_unit: str
    largest: Annotated[Finite, Field(gt=0.0)] | None = None
    measured_unit: str = ""


class StoredSpec(ResultTable):
    """A specification; what is not here is checked by `ControllerSpec` itself."""

    model_config = ConfigDict(extra="allow", frozen=True)
    bandwidth_range_hz: tuple[Finite, Finite]
    passive_band_hz: tuple[Finite, Finite] | None = None
    measured: str | tuple[str, ...] = "F1"
    robust_to: list[str] = []


class StoredPossible(ResultTable):
    """The bandwidths that keep the limits."""

    nearest_hz: tuple[Finite, ...]
    largest_hz: Finite | None
    closest_hz: Finite | None
    missed_by: Finite | None
    fall: Finite | None = None
    largest_fall: Finite | None = None
    fall_unit: str = ""
    fall_parameters: tuple[str, ...] = ()

    @model_validator(mode="after")
    def _require_pairs(self) -> StoredPossible:
        for pair in (("closest_hz", "missed_by"), ("fall", "largest_fall")):
            if len({getattr(self, name) is None for name in pair}) > 1:
                raise ValueError(f"should have both of {' and '.join(pair)}, or neither")
        return self


class StoredMeasured(ResultTable):
    """What the law does on one measured response; what is not finite stands as nothing."""

    name: str
    confidence: Finite
    points: Whole
    band_hz: tuple[Finite, Finite]
    bandwidth_hz: tuple[Finite | None, Finite | None]
    stable: Flag
    ms: Finite | None
    ms_hz: Finite | None
    mt: Finite | None
    disk_margin: Finite
    noise_gain: Finite | None
    reference_peak: Finite | None
    droop_db: Finite | None
    assumed: str

    def build(self) -> MeasuredFigures:
        """Return the figures."""
        fields: dict[str, Any] = self.model_dump()
        sizes = ("ms", "mt", "noise_gain", "reference_peak", "droop_db")
        missing: dict[str, Any] = {name: np.inf for name in sizes if fields[name] is None}
        missing |= {"ms_hz": np.nan} if self.ms_hz is None else {}
        return MeasuredFigures(**(fields | missing))


class StoredOuterLoop(ResultTable):
    """An outer loop of stiffness and damping."""

    stiffness: Annotated[Finite, Field(ge=0.0)]
    damping: Finite
    velocity_filter_s: Annotated[Finite, Field(ge=0.0)]
    direction: Finite
    sample_time_s: Annotated[Finite, Field(gt=0.0)]
    place_unit: Literal["m", "rad"]
    plant: str = ""


class StoredFrictionTerm(ResultTable):
    """Compensation of friction."""

    effort: Annotated[Finite, Field(gt=0.0)]
    speed: Annotated[Finite, Field(gt=0.0)]
    speed_unit: str
    fraction: Annotated[Finite, Field(gt=0.0)]
    source: Literal["reference", "speed"]
    reads: str
    velocity_per_rate: Finite

    @model_validator(mode="after")
    def _require_reading(self) -> StoredFrictionTerm:
        if bool(self.reads) != (self.source == "speed"):
            raise ValueError('should have reads where source is "speed", and only there')
        return self


class StoredGravityTerm(ResultTable):
    """Compensation of gravity."""

    coefficients: Annotated[tuple[Finite, ...], Field(min_length=1, max_length=100)]
    low: Finite
    high: Finite
    reads: Annotated[str, Field(min_length=1)]
    unit: str
    fraction: Annotated[Finite, Field(gt=0.0)]

    @model_validator(mode="after")
    def _require_range(self) -> StoredGravityTerm:
        if not self.low < self.high:
            raise ValueError("should have low below high")
        return self


class StoredRippleTerm(ResultTable):
    """Compensation of torque ripple."""

    cycles: Annotated[
        tuple[Annotated[Whole, Field(ge=1, le=MOST_CYCLES)], ...], Field(min_length=1, max_length=MOST_CYCLES)
    ]
    cos: tuple[Finite, ...]
    sin: tuple[Finite, ...]
    period: Annotated[Finite, Field(gt=0.0)]
    reads: Annotated[str, Field(min_length=1)]
    unit: str
    fraction: Annotated[Finite, Field(gt=0.0)]

    @model_validator(mode="after")
    def _require_series(self) -> StoredRippleTerm:
        if not len(set(self.cycles)) == len(self.cycles) == len(self.cos) == len(self.sin):
            raise ValueError("should have each of cycles once, and one cos and one sin for each")
        return self


class StoredCompensation(ResultTable):
    """What is added to reference and effort."""

    friction: StoredFrictionTerm | None = None
    gravity: StoredGravityTerm | None = None
    ripple: StoredRippleTerm | None = None

    def build(self, sample_time_s: float) -> Compensation:
        """Return the compensation."""
        friction = None if self.friction is None else FrictionTerm(**self.friction.model_dump())
        gravity = None if self.gravity is None else GravityTerm(**self.gravity.model_dump())
        ripple = None if self.ripple is None else RippleTerm(**self.ripple.model_dump())
        return Compensation(sample_time_s=sample_time_s, friction=friction, gravity=gravity, ripple=ripple)


class StoredLinkPath(ResultTable):
    """What is fed forward of the link's motion."""

    measured: str
    unit: str
    inertia: Finite
    damping: Finite
    is_speed: Flag
    fraction: Finite
    corner_hz: Annotated[Finite, Field(gt=0.0)]
    high_pass_hz: Annotated[Finite, Field(ge=0.0)]


class StoredGate(ResultTable):
    """A plausibility gate."""

    range_N: tuple[Finite, Finite]
    max_step_N: Finite
    max_held: Whole
    ramp_A_per_s: Finite

    def build(self) -> PlausibilityGate:
        """Return the gate."""
        try:
            return PlausibilityGate(**self.model_dump())
        except ControlError as error:
            raise _contradict("guards.gate", f"is none: {error}") from error


class StoredGuards(ResultTable):
    """What stands between the law and the world."""

    gate: StoredGate | None = None


class StoredController(ResultTable):
    """A controller.json."""

    structure: str
    gains: dict[str, Finite]
    sample_time_s: Finite
    compute_delay_samples: Annotated[Whole, Field(ge=0)]
    drive_delay_s: Annotated[Finite, Field(ge=0.0)]
    delay_samples: Finite
    law: StoredLaw
    measured: list[str] | None = None
    reference: StoredReading
    measurement: StoredReading | list[StoredReading]
    command: StoredCommand
    spec: StoredSpec
    feasible: Flag
    active_constraints: list[str]
    blocked_by: list[str] = []
    possible: StoredPossible | None = None
    observer: StoredObserver | None = None
    engineering: dict[str, StoredNumber] = {}
    measured_responses: list[StoredMeasured] = []
    impedance: StoredOuterLoop | None = None
    compensation: StoredCompensation | None = None
    link_feedforward: StoredLinkPath | None = None
    guards: StoredGuards = StoredGuards()


def read_controller(content: Mapping[str, Any]) -> dict[str, Any]:
    """Return the fields of a `Controller` that a controller.json holds; not what it achieves.

    Raises
    ------
    FileError
        A field is missing or malformed, or two contradict each other: the gains must give the coefficients.

    """
    table = check_result(StoredController, content, "controller.json", remedy=TUNE_AGAIN)
    spec, robust_to = _build_spec(table.spec)
    for name, expected in (
        ("structure", spec.structure), ("compute_delay_samples", spec.loop_delay_samples)
    ):  # fmt: skip
        if getattr(table, name) != expected:
            raise _contradict(name, f"is {getattr(table, name)!r} and spec.{name} {expected!r}")
    both = table.compute_delay_samples + table.drive_delay_s / table.sample_time_s
    if not abs(table.delay_samples - both) <= AGREES * max(both, 1.0):
        raise _contradict("delay_samples", f"= {table.delay_samples:g}, and both delays together are {both:g}")
    if not abs(table.sample_time_s * spec.sample_rate_hz - 1.0) < 1e-9:
        stated = f"is {table.sample_time_s:g}, which is not 1/spec.sample_rate_hz = {spec.sample_time_s:g}"
        raise _contradict("sample_time_s", stated)
    law = table.law.build(spec.sample_time_s)
    link = None if table.link_feedforward is None else LinkPath(**table.link_feedforward.model_dump())
    if (link is None) != (spec.link_feedforward is None):
        raise _contradict("link_feedforward", "is not that of spec.link_feedforward")
    reads = _check_measured(table, spec, law, link)
    observer = None if table.observer is None else table.observer.build(spec.sample_time_s)
    outer = None if table.impedance is None else OuterLoop(**table.impedance.model_dump())
    if outer is not None and not abs(outer.sample_time_s * spec.sample_rate_hz - 1.0) < 1e-9:
        raise _contradict("impedance.sample_time_s", f"is {outer.sample_time_s:g}, and the law has another")
    _check_gains(table.gains, observer, spec, law, reads, link)
    for name, stated in table.engineering.items():
        expected = table.command.per_effort * table.gains.get(name, np.nan)
        if not abs(stated.value - expected) <= AGREES * abs(expected):
            raise _contradict(f"engineering.{name}", f"is {stated.value:g}, and the gain makes {expected:g}")
    _check_reading(table, law)
    return {
        "law": law,
        "structure": spec.structure, "gains": table.gains, "sample_time_s": table.sample_time_s,
        "compute_delay_samples": table.compute_delay_samples, "drive_delay_s": table.drive_delay_s,
        "command": _build_command(table.command), "spec": spec,
        "feasible": table.feasible, "robust_to": robust_to, "active_constraints": tuple(table.active_constraints),
        "observer": observer, "link": link, "reads": reads, "blocked_by": tuple(table.blocked_by),
        "measured": tuple(one.build() for one in table.measured_responses),
        "outer": outer,
        "compensation": None if table.compensation is None else table.compensation.build(spec.sample_time_s),
        "gate": None if table.guards.gate is None else table.guards.gate.build(),
        "possible": None if table.possible is None else PossibleBandwidths(**table.possible.model_dump()),
    }  # fmt: skip


def check_link(link: LinkPath, spec: ControllerSpec, plant: Plant) -> None:
    """Refuse a signal that is not the link's motion on the design plant, or of the same actuator with its link free.

    Of a signal that the specification names, and neither knows, it is checked on the plants that it is closed on.

    Raises
    ------
    FileError
        The signal is another one, or has another unit.

    """
    port = plant.port
    free = plant if port is None or port.motion is not None or port.probe is None else port.probe()
    motion = None if free.sensing is None else free.sensing.link_position
    named = spec.link_feedforward is not None and spec.link_feedforward.measured is not None
    if motion is not None and not named and link.measured != motion:
        raise _contradict("link_feedforward.measured", f'is "{link.measured}", and the link moves "{motion}"')
    unit = free.outputs.get(link.measured, link.unit)
    if unit != link.unit:
        raise _contradict("link_feedforward.unit", f'is "{link.unit}", and {link.measured} is in {unit}')


def _check_measured(
    table: StoredController, spec: ControllerSpec, law: Law, link: LinkPath | None
) -> tuple[str, ...]:  # fmt: skip
    """Return the outputs that the law reads, where they are not those of the specification; refuse another number."""
    names = list_names(spec.measured)
    reads = names if table.measured is None else tuple(table.measured)
    further = () if link is None else (link.measured,)
    if len(reads) != len(names) + len(further) or reads[0] != names[0] or reads[len(names) :] != further:
        raise _contradict("measured", f"is {list(reads)}, and spec.measured {list(names)}")
    if law.d.size != 1 + len(reads):
        raise _contradict("law", f"has {law.d.size} inputs, and reference and measured are {1 + len(reads)}")
    return () if reads == names else reads


def _build_command(stored: StoredCommand) -> Command:
    """Return the command; a duty ends at 1 also where the file is older than ranges, and has none."""
    command = Command(**stored.model_dump())
    if (command.input, command.unit) != ("duty", "-"):
        return command
    if command.largest is not None and command.largest > 1.0:
        raise _contradict("command.largest", f"is {command.largest:g}, and a duty ends at 1")
    return command if "largest" in stored.model_fields_set else replace(command, largest=1.0)


def _build_spec(stored: StoredSpec) -> tuple[ControllerSpec, tuple[str, ...]]:
    """Return the specification and the names of the plants that it was tuned for besides."""
    fields = stored.model_dump(exclude={"robust_to"})
    try:
        if fields.get("notch") is not None:
            fields["notch"] = Notch(**fields["notch"])
        if isinstance(fields.get("prefilter"), Mapping):
            fields["prefilter"] = Prefilter(**fields["prefilter"])
        if fields.get("link_feedforward") is not None:
            fields["link_feedforward"] = LinkFeedforward(**fields["link_feedforward"])
        return ControllerSpec(**fields), tuple(stored.robust_to)
    except (ControlError, TypeError, ValueError) as error:
        raise FileError(f"controller.json: spec: {error}; {TUNE_AGAIN}") from error


def _check_gains(
    gains: Mapping[str, float],
    observer: DisturbanceObserver | None,
    spec: ControllerSpec,
    law: Law,
    reads: tuple[str, ...],
    link: LinkPath | None,
) -> None:
    """Refuse gains that do not give the law."""
    if spec.structure == CUSTOM:
        if gains:
            raise _contradict("gains", f"has {', '.join(sorted(gains))}, and a custom law has none")
        return
    speed = spec.find_speed_loop(reads or list_names(spec.measured))
    inner = () if speed is None else (*INNER_GAINS, *(("T_v",) if "T_v" in gains else ()))
    needed = {
        *LAW_GAINS,
        *inner,
        *(NOTCH_GAINS if "notch_depth" in gains else ()),
        *(("T_q",) if observer is not None else ()),
    }
    if spec.reference_filter is not None:
        needed |= PREFILTER_GAINS if spec.reference_filter.is_second_order else {PREFILTER}
    if set(gains) != needed:
        raise _contradict("gains", f"has {', '.join(sorted(gains))} where the law has {', '.join(sorted(needed))}")
    _check_asked(gains, spec, link)
    if (observer is not None) != (spec.structure == "pid_dob") or (
        observer is not None and gains["T_q"] != observer.T_q
    ):
        raise _contradict("observer", "is not that of structure and gains")
    if not Gains.from_names(gains, observer, speed, link).makes(law, spec.structure):
        raise _contradict("law", "is not what gains, observer and spec give")


def _check_asked(gains: Mapping[str, float], spec: ControllerSpec, link: LinkPath | None) -> None:
    """Refuse numbers that the specification gives and the law has otherwise."""
    if "T_v" in gains and spec.speed_loop != "PI":
        raise _contradict("gains.T_v", f'is given, and spec.speed_loop is "{spec.speed_loop}"')
    if not gains.get("T_v", 1.0) > 0.0:
        raise _contradict("gains.T_v", f"is {gains['T_v']:g}, which is no integral time")
    parts: tuple[tuple[str, Any, Mapping[str, Any]], ...] = (
        ("notch", spec.notch, _take(gains, "notch_")),
        ("prefilter", spec.reference_filter, _take(gains, "prefilter_")),
        ("link_feedforward", spec.link_feedforward, {} if link is None else asdict(link)),
    )
    for part, asked, has in parts:
        for name, value in ({} if asked is None else asdict(asked)).items():
            if value is None or name not in has:
                continue
            same = has[name] == value if isinstance(value, str) else math.isclose(has[name], value, rel_tol=AGREES)
            if not same:
                raise _contradict(f"spec.{part}.{name}", f"is {value!r}, and the law has {has[name]!r}")


def _take(gains: Mapping[str, float], prefix: str) -> dict[str, float]:
    """Return the gains of one part of the law, by the part's own names."""
    return {name.removeprefix(prefix): value for name, value in gains.items() if name.startswith(prefix)}


def _check_reading(table: StoredController, law: Law) -> None:
    """Refuse transfer functions that are not the law multiplied out."""
    f = COMPARED / law.sample_time_s
    q = np.exp(-2j * np.pi * COMPARED)
    measurements = table.measurement if isinstance(table.measurement, list) else [table.measurement]
    if len(measurements) != law.d.size - 1:
        raise _contradict("measurement", f"has {len(measurements)} entries, and the law reads {law.d.size - 1} signals")
    read = [("reference", table.reference.build(), law.reference_response(f))]
    read += [
        ("measurement", one.build(), response)
        for one, response in zip(measurements, law.feedback_responses(f), strict=True)
    ]
    for name, tf, expected in read:
        num, den = (np.polynomial.polynomial.polyval(q, p) for p in (tf.num, tf.den))
        # C den = num, to the rounding of either polynomial's coefficients.
        rounding = ROUNDINGS * (np.sum(np.abs(tf.num)) + np.sum(np.abs(tf.den)) * np.abs(expected))
        if not np.all(np.abs(expected * den - num) <= AGREES * np.abs(num) + rounding):
            raise _contradict(name, "is not the law multiplied out")


def check_achieved(stated: Any, figures: Mapping[str, Any]) -> None:
    """Refuse figures, those of controller.json's `achieved`, that are not the ones that its law has.

    Raises
    ------
    FileError
        One of them is not.

    """
    if not isinstance(stated, Mapping):
        raise FileError(f"controller.json: achieved is missing or not a table; {TUNE_AGAIN}")
    for name, figure in figures.items():
        value = stated.get(name)
        if not _agree(value, figure):
            raise _contradict(f"achieved.{name}", f"is {value!r}, and the law has {figure!r} on the design plant")


def check_friction_margin(stated: Any, margin: FrictionMargin | None) -> None:
    """Refuse a friction margin that the law does not have; a file that states none claims none.

    Raises
    ------
    FileError
        It is another than the margin found, which is known to `MARGIN_PRECISION`; without friction any one holds.

    """
    if stated is None or margin is None:
        return
    if not _agree(stated, margin.least_slope, 2.0 * MARGIN_PRECISION):
        found = f"{margin.least_slope:.6g}"
        raise _contradict("achieved.friction_margin", f"is {stated!r}, and the law has {found} on the design plant")


def _agree(stated: Any, figure: Any, tolerance: float = FIGURES_AGREE) -> bool:
    """Tell whether a figure is as stated; what is not finite stands in JSON as nothing."""
    try:
        one, other = (np.array(np.nan if value is None else value, dtype=float) for value in (stated, figure))
    except (TypeError, ValueError):
        return False
    one, other = (np.where(np.isfinite(values), values, np.nan) for values in (one, other))
    return one.shape == other.shape and np.allclose(one, other, rtol=tolerance, atol=0.0, equal_nan=True)


def _contradict(name: str, what: str) -> FileError:
    return FileError(f"controller.json: {name} {what}; {TUNE_AGAIN}")
