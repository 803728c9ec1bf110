"""Sampled channels with units, and what a table of them as read and a checked log have in common."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Complex, Float, Int

from seaopt.errors import LogError
from seaopt.records import record

# Arrays of numbers, and of row numbers, by their shape: of one call all with the same letter are as long as each other.
VectorN = Float[np.ndarray, " n"]
VectorM = Float[np.ndarray, " m"]
VectorK = Float[np.ndarray, " k"]
VectorX = Float[np.ndarray, " nx"]
MatrixNN = Float[np.ndarray, "n n"]
MatrixMN = Float[np.ndarray, "m n"]
ComplexM = Complex[np.ndarray, " m"]
ComplexN = Complex[np.ndarray, " n"]
RowsK = Int[np.ndarray, " k"]
RowsN = Int[np.ndarray, " n"]

# What channels are called where nobody says what they are, in any case.
INPUT_NAMES = frozenset({"i", "fe1", "fe2", "u", "v", "duty", "goal"})
HOLDING_NAMES = frozenset({"duty", "goal"})  # of inputs that hold a value for as long as they like
INPUT_UNITS = frozenset({"A", "V"})
SAME_SIGN = ("f1", "f2")  # both forces of an actuator between two links
REFERENCE = "reference"  # of a law, in a log that was taken under it
HOLDS = "holds"  # of a log whose command firmware takes only at some samples: above zero at the others
STATUS = "status"  # of the law, as its C has it
TARGET_LOG = "SEALOG1"  # with which a log begins that the C beside a law writes
REFERENCES = (REFERENCE, "ref")  # what its column is called where nobody says


def median(values: VectorN) -> float:
    """Return the median of numbers, NaN where one is none: NumPy's takes ten times as long to find both middle ones."""
    middle = values.size // 2
    if not values.size or np.isnan(np.sum(values)):
        return float(np.median(values))
    ordered = np.partition(values, middle)
    upper = float(ordered[middle])
    return upper if values.size % 2 else 0.5 * (float(np.max(ordered[:middle])) + upper)


def measure_white(values: VectorN) -> float:
    """Return the std of white noise on a smooth signal: by third differences, which motions hardly have. Zero of fewer
    than four values.
    """
    third = np.abs(np.diff(values, 3))
    return 1.4826 * median(third) / np.sqrt(20.0) if third.size else 0.0


def bridge(values: VectorN) -> VectorN:
    """Return a signal with its missing samples on lines between those that are there."""
    there = np.flatnonzero(np.isfinite(values))
    return values if there.size in (0, values.size) else np.interp(np.arange(values.size), there, values[there])


def find_taken(n: int, samples: int, first: int) -> tuple[RowsN, RowsN]:
    """Return, for each of n rows of a command that is taken every so many of them, the row at which its value was taken
    (before `first` the row that the log begins with), and how many rows ago that is of any log.
    """
    rows = np.arange(n)
    since = (rows - first) % samples
    return np.maximum(rows - since, 0), since


def weigh_points(points: VectorN, at: float) -> VectorN:
    """Return what the values at some points weigh in that of the polynomial through them at another (Lagrange)."""
    others = [np.delete(points, i) for i in range(points.size)]
    return np.array([np.prod((at - rest) / (point - rest)) for point, rest in zip(points, others, strict=True)])


@record
class Origin:
    """Where a channel came from."""

    file: str = ""  # the file's path as given; "" for arrays
    sha256: str = ""  # of the file's bytes, hexadecimal; "" for arrays
    column: str = ""  # header, path or topic.field inside the file
    conversion: str = ""  # what was done to its numbers on the way to SI, in words, for example "mA to A"


@record(eq=False)
class Signal:
    """One channel of a log: samples in an SI unit."""

    name: str  # the channel's name, usually that of a plant's input or output
    values: VectorN  # samples in `unit`; NaN marks a missing one
    unit: str = ""  # SI unit text; "" where it was not said (arrays from Python are SI by convention)
    origin: Origin = Origin()  # file, column and conversion

    def __post_init__(self) -> None:
        if self.values.ndim != 1:
            raise LogError(f"channel {self.name} has shape {self.values.shape}; give one value per sample")
        self.values.setflags(write=False)


@runtime_checkable
class Recording(Protocol):
    """A log or a table, as far as both are read alike: channels of one clock, source and notes."""

    @property
    def time(self) -> VectorN:
        """Seconds."""
        ...

    @property
    def signals(self) -> Mapping[str, Signal]:
        """Channels by name."""
        ...

    @property
    def source(self) -> str:
        """Where the recording came from."""
        ...

    @property
    def notes(self) -> tuple[str, ...]:
        """What was done to it, one sentence each."""
        ...

    def __len__(self) -> int: ...


@record(eq=False)
class RawLog:
    """Channels of one clock, as read: time may repeat, run backwards or be missing.

    Parameters
    ----------
    time : array, shape (n,)
        Seconds, as the file has them.
    signals : mapping of name to Signal
        Channels of n samples each, in SI where their unit is known.
    source : str
        The file, or the files.
    notes : tuple of str
        What was done on reading, one sentence each.
    law : str
        Hash of the law that it says it was taken under; empty where it does not.
    """

    time: VectorN
    signals: Mapping[str, Signal]
    source: str
    notes: tuple[str, ...] = ()
    law: str = ""

    def __len__(self) -> int:
        return int(self.time.size)


def check_distinct(channels: Mapping[str, tuple[tuple[str, str], str]]) -> list[str]:
    """Refuse one column for two channels; say so where they are two quantities, each with a conversion of its own.
    `channels`: ((file, column), SI unit) by name. A screw's angle (rad) and its nut's place (m) may come of one
    encoder; two forces do not come of one load cell. Raises LogError: two channels of one column have the same SI unit.
    """
    seen: dict[tuple[str, str], dict[str, str]] = {}
    notes: list[str] = []
    for name, (column, unit) in channels.items():
        for other, other_unit in seen.get(column, {}).items():
            if other_unit == unit:
                raise LogError(
                    f'{column[0]}: column "{column[1]}" is given for {other} and for {name}; each channel needs a '
                    "column of its own: choose another for one of them, leave it out, or give a file's column "
                    "shared = true"
                )
            notes.append(
                f'{other} and {name} are the same column "{column[1]}", in {other_unit or "-"} and in {unit or "-"}'
            )
        seen.setdefault(column, {})[name] = unit
    return notes
