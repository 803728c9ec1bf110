"""An option, written once: a field of a record with its meaning, default, unit and range.

From the field follow the check of the record (`check_options`), the parameters in its documentation, the key of a
problem file with its JSON Schema (`seaopt.problem.option_tables`), and the row in docs/reference/problem_keys.md.
"""

from __future__ import annotations

import math
import re
import textwrap
from collections.abc import Mapping
from dataclasses import MISSING, dataclass, field, fields
from functools import cache
from numbers import Integral, Real
from types import NoneType, UnionType
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

from seaopt.errors import SeaoptError, suggestion

INDENT = " " * 4
WIDTH = 116  # of a docstring's lines, behind their indent


@dataclass(frozen=True, slots=True, kw_only=True)
class Option:
    """What an option means, and which values it takes; the ends of its range hold for each number in it."""

    text: str
    unit: str = ""
    above: float | None = None
    least: float | None = None
    below: float | None = None
    most: float | None = None
    key: str = ""  # in a file, where it is not the field's name
    stated: bool = False  # a file has no default for it, though Python has
    switch: bool = False  # in a file, true is the record with its defaults, and false none

    def describe_range(self) -> str:
        """Return the range in words: "from 0 to below 0.5"; empty without one."""
        low = "" if self.above is None else f"above {self.above:g}"
        low = low if self.least is None else f"from {self.least:g}"
        joint = " to " if self.least is not None else " and " if low else ""
        if self.most is not None:
            return f"{low}{joint}{self.most:g}" if self.least is not None else f"{low}{joint}up to {self.most:g}"
        if self.below is not None:
            return f"{low}{joint}below {self.below:g}"
        return low if self.least is None else f"{self.least:g} or more"

    def holds(self, value: float) -> bool:
        """Tell whether a number is in the range."""
        return (
            (self.above is None or value > self.above)
            and (self.least is None or value >= self.least)
            and (self.below is None or value < self.below)
            and (self.most is None or value <= self.most)
        )


def option(text: str, *, default: Any = MISSING, default_factory: Any = MISSING, **described: Any) -> Any:
    """Return a field of a record that is an option; `described` are fields of `Option`."""
    defaults: dict[str, Any] = {"default": default, "default_factory": default_factory}
    return field(**defaults, metadata={"option": Option(text=text, **described)})


@dataclass(frozen=True, slots=True, kw_only=True)
class OptionField:
    """A field that is an option: its name, type and default."""

    name: str
    kind: Any
    option: Option
    default: Any  # MISSING where there is none; of a factory what it makes


@cache
def list_options(record: type[Any]) -> tuple[OptionField, ...]:
    """Return the fields of a record that are options."""
    kinds = get_type_hints(record)
    return tuple(
        OptionField(
            name=entry.name,
            kind=kinds[entry.name],
            option=entry.metadata["option"],
            default=entry.default if entry.default_factory is MISSING else entry.default_factory(),
        )
        for entry in fields(record)
        if "option" in entry.metadata
    )


def split_union(kind: Any) -> tuple[Any, ...]:
    """Return the types of which a value may be, one by one; the type itself if there is one alone."""
    if get_origin(kind) in (Union, UnionType):
        return tuple(inner for part in get_args(kind) for inner in split_union(part))
    return (kind,)


def check_options(record: Any, error: type[SeaoptError], prefix: str = "") -> None:
    """Refuse numbers and words of a record that its options do not take; `prefix` stands before names in messages. What
    is neither (lists, tables, numbers that may be lifted by False) is left to the record.
    """
    for entry in list_options(type(record)):
        value = getattr(record, entry.name)
        kinds = split_union(entry.kind)
        if value is None and NoneType in kinds:
            continue
        kinds = tuple(kind for kind in kinds if kind is not NoneType)
        name = f"{prefix}{entry.option.key or entry.name}"
        if all(get_origin(kind) is Literal for kind in kinds):
            choices = [choice for kind in kinds for choice in get_args(kind)]
            if value not in choices:
                raise error(f"{name} = {_quote(value)} is not known; {suggestion(str(value), choices)}")
        elif kinds in ((float,), (int,)):
            _check_number(name, value, entry, kinds[0], error)


def _quote(value: Any) -> str:
    return f'"{value}"' if isinstance(value, str) else repr(value)


def _check_number(name: str, value: Any, entry: OptionField, kind: type, error: type[SeaoptError]) -> None:
    numeric = Real if kind is float else Integral  # NumPy's numbers are, too
    if isinstance(value, bool) or not isinstance(value, numeric) or not math.isfinite(value):
        unit = f" in {entry.option.unit}" if entry.option.unit else ""
        raise error(f"{name} = {value!r} is not a {'finite' if kind is float else 'whole'} number; give one{unit}")
    if not entry.option.holds(float(value)):
        usual = isinstance(entry.default, int | float) and not isinstance(entry.default, bool)
        remedy = (
            f"give {(entry.option.key or entry.name).rpartition('.')[2]} = {entry.default:g}"
            if usual
            else "correct it, or leave it out"
        )
        raise error(f"{name} = {value:g} is not {entry.option.describe_range()}; {remedy}")


def describe_kind(kind: Any) -> str:
    """Return a type in words, as documentation has it."""
    words = [_name_kind(part) for part in split_union(kind) if part is not NoneType]
    return " or ".join(dict.fromkeys(words))


def _name_kind(kind: Any) -> str:
    origin, parts = get_origin(kind), get_args(kind)
    if origin is Literal:
        return "False" if parts == (False,) else "{" + ", ".join(_quote(part) for part in parts) + "}"
    if origin is tuple and len(parts) == 2 and parts[1] is not Ellipsis:
        return "(low, high)"
    if origin is tuple:
        return f"tuple of {describe_kind(parts[0])}"
    if isinstance(origin, type) and issubclass(origin, Mapping):
        return f"mapping of name to {describe_kind(parts[1])}"
    return kind.__name__


def document_options(record: type[Any]) -> str:
    """Return a record's docstring with its options as parameters, before its other sections."""
    lines = ["Parameters", "----------"]
    for entry in list_options(record):
        kind = [describe_kind(entry.kind), entry.option.unit, entry.option.describe_range()]
        if entry.default is None:
            kind.append("optional")
        elif isinstance(entry.default, str | int | float):
            kind.append(f"default {_quote(entry.default)}")
        text = re.sub(r"\|([^|]+)\|", r"abs(\1)", entry.option.text)  # bars are links to Sphinx
        text = re.sub(r"^[a-z](?=[a-z]+ )", lambda first: first[0].upper(), text)
        lines.append(f"{entry.name} : {', '.join(part for part in kind if part)}")
        lines += textwrap.wrap(text, WIDTH, initial_indent=INDENT, subsequent_indent=INDENT)
    head, *sections = re.split(r"(?m)^(?=\s*(?:Raises|Examples|Notes)\n\s*-{3})", record.__doc__ or "", maxsplit=1)
    sections = [INDENT + text.lstrip() for text in sections] or [INDENT]
    section = textwrap.indent("\n".join(lines), INDENT)
    return "\n\n".join([head.rstrip(), section, *sections])
