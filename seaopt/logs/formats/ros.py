"""ROS recordings: ROS 1 bags, ROS 2 db3 and MCAP; each topic is a clock, its numbers are topic.field paths.

The clock of a topic is the time of reception; stamps inside the messages are columns of their own. Both count seconds
from the start of the recording, which the notes name.
"""

from __future__ import annotations

import bz2
import json
import struct
import zlib
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import replace
from datetime import UTC, datetime
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from seaopt.errors import LogError
from seaopt.logs.formats.json import flatten, name_kind
from seaopt.logs.formats.messages import Node, build_tree, build_wanted_tree, list_leaves, take_values
from seaopt.logs.formats.source import Field, Source, Window, import_optional, summarise_error
from seaopt.records import record
from seaopt.signals import VectorN

MAX_CHUNK = 1 << 30  # bytes
MCAP_MAGIC = b"\x89MCAP0\r\n"
MCAP_FOOTER = struct.Struct("<BQQQI")  # kind, length, begin of the summary and of its index, checksum
MCAP_DATA_END = struct.Struct("<BQI")  # kind, length, checksum
UNIX_STAMP_NS = 1_000_000_000 * 1_000_000_000  # stamps after 2001 count from 1970; earlier ones are a simulation's
ENCODINGS = ("cdr", "ros1", "json")
SYNTAXES = {"ros2msg": "msg", "ros1msg": "msg", "ros2idl": "idl", "omgidl": "idl"}  # of definitions in MCAP


@record
class Topic:
    """One stream of messages."""

    name: str
    kind: str
    count: int
    encoding: str
    definition: str
    syntax: str  # "msg", "idl", or "" where the recording has no definition


@record
class Bag:
    """An open recording: `messages` gives time in ns and bytes, of one topic, from start to stop (ns)."""

    start: int
    topics: Mapping[str, Topic]
    messages: Callable[[str, int | None, int | None], Iterator[tuple[int, bytes]]]


BagOpener = Callable[[Path], AbstractContextManager[Bag]]


def _list_recording(path: Path, form: str, open_file: BagOpener) -> Source:
    """List the topics of a recording, and what their first messages hold."""
    import_optional("rosbags", "ros", path, form)
    fields: list[Field] = []
    notes: list[str] = []
    nodes: dict[str, Node | None] = {}
    with open_file(path) as bag:
        for topic in bag.topics.values():
            fields.append(Field(name=topic.name, kind="float64", length=topic.count, unit="s", clock=topic.name))
            try:
                nodes[topic.name] = _decode_definition(topic)
                fields += _list_fields(bag, topic, nodes[topic.name])
            except Exception as error:  # one odd definition leaves the other topics readable
                notes.append(f"{topic.name}: {topic.kind} cannot be decoded ({summarise_error(error)})")
        count = sum(topic.count for topic in bag.topics.values())
        began = datetime.fromtimestamp(bag.start * 1e-9, UTC).isoformat(timespec="microseconds") if count else "nothing"
    notes.insert(0, f"{count} messages; times count from {began} ({bag.start} ns)")
    return Source(
        path=path, format=form, fields=tuple(fields), load=partial(_load, path, open_file, nodes), notes=tuple(notes)
    )


def _decode_definition(topic: Topic) -> Node | None:
    """Return how a topic's messages are built; None where they carry their own names (JSON)."""
    from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore

    if topic.encoding == "json":
        return None
    if topic.encoding not in ENCODINGS:
        raise ValueError(f"its encoding is {topic.encoding or 'not given'}")
    if topic.syntax == "idl":
        types: Any = {}
        for part in topic.definition.split("=" * 80 + "\n"):
            types |= get_types_from_idl(part.split("\n", 1)[1] if part.startswith("IDL: ") else part)
    elif topic.syntax == "msg":
        types = get_types_from_msg(topic.definition, topic.kind)
    else:  # ROS 2 up to Humble stores no definitions in db3; the standard messages are known
        types = get_typestore(Stores.LATEST).fielddefs
    return build_tree(topic.kind, types)


def _list_fields(bag: Bag, topic: Topic, node: Node | None) -> list[Field]:
    """Return the fields of a topic, as long as its first message has them."""
    first = next(bag.messages(topic.name, None, None), None)
    if first is None:
        return []
    if node is None:
        leaves = [(name, name_kind(value)) for name, value in flatten(json.loads(first[1]))]
    else:
        leaves = list_leaves(node, first[1], topic.encoding)
    return [
        Field(name=f"{topic.name}.{path}", kind=word, length=topic.count, unit=_find_unit(path), clock=topic.name)
        for path, word in leaves
    ]


def _find_unit(path: str) -> str | None:
    return "s" if path.split(".")[-1] == "stamp" else None


def _load(
    path: Path, open_file: BagOpener, nodes: Mapping[str, Node | None], names: Sequence[str], window: Window | None
) -> dict[str, VectorN]:
    with open_file(path) as bag:
        topic = next(
            topic
            for topic in bag.topics.values()
            if all(name == topic.name or name.startswith(f"{topic.name}.") for name in names)
        )
        paths = {name.removeprefix(f"{topic.name}."): name for name in names if name != topic.name}
        span = _window_ns(bag, window) if window is not None and window.clock == topic.name else (None, None)
        take = _make_taker(topic, nodes[topic.name], paths) if paths else None
        times: list[int] = []
        rows: list[Mapping[str, float | int]] = []
        for time, data in bag.messages(topic.name, *span):
            times.append(time - bag.start)
            if take is not None:
                rows.append(take(data))
    if span == (None, None) and len(times) != topic.count:
        raise LogError(
            f"{path}: {topic.name} counts {topic.count} messages and holds {len(times)}, the file is damaged; "
            "copy or record it again"
        )
    out: dict[str, VectorN] = {}
    for name in paths.values():
        if _find_unit(name) == "s":  # of stamps from 1970 on, count from the start of the recording
            stamps = np.array([int(row[name]) for row in rows], dtype=np.int64)
            out[name] = np.where(stamps > UNIX_STAMP_NS, stamps - bag.start, stamps) * 1e-9
        else:
            out[name] = np.array([row.get(name, np.nan) for row in rows], dtype=float)
    if topic.name in names:
        out[topic.name] = np.array(times, dtype=np.int64) * 1e-9
    return out


def _window_ns(bag: Bag, window: Window) -> tuple[int | None, int | None]:
    edges = (window.start, window.stop)
    start, stop = (None if np.isinf(edge) else bag.start + int(edge * 1e9) for edge in edges)
    return None if start is None else max(start - 1, 0), None if stop is None else max(stop + 2, 0)


def _make_taker(
    topic: Topic, node: Node | None, paths: Mapping[str, str]
) -> Callable[[bytes], Mapping[str, float | int]]:
    if node is not None:
        wanted = build_wanted_tree(paths)
        return lambda data: take_values(node, data, topic.encoding, wanted)

    def from_json(data: bytes) -> Mapping[str, float | int]:
        record = dict(flatten(json.loads(data)))
        return {name: record[path] for path, name in paths.items() if isinstance(record.get(path), int | float)}

    return from_json


@contextmanager
def _open_bag_file(path: Path) -> Generator[Bag]:
    from rosbags.rosbag1 import Reader

    with Reader(path) as reader:
        reader.chunks = {at: chunk._replace(decompressor=_limit_size(chunk)) for at, chunk in reader.chunks.items()}
        yield _wrap_rosbags(reader, reader.start_time if reader.message_count else 0, "ros1")


@contextmanager
def _open_db3_file(path: Path) -> Generator[Bag]:
    from rosbags.rosbag2.storage_sqlite3 import Sqlite3Reader

    _check_pages(path)
    reader: Any = Sqlite3Reader(path.absolute())
    reader.open()
    try:
        # A page that is damaged leaves rows out, or in another order than their index has.
        ((verdict,),) = reader.dbconn.cursor().execute("PRAGMA integrity_check(1)")
        if verdict != "ok":
            raise LogError(f"{path}: its pages contradict each other, the file is damaged; copy or record it again")
        meta = reader.metadata
        yield _wrap_rosbags(reader, meta.start_time if meta.message_count else 0, "cdr")
    finally:
        reader.close()


def _check_pages(path: Path) -> None:
    """Refuse a cut database, whose last messages SQLite would leave out without a word."""
    with path.open("rb") as stream:
        head = stream.read(100)
    page = int.from_bytes(head[16:18], "big")
    whole = (1 << 16 if page == 1 else page) * int.from_bytes(head[28:32], "big")
    if path.stat().st_size < max(whole, 100):
        raise LogError(f"{path}: is cut off, {path.stat().st_size} of {whole} bytes are there; copy or record it again")


def _wrap_rosbags(reader: Any, start: int, encoding: str) -> Bag:
    """Return rosbags' reader as a Bag."""
    topics = [
        Topic(
            name=connection.topic,
            kind=connection.msgtype,
            encoding=getattr(connection.ext, "serialization_format", encoding) or encoding,
            definition=connection.msgdef.data,
            count=connection.msgcount,
            syntax=connection.msgdef.format.name.lower().replace("none", ""),
        )
        for connection in reader.connections
    ]

    def messages(topic: str, start: int | None, stop: int | None) -> Iterator[tuple[int, bytes]]:
        chosen = [connection for connection in reader.connections if connection.topic == topic]
        for _, time, data in reader.messages(chosen, start, stop):
            yield time, bytes(data)

    return Bag(start=start, topics=_join_publishers(topics), messages=messages)


def _join_publishers(publishers: Iterable[Topic]) -> dict[str, Topic]:
    """Return each topic once, with the messages of all that publish it."""
    topics: dict[str, Topic] = {}
    for topic in publishers:
        earlier = topics.get(topic.name)
        if earlier is not None and earlier.kind != topic.kind:
            raise ValueError(
                f"topic {topic.name} carries {earlier.kind} and {topic.kind}; record them on topics of their own"
            )
        topics[topic.name] = replace(topic, count=topic.count + (earlier.count if earlier else 0))
    return topics


def _limit_size(chunk: Any) -> Callable[[bytes], bytes]:
    """Return the chunk's own decompressor, stopped at the limit."""

    def unpack(data: bytes) -> bytes:
        if data.startswith(b"BZh"):
            stream: Any = bz2.BZ2Decompressor()
        elif data.startswith(b"\x04\x22\x4d\x18"):
            import lz4.frame

            stream = lz4.frame.LZ4FrameDecompressor()
        else:
            return chunk.decompressor(data)
        out = stream.decompress(data, MAX_CHUNK)
        if not stream.eof:
            raise ValueError(f"a chunk unpacks to more than {MAX_CHUNK >> 20} MiB, or is cut off")
        return out

    return unpack


@contextmanager
def _open_mcap_file(path: Path) -> Generator[Bag]:
    reading = import_optional("mcap.reader", "ros", path, "MCAP")
    begin = _check_mcap_summary(path)
    check_data = cache(partial(_check_mcap_data, path, begin))  # of all messages, once they are read
    with path.open("rb") as stream:
        reader = reading.make_reader(stream, validate_crcs=True)
        summary = reader.get_summary()
        if summary is None or summary.statistics is None:
            raise LogError(f"{path}: has no summary, its recorder did not end in order; run mcap recover on it")
        if any(chunk.uncompressed_size > MAX_CHUNK for chunk in summary.chunk_indexes):
            raise LogError(f"{path}: a chunk unpacks to more than {MAX_CHUNK >> 20} MiB; is it damaged?")
        statistics, topics = summary.statistics, list[Topic]()
        for channel in summary.channels.values():
            schema = summary.schemas.get(channel.schema_id)
            name = schema.name if schema else ""
            topic = Topic(
                name=channel.topic,
                kind=name.replace("/", "/msg/") if name.count("/") == 1 else name,  # as rosbags writes it
                count=statistics.channel_message_counts.get(channel.id, 0),
                encoding=channel.message_encoding,
                definition=schema.data.decode(errors="replace") if schema else "",
                syntax=SYNTAXES.get(schema.encoding, "") if schema else "",
            )
            topics.append(topic)

        def messages(topic: str, start: int | None, stop: int | None) -> Iterator[tuple[int, bytes]]:
            check_data()
            for _, _, message in reader.iter_messages([topic], starting_at=start, ending_before=stop):
                yield message.log_time, message.data

        start = statistics.message_start_time if statistics.message_count else 0
        yield Bag(start=start, topics=_join_publishers(topics), messages=messages)


def _check_mcap_summary(path: Path) -> int:
    """Return where the summary begins, refusing one that its checksum is not of: the library checks chunks alone."""
    start, checksum = _read_mcap_footer(path)
    with path.open("rb") as stream:
        stream.seek(start)
        summary = stream.read()[: -len(MCAP_MAGIC) - 4]
    if checksum and zlib.crc32(summary) != checksum:
        raise LogError(f"{path}: its summary does not have its checksum, the file is damaged; copy or record it again")
    return start


def _check_mcap_data(path: Path, summary: int) -> None:
    """Refuse messages that are not those that the checksum of all of them is of, where the recorder wrote one."""
    end = summary - MCAP_DATA_END.size
    with path.open("rb") as stream:
        stream.seek(max(end, 0))
        code, size, checksum = MCAP_DATA_END.unpack(stream.read(MCAP_DATA_END.size))
        if (code, size) != (0x0F, 4):
            raise LogError(f"{path}: its data do not end before its summary, the file is damaged; record it again")
        stream.seek(0)
        computed, left = 0, end if checksum else 0
        while left > 0:
            part = stream.read(min(left, 1 << 22))
            computed, left = zlib.crc32(part, computed), left - len(part)
    if checksum and computed != checksum:
        raise LogError(f"{path}: its messages do not have their checksum, the file is damaged; copy or record it again")


def _read_mcap_footer(path: Path) -> tuple[int, int]:
    """Return where the summary begins, and its checksum (0: none)."""
    with path.open("rb") as stream:
        size = stream.seek(0, 2)
        stream.seek(max(size - MCAP_FOOTER.size - len(MCAP_MAGIC), 0))
        tail = stream.read()
    if not tail.endswith(MCAP_MAGIC) or len(tail) < MCAP_FOOTER.size + len(MCAP_MAGIC):
        raise LogError(f"{path}: cannot be read as MCAP (it does not end as one does); it is cut off, run mcap recover")
    code, length, start, _, checksum = MCAP_FOOTER.unpack(tail[: MCAP_FOOTER.size])
    if (code, length) != (0x02, 20) or not 0 <= start <= size:
        raise LogError(f"{path}: cannot be read as MCAP (its last record is damaged); copy or record it again")
    if start == 0:
        raise LogError(f"{path}: has no summary, its recorder did not end in order; run mcap recover on it")
    return start, checksum


open_bag = partial(_list_recording, form="ROS 1 bag", open_file=_open_bag_file)
open_db3 = partial(_list_recording, form="ROS 2 db3", open_file=_open_db3_file)
open_mcap = partial(_list_recording, form="MCAP", open_file=_open_mcap_file)
