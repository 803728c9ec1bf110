"""What controller.json holds of a predictive controller beside its linear law: specification, numbers of its C code."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import Annotated, Any

import numpy as np
from pydantic import StringConstraints

from seaopt.control.laws.structures import AGREES
from seaopt.control.mpc.export import MPCCode, collect_code
from seaopt.control.mpc.mpc import ForceMPC
from seaopt.documents import Number, ResultTable, Whole, check_table
from seaopt.errors import FileError
from seaopt.files import plain

TUNE_AGAIN = "run seaopt tune again"
CName = Annotated[str, StringConstraints(pattern=r"^[A-Za-z_]+$")]
CText = Annotated[str, StringConstraints(pattern=r'^[^"\\\r\n]*$')]  # stands between quotation marks in C


class StoredCode(ResultTable):
    """The fields of `MPCCode`."""

    sizes: dict[CName, Whole]
    numbers: dict[CName, Number]
    arrays: dict[CName, list[Number] | list[list[Number]]]
    units: dict[CName, CText]
    hessian: list[list[Number]]
    rows: list[list[Number]]


def describe_mpc(mpc: ForceMPC) -> dict[str, Any]:
    """Return what controller.json says of a plan beside its linear law: its specification, and its C code's numbers."""
    return {"spec": asdict(mpc.spec), "code": collect_code(mpc).to_dict()}


def check_described(content: Any, mpc: ForceMPC, *, source: str, problem: str, remedy: str) -> None:
    """Refuse what a controller.json says of a plan (`describe_mpc`) where it is not that of a controller.

    Parameters
    ----------
    content : Any
        The file's `mpc`.
    mpc : ForceMPC
        As the problem asks for it.
    source, problem, remedy : str
        The file, the problem's file, and what to do, for messages.

    Raises
    ------
    FileError
        The specification is another; or the C code's numbers are, which other parameters make; or they are malformed.

    """
    stored, own = plain(content), plain(describe_mpc(mpc))
    spec = stored.get("spec") if isinstance(stored, dict) else None
    if not isinstance(spec, dict):
        raise FileError(f"{source}: mpc has no spec; {remedy}")
    for name, asked in own["spec"].items():
        if spec.get(name) != asked:
            raise FileError(
                f"{source}: mpc.spec.{name} is {spec.get(name)}, and {problem} asks for {asked}; correct one of them, "
                f"or {remedy}"
            )
    if not _is_same(read_code(stored.get("code")).to_dict(), own["code"]):
        raise FileError(
            f"{source}: mpc.code is not what {problem} makes of this specification: its parameters, or its fit, are "
            f"others; {remedy}"
        )


def _is_same(stored: Any, own: Any) -> bool:
    """Tell whether numbers of C code are the same but for the rounding of another machine."""
    if isinstance(own, Mapping):
        return stored.keys() == own.keys() and all(_is_same(stored[name], own[name]) for name in own)
    if isinstance(own, str):
        return stored == own
    a, b = np.array(stored, dtype=float), np.array(own, dtype=float)
    return a.shape == b.shape and bool(np.all(np.abs(a - b) <= AGREES * np.max(np.abs(b), initial=0.0)))


def read_code(content: Any) -> MPCCode:
    """Return the numbers of the C code that a controller.json holds.

    Raises
    ------
    FileError
        A field is missing or malformed.

    """
    stored = check_table(StoredCode, plain(content), "controller.json: mpc.code", remedy=TUNE_AGAIN)
    return MPCCode(
        sizes=stored.sizes, numbers=stored.numbers, units=stored.units,
        arrays={name: np.array(value, dtype=float) for name, value in stored.arrays.items()},
        hessian=np.array(stored.hessian, dtype=float), rows=np.array(stored.rows, dtype=float),
    )  # fmt: skip
