"""What controller.json holds of a predictive controller beside its linear law: specification, numbers of its C code."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import numpy as np

from seaopt.codec import from_content
from seaopt.control.laws.structures import AGREES
from seaopt.control.mpc.export import MPCCode, collect_code
from seaopt.control.mpc.mpc import ForceMPC
from seaopt.errors import FileError
from seaopt.files import plain

TUNE_AGAIN = "run seaopt tune again"


def describe_mpc(mpc: ForceMPC) -> dict[str, Any]:
    """Return what controller.json says of a plan beside its linear law: its specification, and its C code's numbers."""
    return {"spec": asdict(mpc.spec), "code": collect_code(mpc).to_dict()}


def check_described(content: Any, mpc: ForceMPC, *, source: str, problem: str, remedy: str) -> None:
    """Refuse (FileError) a controller.json's `mpc` that does not describe (`describe_mpc`) the controller: another
    specification, numbers of the C code that other parameters make, or malformed ones.
    """
    stored, expected = plain(content), plain(describe_mpc(mpc))
    spec = stored.get("spec") if isinstance(stored, dict) else None
    if not isinstance(spec, dict):
        raise FileError(f"{source}: mpc has no spec; {remedy}")
    for name, wanted in expected["spec"].items():
        if spec.get(name) != wanted:
            raise FileError(
                f"{source}: mpc.spec.{name} is {spec.get(name)}, and {problem} asks for {wanted}; correct one of them, "
                f"or {remedy}"
            )
    if not _is_same(read_code(stored.get("code")).to_dict(), expected["code"]):
        raise FileError(
            f"{source}: mpc.code is not what {problem} makes of this specification: its parameters, or its fit, are "
            f"others; {remedy}"
        )


def _is_same(stored: Any, expected: Any) -> bool:
    """Tell whether numbers of C code are the same but for the rounding of another machine."""
    if isinstance(expected, Mapping):
        return stored.keys() == expected.keys() and all(_is_same(stored[name], expected[name]) for name in expected)
    if expected is None or isinstance(expected, str):
        return stored == expected
    a, b = np.array(stored, dtype=float), np.array(expected, dtype=float)
    return a.shape == b.shape and bool(np.all(np.abs(a - b) <= AGREES * np.max(np.abs(b), initial=0.0)))


def read_code(content: Any) -> MPCCode:
    """Return the numbers of a controller.json's C code. Raises FileError: a field is missing or malformed."""
    return from_content(MPCCode, content, "controller.json: mpc.code", remedy=TUNE_AGAIN)
