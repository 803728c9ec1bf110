"""Read a controller.json, and check that its fields agree with each other."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, field, fields, replace
from typing import Annotated, Any

import numpy as np
from jaxtyping import Float

from seaopt.codec import Constraints, Fields, check_agrees, from_content, to_content
from seaopt.control.laws.command import Command
from seaopt.control.laws.plausibility import PlausibilityGate
from seaopt.control.laws.spec import ControllerSpec
from seaopt.control.laws.structures import (
    AGREES,
    CUSTOM,
    INNER_GAINS,
    LAW_GAINS,
    PREFILTER,
    DisturbanceObserver,
    Gains,
    Nominal,
)
from seaopt.control.laws.verdict import BindingLimit, PossibleBandwidths
from seaopt.control.loops.absolute_stability import MARGIN_PRECISION, FrictionMargin
from seaopt.control.loops.compensation.link_feedforward import LinkPath
from seaopt.control.loops.compensation.terms import Compensation
from seaopt.control.loops.law import Law
from seaopt.control.loops.measured.loop import MeasuredFigures
from seaopt.control.loops.minimal import has_response
from seaopt.control.loops.outer_loop import OuterLoop
from seaopt.control.loops.sampled_plant import list_names
from seaopt.control.loops.transfer_function import TransferFunction
from seaopt.errors import ControlError, FileError
from seaopt.files import check_schema
from seaopt.plants import Plant
from seaopt.records import record

CONTROLLER_SCHEMA = "seaopt/controller/3"
FILE = "controller.json"
NOTCH_GAINS = {"notch_frequency_hz", "notch_width", "notch_depth"}
PREFILTER_GAINS = {PREFILTER, "prefilter_damping"}
ROUNDINGS = 1024.0  # of the coefficients of what is multiplied out, on this machine and another
FIGURES_AGREE = 1e-4  # a bandwidth where abs(F/F_ref) is flat is known to the root of rounding
TUNE_AGAIN = "tune again"
Terms = Annotated[Mapping[str, Any], Fields(of=Compensation)] | None


@record(eq=False)
class StoredLaw:
    """The law: a state space from (reference, measured) to effort, and a frozen schedule's share of anti-windup."""

    A: Float[np.ndarray, "_ _"]
    B: Float[np.ndarray, "_ _"]
    C: Float[np.ndarray, "_ _"]
    D: Float[np.ndarray, "_ _"]
    share: Annotated[float, Constraints(ge=0.0, le=0.5)] | None = None

    def __post_init__(self) -> None:
        n, k = len(self.A), self.D.shape[1]
        for name, shape in {"A": (n, n), "B": (n, k), "C": (1, n), "D": (1, max(k, 2))}.items():
            matrix = getattr(self, name)
            if matrix.shape != shape and (matrix.size or math.prod(shape)):
                raise ControlError(f"{name} is not a matrix of {shape[0]} x {shape[1]}")

    def build(self, sample_time_s: float) -> Law:
        """Return the law."""
        n, k = len(self.A), self.D.shape[1]
        return Law(a=self.A, b=self.B.reshape(n, k), c=self.C.reshape(n), d=self.D[0], sample_time_s=sample_time_s)


@record(eq=False)
class StoredObserver:
    """A disturbance observer: the two parts of its nominal plant, and the time constant of Q."""

    kept: Annotated[Float[np.ndarray, " n"], Constraints(min_length=1)]
    inverse: tuple[TransferFunction, ...]
    T_q: float


@record
class StoredNumber:
    """A gain as a drive is set."""

    value: float
    unit: str


@record
class StoredPlants:
    """The plants that the controller was tuned for besides the design plant; they stand in the specification."""

    robust_to: tuple[str, ...] = ()


@record(eq=False)
class StoredBlocks:
    """The blocks of a law besides its gains."""

    observer: StoredObserver | None = None
    link_feedforward: LinkPath | None = None
    impedance: OuterLoop | None = None


@record
class StoredGuards:
    """The guards between the law and the hardware."""

    gate: PlausibilityGate | None = None
    derate: bool = False


@record(eq=False)
class StoredLoop:
    """What every controller.json says of its loop, of a law and of a schedule."""

    structure: str
    sample_time_s: float
    compute_delay_samples: Annotated[int, Constraints(ge=0)]
    drive_delay_s: Annotated[float, Constraints(ge=0.0)]
    delay_samples: float
    measured: tuple[str, ...] | None = None
    guards: StoredGuards = StoredGuards()
    command: Command
    spec: ControllerSpec
    feasible: bool


@record(eq=False)
class StoredController(StoredLoop):
    """The controller.json of one law."""

    json_names = {"binding": "active_constraints"}

    gains: dict[str, float]
    blocks: StoredBlocks
    terms: Terms
    law: StoredLaw
    reference: TransferFunction
    measurement: TransferFunction | tuple[TransferFunction, ...]
    binding: tuple[BindingLimit, ...]
    blocked_by: tuple[str, ...] = ()
    possible: PossibleBandwidths | None = None
    measured_responses: tuple[MeasuredFigures, ...] = ()
    engineering: dict[str, StoredNumber] = field(default_factory=dict[str, StoredNumber])
    schedule: None = None


def read_controller(content: Mapping[str, Any]) -> dict[str, Any]:
    """Return the fields of a `Controller` that a controller.json holds; not what it achieves. Raises FileError: a field
    is missing or malformed, or two contradict each other: the gains must give the law.
    """
    check_schema(content, CONTROLLER_SCHEMA, FILE, remedy=TUNE_AGAIN)
    if content.get("schedule") is not None:
        raise FileError(f"{FILE}: is of a schedule, and not of one law; read it with ScheduledController.from_dict")
    table = from_content(StoredController, content, FILE, remedy=TUNE_AGAIN)
    command, parts = table.command, table.blocks
    link, outer = parts.link_feedforward, parts.impedance
    if unknown := {*content["spec"]} - {"robust_to"} - {field.name for field in fields(table.spec)}:
        raise _contradict(f"spec.{min(unknown)}", "is not known")
    # What is written as 30 is written as 30 again, not as 30.0.
    spec = replace(table.spec, **{key: value for key, value in content["spec"].items() if isinstance(value, int)})
    ts, observer = spec.sample_time_s, None
    made: dict[str, Any] = {
        "structure": spec.structure,
        "sample_time_s": ts,
        "compute_delay_samples": spec.loop_delay_samples,
        "delay_samples": table.compute_delay_samples + table.drive_delay_s / table.sample_time_s,
    }
    blocks: dict[str, Any] = {} if outer is None else {"impedance": {"sample_time_s": ts}}
    if parts.observer is not None:
        nominal = Nominal(kept=parts.observer.kept, inverse=parts.observer.inverse)
        observer = DisturbanceObserver(nominal=nominal, T_q=parts.observer.T_q)
        blocks["observer"] = observer.to_dict(ts)
    made["blocks"] = blocks
    check_agrees(content, made, FILE, remedy=TUNE_AGAIN, rtol=AGREES)
    law = table.law.build(ts)
    if outer is not None and not outer.position:  # a file from before it was stored
        raise _contradict("blocks.impedance.position", "is missing: the output that the outer loop reads")
    if (link is None) != (spec.link_feedforward is None):
        raise _contradict("blocks.link_feedforward", "is not that of spec.link_feedforward")
    reads = _check_measured(table, law)
    _check_gains(table, law, observer, reads)
    scaled = {name: {"value": command.per_effort * table.gains.get(name, math.nan)} for name in table.engineering}
    check_agrees(content, {"engineering": scaled}, FILE, remedy=TUNE_AGAIN, rtol=AGREES)
    _check_reading(table, law)
    if (command.input, command.unit) == ("duty", "-"):
        largest = 1.0 if command.largest is None else command.largest  # left out before there were ranges
        if largest > 1.0:
            raise _contradict("command.largest", f"is {largest:g}, and a duty ends at 1")
        command = replace(command, largest=largest)
    taken = ("structure", "gains", "sample_time_s", "compute_delay_samples", "drive_delay_s")
    taken += ("binding", "blocked_by", "possible")
    terms = table.terms
    return {name: getattr(table, name) for name in taken} | {
        "law": law,
        "share": table.law.share,
        "spec": spec,
        "command": command,
        "met": table.feasible,
        "robust_to": from_content(StoredPlants, content["spec"], f"{FILE}: spec", remedy=TUNE_AGAIN).robust_to,
        "observer": observer,
        "link": link,
        "reads": reads,
        "measured": table.measured_responses,
        "outer": outer,
        "compensation": terms and Compensation(sample_time_s=ts, **terms),
        "gate": table.guards.gate,
        "derate": table.guards.derate,
    }


def check_link(link: LinkPath, spec: ControllerSpec, plant: Plant) -> None:
    """Refuse a signal that is not the link's motion on the design plant, or of the same actuator with its link free. Of
    a signal that the specification names, and neither knows, it is checked on the plants that it is closed on.
    """
    port = plant.port
    free = plant if port is None or port.motion is not None or port.probe is None else port.probe()
    motion = None if free.sensing is None else free.sensing.link_position
    named = spec.link_feedforward is not None and spec.link_feedforward.measured is not None
    if motion is not None and not named and link.measured != motion:
        raise _contradict("blocks.link_feedforward.measured", f'is "{link.measured}", and the link moves "{motion}"')
    unit = free.outputs.get(link.measured, link.unit)
    if unit != link.unit:
        raise _contradict("blocks.link_feedforward.unit", f'is "{link.unit}", and {link.measured} is in {unit}')


def _check_measured(table: StoredController, law: Law) -> tuple[str, ...]:
    """Return the outputs that the law reads, where they are not those of the specification; refuse another number."""
    names, link = list_names(table.spec.measured), table.blocks.link_feedforward
    reads = names if table.measured is None else table.measured
    further = () if link is None else (link.measured,)
    if len(reads) != len(names) + len(further) or reads[0] != names[0] or reads[len(names) :] != further:
        raise _contradict("measured", f"is {list(reads)}, and spec.measured {list(names)}")
    if law.d.size != 1 + len(reads):
        raise _contradict("law", f"has {law.d.size} inputs, and reference and measured are {1 + len(reads)}")
    return () if reads == names else reads


def _check_gains(
    table: StoredController, law: Law, observer: DisturbanceObserver | None, reads: tuple[str, ...]
) -> None:
    """Refuse gains that do not give the law."""
    gains, spec, link = table.gains, table.spec, table.blocks.link_feedforward
    if spec.structure == CUSTOM:
        if gains:
            raise _contradict("gains", f"has {', '.join(sorted(gains))}, and a custom law has none")
        return
    speed = spec.find_speed_loop(reads or list_names(spec.measured))
    needed = {*LAW_GAINS}
    if speed is not None:
        needed |= {*INNER_GAINS} | ({"T_v"} & gains.keys())
    if "notch_depth" in gains:
        needed |= NOTCH_GAINS
    if observer is not None:
        needed |= {"T_q"}
    if spec.reference_filter is not None:
        needed |= PREFILTER_GAINS if spec.reference_filter.is_second_order else {PREFILTER}
    if set(gains) != needed:
        raise _contradict("gains", f"has {', '.join(sorted(gains))} where the law has {', '.join(sorted(needed))}")
    if "T_v" in gains and not (spec.speed_loop == "PI" and gains["T_v"] > 0.0):
        raise _contradict("gains.T_v", f'is {gains["T_v"]:g}, and spec.speed_loop is "{spec.speed_loop}"')
    parts = {
        "notch": (spec.notch, _take(gains, "notch_")),
        "prefilter": (spec.reference_filter, _take(gains, "prefilter_")),
        "link_feedforward": (spec.link_feedforward, to_content(link) or {}),
    }
    for name, (requested, has) in parts.items():
        fields = {} if requested is None else asdict(requested)
        numbers = {key: value for key, value in fields.items() if value is not None}
        check_agrees(numbers, has, FILE, remedy=TUNE_AGAIN, path=f"spec.{name}", rtol=AGREES)
    if (observer is not None) != (spec.structure == "pid_dob") or (observer and gains["T_q"] != observer.T_q):
        raise _contradict("blocks.observer", "is not that of structure and gains")
    if not Gains.from_names(gains, observer, speed, link).makes(law, spec.structure):
        raise _contradict("law", "is not what gains, observer and spec give")


def _take(gains: Mapping[str, float], prefix: str) -> dict[str, float]:
    """Return the gains of one part of the law, by the part's own names."""
    return {name.removeprefix(prefix): value for name, value in gains.items() if name.startswith(prefix)}


def _check_reading(table: StoredController, law: Law) -> None:
    """Refuse transfer functions that are not the law multiplied out."""
    paths = table.measurement if isinstance(table.measurement, tuple) else (table.measurement,)
    if len(paths) != law.d.size - 1:
        raise _contradict("measurement", f"has {len(paths)} entries, and the law reads {law.d.size - 1} signals")
    signs = np.array([1.0] + [-1.0] * len(paths))
    for column, path in enumerate((table.reference, *paths)):
        name = "measurement" if column else "reference"
        if path.den[0] != 1.0:
            raise _contradict(f"{name}.den", "should begin with 1")
        if not has_response(path, lambda f, i=column: signs[i] * law.responses(f)[i], law.sample_time_s, ROUNDINGS):
            raise _contradict(name, "is not the law multiplied out")


def check_achieved(stated: Any, figures: Mapping[str, Any]) -> None:
    """Refuse figures in controller.json's `achieved` that its law does not have, or lacks (FileError)."""
    if not isinstance(stated, Mapping):
        raise FileError(f"{FILE}: achieved is missing or not a table; {TUNE_AGAIN}")
    stated = {name: stated.get(name) for name in figures}
    check_agrees(stated, figures, FILE, remedy=TUNE_AGAIN, path="achieved", rtol=FIGURES_AGREE)


def check_friction_margin(stated: Any, margin: FrictionMargin | None) -> None:
    """Refuse a stated friction margin that the law does not have, to its precision; without friction any holds."""
    if stated is not None and margin is not None:
        figures, rtol = {"friction_margin": margin.least_slope}, 2.0 * MARGIN_PRECISION
        check_agrees({"friction_margin": stated}, figures, FILE, remedy=TUNE_AGAIN, path="achieved", rtol=rtol)


def _contradict(name: str, what: str) -> FileError:
    return FileError(f"{FILE}: {name} {what}; {TUNE_AGAIN}")
