"""Simulink's and Speedgoat's logs in MAT files: a struct with its own time, as To Workspace and timeseries save it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from seaopt.logs.formats.source import Field

# Last parts of the path of a clock, and of what it times, under one struct.
OBJECT = "a MATLAB object"
_PAIRS = (("time", ("signals",)), ("Time", ("Data",)))


def clocked(fields: Sequence[Field]) -> list[Field]:
    """Give the signals of "structure with time" and of a timeseries saved as a struct their clock, in seconds.

    Examples
    --------
    >>> names = ("out.time", "out.signals.values")
    >>> fields = clocked([Field(name=name, kind="float64", length=9) for name in names])
    >>> [(field.name, field.clock, field.unit) for field in fields]
    [('out.time', 'out.time', 's'), ('out.signals.values', 'out.time', None)]

    """
    lengths = {field.name: field.length for field in fields}
    out: list[Field] = []
    for field in fields:
        clock = next((found for found in _clocks(field.name) if _times(lengths, found, field)), None)
        if clock is None:
            out.append(field)
        else:
            out.append(replace(field, clock=clock, unit="s" if field.name == clock else field.unit))
    timed = {field.clock for field in out if field.clock not in (None, field.name)}
    return [field if field.clock in timed else old for field, old in zip(out, fields, strict=True)]


def opaque(name: str, owner: str) -> Field:
    """Return the field of a MATLAB object, which only MATLAB decodes; a timeseries is saved as a struct there."""
    code = f"s.time = {name}.Time; s.signals.values = {name}.Data; save('log.mat', 's', '-v7')"
    remedy = f"only MATLAB decodes it; save a timeseries there by {code}"
    return Field(name=name, kind=f"{OBJECT} ({owner})" if owner else OBJECT, length=None, remedy=remedy)


def _clocks(name: str) -> list[str]:
    """Return the names that a field's clock would have."""
    found: list[str] = []
    pieces = name.split(".")
    for depth in range(1, len(pieces)):
        struct, key = ".".join(pieces[:depth]), pieces[depth].split("(")[0]
        for clock, timed in _PAIRS:
            if (key == clock and depth == len(pieces) - 1) or key in timed:
                found.append(f"{struct}.{clock}")
    return found


def _times(lengths: dict[str, int | None], clock: str, field: Field) -> bool:
    return lengths.get(clock) is not None and lengths[clock] == field.length and field.numeric
