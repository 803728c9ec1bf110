"""Sampled channels with units."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from seaopt.errors import LogError
from seaopt.records import record


@record
class Origin:
    """Where a channel came from.

    Parameters
    ----------
    file : str
        The file's path as given; "" for arrays.
    sha256 : str
        Of the file's bytes, hexadecimal; "" for arrays.
    column : str
        Header, path or topic.field inside the file.
    conversion : str
        What was done to its numbers on the way to SI, in words, for example "mA to A".

    """

    file: str = ""
    sha256: str = ""
    column: str = ""
    conversion: str = ""


@record(eq=False)
class Signal:
    """One channel of a log: samples in an SI unit.

    Parameters
    ----------
    name : str
        The channel's name, usually that of a plant's input or output.
    values : array, shape (n,)
        Samples in `unit`; NaN marks a missing one.
    unit : str
        SI unit text; "" where it was not said (arrays from Python are SI by convention).
    origin : Origin
        File, column and conversion.

    """

    name: str
    values: Float[np.ndarray, " n"]
    unit: str = ""
    origin: Origin = Origin()

    def __post_init__(self) -> None:
        if self.values.ndim != 1:
            raise LogError(f"channel {self.name} has shape {self.values.shape}; give one value a sample")
        self.values.setflags(write=False)
