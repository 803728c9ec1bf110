"""A law of somebody else's, as JSON or TOML: controller.json's keys, or the gains of a PID."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, FiniteFloat, Strict, model_validator

from seaopt.codec import from_content
from seaopt.control.given.pid_forms import Integral, ideal_pid, parallel_pid
from seaopt.control.laws.stored import StoredLaw
from seaopt.control.laws.structures import AGREES, COMPARED
from seaopt.control.loops.law import Law
from seaopt.control.loops.sampled_plant import Measured
from seaopt.control.loops.transfer_function import TransferFunction
from seaopt.documents import Number, ResultTable, Whole, check_table
from seaopt.errors import ControlError, FileError
from seaopt.files import parse_file
from seaopt.records import record

LARGEST = 1e50  # of a law's numbers: squares of larger ones, and products of three, are beyond a double
Finite = Annotated[FiniteFloat, Strict()]
Positive = Annotated[Finite, Field(gt=0.0)]


def _bound(value: float) -> float:
    if abs(value) > LARGEST:
        raise ValueError(f"should be within ±{LARGEST:g}")
    return value


Bounded = Annotated[Finite, AfterValidator(_bound)]
# A whole one, in one line.
LAW_EXAMPLE = "sample_rate_hz = 1000, compute_delay_samples = 1, pid = { k_p = 2.0, k_i = 30.0 }"
# Keys of a controller.json that are not its law.
TUNING = {
    "schema", "title", "structure", "gains", "achieved", "met", "feasible", "active_constraints", "engineering",
    "blocks", "heat", "blocked_by", "largest_bandwidth_hz", "possible", "notes",
    "measured_responses", "provenance", "fit_met", "guessed", "made_from", "guards", "schedule",
}  # fmt: skip
PID_GAINS = {"parallel": ("k_p", "k_i", "k_d", "T_f"), "ideal": ("K", "T_i", "T_d", "N")}


@record(eq=False)
class GivenLaw:
    """A law as a file gives it.

    Parameters
    ----------
    law : Law
        From reference and measured to effort; or to the command, where `to_command`.
    delays : mapping
        Of `seaopt.ControllerSpec`, what the file states: compute_delay_samples, drive_delay_s, delay_samples.
    measured : str, tuple of str or None
        What it measures; None where the file does not say.
    to_command : bool
        Whether it gives the command (A, V, duty) itself.
    per_effort : float or None
        The command that it makes of one unit of effort; None where the file does not say.
    """

    law: Law
    delays: Mapping[str, Any]
    measured: Measured | None = None
    to_command: bool = False
    per_effort: float | None = None

    def to_effort(self, per_effort: float) -> Law:
        """Return the law to an effort of which one unit takes the command `per_effort`: the same commands."""
        made = 1.0 if self.to_command else self.per_effort
        return self.law if made is None else self.law.scaled(made / per_effort)


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class _Pid(_Strict):
    """The gains of a PID, with the names of its form."""

    form: Literal["parallel", "ideal"] = "parallel"
    k_p: Bounded | None = None
    k_i: Bounded | None = None
    k_d: Bounded | None = None
    T_f: Bounded | None = None
    K: Bounded | None = None
    T_i: Positive | None = None
    T_d: Bounded | None = None
    N: Positive | None = None
    b: Bounded = 1.0
    c: Bounded = 1.0
    feedforward: Bounded = 0.0
    integral: Integral = "trapezoid"

    @model_validator(mode="after")
    def _check_names(self) -> _Pid:
        for form, names in PID_GAINS.items():
            wrong = [name for name in names if form != self.form and getattr(self, name) is not None]
            if wrong:
                raise ValueError(
                    f"should have {', '.join(PID_GAINS[self.form])} in the {self.form} form, not {wrong[0]}"
                )
        if getattr(self, PID_GAINS[self.form][0]) is None:
            raise ValueError(f"should have {PID_GAINS[self.form][0]} in the {self.form} form")
        return self

    def build(self, sample_time_s: float) -> Law:
        make: Any = parallel_pid if self.form == "parallel" else ideal_pid
        return make(**self.model_dump(exclude={"form"}, exclude_none=True), sample_time_s=sample_time_s)


class _CommandTable(BaseModel):
    model_config = ConfigDict(extra="ignore", frozen=True)
    per_effort: Positive | None = None


class FractionTable(ResultTable):
    """num(q)/den(q), ascending powers of q = z^-1."""

    num: Annotated[list[Finite], Field(min_length=1)]
    den: Annotated[list[Finite], Field(min_length=1)]


class LawFile(_Strict):
    """A law's file; of a controller.json what describes its tuning may stand in it, and is not read."""

    sample_time_s: Positive | None = None
    sample_rate_hz: Positive | None = None
    compute_delay_samples: Annotated[Whole, Field(ge=0)] | None = None
    drive_delay_s: Annotated[Number, Field(ge=0.0)] | None = None
    delay_samples: Annotated[Number, Field(ge=0.0)] | None = None
    output: Literal["effort", "command"] = "effort"
    measured: list[str] | str | None = None
    law: dict[Literal["A", "B", "C", "D"], list[list[Bounded]]] | None = None
    reference: FractionTable | None = None
    measurement: FractionTable | list[FractionTable] | None = None
    pid: _Pid | None = None
    command: _CommandTable = _CommandTable()
    spec: Any = None
    terms: Any = None

    @model_validator(mode="before")
    @classmethod
    def _leave_out(cls, content: Any) -> Any:
        if isinstance(content, dict) and content.get("schedule") is not None:  # whose law, terms ... are lists
            raise ValueError("should have no schedule: one law is measured against one [controller]")
        return {key: content[key] for key in content if key not in TUNING} if isinstance(content, dict) else content

    @model_validator(mode="after")
    def _check_law(self) -> LawFile:
        if (self.sample_time_s is None) == (self.sample_rate_hz is None):
            raise ValueError("should have one of sample_time_s and sample_rate_hz")
        if self.compute_delay_samples is None and self.delay_samples is None:
            raise ValueError("should have compute_delay_samples, the samples from a reading to the command, such as 1")
        newer = self.compute_delay_samples is not None or self.drive_delay_s is not None
        if self.spec is None and self.delay_samples is not None and newer:
            raise ValueError(
                "should have compute_delay_samples and drive_delay_s, or delay_samples, the whole loop; not both"
            )
        if (self.reference is None) != (self.measurement is None):
            raise ValueError("should have both of reference and measurement, each with num and den")
        if (self.pid is not None) == (self.law is not None or self.reference is not None):
            raise ValueError("should have law (A, B, C, D), or reference and measurement (num, den), or pid (gains)")
        if self.terms is not None:
            raise ValueError("should have no terms, which no linear law has; ask for compensation in [controller]")
        if isinstance(self.measured, list) and not self.measured:
            raise ValueError("should name what is measured")
        return self

    @property
    def delays(self) -> dict[str, Any]:
        """The delays that the file states; of a controller.json those requested: its drive's may come from a fit."""
        if self.compute_delay_samples is None:
            samples = float(self.delay_samples or 0.0)
            return {"delay_samples": int(samples) if samples.is_integer() else samples}
        spec = self.spec if isinstance(self.spec, dict) else {"drive_delay_s": self.drive_delay_s}
        if spec.get("delay_samples") is not None:  # of a controller.json: its samples are the whole loop's
            return {"delay_samples": self.compute_delay_samples}
        return {"compute_delay_samples": self.compute_delay_samples, "drive_delay_s": spec.get("drive_delay_s")}

    def build(self, source: str) -> GivenLaw:
        """Return the law."""
        names = tuple([self.measured] if isinstance(self.measured, str) else self.measured or ())
        try:
            law = self._build_law(source, self.sample_time_s or 1.0 / (self.sample_rate_hz or 1.0))
        except ControlError as error:
            raise FileError(f"{source}: {error}") from error
        if names and law.d.size != 1 + len(names):
            raise FileError(
                f"{source}: the law reads {law.d.size - 1} signals, and measured names {len(names)}; name each"
            )
        return GivenLaw(
            law=law,
            delays=self.delays,
            measured=names[0] if len(names) == 1 else names or None,
            to_command=self.output == "command",
            per_effort=self.command.per_effort,
        )

    def _build_law(self, source: str, ts: float) -> Law:
        if self.pid is not None:
            return self.pid.build(ts)
        fractions: list[tuple[str, TransferFunction]] = []
        if self.reference is not None and self.measurement is not None:
            paths = self.measurement if isinstance(self.measurement, list) else [self.measurement]
            named = [("reference", self.reference), *(("measurement", path) for path in paths)]
            fractions = [(name, _normalise(source, name, fraction)) for name, fraction in named]
        if self.law is None:
            return Law.from_transfer_functions(fractions[0][1], [fraction for _, fraction in fractions[1:]], ts)
        remedy = "give the matrices from (reference, measured) to effort"
        law = from_content(StoredLaw, self.law, f"{source}: law", remedy=remedy).build(ts).set_apart()
        f = COMPARED / ts
        if fractions and len(fractions) != law.d.size:
            raise FileError(
                f"{source}: measurement has {len(fractions) - 1} entries, and law reads {law.d.size - 1} signals"
            )
        responses = (law.reference_response(f), *law.feedback_responses(f))
        for (name, fraction), response in zip(fractions, responses, strict=False):
            if np.any(np.abs(fraction.response(f, ts) - response) > AGREES * np.max(np.abs(response))):
                raise FileError(f"{source}: {name} is not what law gives; leave one of them out")
        return law


def read_law(path: Path | str) -> GivenLaw:
    r"""Read a law from a JSON or TOML file.

    Parameters
    ----------
    path : path
        A file with sample_time_s or sample_rate_hz, compute_delay_samples, and one of ``law`` (A, B, C, D from
        reference and measured to effort), ``reference`` and ``measurement`` (num and den in ascending powers of 1/z:
        effort = reference F_ref - measurement F; of several signals a list, one for each name in ``measured``), and
        ``pid`` (gains of `parallel_pid` or `ideal_pid`, by ``form``). With
        ``output = "command"`` the law gives the command itself (A, V, a duty).

    Raises
    ------
    FileError
        It cannot be read, or does not say what the law is.

    Examples
    --------
    >>> import pathlib, tempfile
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "law.toml"
    >>> _ = path.write_text('sample_rate_hz = 1000.0\ncompute_delay_samples = 1\n[pid]\nk_p = 2.0\nk_i = 30.0\n')
    >>> read_law(path).law.integrators
    1
    """
    source = Path(path)
    parse, form = (json.loads, "JSON") if source.suffix.lower() == ".json" else (tomllib.loads, "TOML")
    content = parse_file(source, parse, form, remedy=f"give the law's file: {LAW_EXAMPLE}")
    if isinstance(content, dict) and "mpc" in content:
        raise FileError(
            f"{source}: is of predictive control, which plans and is no law; certify it with the problem file that it "
            'was made from, whose [controller] has structure = "mpc"'
        )
    return check_table(LawFile, content, str(source)).build(str(source))


def _normalise(source: str, name: str, fraction: FractionTable) -> TransferFunction:
    num, den = np.array(fraction.num), np.array(fraction.den)
    if den[0] == 0.0:
        raise FileError(f"{source}: {name}.den begins with 0; give ascending powers of 1/z, the first not 0")
    with np.errstate(over="ignore", under="ignore"):
        num, bottom = num / den[0], den / den[0]
    largest = np.max(np.abs(num), initial=0.0)
    if max(largest, np.max(np.abs(bottom))) > LARGEST or (np.any(fraction.num) and largest < 1.0 / LARGEST):
        raise FileError(
            f"{source}: {name}.den[0] = {den[0]:g} leaves, divided by it, coefficients beyond {LARGEST:g} or all of "
            f"num below {1.0 / LARGEST:g}; correct {name}.den or {name}.num"
        )
    return TransferFunction(num=num, den=bottom)
