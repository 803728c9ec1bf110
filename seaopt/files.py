"""Files that are either whole or absent, and results that carry a digest of themselves.

A file is written to a temporary name, then moved into place. A result, a JSON file with a "schema", has in `made_from`
the SHA-256 of its content: it tells that somebody edited it. It is no signature: whoever wants to deceive can compute a
new one.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import re
import secrets
import stat
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from seaopt.errors import FileError, SeaoptError

CONTENT = "content"  # the key of a result's own digest in made_from
MOST_BYTES = 64 << 20  # of a file that is read as one text: problems, laws, results
MOST_LEVELS = 100  # of tables and lists in it
# What JSON may hold raw and a terminal would obey, and halves of characters, which are in names that are no text.
_ESCAPED = re.compile(r"[\x7f-\x9f\u200e\u200f\u202a-\u202e\u2066-\u2069\ud800-\udfff]")


def check_regular(path: Path) -> None:
    """Refuse what is there and is not a regular file (FileError): reading a pipe or a device may never end."""
    try:
        mode = path.stat().st_mode
    except (OSError, ValueError):  # whoever reads it says why it cannot be read
        return
    if not stat.S_ISREG(mode):
        what = "a folder" if stat.S_ISDIR(mode) else "a pipe, a device or a socket"
        raise FileError(f"{path}: is {what}; give a regular file")


def exists(path: Path) -> bool:
    """Tell whether a file or a folder is there; where the name is none that a file can have, none is."""
    try:
        return path.exists()
    except (OSError, ValueError):
        return False


def check_folder(path: Path) -> None:
    """Refuse a path of results at which no folder is or can be (FileError): a file, or no path of this system."""
    try:
        is_file = path.exists() and not path.is_dir()
    except (OSError, ValueError) as error:
        raise FileError(f"{path}: cannot be a folder ({describe_os_error(error)}); give another one: -o out") from error
    if is_file:
        raise FileError(f"{path}: is a file; give a folder for the results: -o out")


def check_name(path: Path | str, remedy: str, error: type[SeaoptError] = FileError) -> None:
    """Refuse a name that is not UTF-8 (`error`): no Polars, table or problem file can hold it."""
    try:
        str(path).encode()
    except UnicodeEncodeError:
        raise error(f"{path}: its name is not UTF-8; {remedy}") from None


def write_bytes(path: Path | str, content: bytes) -> Path:
    """Write `content` in one step: a reader sees the old file or the new. Raises FileError: it cannot be written."""
    target = Path(path)
    temporary = target.with_name(f".seaopt-{secrets.token_hex(8)}")
    made = False
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        # The system takes the umask off the mode; asking for it would change it for other threads.
        handle = os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666)
        made = True
        with os.fdopen(handle, "wb") as stream:
            stream.write(content)
        temporary.replace(target)
    except (OSError, ValueError) as error:
        if made:
            temporary.unlink(missing_ok=True)
        raise FileError(f"{target}: cannot be written ({describe_os_error(error)}); choose another folder") from error
    return target


def describe_os_error(error: OSError | ValueError) -> str:
    """Return why a file cannot be opened; a ValueError is a path that no system can have."""
    return (error.strerror if isinstance(error, OSError) else None) or str(error)


def write_text(path: Path | str, content: str) -> Path:
    """Write text as UTF-8, as `write_bytes` does. Raises FileError also: it holds half a character."""
    try:
        raw = content.encode()
    except UnicodeEncodeError as error:
        around = ascii(content[max(error.start - 20, 0) : error.end])
        raise FileError(
            f"{path}: cannot be written, as {around} is not text; remove or rename what is so named"
        ) from error
    return write_bytes(path, raw)


def plain(value: Any) -> Any:
    """Return `value` as what JSON can hold: arrays become lists, numbers that are not finite become null."""
    if isinstance(value, dict):
        return {str(key): plain(entry) for key, entry in value.items()}  # pyright: ignore[reportUnknownArgumentType]
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, (list, tuple)):
        return [plain(entry) for entry in value]
    if isinstance(value, np.generic):
        return plain(value.item())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value


def to_json(content: dict[str, Any]) -> str:
    """Return `content` as strict JSON (no NaN, no Infinity), indented."""
    text = json.dumps(plain(content), indent=1, allow_nan=False, ensure_ascii=False) + "\n"
    return _ESCAPED.sub(lambda match: f"\\u{ord(match.group()):04x}", text)


def digest_content(content: Mapping[str, Any]) -> str:
    """Return the SHA-256 of a result and of what it says that it was made from, but for clock and machine."""
    counted = {name: value for name, value in content.items() if name not in ("made_from", "provenance")}
    made_from = content.get("made_from") or {}
    if isinstance(made_from, Mapping) and (sources := {k: v for k, v in made_from.items() if k != CONTENT}):
        counted["made_from"] = sources
    return digest_plain(counted)


def digest_plain(content: Any) -> str:
    """Return the SHA-256 of what JSON can hold, whatever the order of its keys."""
    return hashlib.sha256(json.dumps(plain(content), sort_keys=True).encode()).hexdigest()


def seal(content: Mapping[str, Any]) -> dict[str, Any]:
    """Return a result with its digest in `made_from`, beside what it was made from."""
    return {**content, "made_from": {**(content.get("made_from") or {}), CONTENT: digest_content(content)}}


def check_schema(content: Any, schema: str, source: Path | str, remedy: str) -> None:
    """Refuse what does not carry a schema (FileError): another file, or one of an older version."""
    stated = content.get("schema") if isinstance(content, Mapping) else None
    if stated != schema:
        raise FileError(f'{source}: schema is {stated!r}, expected "{schema}"; {remedy}')


def check_seal(content: Mapping[str, Any], source: Path | str, remedy: str) -> None:
    """Refuse a result without a digest, which somebody wrote by hand, and one that was edited since. Raises FileError:
    the digest is missing or damaged, or another one than the content has.
    """
    made_from = content.get("made_from")
    if not isinstance(made_from, Mapping) or CONTENT not in made_from:
        raise FileError(
            f"{source}: has no made_from with a digest of its content: it was written by hand, and is no result of "
            f"seaopt; {remedy}"
        )
    if made_from[CONTENT] != digest_content(content):
        raise FileError(
            f"{source}: was edited after it was written, or is of an older seaopt, so that it is no longer what was "
            f"found; {remedy}"
        )


def write_json(path: Path | str, content: dict[str, Any]) -> Path:
    """Write a result as strict JSON with its digest, as `write_bytes` does."""
    return write_text(path, to_json(seal(content)))


def parse_file(
    path: Path | str, parse: Callable[[str], Any], form: str, *, remedy: str, error: type[SeaoptError] = FileError
) -> Any:
    """Read a small file of text and parse it, or say in one line why that cannot be. `path`: the file. `parse`:
    `json.loads` or `tomllib.loads`. `form`: what it should be: "JSON" or "TOML". `remedy`: where such a file comes
    from. `error`: what is raised. Raises SeaoptError: the file is missing, is no regular file, is larger than
    `MOST_BYTES`, or is not what it should be.
    """
    source = Path(path)
    check_regular(source)
    try:
        if source.stat().st_size > MOST_BYTES:
            raise error(f"{source}: is larger than {MOST_BYTES >> 20} MB, is it {form}?; {remedy}")
        text = source.read_text(encoding="utf-8-sig")
    except FileNotFoundError as problem:
        raise error(f"{source}: no such file; {remedy}") from problem
    except OSError as problem:
        raise error(f"{source}: cannot be read ({describe_os_error(problem)}); {remedy}") from problem
    except ValueError as problem:  # bytes that are no text, or a path that no system has
        raise error(f"{source}: cannot be read as UTF-8 text ({problem}); {remedy}") from problem
    return parse_text(text, source, parse, form, remedy=remedy, error=error)


def parse_text(
    text: str,
    source: Path | str,
    parse: Callable[[str], Any],
    form: str,
    *,
    remedy: str,
    error: type[SeaoptError] = FileError,
) -> Any:
    """Parse the text of a file, as `parse_file` does."""
    try:
        content = parse(text)
        check_content(content)
    except (ValueError, RecursionError) as problem:
        # Of a number of more digits than it reads, Python says how a program changes that.
        reason, *_ = str(problem).split("; use sys.")
        raise error(f"{source}: is not valid {form} ({reason}); correct that place, or {remedy}") from problem
    return content


def check_content(content: Any) -> None:
    """Refuse what Python can read but not always print: deep nesting, and integers of any size. Raises ValueError: it
    is nested deeper than `MOST_LEVELS`, or an integer has more than 64 bits.
    """
    level, depth = [content], 0
    while level:
        if depth > MOST_LEVELS:
            raise ValueError(f"it is nested more than {MOST_LEVELS} deep")
        inner: list[Any] = []
        for value in level:
            if isinstance(value, int) and not -(2**63) <= value < 2**63:
                raise ValueError(f"an integer has {value.bit_length()} bits, and 63 beside its sign are the most")
            inner += value.values() if isinstance(value, dict) else value if isinstance(value, list) else ()
        level, depth = inner, depth + 1


def read_json(path: Path | str, schema: str, *, remedy: str = "run its stage again") -> dict[str, Any]:
    """Read a result file; check its "schema" field and its digest. Raises FileError: the file is missing, is not JSON,
    carries another schema, was edited, or was written by hand.
    """
    source = Path(path)
    content = parse_file(source, json.loads, "JSON", remedy=remedy)
    check_schema(content, schema, source, remedy)
    check_seal(content, source, remedy)
    return content
