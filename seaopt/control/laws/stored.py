"""What a controller needs of its controller.json, as pydantic models, and whether its fields agree with each other."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

import numpy as np
from pydantic import AfterValidator, ConfigDict, Field, FiniteFloat, Strict

from seaopt.control.laws.command import Command
from seaopt.control.laws.spec import ControllerSpec
from seaopt.control.laws.structures import LAW_GAINS, DisturbanceObserver, Gains, Nominal, Notch
from seaopt.control.loops.transfer_function import TransferFunction
from seaopt.documents import Flag, ResultTable, Whole, check_table
from seaopt.errors import ControlError, FileError
from seaopt.files import plain

NOTCH_GAINS = ("notch_frequency_hz", "notch_width", "notch_depth")
GAINS_AGREE = 1e-9  # of the largest coefficient
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


class StoredLaw(StoredTransferFunction):
    """One of the law's two transfer functions."""

    den: Annotated[Coefficients, AfterValidator(_begin_with_one)]


class StoredObserver(ResultTable):
    """A disturbance observer: the two parts of its nominal plant, and the time constant of Q."""

    kept: Coefficients
    inverse: StoredTransferFunction
    T_q: Finite


class StoredCommand(ResultTable):
    """What the controller sends to the motor for an effort."""

    input: str
    unit: str
    per_effort: Annotated[Finite, Field(gt=0.0)]
    effort_unit: str


class StoredSpec(ResultTable):
    """A specification; what is not here is checked by `ControllerSpec` itself."""

    model_config = ConfigDict(extra="allow", frozen=True)
    bandwidth_range_hz: tuple[Finite, Finite]
    passive_band_hz: tuple[Finite, Finite] | None = None
    robust_to: list[str] = []


class StoredController(ResultTable):
    """A controller.json."""

    structure: str
    gains: dict[str, Finite]
    sample_time_s: Finite
    delay_samples: Whole
    reference: StoredLaw
    measurement: StoredLaw
    command: StoredCommand
    spec: StoredSpec
    feasible: Flag
    active_constraints: list[str]
    blocked_by: list[str] = []
    largest_bandwidth_hz: Finite | None = None
    observer: StoredObserver | None = None


def read_controller(content: Mapping[str, Any]) -> dict[str, Any]:
    """Return the fields of a `Controller` that a controller.json holds; not what it achieves.

    Raises
    ------
    FileError
        A field is missing or malformed, or two contradict each other: the gains must give the coefficients.

    """
    table = check_table(StoredController, plain(content), "controller.json", remedy=TUNE_AGAIN)
    spec, robust_to = _build_spec(table.spec)
    for name, expected in (("structure", spec.structure), ("delay_samples", spec.loop_delay_samples)):
        if getattr(table, name) != expected:
            raise _contradict(name, f"is {getattr(table, name)!r} and spec.{name} {expected!r}")
    if not abs(table.sample_time_s * spec.sample_rate_hz - 1.0) < 1e-9:
        stated = f"is {table.sample_time_s:g}, which is not 1/spec.sample_rate_hz = {spec.sample_time_s:g}"
        raise _contradict("sample_time_s", stated)
    law = {"reference": table.reference.build(), "measurement": table.measurement.build()}
    observer = None
    if table.observer is not None:
        nominal = Nominal(kept=np.array(table.observer.kept), inverse=table.observer.inverse.build())
        observer = DisturbanceObserver(nominal=nominal, T_q=table.observer.T_q)
    _check_agreement(table.gains, observer, spec, law)
    return law | {
        "structure": spec.structure, "gains": table.gains, "sample_time_s": table.sample_time_s,
        "delay_samples": table.delay_samples, "command": Command(**table.command.model_dump()), "spec": spec,
        "feasible": table.feasible, "robust_to": robust_to, "active_constraints": tuple(table.active_constraints),
        "observer": observer, "blocked_by": tuple(table.blocked_by),
        "largest_bandwidth_hz": table.largest_bandwidth_hz,
    }  # fmt: skip


def _build_spec(stored: StoredSpec) -> tuple[ControllerSpec, tuple[str, ...]]:
    """Return the specification and the names of the plants that it was tuned for besides."""
    fields = stored.model_dump(exclude={"robust_to"})
    try:
        if fields.get("notch") is not None:
            fields["notch"] = Notch(**fields["notch"])
        return ControllerSpec(**fields), tuple(stored.robust_to)
    except (ControlError, TypeError, ValueError) as error:
        raise FileError(f"controller.json: spec: {error}; {TUNE_AGAIN}") from error


def _check_agreement(
    gains: Mapping[str, float],
    observer: DisturbanceObserver | None,
    spec: ControllerSpec,
    law: Mapping[str, TransferFunction],
) -> None:
    """Refuse gains that do not give the coefficients."""
    needed = {*LAW_GAINS, *(NOTCH_GAINS if "notch_depth" in gains else ()), *(("T_q",) if observer is not None else ())}
    if set(gains) != needed:
        raise _contradict("gains", f"has {', '.join(sorted(gains))} where the law has {', '.join(sorted(needed))}")
    if (observer is not None) != (spec.structure == "pid_dob") or (
        observer is not None and gains["T_q"] != observer.T_q
    ):
        raise _contradict("observer", "is not that of structure and gains")
    notch = (
        Notch(**{name.removeprefix("notch_"): gains[name] for name in NOTCH_GAINS}) if "notch_depth" in gains else None
    )
    law_gains = Gains(**{name: gains[name] for name in LAW_GAINS}, observer=observer, notch=notch)
    made_of_gains = law_gains.transfer_functions(spec.structure, spec.sample_time_s)
    for name, made in zip(("reference", "measurement"), made_of_gains, strict=True):
        for part in ("num", "den"):
            stated, expected = getattr(law[name], part), getattr(made, part)
            if stated.shape != expected.shape or not np.all(
                np.abs(stated - expected) <= GAINS_AGREE * np.max(np.abs(expected), initial=0.0)
            ):
                raise _contradict(f"{name}.{part}", "is not what gains, observer and spec give")


def _contradict(name: str, what: str) -> FileError:
    return FileError(f"controller.json: {name} {what}; {TUNE_AGAIN}")
