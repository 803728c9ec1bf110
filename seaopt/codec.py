"""Records to what JSON holds and back, by their annotations.

A record has in its file the keys that its class lists in `json_keys`, names of fields and properties in the order of
the file; without such a list, all its fields. `json_names` has the names in the file of fields that are called another
way there. Reading makes a pydantic model of the annotations, which checks a file and makes the records of it. What is a
property is computed again: `check_agrees` compares it with the file's.

- a float is a number; `OrInfinite`, `OrMinusInfinite` and `OrNaN` are null in the file where they are not finite
- a tuple of any length is a list, a tuple of two a range, a Mapping a table, a jaxtyping array lists of numbers, one
  that is complex a table of its parts `re` and `im`
- `Constraints` beside a type in `Annotated` is what its values keep to
- a class whose instances are not made of their own keys alone has a class method `_from_json`, whose argument's
  annotation says what the file holds: Mapping[str, Any] is its own fields, `Fields` those of another record
"""

from __future__ import annotations

import math
import types
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import MISSING, Field, fields, is_dataclass
from functools import cache
from typing import TYPE_CHECKING, Annotated, Any, TypeVar, Union, cast, get_args, get_origin, get_type_hints

import numpy as np
from jaxtyping import AbstractArray, Float

from seaopt.errors import FileError, SeaoptError
from seaopt.files import check_seal, plain
from seaopt.records import record

if TYPE_CHECKING:
    from pydantic import BaseModel

T = TypeVar("T")
EXACT = 1e-9  # between what a file says and what is made of it: the rounding of another machine


@record
class Key:
    """A key of a file, where it is not a field's name alone."""

    field: str
    name: str  # in the file
    omit_none: bool = False  # leave it out where the field is None


@record
class NullIs:
    """What null in a file stands for."""

    value: float


@record
class Constraints:
    """What a number, text or list of a file keeps to, in pydantic's words."""

    gt: float | None = None
    ge: float | None = None
    le: float | None = None
    min_length: int | None = None
    max_length: int | None = None
    pattern: str | None = None


@record
class Fields:
    """Asks for a record's fields in place of the record, beside Mapping[str, Any]."""

    of: type[Any]


OrInfinite = Annotated[float, NullIs(value=math.inf)]
OrMinusInfinite = Annotated[float, NullIs(value=-math.inf)]
OrNaN = Annotated[float, NullIs(value=math.nan)]


def to_content(value: Any) -> Any:
    """Return a record as what its file holds; `files.plain` makes lists of the arrays in it."""
    if is_dataclass(value) and not isinstance(value, type):
        pairs = [(key, to_content(getattr(value, key.field))) for key in list_keys(type(value))]
        return {key.name: item for key, item in pairs if item is not None or not key.omit_none}
    if isinstance(value, Mapping):
        return {key: to_content(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [to_content(item) for item in cast(Sequence[Any], value)]
    if isinstance(value, np.ndarray) and np.iscomplexobj(value):
        return {"re": np.real(value), "im": np.imag(value)}
    return value


def from_content(cls: type[T], content: Any, source: str, *, remedy: str) -> T:
    """Return the record of a file's content, as `read_fields` reads it."""
    try:
        return cls(**read_fields(cls, content, source, remedy=remedy))
    except FileError:
        raise
    except SeaoptError as error:
        raise FileError(f"{source}: {error}; {remedy}") from error


def read_fields(cls: type[Any], content: Any, source: str, *, remedy: str) -> dict[str, Any]:
    """Return the fields of a record in a file. Raises FileError: missing or wrong keys, or another digest."""
    from seaopt.documents import check_table

    if isinstance(content, Mapping) and "made_from" in content:
        check_seal(cast(Mapping[str, Any], content), source, remedy)
    return _take_fields(cls, check_table(make_model(cls), plain(content), source, remedy=remedy))


def check_agrees(content: Any, made: Any, source: str, *, remedy: str, path: str = "", rtol: float = EXACT) -> None:
    """Refuse a file of which a key is not what `made`, `to_content` of the record made of it, has; absent keys are not
    asked for, as an older file may have fewer. `source`, `remedy`, `path`: for the message. `rtol`: relative
    difference that two numbers may have. Raises FileError, with the first key that differs.
    """
    from seaopt.documents import shorten

    if isinstance(made, Mapping) and isinstance(content, Mapping):
        for key in made:
            if key in content:
                inner = f"{path}.{key}".lstrip(".")
                check_agrees(content[key], made[key], source, remedy=remedy, path=inner, rtol=rtol)
        return
    content, made = plain(content), plain(made)
    if not _agree(content, made, rtol):
        if isinstance(content, list) and isinstance(made, list) and len(content) == len(made):
            pairs = zip(content, made, strict=True)
            for number, pair in enumerate(pairs if isinstance(made[0], Mapping) else (), start=1):  # which one differs
                check_agrees(*pair, source, remedy=remedy, path=f"{path}.{number}", rtol=rtol)
        found, expected = shorten(content), shorten(made)
        raise FileError(f"{source}: {path} is {found}, and the other keys make {expected}; {remedy}")


def _agree(a: Any, b: Any, rtol: float) -> bool:
    if isinstance(a, list) and isinstance(b, list):
        pairs = list(zip(cast(list[Any], a), cast(list[Any], b), strict=False))
        return len(a) == len(b) and all(_agree(*pair, rtol) for pair in pairs)
    if isinstance(a, Mapping) and isinstance(b, Mapping):
        return a.keys() == b.keys() and all(_agree(a[key], b[key], rtol) for key in a)
    if isinstance(a, float | int) and isinstance(b, float | int) and bool not in (type(a), type(b)):
        return math.isclose(a, b, rel_tol=rtol)
    return type(cast(Any, a)) is type(cast(Any, b)) and a == b


def list_keys(cls: type[Any]) -> Iterator[Key]:
    """Yield the keys that a record has in its file."""
    names: Mapping[str, str] = getattr(cls, "json_names", {})
    for each in getattr(cls, "json_keys", ()) or [field.name for field in fields(cls)]:
        yield each if isinstance(each, Key) else Key(field=each, name=names.get(each, each))


def json_schema(cls: type[Any]) -> dict[str, Any]:
    """Return the JSON Schema of a record's file."""
    return make_model(cls).model_json_schema(by_alias=True)


def join_schemas(*kinds: type[Any]) -> dict[str, Any]:
    """Return the JSON Schema of a file that holds one of several records."""
    schemas = [json_schema(kind) for kind in kinds]
    shared = [name for name in schemas[0]["required"] if all(name in schema["required"] for schema in schemas)]
    return {
        "$defs": {name: each for schema in schemas for name, each in schema.pop("$defs", {}).items()},
        "description": " ".join(schema["description"] for schema in schemas),
        "type": "object",
        "required": shared,
        "anyOf": schemas,
    }


@cache
def make_model(cls: type[Any]) -> type[BaseModel]:
    """Return the pydantic model of a record's file; what is a property may be left out, and is not read."""
    from pydantic import Field as ModelField
    from pydantic import create_model

    from seaopt.documents import ResultTable

    hints, attributes = get_type_hints(cls, include_extras=True), {field.name: field for field in fields(cls)}
    definitions: dict[str, Any] = {}
    for key in list_keys(cls):
        if key.field in attributes:
            default = _state_default(attributes[key.field])
            definitions[key.field] = (_translate(hints[key.field]), ModelField(alias=key.name, **default))
        else:
            hint = get_type_hints(getattr(cls, key.field).fget, include_extras=True)["return"]
            definitions[key.field] = (_translate(hint), ModelField(alias=key.name, default=None))
    summary = (cls.__doc__ or cls.__name__).strip().split("\n\n")[0].replace("\n", " ")
    return create_model(f"Stored{cls.__name__}", __base__=ResultTable, __doc__=summary, **definitions)


def _state_default(field: Field[Any]) -> dict[str, Any]:
    if field.default is not MISSING:
        return {"default": field.default}
    return {} if field.default_factory is MISSING else {"default_factory": field.default_factory}


def _take_fields(cls: type[Any], model: BaseModel) -> dict[str, Any]:
    names = {field.name for field in fields(cls)}
    return {key.field: getattr(model, key.field) for key in list_keys(cls) if key.field in names}


def _translate(hint: Any) -> Any:
    """Return the annotation with which pydantic reads what a record's annotation says."""
    from pydantic import AfterValidator

    from seaopt.documents import Flag, Number, Whole

    origin, arguments = get_origin(hint), get_args(hint)
    if origin is Annotated:
        return _translate_marked(arguments[0], arguments[1:])
    if origin in (Union, types.UnionType):
        return Union[tuple(_translate(each) for each in arguments)]  # noqa: UP007  # of a tuple
    if origin is tuple and arguments[-1] is not ...:
        return tuple[tuple(_translate(each) for each in arguments)]  # pyright: ignore[reportInvalidTypeArguments]
    if origin is tuple:
        return Annotated[list[_translate(arguments[0])], AfterValidator(tuple)]
    if origin is list:
        return list[_translate(arguments[0])]
    if origin in (dict, Mapping):
        return dict[_translate(arguments[0]), _translate(arguments[1])]
    if isinstance(hint, type) and issubclass(hint, AbstractArray):
        return _translate_array(hint, {bool: Flag, int: Whole, float: Number}[_find_kind(hint)])
    if hasattr(hint, "_from_json"):
        content = get_type_hints(hint._from_json, include_extras=True)["content"]
        content = Annotated[content, Fields(of=hint)] if content == Mapping[str, Any] else content
        return Annotated[_translate(content), AfterValidator(_explain(hint._from_json))]
    if is_dataclass(hint):
        cls = cast(type[Any], hint)
        return Annotated[make_model(cls), AfterValidator(_explain(lambda model: cls(**_take_fields(cls, model))))]
    return {float: Number, int: Whole, bool: Flag}.get(hint, hint)


def _translate_marked(hint: Any, marks: Sequence[Any]) -> Any:
    """Return the annotation of a hint with marks of this module, or with pydantic's own."""
    from pydantic import AfterValidator, BeforeValidator, WithJsonSchema
    from pydantic import Field as ModelField

    from seaopt.documents import Number

    mark, *further = marks
    if further:
        return Annotated[_translate_marked(hint, [mark]), *further]
    if isinstance(mark, Fields):
        return Annotated[make_model(mark.of), AfterValidator(lambda model: _take_fields(mark.of, model))]
    if isinstance(mark, Constraints):
        limits = {key.name: value for key in list_keys(Constraints) if (value := getattr(mark, key.name)) is not None}
        return Annotated[_translate(hint), ModelField(**limits)]
    if not isinstance(mark, NullIs):
        return _translate(hint)
    either = WithJsonSchema({"anyOf": [{"type": "number"}, {"type": "null"}]})
    number = Annotated[Number, BeforeValidator(lambda value: mark.value if value is None else value), either]
    return number if hint is float else _translate_array(hint, number)


def _translate_array(hint: type[AbstractArray], number: Any) -> Any:
    from pydantic import AfterValidator

    if "complex128" in hint.dtypes:
        parts = dict[str, _translate_marked(Float[np.ndarray, hint.dim_str], [NullIs(value=math.nan)])]
        return Annotated[parts, AfterValidator(lambda read: read["re"] + 1j * read["im"])]

    def convert(rows: Any) -> np.ndarray:
        try:
            array = np.array(rows, dtype=_find_kind(hint))
        except ValueError:
            raise ValueError("should have rows of one length") from None
        return array if free else array.reshape(array.shape + (0,) * (len(hint.dims) - array.ndim))  # [] has no columns

    free, rows = "..." in hint.dim_str, list[number]
    if free:
        return Annotated[rows | list[rows], AfterValidator(convert)]
    for _ in hint.dims[1:]:
        rows = list[rows]
    return Annotated[rows, AfterValidator(convert)]


def _find_kind(hint: type[AbstractArray]) -> type[bool] | type[int] | type[float]:
    return bool if "bool" in hint.dtypes else int if "int64" in hint.dtypes else float


def _explain(build: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """Let pydantic say where in the file stands what a record refuses."""

    def checked(value: Any) -> Any:
        try:
            return build(value)
        except SeaoptError as error:
            raise ValueError(str(error)) from error

    return checked
