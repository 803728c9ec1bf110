"""ROS messages: numbers taken straight from the bytes by the definition that the recording carries.

A definition becomes a tree of nodes; a message is walked along it, and only the wanted leaves are decoded. No code is
made from a file. Encodings: ROS 1 serialisation (packed, little-endian), and CDR (OMG formal/02-06-51 §15.3), in which
every number is aligned to its own size after a header of four bytes.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping
from typing import Any

from seaopt.records import record

MAX_ELEMENTS = 256
DEPTH = 32
PAD = "structure_needs_at_least_one_member"
CDR_HEADER = 4
NUMBERS = {
    "bool": "?", "byte": "B", "char": "B", "octet": "B", "int8": "b", "uint8": "B", "int16": "h", "uint16": "H",
    "int32": "i", "uint32": "I", "int64": "q", "uint64": "Q", "float32": "f", "float64": "d",
}  # fmt: skip
TIMES = {"builtin_interfaces/msg/Time": "Ii", "builtin_interfaces/msg/Duration": "ii"}


@record
class Number:
    """A number of fixed size."""

    kind: str
    code: str
    size: int


@record
class Stamp:
    """Seconds and nanoseconds, decoded as whole nanoseconds."""


@record
class Text:
    """A string."""


@record
class Many:
    """An array; `count` is None where each message says its own."""

    child: Node
    count: int | None


@record
class Struct:
    """Named parts, in order."""

    parts: tuple[tuple[str, Node], ...]


Node = Number | Stamp | Text | Many | Struct
Wanted = Mapping[str | int, Any]


def tree(name: str, types: Mapping[str, Any], depth: int = 0) -> Node:
    """Return the tree of a message type, from rosbags' parsed definitions."""
    if name in TIMES:
        return Stamp()
    if depth > DEPTH or name not in types:
        raise ValueError(f"message type {name} is not defined in the file")
    parts = tuple((part, _node(found, types, depth + 1)) for part, found in types[name][1])
    # A struct without members takes a byte in CDR.
    return Struct(parts=parts or ((PAD, Number(kind="uint8", code="B", size=1)),))


def _node(found: Any, types: Mapping[str, Any], depth: int) -> Node:
    kind, detail = int(found[0]), found[1]
    if kind == 1:  # a base type
        if detail[0] in ("string", "wstring"):
            return Text()
        if detail[0] not in NUMBERS:
            raise ValueError(f"numbers of type {detail[0]} are not read")
        code = NUMBERS[detail[0]]
        number = detail[0] if detail[0].rstrip("0123456789") in ("int", "uint", "float", "bool") else "uint8"
        return Number(kind=number, code=code, size=struct.calcsize("=" + code))
    if kind == 2:
        return tree(detail, types, depth)
    return Many(child=_node(detail[0], types, depth), count=detail[1] if kind == 3 else None)


@record
class Wire:
    """How a message lies in its bytes."""

    cdr: bool
    order: str = "<"

    @classmethod
    def of(cls, data: bytes, encoding: str) -> Wire:
        """Return the encoding of a message.

        Raises
        ------
        ValueError
            It is CDR of a kind that ROS does not write.

        """
        if encoding == "ros1":
            return cls(cdr=False)
        if len(data) < CDR_HEADER or data[0] != 0 or data[1] not in (0, 1):
            raise ValueError("a message is not plain CDR")
        return cls(cdr=True, order="<" if data[1] else ">")

    @property
    def start(self) -> int:
        """First byte of the first field."""
        return CDR_HEADER if self.cdr else 0

    def aligned(self, at: int, size: int) -> int:
        """Return where a number of this size begins at or after `at`."""
        return at + (CDR_HEADER - at) % size if self.cdr else at


def leaves(node: Node, data: bytes, encoding: str) -> list[tuple[str, str]]:
    """Return path and kind of everything in one message; arrays are as long as there."""
    found: list[tuple[str, str]] = []
    wire = Wire.of(data, encoding)
    _describe(node, wire, data, wire.start, "", found)
    return found


def values(node: Node, data: bytes, encoding: str, wanted: Wanted) -> dict[str, float | int]:
    """Return the wanted leaves of one message by the name that `wanted` gives them; an absent element is left out."""
    out: dict[str, float | int] = {}
    wire = Wire.of(data, encoding)
    _take(node, wire, data, wire.start, wanted, out)
    return out


def wanted_tree(paths: Mapping[str, str]) -> dict[str | int, Any]:
    """Return paths such as "a.b[2].c", with what to call them, as nested keys.

    Examples
    --------
    >>> wanted_tree({"a.b[2]": "x", "a.c": "y"})
    {'a': {'b': {2: 'x'}, 'c': 'y'}}

    """
    root: dict[str | int, Any] = {}
    for path, name in paths.items():
        keys = list(_keys(path))
        branch = root
        for key in keys[:-1]:
            branch = branch.setdefault(key, {})
        branch[keys[-1]] = name
    return root


def _keys(path: str) -> Iterator[str | int]:
    for part in path.split("."):
        name, *indices = part.split("[")
        if name:
            yield name
        yield from (int(index.rstrip("]")) for index in indices)


def _count(node: Many, wire: Wire, data: bytes, at: int) -> tuple[int, int]:
    """Return the length of an array and where its elements begin."""
    if node.count is not None:
        return node.count, at
    at = wire.aligned(at, 4)
    count = struct.unpack_from(wire.order + "I", data, at)[0]
    if count > len(data):  # an element has at least a byte
        raise ValueError("a message claims more elements than it holds")
    return count, at + 4


def _skip_text(wire: Wire, data: bytes, at: int) -> int:
    at = wire.aligned(at, 4)
    return at + 4 + struct.unpack_from(wire.order + "I", data, at)[0]


def _describe(node: Node, wire: Wire, data: bytes, at: int, path: str, found: list[tuple[str, str]]) -> int:
    if isinstance(node, Struct):
        for name, part in node.parts:
            if name != PAD or wire.cdr:
                at = _describe(part, wire, data, at, f"{path}.{name}" if path else name, found)
        return at
    if isinstance(node, Many):
        count, at = _count(node, wire, data, at)
        for index in range(count):
            # Beyond the limit elements are walked, and not listed.
            listed = found if index < MAX_ELEMENTS else []
            at = _describe(node.child, wire, data, at, f"{path}[{index}]", listed)
        return at
    kind = "float64" if isinstance(node, Stamp) else "text" if isinstance(node, Text) else node.kind
    found.append((path, kind))
    return _take(node, wire, data, at, None, {})


def _take(
    node: Node, wire: Wire, data: bytes, at: int, wanted: Wanted | str | None, out: dict[str, float | int]
) -> int:
    """Walk one node, decode what is wanted, and return where the next begins."""
    if isinstance(node, Number):
        at = wire.aligned(at, node.size)
        if isinstance(wanted, str):
            out[wanted] = struct.unpack_from(wire.order + node.code, data, at)[0]
        return at + node.size
    if isinstance(node, Stamp):
        at = wire.aligned(at, 4)
        if isinstance(wanted, str):
            seconds, rest = struct.unpack_from(wire.order + "iI", data, at)
            out[wanted] = seconds * 1_000_000_000 + rest
        return at + 8
    if isinstance(node, Text):
        return _skip_text(wire, data, at)
    branches: Wanted = wanted if isinstance(wanted, Mapping) else {}
    if isinstance(node, Struct):
        for name, part in node.parts:
            if name != PAD or wire.cdr:
                at = _take(part, wire, data, at, branches.get(name), out)
        return at
    count, at = _count(node, wire, data, at)
    if isinstance(node.child, Number) and count:
        at = wire.aligned(at, node.child.size)
        for index, name in branches.items():
            if isinstance(index, int) and index < count and isinstance(name, str):
                place = at + index * node.child.size
                out[name] = struct.unpack_from(wire.order + node.child.code, data, place)[0]
        return at + count * node.child.size
    for index in range(count):
        at = _take(node.child, wire, data, at, branches.get(index), out)
    return at
