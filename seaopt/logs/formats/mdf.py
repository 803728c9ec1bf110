"""ASAM MDF 4 files (asammdf): the master of each group is its clock; formulas in the file are not evaluated.

The blocks are looked at before they are read (ASAM MDF 4.1, chapter 4). A block has a mark, its length, and links to
others. The header (HD) leads to data groups (DG), these to channel groups (CG), which count their records, and to data:
one block (DT), a list of them (DL), or compressed ones (DZ, zlib with its checksum). asammdf takes lengths and counts
as they come: one that does not fit would be read as other samples, or end the interpreter.
"""

from __future__ import annotations

import gc
import struct
import sys
import traceback
import zlib
from collections import Counter
from collections.abc import Generator, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import field
from functools import partial
from itertools import chain
from pathlib import Path
from typing import IO, Any

import numpy as np

from seaopt.errors import LogError
from seaopt.logs.formats.source import Field, Source, Window, check_size, import_optional, make_row_loader
from seaopt.records import record
from seaopt.signals import VectorN

NUMERIC_CONVERSIONS = frozenset({0, 1, 2, 4, 5, 6})  # conversions: none, linear, rational, tables of numbers
INTEGER_TYPES, FLOAT_TYPES = frozenset({0, 1, 2, 3}), frozenset({4, 5})
TIME_MASTER = 1
HEADER = "<4s4xQQ"  # mark, length, count of links
FIRST = 64  # where the header block is, behind the identification
MAX_BLOCKS = 1_000_000
VARIABLE_LENGTH = 1  # of the flags of a channel group: its records have none of fixed length
PACKED = "<2sBxIQQ"  # of a DZ: what was packed, how, a parameter, its length, the packed length
DEFLATE = (0, 1)  # plain, and transposed before
WHOLE = "the file is damaged; copy or record it again"
ChannelPlaces = Mapping[str, tuple[int, int]]


def open_mdf(path: Path) -> Source:
    """List the channels of an MDF 4 file; a name that several groups have carries the group's number."""
    fields: list[Field] = []
    places: dict[str, tuple[int, int]] = {}
    with _open_file(path, check=True) as file:
        groups = list(file.groups)
        check_size(path, sum(g.channel_group.cycles_nr * g.channel_group.samples_byte_nr for g in groups), "the file")
        names = Counter(channel.name for group in groups for channel in group.channels)
        for number, group in enumerate(groups):
            labels = [c.name if names[c.name] == 1 else f"{number}/{c.name}" for c in group.channels]
            master = file.masters_db.get(number)
            for index, (label, channel) in enumerate(zip(labels, group.channels, strict=True)):
                is_time = index == master and channel.sync_type == TIME_MASTER
                places[label] = (number, index)
                field = Field(
                    name=label,
                    kind=_name_kind(channel),
                    length=int(group.channel_group.cycles_nr),
                    unit=channel.unit or getattr(channel.conversion, "unit", "") or ("s" if is_time else None),
                    clock=None if master is None else labels[master],
                )
                fields.append(field)
    return Source(path=path, format="MDF", fields=tuple(fields), load=partial(_load, path, places))


@contextmanager
def _open_file(path: Path, *, check: bool = False) -> Generator[Any]:
    """Open a file, of which the first opening looks at every block: asammdf takes lengths and counts as they come."""
    asammdf = import_optional("asammdf", "mdf", path, "MDF")
    with path.open("rb") as stream:
        if stream.read(68)[64:] != b"##HD":
            raise LogError(f"{path}: is not an MDF 4 file, or is cut off; convert an older one to MDF 4")
    if check:
        check_blocks(path)
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


def _name_kind(channel: Any) -> str:
    conversion = channel.conversion
    if conversion is not None and conversion.conversion_type not in NUMERIC_CONVERSIONS:
        return "text, or a formula"
    if channel.data_type in FLOAT_TYPES:
        return f"float{channel.bit_count}"
    if channel.data_type in INTEGER_TYPES:
        return f"{'int' if channel.data_type > 1 else 'uint'}{channel.bit_count}"
    return "text"


def _load(path: Path, places: ChannelPlaces, names: Sequence[str], window: Window | None) -> dict[str, VectorN]:
    with _open_file(path) as file:

        def load_column(name: str, rows: slice) -> VectorN:
            group, index = places[name]
            start = rows.start or 0
            count = None if rows.stop is None else rows.stop - start
            if count == 0:  # asammdf would read them all
                return np.empty(0)
            samples, invalid = file.get(
                group=group,
                index=index,
                record_offset=start,
                record_count=count,
                samples_only=True,
                ignore_invalidation_bits=False,
            )
            values = np.array(samples, dtype=float)
            if invalid is not None:
                values[np.asarray(invalid, dtype=bool)] = np.nan
            return values

        return make_row_loader(load_column)(names, window)


@record
class MdfBlock:
    """One block: its mark, its links, and where its data lie."""

    mark: bytes
    links: tuple[int, ...]
    start: int
    end: int


def check_blocks(path: Path) -> None:
    """Refuse (LogError) a finished MDF file whose data groups hold other samples than their channel groups count, or of
    which a block lies outside the file, or does not unpack to what it says.
    """
    with path.open("rb") as stream:
        if stream.read(8) != b"MDF     ":  # one that its recorder did not finish has no counts yet
            return
        blocks = MdfBlocks(path=path, stream=stream, size=path.stat().st_size)
        for group in blocks.walk(blocks.read(FIRST).links[0]):
            counted, present = blocks.count_bytes(group), sum(blocks.measure_data(group.links[2]))
            if counted is not None and counted != present:
                raise LogError(f"{path}: its records take {counted} bytes and {present} are there, {WHOLE}")


@record(eq=False)
class MdfBlocks:
    """The blocks of an open file, each of which is read once: links that lead back are damage."""

    path: Path
    stream: IO[bytes]
    size: int
    visited: set[int] = field(default_factory=set[int])

    def take(self, at: int, form: str) -> tuple[Any, ...]:
        """Return the numbers that stand at a byte."""
        self.stream.seek(at)
        return struct.unpack(form, self.stream.read(struct.calcsize(form)))

    def read(self, at: int) -> MdfBlock:
        """Return the block that begins at a byte."""
        if at + struct.calcsize(HEADER) > self.size:
            raise LogError(f"{self.path}: a block is to begin at byte {at} of {self.size}, {WHOLE}")
        mark, length, count = self.take(at, HEADER)
        start = at + struct.calcsize(HEADER) + 8 * count
        if not mark.startswith(b"##") or at + length > self.size or start > at + length:
            raise LogError(f"{self.path}: the block at byte {at} is cut off or damaged; copy or record the file again")
        if at in self.visited or len(self.visited) > MAX_BLOCKS:
            raise LogError(f"{self.path}: its blocks lead back to byte {at}, {WHOLE}")
        self.visited.add(at)
        return MdfBlock(mark=mark[2:], links=self.take(start - 8 * count, f"<{count}Q"), start=start, end=at + length)

    def walk(self, at: int) -> Iterator[MdfBlock]:
        """Walk blocks of which each one's first link is the next."""
        while at:
            block = self.read(at)
            yield block
            at = block.links[0]

    def count_bytes(self, group: MdfBlock) -> int | None:
        """Return the bytes that the channel groups' records take; None where some have no fixed length."""
        (numbered,) = self.take(group.start, "<B")  # bytes of the number of its group before each record
        total, fixed = 0, True
        for channels in self.walk(group.links[1]):
            _, records, flags, _, data, invalid = self.take(channels.start, "<QQHH4xII")
            fixed = fixed and not flags & VARIABLE_LENGTH
            total += records * (numbered + data + invalid)
            self.check_channels(channels, data + invalid)
        return total if fixed else None

    def check_channels(self, group: MdfBlock, width: int) -> None:
        """Refuse channels that reach beyond their record, in which the reader would look elsewhere."""
        for channel in self.walk(group.links[1]):
            first_bit, first_byte, bits = self.take(channel.start, "<3xBII")
            if 8 * first_byte + first_bit + bits > 8 * width and bits < 1 << 31 and width:
                raise LogError(f"{self.path}: a channel lies outside its record of {width} bytes, {WHOLE}")

    def measure_data(self, at: int) -> Iterator[int]:
        """Walk the data of a group, and return the bytes of each block, unpacked."""
        if not at:
            return
        block = self.read(at)
        if block.mark == b"DZ":
            yield self.unpack(block)
        elif block.mark == b"HL":
            yield from self.measure_data(block.links[0])
        elif block.mark in (b"DL", b"LD"):
            for part in chain([block], self.walk(block.links[0])):
                flags, count = self.take(part.start, "<3xBI")
                invalid = part.mark == b"LD" and flags & 0x80
                for link in part.links[1 : 1 + count * (2 if invalid else 1)]:
                    yield from self.measure_data(link)
        else:
            yield block.end - block.start

    def unpack(self, block: MdfBlock) -> int:
        """Return the length of a compressed block unpacked, where that and its checksum are right."""
        _, how, columns, length, packed = self.take(block.start, PACKED)
        begin = block.start + struct.calcsize(PACKED)
        if begin + packed > block.end or (how == 1 and not 0 < columns <= length):
            raise LogError(f"{self.path}: a compressed block is cut off, {WHOLE}")
        check_size(self.path, length, "a block")
        if how in DEFLATE:
            unpacker = zlib.decompressobj()
            unpacked = len(unpacker.decompress(self.stream.read(packed), length + 1))
            if unpacked != length or not unpacker.eof or unpacker.unused_data:
                raise LogError(
                    f"{self.path}: a compressed block does not unpack to the {length} bytes that it says, {WHOLE}"
                )
        return length
