"""TDMS files of LabVIEW (npTDMS): channels by "group/channel"; a waveform's start and increment are its clock."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from seaopt.errors import LogError
from seaopt.logs.formats.source import Field, Source, check_size, import_optional, make_row_loader

UNIT_PROPERTIES = ("unit_string", "NI_UnitDescription")


def open_tdms(path: Path) -> Source:
    """List the channels of a TDMS file."""
    nptdms = import_optional("nptdms", "tdms", path, "TDMS")
    fields: list[Field] = []
    places: dict[str, tuple[str, str]] = {}
    with path.open("rb") as stream, nptdms.TdmsFile.open(stream) as file:
        if file.file_status.incomplete_final_segment:
            raise LogError(f"{path}: is cut off within its last segment; copy it again, or save what is left anew")
        for group in file.groups():
            clocks = _name_clocks(group)
            for channel in group.channels():
                name = f"{group.name}/{channel.name}"
                clock = clocks.get(channel.name)
                places[name] = (group.name, channel.name)
                if clock is not None and clock not in places:
                    places[clock] = (group.name, channel.name)
                    fields.append(Field(name=clock, kind="float64", length=len(channel), unit="s", clock=clock))
                unit = next(
                    (str(channel.properties[key]) for key in UNIT_PROPERTIES if channel.properties.get(key)), None
                )
                fields.append(Field(name=name, kind=_name_kind(channel), length=len(channel), unit=unit, clock=clock))
    clock_names = frozenset(field.clock for field in fields if field.clock is not None)
    return Source(
        path=path, format="TDMS", fields=tuple(fields), load=make_row_loader(partial(_load, path, places, clock_names))
    )


def _name_clocks(group: Any) -> dict[str, str]:
    """Return the clock's name of each waveform; those of one rate, start and length share it."""
    waves = {
        channel.name: (
            channel.properties["wf_increment"],
            channel.properties.get("wf_start_offset", 0.0),
            str(channel.properties.get("wf_start_time", "")),
            len(channel),
        )
        for channel in group.channels()
        if channel.properties.get("wf_increment") and len(channel)
    }
    if len(set(waves.values())) <= 1:
        return dict.fromkeys(waves, f"{group.name}:time")
    return {name: f"{group.name}/{name}:time" for name in waves}


def _name_kind(channel: Any) -> str:
    kind = np.dtype(channel.dtype).kind
    return np.dtype(channel.dtype).name if kind in "fiub" else "times" if kind == "M" else "text"


def _load(path: Path, places: Mapping[str, tuple[str, str]], clocks: frozenset[str], name: str, rows: slice) -> Any:
    nptdms = import_optional("nptdms", "tdms", path, "TDMS")
    group, channel_name = places[name]
    with path.open("rb") as stream, nptdms.TdmsFile.open(stream) as file:
        channel = file[group][channel_name]
        check_size(path, len(channel) * 8, f'"{name}"')
        if name in clocks:
            return channel.time_track()[rows]
        start, stop, _ = rows.indices(len(channel))
        return channel.read_data(offset=start, length=max(stop - start, 0))
