"""A column of a file, and its declared way to SI."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from seaopt.errors import LogError, require_number, require_type
from seaopt.logs.log.alignment import Rule
from seaopt.records import record
from seaopt.signals import VectorN
from seaopt.units import factor, si_unit


@record(keywords=True)
class Column:
    """A column of a file and its conversion to SI: (value, unwrapped, times scale, plus offset) in `unit`.

    Parameters
    ----------
    column : str or int
        Its header or path, as `contents` lists it; or its number, from 1, where headers are missing or repeated.
    unit : str, optional
        Unit after scale and offset; where it is left out, the file's own.
    scale, offset : float
        Applied before the unit, in this order.
    wrap_bits : int, optional
        The numbers are unsigned integers of this many bits that represent signed ones (two's complement).
    file : path, optional
        Which of several files; needed where more than one has the column.
    time : str or Column, optional
        The column's own clock, where it is not the log's.
    clock_offset_s : float
        Seconds to add to its own clock.
    align : Hold, Linear, Nearest or Readings, optional
        How it is aligned from its own clock to the log's.
    where : mapping of column to value, optional
        Read only the rows in which other columns have these values: a table of (name, value, time) holds many channels.
        Each is then on the clock of its own rows.
    from_header : bool
        `column` is not a column but a constant that the header states ("kp = 200"); the channel has that value always.
    shared : bool
        Another channel of the same unit may be the same column, which is otherwise taken for a mistake.
    at_rest : bool
        That it is constant is expected, and not noted.

    Examples
    --------
    >>> Column(column="load", unit="-", wrap_bits=16, scale=1e-3).describe_conversion("-")
    "two's complement of 16 bits, times 0.001"
    """

    column: str | int
    unit: str | None = None
    scale: float = 1.0
    offset: float = 0.0
    wrap_bits: int | None = None
    file: str | Path | None = None
    time: str | int | Column | None = None
    clock_offset_s: float = 0.0
    align: Rule | None = None
    where: Mapping[str, str | float] | None = None
    from_header: bool = False
    shared: bool = False
    at_rest: bool = False

    def __post_init__(self) -> None:
        if isinstance(self.column, bool) or not isinstance(self.column, str | int):
            raise LogError(f"column = {self.column!r} is neither a header nor a number; give one, counted from 1")
        if isinstance(self.column, int) and self.column < 1:
            raise LogError(f"column = {self.column}: columns are counted from 1")
        if self.from_header and (self.where or self.time or self.wrap_bits):
            raise LogError(f'column "{self.column}": a constant from the header has no where, time or wrap_bits')
        for what in ("scale", "offset", "clock_offset_s"):
            require_number(getattr(self, what), f'{what} of column "{self.column}"', LogError)
        require_type(self.unit or "", str, f'unit of column "{self.column}"', "give a text", LogError)
        require_type(self.where or {}, Mapping, f'where of column "{self.column}"', "give a mapping", LogError)
        if not np.isfinite(self.scale) or self.scale == 0 or not np.isfinite(self.offset):
            raise LogError(
                f'column "{self.column}": scale = {self.scale:g}, offset = {self.offset:g}; give finite numbers, no '
                "scale of 0"
            )
        if self.wrap_bits is not None and not 2 <= self.wrap_bits <= 53:
            raise LogError(f'column "{self.column}": wrap_bits = {self.wrap_bits}; give 2 to 53, 16 for a uint16')
        if not np.isfinite(self.clock_offset_s):
            raise LogError(f'column "{self.column}": clock_offset_s = {self.clock_offset_s:g}; give seconds')

    def to_si(self, values: VectorN, unit: str, source: str) -> VectorN:
        """Return the values in the SI unit of `unit`; the array given is used up."""
        if self.wrap_bits is not None:
            values = _decode_twos_complement(values, self.wrap_bits, f'{source}: column "{self.column}"')
        with np.errstate(over="ignore", invalid="ignore"):
            for step in (self.scale, factor(unit, si_unit(unit))):
                if step != 1.0:
                    values *= step
                if step is self.scale and self.offset:
                    values += self.offset
        if np.any(np.isinf(values)):  # none of a file's numbers is
            raise LogError(
                f'{source}: column "{self.column}": its scale, offset or unit makes a number infinite; correct it'
            )
        return values

    def describe_conversion(self, unit: str) -> str:
        """Return in words what `to_si` does."""
        steps = [f"two's complement of {self.wrap_bits} bits"] if self.wrap_bits is not None else []
        steps += [f"times {self.scale:g}"] if self.scale != 1 else []
        steps += [f"plus {self.offset:g}"] if self.offset else []
        steps += [f"{unit} to {si_unit(unit)}"] if factor(unit, si_unit(unit)) != 1 else []
        return ", ".join(steps)


def spell_column(**keys: str | int) -> str:
    """Return how a column is given: by keys that are called alike in `Column` and in a file of settings."""
    return ", ".join(f"{name} = {json.dumps(value, ensure_ascii=False)}" for name, value in keys.items())


def suspect_wrap(values: VectorN, low: float, high: float) -> int | None:
    """Return the bits of an unsigned field that seems to hold small signed numbers, from `low` to `high`."""
    # Small numbers of either sign leave the middle half of the unsigned range empty.
    bits = next((bits for bits in (8, 16, 32) if 0.75 * 2**bits <= high < 2**bits and 0 <= low < 0.25 * 2**bits), None)
    if bits is None:
        return None
    small, large = values[values < 0.25 * 2**bits], values[values >= 0.75 * 2**bits]
    whole = np.all(small == np.floor(small)) and np.all(large == np.floor(large))
    apart = small.size + large.size == np.count_nonzero(~np.isnan(values))
    return bits if whole and apart and np.ptp(small) > 0 and np.ptp(large) > 0 else None


def _decode_twos_complement(values: VectorN, bits: int, where: str) -> VectorN:
    """Return two's complement of unsigned integers."""
    whole = 2.0**bits
    valid = np.isnan(values) | ((values >= 0) & (values < whole) & (values == np.floor(values)))
    if not np.all(valid):
        row = int(np.flatnonzero(~valid)[0])
        raise LogError(
            f"{where} is {values[row]:g} in sample {row + 1}, not an unsigned integer of {bits} bits; correct wrap_bits"
        )
    return np.where(values >= whole / 2, values - whole, values)
