"""TDMS files of LabVIEW (npTDMS): channels by "group/channel"; a waveform's start and increment are its clock."""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from seaopt.errors import LogError
from seaopt.logs.formats.source import Field, Source, check_size, import_optional, open_columns

UNIT_PROPERTIES = ("unit_string", "NI_UnitDescription")
LEAD_IN = 28  # bytes before each segment: tag, contents, version, where the next segment and this one's data begin
BIG_ENDIAN, DAQMX = 1 << 6, 1 << 7  # of the contents
ChannelPlace = tuple[str, str, bool]  # group, channel, and whether its clock is meant
CUT_OFF = "cannot be read as TDMS (it is cut off within its last segment, or damaged); copy it again, or save it anew"


def open_tdms(path: Path) -> Source:
    """List the channels of a TDMS file."""
    nptdms = import_optional("nptdms", "tdms", path, "TDMS")
    size = _measure_segments(path)
    with path.open("rb") as stream, nptdms.TdmsFile.open(stream) as file:
        if file.file_status.incomplete_final_segment:
            raise LogError(f"{path}: {CUT_OFF}")
        _check_lengths(path, [channel for group in file.groups() for channel in group.channels()], size)
        return open_columns(path, "TDMS", _walk_columns(file), partial(_load, path))


def _walk_columns(file: Any) -> Iterator[tuple[Field, ChannelPlace]]:
    listed: set[str] = set()
    for group in file.groups():
        clocks = _name_clocks(group)
        for channel in group.channels():
            length, clock = len(channel), clocks.get(channel.name)
            if clock is not None and clock not in listed:
                listed.add(clock)
                field = Field(name=clock, kind="float64", length=length, unit="s", clock=clock)
                yield field, (group.name, channel.name, True)
            unit = next((str(channel.properties[key]) for key in UNIT_PROPERTIES if channel.properties.get(key)), None)
            dtype = np.dtype(channel.dtype)
            kind = dtype.name if dtype.kind in "fiub" else "times" if dtype.kind == "M" else "text"
            field = Field(name=f"{group.name}/{channel.name}", kind=kind, length=length, unit=unit, clock=clock)
            yield field, (group.name, channel.name, False)


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


def _load(path: Path, location: ChannelPlace, rows: slice) -> Any:
    nptdms = import_optional("nptdms", "tdms", path, "TDMS")
    group, name, is_clock = location
    with path.open("rb") as stream, nptdms.TdmsFile.open(stream) as file:
        channel = file[group][name]
        check_size(path, len(channel) * 8, f'"{group}/{name}"')
        if is_clock:
            return channel.time_track()[rows]
        start, stop, _ = rows.indices(len(channel))
        return channel.read_data(offset=start, length=max(stop - start, 0))
