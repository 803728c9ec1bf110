"""JSON: lines of objects, a list of them, one under "entries" with header fields beside it, or an object of lists."""

from __future__ import annotations

import json
from collections.abc import Generator, Iterator, Mapping, Sequence
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from seaopt.errors import LogError
from seaopt.logs.formats.source import MAX_DEPTH, MAX_PARTS, Field, Source, Window, summarise_error
from seaopt.logs.formats.text_layout import MAX_LINE, line_length_error
from seaopt.signals import VectorN
from seaopt.units import header_unit

LARGEST = 1e308  # number that is taken; JSON has whole ones of any length
MAX_WHOLE = 512 << 20  # JSON that is not in lines has to be held whole
JsonEntry = Mapping[str, Any]


def open_json(path: Path) -> Source:
    """List the keys of a JSON log; nested objects become dotted paths, lists carry an index."""
    header, entries = _read_entries(path)
    columns: dict[str, str] = {}
    length = 0
    with closing(entries):
        for _, entry in entries:
            length += 1
            for name, value in flatten(entry):
                if value is not None and columns.get(name, "empty") == "empty":
                    columns[name] = name_kind(value)
                else:
                    columns.setdefault(name, "empty")
    if not length:
        raise LogError(f"{path}: holds no entries; record the log again")
    listed = ", ".join(f"{key} = {value}" for key, value in header.items())
    constants = {
        key: (float(value), header_unit(key))
        for key, value in header.items()
        if name_kind(value) == "float64" and abs(value) <= LARGEST
    }
    return Source(
        path=path,
        format="JSON",
        fields=tuple(
            Field(name=name, kind=kind, length=length, unit=header_unit(name)) for name, kind in columns.items()
        ),
        load=partial(_load, path),
        constants=constants,
        notes=(f"header: {listed}"[:400],) if header else (),
    )


def _load(path: Path, names: Sequence[str], _: Window | None) -> dict[str, VectorN]:
    columns: dict[str, list[float]] = {name: [] for name in names}
    with closing(_read_entries(path)[1]) as entries:
        for where, entry in entries:
            row = dict(flatten(entry))
            for name, values in columns.items():
                values.append(_to_number(path, where, name, row.get(name)))
    return {name: np.array(values) for name, values in columns.items()}


def name_kind(value: Any) -> str:
    """Return the kind of a JSON value."""
    return "bool" if isinstance(value, bool) else "float64" if isinstance(value, int | float) else "text"


def _to_number(path: Path, where: str, name: str, value: Any) -> float:
    if value is None:
        return float("nan")
    if not isinstance(value, int | float):
        raise LogError(f'{path}: {where}: {json.dumps(value)[:60]} in "{name}" is not a number; correct it')
    if abs(value) > LARGEST:
        raise LogError(f'{path}: {where}: "{name}" is not finite; write null')
    return float(value)


def _read_entries(path: Path) -> tuple[dict[str, Any], Generator[tuple[str, JsonEntry]]]:
    """Return what stands beside the entries, and the entries with their places."""
    with path.open("rb") as stream:
        first = _read_line(path, stream, 1)
        in_lines = _is_entry(first) and any(line.strip() for line in stream)
    return ({}, _walk_lines(path)) if in_lines else _read_whole(path)


def _walk_lines(path: Path) -> Generator[tuple[str, JsonEntry]]:
    number = 1
    with path.open("rb") as stream:
        while line := _read_line(path, stream, number):
            if line.strip():
                yield _check_object(path, _parse(path, line.rstrip(), number), f"line {number}")
            number += 1


def _read_line(path: Path, stream: Any, number: int) -> bytes:
    line = stream.readline(MAX_LINE + 1)
    if len(line) > MAX_LINE and number > 1:
        raise line_length_error(path, number)
    return line.removeprefix(b"\xef\xbb\xbf") if number == 1 else line


def _is_entry(line: bytes) -> bool:
    """Return whether the first line is an object by itself, as in JSON lines."""
    try:
        return len(line) <= MAX_LINE and isinstance(json.loads(line), dict)
    except (ValueError, RecursionError):
        return False


def _read_whole(path: Path) -> tuple[dict[str, Any], Generator[tuple[str, JsonEntry]]]:
    size = path.stat().st_size
    if size > MAX_WHOLE:
        raise LogError(f"{path}: is {size >> 20} MiB of JSON in one piece; save it as JSON lines, one entry per line")
    content = entries = _parse(path, path.read_bytes().removeprefix(b"\xef\xbb\xbf"), 1)
    header: dict[str, Any] = {}
    if isinstance(content, dict):
        _refuse_result(path, content)
        entries = content["entries"] if "entries" in content else _transpose(path, content)
        header = {key: value for key, value in content.items() if isinstance(value, str | int | float)}
    if not isinstance(entries, list):
        raise LogError(
            f'{path}: holds no list of entries; write {{"entries": [{{"time": 0.0, ...}}, ...]}} or JSON lines'
        )
    return header, (_check_object(path, entry, f"entry {number}") for number, entry in enumerate(entries, start=1))


def _refuse_result(path: Path, content: dict[str, Any]) -> None:
    """Refuse a file that a command wrote as its result."""
    schema = content.get("schema")
    if isinstance(schema, str) and schema.startswith("seaopt/"):
        raise LogError(f'{path}: is a result ("schema": "{schema[:60]}"), and no log; give what the machine recorded')


def _transpose(path: Path, content: dict[str, Any]) -> list[JsonEntry]:
    """Return the entries of an object of lists, one list per column; without lists it is an entry itself."""
    lists = {key: value for key, value in content.items() if isinstance(value, list)}
    lengths = {len(value) for value in lists.values()}
    if len(lengths) > 1:
        counts = ", ".join(f"{key}: {len(value)}" for key, value in list(lists.items())[:10])
        raise LogError(f"{path}: its lists differ in length ({counts}); write one value per sample in each")
    return [dict(zip(lists, row, strict=True)) for row in zip(*lists.values(), strict=True)] if lists else [content]


def _parse(path: Path, text: bytes, line: int) -> Any:
    try:
        return json.loads(text, object_pairs_hook=partial(_check_unique, path))
    except json.JSONDecodeError as error:
        raise LogError(
            f"{path}: line {line + error.lineno - 1}, column {error.colno}: is not valid JSON ({error.msg}); the file "
            "may be cut off, correct that place"
        ) from error
    except RecursionError as error:
        raise LogError(f"{path}: line {line}: is nested too deep; is it a log?") from error
    except ValueError as error:  # bytes that are not text, integers of thousands of digits
        raise LogError(
            f"{path}: line {line}: is not valid JSON ({summarise_error(error)}); correct that place"
        ) from error


def _check_unique(path: Path, pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    entry = dict(pairs)
    if len(entry) < len(pairs):
        keys = [key for key, _ in pairs]
        double = next(key for key in keys if keys.count(key) > 1)
        raise LogError(f'{path}: {keys.count(double)} keys of one entry are named "{double}"; rename all but one')
    return entry


def _check_object(path: Path, entry: Any, where: str) -> tuple[str, JsonEntry]:
    if not isinstance(entry, dict):
        raise LogError(f"{path}: {where} is not an object but {json.dumps(entry)[:40]}; write one with named values")
    return where, entry


def flatten(record: JsonEntry, prefix: str = "", depth: int = 0) -> Iterator[tuple[str, Any]]:
    """Return names and values; a list gives one name for each of its first elements."""
    for key, value in record.items():
        name = f"{prefix}{key}"
        if isinstance(value, dict) and depth < MAX_DEPTH:
            yield from flatten(value, f"{name}.", depth + 1)
        elif isinstance(value, list):
            named = {f"{name}[{index}]": element for index, element in enumerate(value[:MAX_PARTS])}
            yield from flatten(named, "", depth + 1) if depth < MAX_DEPTH else ()
        else:
            yield name, value
