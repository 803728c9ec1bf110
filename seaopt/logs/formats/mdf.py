"""ASAM MDF 4 files (asammdf): the master of each group is its clock; formulas in the file are not evaluated."""

from __future__ import annotations

import gc
import sys
import traceback
from collections import Counter
from collections.abc import Generator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from seaopt.errors import LogError
from seaopt.logs.formats.source import Field, Source, Window, check_size, find_rows, import_optional

NUMERIC_CONVERSIONS = frozenset({0, 1, 2, 4, 5, 6})  # conversions: none, linear, rational, tables of numbers
INTEGER_TYPES, FLOAT_TYPES = frozenset({0, 1, 2, 3}), frozenset({4, 5})
TIME_MASTER = 1
ChannelPlaces = Mapping[str, tuple[int, int]]


def open_mdf(path: Path) -> Source:
    """List the channels of an MDF 4 file; a name that several groups have carries the group's number."""
    fields: list[Field] = []
    places: dict[str, tuple[int, int]] = {}
    with _open_file(path) as file:
        groups = list(file.groups)
        check_size(path, sum(g.channel_group.cycles_nr * g.channel_group.samples_byte_nr for g in groups), "the file")
        names = Counter(channel.name for group in groups for channel in group.channels)
        for number, group in enumerate(groups):
            labels = [_name_channel(channel.name, number, names) for channel in group.channels]
            master = file.masters_db.get(number)
            for index, (label, channel) in enumerate(zip(labels, group.channels, strict=True)):
                is_master = index == master
                fields.append(
                    Field(
                        name=label, kind=_name_kind(channel), length=int(group.channel_group.cycles_nr),
                        unit=_find_unit(channel) or ("s" if is_master and channel.sync_type == TIME_MASTER else None),
                        clock=None if master is None else labels[master],
                    )
                )  # fmt: skip
                places[label] = (number, index)
    return Source(path=path, format="MDF", fields=tuple(fields), load=partial(_load, path, places))


@contextmanager
def _open_file(path: Path) -> Generator[Any]:
    asammdf = import_optional("asammdf", "mdf", path, "MDF")
    with path.open("rb") as stream:
        if stream.read(68)[64:] != b"##HD":
            raise LogError(f"{path}: is not an MDF 4 file, or is cut off; convert an older one to MDF 4")
    hook = sys.unraisablehook
    try:
        with path.open("rb") as stream, asammdf.MDF(stream) as file:
            yield file
    except Exception as error:
        # What asammdf has half opened complains as it goes: it has to go here.
        sys.unraisablehook = lambda _: None
        while error is not None:
            traceback.clear_frames(error.__traceback__)
            error = error.__context__
        gc.collect()
        raise
    finally:
        sys.unraisablehook = hook


def _name_channel(name: str, group: int, names: Mapping[str, int]) -> str:
    return name if names[name] == 1 else f"{group}/{name}"


def _name_kind(channel: Any) -> str:
    conversion = channel.conversion
    if conversion is not None and conversion.conversion_type not in NUMERIC_CONVERSIONS:
        return "text, or a formula"
    if channel.data_type in FLOAT_TYPES:
        return f"float{channel.bit_count}"
    if channel.data_type in INTEGER_TYPES:
        return f"{'int' if channel.data_type > 1 else 'uint'}{channel.bit_count}"
    return "text"


def _find_unit(channel: Any) -> str | None:
    conversion = channel.conversion
    return channel.unit or (conversion.unit if conversion is not None else "") or None


def _load(
    path: Path, places: ChannelPlaces, names: Sequence[str], window: Window | None
) -> dict[str, Float[np.ndarray, " n"]]:
    with _open_file(path) as file:

        def load_column(name: str, rows: slice) -> Float[np.ndarray, " n"]:
            group, index = places[name]
            start = rows.start or 0
            count = None if rows.stop is None else rows.stop - start
            samples, invalid = file.get(
                group=group, index=index, record_offset=start, record_count=count, samples_only=True,
                ignore_invalidation_bits=False,
            )  # fmt: skip
            values = np.array(samples, dtype=float).reshape(-1)
            if invalid is not None:
                values[np.asarray(invalid, dtype=bool)] = np.nan
            return values

        rows = slice(None) if window is None else find_rows(load_column(window.clock, slice(None)), window)
        if rows.stop is not None and rows.stop <= (rows.start or 0):
            return {name: np.empty(0) for name in names}
        return {name: load_column(name, rows) for name in names}
