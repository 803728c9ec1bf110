"""A problem file's table: TOML checked against the schema, with messages that name key, value and remedy."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ValidationError

from seaopt.errors import ProblemError, suggestion
from seaopt.problem.schema import ProblemTable

MAX_BYTES = 4 << 20


def validated(source: Path) -> ProblemTable:
    """Return a problem file's table.

    Raises
    ------
    ProblemError
        The file is missing or not TOML, a key is unknown or missing, or a value is out of range.

    """
    content = _toml(source)
    try:
        return ProblemTable.model_validate(content)
    except ValidationError as error:
        found = error.errors(include_url=False)
        # A misspelt key is also a missing one: the misspelling is the mistake.
        first = next((item for item in found if item["type"] == "extra_forbidden"), found[0])
        # Where a string or a table may stand, what is wrong inside the table is the mistake.
        inside = [
            item for item in found if item["loc"][:-1] != first["loc"][:-1] and _within(item["loc"], first["loc"])
        ]
        first = inside[0] if first["type"] == "string_type" and inside else first
        place = _place(first["loc"])
        if first["type"] == "extra_forbidden":
            known = _known_keys(first["loc"])
            raise ProblemError(f"{source}: unknown key {place}; {suggestion(str(first['loc'][-1]), known)}") from error
        if _of_a_pair(first):
            at = _place(first["loc"][:-1] if first["type"] == "missing" else first["loc"])
            raise ProblemError(f"{source}: {at} = {_shown(first['input'])} is not a range; give [low, high]") from error
        if first["type"] == "missing":
            raise ProblemError(f"{source}: key {place} is missing; add it") from error
        raise ProblemError(f"{source}: {place} = {_shown(first['input'])}: {first['msg']}") from error


def _of_a_pair(error: Mapping[str, Any]) -> bool:
    """Tell whether an error is that of two numbers that are not two; every tuple of the schema is a range."""
    return error["type"] in ("tuple_type", "too_long", "too_short") or (
        error["type"] == "missing" and isinstance(error["loc"][-1], int)
    )


def _shown(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."


def _toml(source: Path) -> dict[str, Any]:
    try:
        if source.is_dir():
            raise ProblemError(f"{source}: is a folder; give a problem file (TOML)")
        if source.stat().st_size > MAX_BYTES:
            raise ProblemError(f"{source}: is larger than {MAX_BYTES >> 20} MB; give a problem file (TOML)")
        return tomllib.loads(source.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise ProblemError(f"{source}: no such file; check the path") from error
    except OSError as error:
        raise ProblemError(f"{source}: cannot be read ({error.strerror})") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError) as error:
        raise ProblemError(f"{source}: is not valid TOML ({error}); correct that place") from error


def _within(loc: tuple[int | str, ...], other: tuple[int | str, ...]) -> bool:
    return len(loc) > len(other) and loc[: len(other) - 1] == other[:-1]


def _place(loc: tuple[int | str, ...]) -> str:
    """Return where in the file an error lies: names of union branches are not keys and are left out."""
    keys = [str(item + 1) if isinstance(item, int) else item for item in loc]
    branches = ("Table", "float", "bool", "str", "literal", "dict", "tuple")
    return ".".join(key for key in keys if not any(branch in key for branch in branches) or key in loc[:1])


def _known_keys(loc: tuple[int | str, ...]) -> list[str]:
    """Return the keys that are known where `loc` points."""
    model: Any = ProblemTable
    for item in loc[:-1]:
        if isinstance(item, int):
            continue
        if isinstance(model, type) and issubclass(model, BaseModel) and item in model.model_fields:
            found = _models_in(model.model_fields[item].annotation)
            model = found[0] if found else model
    return [field.alias or name for name, field in model.model_fields.items()]


def _models_in(annotation: Any) -> list[Any]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [model for item in getattr(annotation, "__args__", ()) for model in _models_in(item)]
