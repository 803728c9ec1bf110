"""ROS messages: numbers taken straight from the bytes by the definition that the recording carries.

A definition becomes a tree of nodes; a message is walked along it, and only the wanted leaves are decoded. No code is
made from a file. Encodings: ROS 1 serialisation (packed, little-endian), and CDR (OMG formal/02-06-51 §15.3), in which
every number is aligned to its own size after a header of four bytes.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Mapping
from typing import Any

from seaopt.logs.formats.source import MAX_DEPTH
from seaopt.records import record

MAX_ELEMENTS = 256
PAD = "structure_needs_at_least_one_member"
CDR_HEADER = 4
NUMBER_CODES = {
    "bool": "?", "byte": "B", "char": "B", "octet": "B", "int8": "b", "uint8": "B", "int16": "h", "uint16": "H",
    "int32": "i", "uint32": "I", "int64": "q", "uint64": "Q", "float32": "f", "float64": "d",
}  # fmt: skip
TIMES = ("builtin_interfaces/msg/Time", "builtin_interfaces/msg/Duration")


@record
class Leaf:
    """A number, a stamp of seconds and nanoseconds, or a text, of which the length alone is read."""

    kind: str
    code: str  # struct's
    size: int  # to which it is aligned
    width: int | None  # bytes; None of a text


@record
class ArrayNode:
    """An array; `count` is None where each message says its own."""

    child: Node
    count: int | None


@record
class StructNode:
    """Named parts, in order."""

    parts: tuple[tuple[str, Node], ...]


Node = Leaf | ArrayNode | StructNode
Wanted = Mapping[str | int, Any]
STAMP = Leaf(kind="float64", code="iI", size=4, width=8)
TEXT = Leaf(kind="text", code="I", size=4, width=None)


def build_tree(name: str, types: Mapping[str, Any], depth: int = 0) -> Node:
    """Return the tree of a message type, from rosbags' parsed definitions."""
    if name in TIMES:
        return STAMP
    if depth > MAX_DEPTH or name not in types:
        raise ValueError(f"message type {name} is not defined in the file")
    parts = [(part, _build_node(definition, types, depth + 1)) for part, definition in types[name][1]]
    return StructNode(parts=tuple(parts or [(PAD, _make_number("uint8"))]))  # in CDR an empty struct takes a byte


def _build_node(definition: Any, types: Mapping[str, Any], depth: int) -> Node:
    kind, detail = int(definition[0]), definition[1]
    if kind == 1:  # a base type
        return TEXT if detail[0] in ("string", "wstring") else _make_number(detail[0])
    if kind == 2:
        return build_tree(detail, types, depth)
    return ArrayNode(child=_build_node(detail[0], types, depth), count=detail[1] if kind == 3 else None)


def _make_number(name: str) -> Leaf:
    if name not in NUMBER_CODES:
        raise ValueError(f"numbers of type {name} are not read")
    size = struct.calcsize("=" + NUMBER_CODES[name])
    kind = "uint8" if name in ("byte", "char", "octet") else name
    return Leaf(kind=kind, code=NUMBER_CODES[name], size=size, width=size)


@record
class Wire:
    """How a message lies in its bytes."""

    cdr: bool
    order: str = "<"

    @classmethod
    def detect(cls, data: bytes, encoding: str) -> Wire:
        """Return the encoding of a message. Raises ValueError: it is CDR of a kind that ROS does not write."""
        if encoding == "ros1":
            return cls(cdr=False)
        if len(data) < CDR_HEADER or data[0] != 0 or data[1] not in (0, 1):
            raise ValueError("a message is not plain CDR")
        return cls(cdr=True, order="<" if data[1] else ">")

    @property
    def start(self) -> int:
        """First byte of the first field."""
        return CDR_HEADER if self.cdr else 0

    def align(self, at: int, size: int) -> int:
        """Return where a number of this size begins at or after `at`."""
        return at + (CDR_HEADER - at) % size if self.cdr else at


def list_leaves(node: Node, data: bytes, encoding: str) -> list[tuple[str, str]]:
    """Return path and kind of everything in one message; arrays are as long as there."""
    leaves: list[tuple[str, str]] = []
    wire = Wire.detect(data, encoding)
    _describe(node, wire, data, wire.start, "", leaves)
    return leaves


def take_values(node: Node, data: bytes, encoding: str, wanted: Wanted) -> dict[str, float | int]:
    """Return the wanted leaves of one message by the name that `wanted` gives them; an absent element is left out."""
    out: dict[str, float | int] = {}
    wire = Wire.detect(data, encoding)
    _take(node, wire, data, wire.start, wanted, out)
    return out


def build_wanted_tree(paths: Mapping[str, str]) -> dict[str | int, Any]:
    """Return paths such as "a.b[2].c", with what to call them, as nested keys."""
    root: dict[str | int, Any] = {}
    for path, name in paths.items():
        keys = [int(key) if key.isdecimal() else key for key in re.findall(r"[^.\[\]]+", path)]
        branch = root
        for key in keys[:-1]:
            branch = branch.setdefault(key, {})
        branch[keys[-1]] = name
    return root


def _read_count(node: ArrayNode, wire: Wire, data: bytes, at: int) -> tuple[int, int]:
    """Return the length of an array and where its elements begin."""
    if node.count is not None:
        return node.count, at
    at = wire.align(at, 4)
    count = struct.unpack_from(wire.order + "I", data, at)[0]
    if count > len(data):  # an element has at least a byte
        raise ValueError("a message claims more elements than it holds")
    return count, at + 4


def _describe(node: Node, wire: Wire, data: bytes, at: int, path: str, leaves: list[tuple[str, str]]) -> int:
    """Walk one node, list its leaves, and return where the next begins."""
    if isinstance(node, Leaf):
        leaves.append((path, node.kind))
        return _take(node, wire, data, at, None, {})
    if isinstance(node, StructNode):
        for name, part in node.parts:
            if name != PAD or wire.cdr:
                at = _describe(part, wire, data, at, f"{path}.{name}" if path else name, leaves)
        return at
    count, at = _read_count(node, wire, data, at)
    for index in range(count):
        # Beyond the limit elements are walked, and not listed.
        at = _describe(node.child, wire, data, at, f"{path}[{index}]", leaves if index < MAX_ELEMENTS else [])
    return at


def _take(
    node: Node, wire: Wire, data: bytes, at: int, wanted: Wanted | str | None, out: dict[str, float | int]
) -> int:
    """Walk one node, decode what is wanted, and return where the next begins."""
    if isinstance(node, Leaf):
        at = wire.align(at, node.size)
        if node.width is None:
            return at + 4 + struct.unpack_from(wire.order + node.code, data, at)[0]
        if isinstance(wanted, str):
            numbers = struct.unpack_from(wire.order + node.code, data, at)
            out[wanted] = numbers[0] if node is not STAMP else numbers[0] * 1_000_000_000 + numbers[1]
        return at + node.width
    branches: Wanted = wanted if isinstance(wanted, Mapping) else {}
    if isinstance(node, StructNode):
        for name, part in node.parts:
            if name != PAD or wire.cdr:
                at = _take(part, wire, data, at, branches.get(name), out)
        return at
    count, at = _read_count(node, wire, data, at)
    child = node.child
    if isinstance(child, Leaf) and child.width == child.size and count:  # numbers lie at equal distances
        at, code = wire.align(at, child.size), wire.order + child.code
        for index, name in branches.items():
            if isinstance(index, int) and index < count and isinstance(name, str):
                out[name] = struct.unpack_from(code, data, at + index * child.size)[0]
        return at + count * child.size
    for index in range(count):
        at = _take(child, wire, data, at, branches.get(index), out)
    return at
