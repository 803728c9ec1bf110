"""Reading controller.json: what a controller needs of it, each field checked, and all of them against each other."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float

from seaopt.control.laws.command import Command
from seaopt.control.laws.spec import ControllerSpec
from seaopt.control.laws.structures import DisturbanceObserver, Gains, Nominal, Notch
from seaopt.control.loops.transfer_function import TransferFunction
from seaopt.errors import ControlError, FileError

LAW = ("k_p", "k_i", "k_d", "T_f", "k_ff")
NOTCH = ("notch_frequency_hz", "notch_width", "notch_depth")
AGREE = 1e-9  # of the largest coefficient


def stored(content: Mapping[str, Any]) -> dict[str, Any]:
    """Return the fields of a `Controller` that a controller.json holds; not what it achieves.

    Raises
    ------
    FileError
        A field is missing or malformed, or two contradict each other: the gains must give the coefficients.

    """
    spec, robust_to = _spec(_item(content, "spec"))
    observer, gains = _observer(content.get("observer")), _gains(_item(content, "gains"))
    law = {name: _transfer_function(content, name) for name in ("reference", "measurement")}
    for name, expected in (("structure", spec.structure), ("delay_samples", spec.delay_samples)):
        if _item(content, name) != expected:
            raise _wrong(name, f"is {content[name]!r} and spec.{name} {expected!r}")
    ts, feasible = _number(content, "sample_time_s"), _item(content, "feasible")
    if not abs(ts * spec.sample_rate_hz - 1.0) < 1e-9:
        raise _wrong("sample_time_s", f"is {ts:g}, which is not 1/spec.sample_rate_hz = {spec.sample_time_s:g}")
    if not isinstance(feasible, bool):
        raise _wrong("feasible", f"is {feasible!r}, neither true nor false")
    _agree(gains, observer, spec, law)
    largest = None if content.get("largest_bandwidth_hz") is None else _number(content, "largest_bandwidth_hz")
    return {
        "structure": spec.structure, "gains": gains, "sample_time_s": ts, "delay_samples": spec.delay_samples, **law,
        "command": _command(content), "spec": spec, "feasible": feasible, "robust_to": robust_to,
        "active_constraints": _names(content, "active_constraints"), "observer": observer,
        "blocked_by": _names(content, "blocked_by") if "blocked_by" in content else (),
        "largest_bandwidth_hz": largest,
    }  # fmt: skip


def _agree(
    gains: Mapping[str, float],
    observer: DisturbanceObserver | None,
    spec: ControllerSpec,
    law: Mapping[str, TransferFunction],
) -> None:
    """Refuse gains that do not give the coefficients."""
    needed = {*LAW, *(NOTCH if "notch_depth" in gains else ()), *(("T_q",) if observer is not None else ())}
    if set(gains) != needed:
        raise _wrong("gains", f"has {', '.join(sorted(gains))} where the law has {', '.join(sorted(needed))}")
    if (observer is not None) != (spec.structure == "pid_dob") or (
        observer is not None and gains["T_q"] != observer.T_q
    ):
        raise _wrong("observer", "is not that of structure and gains")
    notch = Notch(**{name.removeprefix("notch_"): gains[name] for name in NOTCH}) if "notch_depth" in gains else None
    own = Gains(**{name: gains[name] for name in LAW}, derivative=spec.derivative, observer=observer, notch=notch)
    made_of_gains = own.transfer_functions(spec.structure, spec.sample_time_s)
    for name, made in zip(("reference", "measurement"), made_of_gains, strict=True):
        for part in ("num", "den"):
            given, expected = getattr(law[name], part), getattr(made, part)
            if given.shape != expected.shape or not np.all(
                np.abs(given - expected) <= AGREE * np.max(np.abs(expected), initial=0.0)
            ):
                raise _wrong(f"{name}.{part}", "is not what gains, observer and spec give")


def _spec(content: Any) -> tuple[ControllerSpec, tuple[str, ...]]:
    if not isinstance(content, Mapping):
        raise _wrong("spec", f"is {_short(content)}, not a table")
    given = dict(content)
    robust_to = _names(given, "robust_to") if "robust_to" in given else ()
    given.pop("robust_to", None)
    given["bandwidth_range_hz"] = tuple(_numbers(given, "bandwidth_range_hz", "spec."))
    if len(given["bandwidth_range_hz"]) != 2:
        raise _wrong("spec.bandwidth_range_hz", "is not two numbers")
    if given.get("passive_band_hz") is not None:
        given["passive_band_hz"] = tuple(_numbers(given, "passive_band_hz", "spec.").tolist())
    try:
        if given.get("notch") is not None:
            given["notch"] = Notch(**given["notch"])
        return ControllerSpec(**given), robust_to
    except (ControlError, TypeError) as error:
        raise FileError(f"controller.json: spec: {error}; tune again") from error


def _command(content: Mapping[str, Any]) -> Command:
    table = _item(content, "command")
    texts = {name: _item(table, name, "command.") for name in ("input", "unit", "effort_unit")}
    for name, value in texts.items():
        if not isinstance(value, str):
            raise _wrong(f"command.{name}", f"is {_short(value)}, not text")
    per_effort = _number(table, "per_effort", "command.")
    if not per_effort > 0.0:
        raise _wrong("command.per_effort", f"is {per_effort:g}, not positive")
    return Command(per_effort=per_effort, **texts)


def _gains(content: Any) -> dict[str, float]:
    if not isinstance(content, Mapping):
        raise _wrong("gains", f"is {_short(content)}, not a table")
    return {str(name): _number(content, name, "gains.") for name in content}


def _transfer_function(content: Mapping[str, Any], name: str) -> TransferFunction:
    table = _item(content, name)
    num, den = (_numbers(table, part, f"{name}.") for part in ("num", "den"))
    if den[0] != 1.0:
        raise _wrong(f"{name}.den", f"begins with {den[0]:g}, not 1")
    return TransferFunction(num=num, den=den)


def _observer(content: Any) -> DisturbanceObserver | None:
    if content is None:
        return None
    table = _item(content, "inverse", "observer.")
    inverse = TransferFunction(**{part: _numbers(table, part, "observer.inverse.") for part in ("num", "den")})
    nominal = Nominal(kept=_numbers(content, "kept", "observer."), inverse=inverse)
    return DisturbanceObserver(nominal=nominal, T_q=_number(content, "T_q", "observer."))


def _item(content: Any, name: str, before: str = "") -> Any:
    if not isinstance(content, Mapping) or name not in content:
        raise _wrong(before + name, "is missing")
    return content[name]


def _number(content: Any, name: str, before: str = "") -> float:
    value = _item(content, name, before)
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
        raise _wrong(before + name, f"is {_short(value)}, not a number")
    return float(value)


def _numbers(content: Any, name: str, before: str = "") -> Float[np.ndarray, " n"]:
    given = _item(content, name, before)
    values = given.tolist() if isinstance(given, np.ndarray) else given
    if not isinstance(values, (list, tuple)) or not values:
        raise _wrong(before + name, f"is {_short(values)}, not a list of numbers")
    return np.array([_number({f"{name}[{k}]": item}, f"{name}[{k}]", before) for k, item in enumerate(values)])


def _names(content: Mapping[str, Any], name: str) -> tuple[str, ...]:
    values = _item(content, name)
    if not isinstance(values, (list, tuple)) or not all(isinstance(item, str) for item in values):
        raise _wrong(name, f"is {_short(values)}, not a list of names")
    return tuple(values)


def _short(value: Any) -> str:
    text = " ".join(repr(value).split())
    return text if len(text) < 40 else text[:36] + " ..."


def _wrong(name: str, what: str) -> FileError:
    return FileError(f"controller.json: {name} {what}; tune again")
