"""What a controller needs of its controller.json, and whether its fields agree with each other."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, field, replace
from typing import Annotated, Any

import numpy as np
from jaxtyping import Float
from pydantic import ConfigDict

from seaopt.codec import Fields, Limits, check_agrees, from_content, to_content
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
from seaopt.control.loops.compensation.terms import Compensation
from seaopt.control.loops.law import Law
from seaopt.control.loops.measured.figures import MeasuredFigures
from seaopt.control.loops.outer_loop import OuterLoop
from seaopt.control.loops.sampled_plant import list_names
from seaopt.control.loops.transfer_function import TransferFunction
from seaopt.documents import Number, ResultTable
from seaopt.errors import ControlError, FileError
from seaopt.plants import Plant
from seaopt.records import record

NOTCH_GAINS = ("notch_frequency_hz", "notch_width", "notch_depth")
PREFILTER_GAINS = {PREFILTER, "prefilter_damping"}
FIGURES_AGREE = 1e-4  # a bandwidth where abs(F/F_ref) is flat is known to the root of rounding
ROUNDINGS = 1024 * float(np.finfo(float).eps)
TUNE_AGAIN = "tune again"


@record(eq=False)
class StoredLaw:
    """The law: a state space from (reference, measured) to effort."""

    A: Float[np.ndarray, "_ _"]  # whose shapes are checked with each other
    B: Float[np.ndarray, "_ _"]
    C: Float[np.ndarray, "_ _"]
    D: Float[np.ndarray, "_ _"]

    def build(self, sample_time_s: float) -> Law:
        """Return the law."""
        n, k = len(self.A), self.D.shape[1]
        shapes = {"A": (n, n), "B": (n, k), "C": (1, n), "D": (1, max(k, 2))}
        for name, shape in shapes.items():
            if getattr(self, name).shape != shape and (getattr(self, name).size or math.prod(shape)):
                raise _contradict(f"law.{name}", f"is not a matrix of {shape[0]} x {shape[1]}")
        b = self.B.reshape(shapes["B"])
        return Law(a=self.A, b=b, c=self.C.reshape(n), d=self.D[0], sample_time_s=sample_time_s)


@record(eq=False)
class StoredObserver:
    """A disturbance observer: the two parts of its nominal plant, and the time constant of Q; what these give."""

    kept: Annotated[Float[np.ndarray, " n"], Limits(min_length=1)]
    inverse: tuple[TransferFunction, ...]
    T_q: float
    bandwidth_hz: float
    Q: TransferFunction
    Q_over_P_n: TransferFunction

    def build(self, sample_time_s: float) -> DisturbanceObserver:
        """Return the observer; refuse what is for reading where it is not that of T_q, kept and inverse."""
        observer = DisturbanceObserver(nominal=Nominal(kept=self.kept, inverse=self.inverse), T_q=self.T_q)
        made = observer.to_dict(sample_time_s)
        check_agrees(to_content(self), made, "controller.json", remedy=TUNE_AGAIN, place="observer", rtol=AGREES)
        return observer


@record
class StoredNumber:
    """A gain as a drive is set."""

    value: float
    unit: str


class StoredSpec(ResultTable):
    """A specification; what is not here is checked by `ControllerSpec` itself."""

    model_config = ConfigDict(extra="allow", frozen=True)
    bandwidth_range_hz: tuple[Number, Number]
    passive_band_hz: tuple[Number, Number] | None = None
    measured: str | tuple[str, ...] = "F1"
    robust_to: list[str] = []


@record
class StoredGuards:
    """What stands between the law and the world."""

    gate: PlausibilityGate | None = None


@record(eq=False)
class StoredController:
    """A controller.json."""

    structure: str
    gains: dict[str, float]
    sample_time_s: float
    compute_delay_samples: Annotated[int, Limits(ge=0)]
    drive_delay_s: Annotated[float, Limits(ge=0.0)]
    delay_samples: float
    law: StoredLaw
    measured: tuple[str, ...] | None = None
    reference: TransferFunction
    measurement: TransferFunction | tuple[TransferFunction, ...]
    command: Command
    spec: StoredSpec
    feasible: bool
    active_constraints: tuple[str, ...]
    blocked_by: tuple[str, ...] = ()
    possible: PossibleBandwidths | None = None
    observer: StoredObserver | None = None
    engineering: dict[str, StoredNumber] = field(default_factory=dict[str, StoredNumber])
    measured_responses: tuple[MeasuredFigures, ...] = ()
    impedance: OuterLoop | None = None
    compensation: Annotated[Mapping[str, Any], Fields(of=Compensation)] | None = None
    link_feedforward: LinkPath | None = None
    guards: StoredGuards = StoredGuards()


def read_controller(content: Mapping[str, Any]) -> dict[str, Any]:
    """Return the fields of a `Controller` that a controller.json holds; not what it achieves.

    Raises
    ------
    FileError
        A field is missing or malformed, or two contradict each other: the gains must give the coefficients.

    """
    table = from_content(StoredController, content, "controller.json", remedy=TUNE_AGAIN)
    spec, robust_to = _build_spec(table.spec)
    for name, expected in (("structure", spec.structure), ("compute_delay_samples", spec.loop_delay_samples)):
        if getattr(table, name) != expected:
            raise _contradict(name, f"is {getattr(table, name)!r} and spec.{name} {expected!r}")
    both = table.compute_delay_samples + table.drive_delay_s / table.sample_time_s
    if not abs(table.delay_samples - both) <= AGREES * max(both, 1.0):
        raise _contradict("delay_samples", f"= {table.delay_samples:g}, and both delays together are {both:g}")
    if not abs(table.sample_time_s * spec.sample_rate_hz - 1.0) < 1e-9:
        stated = f"is {table.sample_time_s:g}, which is not 1/spec.sample_rate_hz = {spec.sample_time_s:g}"
        raise _contradict("sample_time_s", stated)
    law = table.law.build(spec.sample_time_s)
    link = table.link_feedforward
    if (link is None) != (spec.link_feedforward is None):
        raise _contradict("link_feedforward", "is not that of spec.link_feedforward")
    reads = _check_measured(table, spec, law, link)
    observer = None if table.observer is None else table.observer.build(spec.sample_time_s)
    outer = table.impedance
    if outer is not None and not abs(outer.sample_time_s * spec.sample_rate_hz - 1.0) < 1e-9:
        raise _contradict("impedance.sample_time_s", f"is {outer.sample_time_s:g}, and the law has another")
    _check_gains(table.gains, observer, spec, law, reads, link)
    for name, stated in table.engineering.items():
        expected = table.command.per_effort * table.gains.get(name, np.nan)
        if not abs(stated.value - expected) <= AGREES * abs(expected):
            raise _contradict(f"engineering.{name}", f"is {stated.value:g}, and the gain makes {expected:g}")
    _check_reading(table, law)
    command, terms = table.command, table.compensation
    if (command.input, command.unit) == ("duty", "-") and command.largest is not None and command.largest > 1.0:
        raise _contradict("command.largest", f"is {command.largest:g}, and a duty ends at 1")
    if (command.input, command.unit) == (
        "duty",
        "-",
    ) and command.largest is None:  # as written before there were ranges
        command = replace(command, largest=1.0)
    return {
        "law": law,
        "structure": spec.structure,
        "gains": table.gains,
        "sample_time_s": table.sample_time_s,
        "compute_delay_samples": table.compute_delay_samples,
        "drive_delay_s": table.drive_delay_s,
        "command": command,
        "spec": spec,
        "met": table.feasible,
        "robust_to": robust_to,
        "active_constraints": table.active_constraints,
        "observer": observer,
        "link": link,
        "reads": reads,
        "blocked_by": table.blocked_by,
        "measured": table.measured_responses,
        "outer": outer,
        "compensation": terms and Compensation(sample_time_s=spec.sample_time_s, **terms),
        "gate": table.guards.gate,
        "possible": table.possible,
    }


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


def _check_measured(table: StoredController, spec: ControllerSpec, law: Law, link: LinkPath | None) -> tuple[str, ...]:
    """Return the outputs that the law reads, where they are not those of the specification; refuse another number."""
    names = list_names(spec.measured)
    reads = names if table.measured is None else table.measured
    further = () if link is None else (link.measured,)
    if len(reads) != len(names) + len(further) or reads[0] != names[0] or reads[len(names) :] != further:
        raise _contradict("measured", f"is {list(reads)}, and spec.measured {list(names)}")
    if law.d.size != 1 + len(reads):
        raise _contradict("law", f"has {law.d.size} inputs, and reference and measured are {1 + len(reads)}")
    return () if reads == names else reads


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
    measurements = table.measurement if isinstance(table.measurement, tuple) else (table.measurement,)
    if len(measurements) != law.d.size - 1:
        raise _contradict("measurement", f"has {len(measurements)} entries, and the law reads {law.d.size - 1} signals")
    read = [("reference", table.reference, law.reference_response(f))]
    read += [
        ("measurement", one, response) for one, response in zip(measurements, law.feedback_responses(f), strict=True)
    ]
    for name, tf, expected in read:
        if tf.den[0] != 1.0:
            raise _contradict(f"{name}.den", "should begin with 1")
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
