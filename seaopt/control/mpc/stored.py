"""The numbers of a predictive controller's C code as controller.json holds them."""

from __future__ import annotations

from typing import Annotated, Any

import numpy as np
from pydantic import StringConstraints

from seaopt.control.mpc.export import MPCCode
from seaopt.documents import Number, ResultTable, Whole, check_table
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
