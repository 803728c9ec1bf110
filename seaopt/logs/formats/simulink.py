"""Simulink's and Speedgoat's logs in MAT files: a struct with its own time, as To Workspace and timeseries save it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from seaopt.logs.formats.source import Field

OBJECT = "a MATLAB object"
# Last parts of the path of a clock, and of what it times, under one struct.
_PAIRS = (("time", ("signals",)), ("Time", ("Data",)))


def assign_clocks(fields: Sequence[Field]) -> list[Field]:
    """Give the signals of "structure with time" and of a timeseries saved as a struct their clock, in seconds."""
    lengths = {field.name: field.length for field in fields}
    timed: list[Field] = []
    for field in fields:
        alike = (name for name in _clock_names(field.name) if lengths.get(name) == field.length)
        clock = next(alike, None)
        if clock is None or field.length is None or not field.numeric:
            timed.append(field)
        else:
            timed.append(replace(field, clock=clock, unit="s" if field.name == clock else field.unit))
    clocks = {field.clock for field in timed if field.clock not in (None, field.name)}
    return [field if field.clock in clocks else old for field, old in zip(timed, fields, strict=True)]


def make_object_field(name: str, owner: str) -> Field:
    """Return the field of a MATLAB object, which only MATLAB decodes; a timeseries is saved as a struct there."""
    code = f"s.time = {name}.Time; s.signals.values = {name}.Data; save('log.mat', 's', '-v7')"
    remedy = f"only MATLAB decodes it; save a timeseries there by {code}"
    return Field(name=name, kind=f"{OBJECT} ({owner})" if owner else OBJECT, length=None, remedy=remedy)


def _clock_names(name: str) -> list[str]:
    """Return the names that a field's clock would have."""
    clocks: list[str] = []
    pieces = name.split(".")
    for depth in range(1, len(pieces)):
        struct, key = ".".join(pieces[:depth]), pieces[depth].split("(")[0]
        for clock, values in _PAIRS:
            if (key == clock and depth == len(pieces) - 1) or key in values:
                clocks.append(f"{struct}.{clock}")
    return clocks
