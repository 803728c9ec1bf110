"""Tables of a problem file that follow from records of options (`seaopt.options`), and the records made of them."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import MISSING, is_dataclass
from functools import cache, reduce
from operator import or_
from typing import Annotated, Any, dataclass_transform, get_args, get_origin

from pydantic import BaseModel, ConfigDict, Field, Strict, StringConstraints, create_model

from seaopt.documents import Flag, Number, Whole
from seaopt.options import Option, list_options, split_union

Name = Annotated[str, StringConstraints(pattern=r"^[A-Za-z][A-Za-z0-9_-]*$", max_length=64)]
Formula = Annotated[
    Annotated[str, Strict()] | Number,
    Field(
        description="Numbers, names, + - * / ^, brackets, sin, cos, tan, tanh, exp, log, sqrt, abs, min, max, atan2, "
        "if_else(a > b, then, else), pi."
    ),
]


def key(text: str, *, default: Any = ..., **limits: Any) -> Any:
    """Return a key of a table: what it means, what holds where it is left out, and pydantic's limits of its value."""
    return Field(default, description=text, **limits)


@dataclass_transform(kw_only_default=True, frozen_default=True, field_specifiers=(Field, key))
class StrictTable(BaseModel):
    """A table of a problem file: no other keys, no numbers that are not finite."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, strict=False)


@cache
def table_of(record: type[Any], leave_out: Collection[str] = (), base: type[StrictTable] = StrictTable) -> Any:
    """Return a record's table, a key per stated option with type, range, default and text, behind those of `base`."""
    keys: dict[str, Any] = {}
    for field in list_options(record):
        if field.name in leave_out:
            continue
        option, default = field.option, field.default
        kind = _as_written(field.kind, option)
        if get_origin(kind) is tuple and Ellipsis in get_args(kind):
            kind = list[get_args(kind)[0]]  # a tuple is a range to messages
            default = list(default) if isinstance(default, tuple) else default
        if option.switch:
            kind, default = Flag | kind, False
        if callable(default):  # what a function gives where it is left out
            default = default(None)
        extra: Any = {"unit": option.unit} if option.unit else None
        keys[field.name] = (
            kind,
            Field(
                ... if default is MISSING or option.stated else default,
                alias=option.key or None,
                description=option.text,
                json_schema_extra=extra,
            ),
        )
    text = (record.__doc__ or "").strip().splitlines()[0]
    return create_model(f"{record.__name__}Table", __base__=base, __doc__=text, __module__=__name__, **keys)


def _as_written(kind: Any, option: Option) -> Any:
    """Return the type that a file's value has: strict numbers within the range, and tables in place of records."""
    parts = split_union(kind)
    if len(parts) > 1:
        return reduce(or_, (_as_written(part, option) for part in parts))
    origin, inner = get_origin(kind), get_args(kind)
    if kind in (float, int):
        ends: dict[str, Any] = {"gt": option.above, "ge": option.least, "lt": option.below, "le": option.most}
        ends = {name: end for name, end in ends.items() if end is not None}
        number = Number if kind is float else Whole
        return Annotated[number, Field(**ends)] if ends else number
    if kind is bool:
        return Flag
    if is_dataclass(kind):
        return table_of(kind)
    if origin is Callable:
        return _as_formula(*inner)
    if origin is tuple:
        return tuple[tuple(part if part is Ellipsis else _as_written(part, option) for part in inner)]
    if isinstance(origin, type) and issubclass(origin, Mapping):
        return dict[str, _as_written(inner[1], option)]
    return kind


def _as_formula(takes: Any, returned: Any) -> Any:
    """Return the type of a function in a file: a formula, or several; of one that makes a plant, the plant's name."""
    if not takes:
        return Name
    if get_origin(returned) is tuple:
        return tuple[tuple(Formula for _ in get_args(returned))]
    return dict[str, Formula] if get_origin(returned) is Mapping else Formula


def make_record(record: type[Any], table: BaseModel, **further: Any) -> Any:
    """Return a record with the options that a table states, and others that are given."""
    stated = {field.name: field for field in list_options(record) if field.name in type(table).model_fields}
    values = {
        name: make_value(getattr(table, name), field.kind) for name, field in stated.items() if name not in further
    }
    return record(**values, **further)


def make_value(value: Any, kind: Any) -> Any:
    """Return what a file's value stands for: a record of its table, or of true with its defaults."""
    records: list[Any] = [part for part in split_union(kind) if is_dataclass(part)]
    if not records:
        return tuple(value) if isinstance(value, list) else value
    if isinstance(value, BaseModel):
        return make_record(records[0], value)
    if isinstance(value, bool):
        return records[0]() if value else None
    return value
