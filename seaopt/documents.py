"""Tables read from JSON and TOML, checked against a pydantic model; the first mistake is one line that says what to do.

What a field may hold is said by its type; what several fields must have in common is checked by those who read them.
JSON has no infinity, so that null stands for one where a type here says so.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from difflib import get_close_matches
from typing import Annotated, Any, Literal, TypeVar, get_args, get_origin

from pydantic import BaseModel, ConfigDict, Strict, ValidationError

from seaopt.errors import FileError, SeaoptError, suggestion

EXAMPLES = {
    "float": "1.0",
    "int": "1",
    "bool": "true",
    "string": '"..."',
    "list": "[...]",
    "model": "{ ... }",
}  # of a kind of value
MOST_KEYS = 16  # of a table that a message lists
MAX_SHOWN = 60  # characters of a wrong value that a message repeats
# In a place of pydantic's these name what a value was tried as, and are no keys of the file.
UNION_BRANCH = re.compile(
    r"\w*Table|Stored\w+|float|int|bool|str|(literal|dict|tuple|list)\[.*|(function|constrained)-.*"
)

Number = Annotated[float, Strict()]
Whole = Annotated[int, Strict()]
Flag = Annotated[bool, Strict()]


class ResultTable(BaseModel):
    """A table in a file of results; keys besides those that are read may stand in it."""

    # Keys as model_std are no methods of pydantic, whose older versions warn of them.
    model_config = ConfigDict(extra="ignore", frozen=True, protected_namespaces=())


Document = TypeVar("Document", bound=BaseModel)


def check_table(
    model: type[Document], content: Any, source: str, *, remedy: str = "", error: type[SeaoptError] = FileError
) -> Document:
    """Return a table as a model. `model`: what the table may hold. `content`: as read from the file. `source`: the
    file, for messages. `remedy`: what to do about any mistake; left out where the place is the user's own, to be
    corrected there. `error`: what is raised. Raises SeaoptError: a key is unknown or missing, or a value is of the
    wrong kind or out of range; of the kind asked for.
    """
    try:
        return model.model_validate(content)
    except ValidationError as problem:
        raise error(f"{source}: {_describe(model, problem, remedy)}") from problem


def has_unknown_key(error: SeaoptError) -> bool:
    """Tell whether an error of `check_table` is a key that nothing reads."""
    cause = error.__cause__
    mistakes = cause.errors(include_url=False) if isinstance(cause, ValidationError) else []
    return any(mistake["type"] == "extra_forbidden" for mistake in mistakes)


def _describe(model: type[BaseModel], problem: ValidationError, remedy: str) -> str:
    """Return the mistake that the others follow from: place, value and remedy."""
    mistakes = problem.errors(include_url=False)
    # A misspelt key is also a missing one: the misspelling is the mistake.
    first = next((mistake for mistake in mistakes if mistake["type"] == "extra_forbidden"), mistakes[0])
    # Where something else or a table may stand, what is wrong inside the table is the mistake.
    inside = [
        mistake
        for mistake in mistakes
        if mistake["loc"][:-1] != first["loc"][:-1] and _within(mistake["loc"], first["loc"])
    ]
    is_table = first["type"] == "string_type" or isinstance(first["input"], Mapping)
    first = inside[0] if inside and is_table else first
    path = _place(first["loc"])
    key = path.rpartition(".")[2]
    if first["type"] == "extra_forbidden":
        keys = [field.alias or name for name, field in _find_model(model, first["loc"]).model_fields.items()]
        near = get_close_matches(str(first["loc"][-1]), keys, n=1, cutoff=0.6)
        if not near and len(keys) > MOST_KEYS:
            return (
                f"unknown key {path}; {_name_table(path)} has {len(keys)} keys, none of them named alike: type seaopt "
                "schema problem, or read the page Keys of a problem file"
            )
        line = f" write {near[0]} = {_spell(first['input'])}" if near else ""
        return f"unknown key {path}; {suggestion(str(first['loc'][-1]), keys)}{line}"
    if _is_range(first):
        at = _place(first["loc"][:-1] if first["type"] == "missing" else first["loc"])
        return (
            f"{at} = {shorten(first['input'])} is not a range; give [low, high]: {at.rpartition('.')[2]} = [1.0, 2.0]"
        )
    if first["type"] == "missing":
        return f"key {path} is missing; {remedy or f'add it: {key} = {_suggest_value(model, first)}'}"
    words = first["msg"].removeprefix("Value error, ").replace("Input should", "should")
    words = words.replace("List should", "should").replace(" after validation", "")
    words = "should be a table" if first["type"] == "model_type" else words
    if not first["loc"]:  # of the whole file
        return f"{words}; {remedy or 'correct the file'}"
    if first["type"] == "value_error" and isinstance(first["input"], Mapping):  # what a whole table says wrongly
        return f"{path}: {words}; {remedy or 'correct that table'}"
    if isinstance(first["loc"][-1], int):  # an entry of a list has no key to write
        return f"{path} = {shorten(first['input'])}: {words}; {remedy or 'correct that entry'}"
    kind = first["type"].partition("_")[0]
    if kind in ("greater", "less"):
        correct = f"correct it: {key} = {_suggest_number(model, first)}"
    elif kind in ("float", "int") and isinstance(
        first["input"], str
    ):  # with its unit, as a rule: a number may be another
        correct = "give the number alone, without quotes, in the key's own unit"
    elif kind == "literal":
        correct = f"correct it: {key} = {_suggest_choice(first)}"
    else:
        correct = f"correct it: {key} = {EXAMPLES.get(kind, '...')}"
    return f"{path} = {shorten(first['input'])}: {words}; {remedy or correct}"


def _name_table(path: str) -> str:
    """Return the table that a key is in, as a file has it."""
    table = path.rpartition(".")[0]
    return f"[{table}]" if table else "the top level"


def _suggest_number(model: type[BaseModel], mistake: Mapping[str, Any]) -> str:
    """Return a number in the range that a mistake leaves: its end where that belongs to it, else the key's default."""
    (end,) = mistake["ctx"].values()
    if mistake["type"].endswith("_equal"):
        return f"{end:g}"
    inside = _find_model(model, mistake["loc"]).model_fields
    default = next((field.default for name, field in inside.items() if mistake["loc"][-1] in (name, field.alias)), None)
    return f"{default:g}" if isinstance(default, int | float) else "..."


def _suggest_choice(mistake: Mapping[str, Any]) -> str:
    """Return the text that was likely meant of those that may be given, or the number."""
    expected = mistake["ctx"]["expected"]
    nearest = get_close_matches(str(mistake["input"]), re.findall(r"'([^']*)'", expected), n=1, cutoff=0.0)
    return f'"{nearest[0]}"' if nearest else expected.split()[0]


def _suggest_value(model: type[BaseModel], mistake: Mapping[str, Any]) -> str:
    """Return what a key that is missing may be, where only a few values may; else "..."."""
    inside = _find_model(model, mistake["loc"]).model_fields
    kinds = [field.annotation for name, field in inside.items() if mistake["loc"][-1] in (name, field.alias)]
    return next((_spell(get_args(kind)[0]) for kind in kinds if get_origin(kind) is Literal), "...")


def _spell(value: Any) -> str:
    """Return a value as TOML has it, where it is short."""
    return json.dumps(value, ensure_ascii=False) if isinstance(value, str | int | float) else "..."


def _is_range(mistake: Mapping[str, Any]) -> bool:
    """Tell whether a mistake is that of two numbers that are not two; every tuple of the models is a range."""
    if mistake["type"] in ("too_long", "too_short"):  # which a list may be, too
        return mistake["ctx"]["field_type"] == "Tuple"
    return mistake["type"] == "tuple_type" or (mistake["type"] == "missing" and isinstance(mistake["loc"][-1], int))


def shorten(value: Any) -> str:
    """Return the repr of a value, cut where it is long."""
    text = repr(value)
    return text if len(text) <= MAX_SHOWN else text[: MAX_SHOWN - 3] + "..."


def _within(loc: tuple[int | str, ...], other: tuple[int | str, ...]) -> bool:
    return len(loc) > len(other) and loc[: len(other) - 1] == other[:-1]


def _place(loc: Sequence[int | str]) -> str:
    """Return where in the file a mistake lies: names of union branches are not keys and are left out."""
    keys = [str(key + 1) if isinstance(key, int) else key for key in loc]
    return ".".join(key for key in keys if not UNION_BRANCH.fullmatch(key))


def _find_model(model: type[BaseModel], loc: Sequence[int | str]) -> type[BaseModel]:
    """Return the model of the table that `loc` points into; of several, it names the one that was tried."""
    inner: list[type[BaseModel]] = []
    for key in loc[:-1]:
        if key in model.model_fields:
            inner = _models_in(model.model_fields[str(key)].annotation)
            model = inner[0] if inner else model
        model = next((table for table in inner if table.__name__ == key), model)
    return model


def _models_in(annotation: Any) -> list[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [model for part in getattr(annotation, "__args__", ()) for model in _models_in(part)]
