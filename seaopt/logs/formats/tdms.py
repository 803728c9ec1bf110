"""TDMS files of LabVIEW (npTDMS): channels by "group/channel"; a waveform's start and increment are its clock."""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from seaopt.errors import LogError
from seaopt.logs.formats.source import Field, Source, check_size, import_optional, make_row_loader

UNIT_PROPERTIES = ("unit_string", "NI_UnitDescription")
LEAD_IN = 28  # bytes before each segment: tag, contents, version, where the next segment and this one's data begin
BIG_ENDIAN, DAQMX = 1 << 6, 1 << 7  # of the contents
CUT_OFF = "cannot be read as TDMS (it is cut off within its last segment, or damaged); copy it again, or save it anew"


def open_tdms(path: Path) -> Source:
    """List the channels of a TDMS file."""
    nptdms = import_optional("nptdms", "tdms", path, "TDMS")
    fields: list[Field] = []
    places: dict[str, tuple[str, str]] = {}
    size = _measure_segments(path)
    with path.open("rb") as stream, nptdms.TdmsFile.open(stream) as file:
        if file.file_status.incomplete_final_segment:
            raise LogError(f"{path}: {CUT_OFF}")
        _check_lengths(path, [channel for group in file.groups() for channel in group.channels()], size)
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


def _measure_segments(path: Path) -> int | None:
    """Return the bytes of data in all segments, None with DAQmx data; npTDMS drops a last segment that was cut off."""
    data, at, size, plain = 0, 0, path.stat().st_size, True
    with path.open("rb") as stream:
        while at < size:
            stream.seek(at)
            lead = stream.read(LEAD_IN)
            contents = int.from_bytes(lead[4:8], "little")
            if len(lead) < LEAD_IN or lead[:4] != b"TDSm":
                raise LogError(f"{path}: {CUT_OFF}")
            following, begin = struct.unpack(">QQ" if contents & BIG_ENDIAN else "<QQ", lead[12:])
            data, at = data + following - begin, at + LEAD_IN + following
            plain = plain and not contents & DAQMX
    if at != size:
        raise LogError(f"{path}: {CUT_OFF}")
    return data if plain else None


def _check_lengths(path: Path, channels: Sequence[Any], size: int | None) -> None:
    """Refuse channels that do not fill the segments: a damaged count would shift the samples of all that follow."""
    widths = [channel.data_type.size if channel.data_type else 0 for channel in channels]
    if size is None or None in widths:  # text has no fixed width
        return
    stated = sum(width * len(channel) for width, channel in zip(widths, channels, strict=True))
    if stated != size:
        raise LogError(
            f"{path}: its channels take {stated} bytes but its segments hold {size}, the file is damaged; copy it again"
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
