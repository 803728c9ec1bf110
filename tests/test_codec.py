"""Records to JSON and back, by what their annotations say."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from typing import Annotated, Any, Literal

import jsonschema
import numpy as np
import pytest
from jaxtyping import Float

from seaopt.codec import (
    Constraints,
    Fields,
    Key,
    OrInfinite,
    OrNaN,
    check_agrees,
    from_content,
    json_schema,
    to_content,
)  # fmt: skip
from seaopt.errors import FileError, SeaoptError
from seaopt.files import seal, to_json
from seaopt.records import record


@record
class Band:
    low_hz: Annotated[float, Constraints(gt=0.0)]
    high_hz: OrInfinite = math.inf

    def __post_init__(self):
        if not self.low_hz < self.high_hz:
            raise SeaoptError("low_hz is not below high_hz")


@record(eq=False)
class Named:
    """Has its name from the key of the table that it stands in."""

    json_keys = ("gain",)

    name: str
    gain: float


@record(eq=False)
class NamedSet:
    members: tuple[Named, ...] = ()

    @classmethod
    def _from_json(cls, content: Mapping[str, Annotated[Mapping[str, Any], Fields(of=Named)]]) -> NamedSet:
        return cls(members=tuple(Named(name=name, **own) for name, own in content.items()))


@record(eq=False)
class Everything:
    """One field of every kind."""

    json_keys = (
        *("kind", "count", "on", "label", "pair", "values", "matrix", "bands", "either", "score", "double"),
        *(Key(field="inner", name="renamed"), Key(field="absent", name="absent", omit_none=True)),
    )

    kind: Literal["a", "b"]
    count: int
    on: bool
    label: str | None
    pair: tuple[float, float]
    values: tuple[float, ...]
    matrix: Float[np.ndarray, "n m"]
    bands: Mapping[str, Band]
    either: str | Band
    score: OrNaN = math.nan
    inner: Band | None = None
    absent: float | None = None
    left_out: object = None

    @property
    def double(self) -> int:
        return 2 * self.count


WHOLE = Everything(
    kind="a", count=2, on=True, label=None, pair=(1.0, 2.0), values=(1.0,), matrix=np.eye(2),
    bands={"x": Band(low_hz=1.0)}, either=Band(low_hz=2.0, high_hz=3.0), left_out=object(),
)  # fmt: skip


def read(content, cls=Everything):
    return from_content(cls, content, "it.json", remedy="make it again")


def test_a_record_is_read_back_as_it_was_written():
    text = to_json(to_content(WHOLE))
    content = json.loads(text)
    assert list(content) == [
        "kind", "count", "on", "label", "pair", "values", "matrix", "bands", "either", "score", "double", "renamed",
    ]  # fmt: skip
    assert content["bands"] == {"x": {"low_hz": 1.0, "high_hz": None}} and content["double"] == 4
    again = read(content)
    assert again.bands == WHOLE.bands and again.either == WHOLE.either and again.left_out is None
    assert again.values == (1.0,) and again.pair == (1.0, 2.0) and math.isnan(again.score)
    assert to_json(to_content(again)) == text


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"kind": "c"}, "kind = 'c': should be 'a' or 'b'; make it again"),
        ({"count": True}, "count = True: should be a valid integer; make it again"),
        ({"count": 2.5}, "count = 2.5"),
        ({"on": 1}, "on = 1: should be a valid boolean"),
        ({"score": "1.0"}, "score = '1.0': should be a valid number"),
        ({"pair": [1.0]}, "pair = [1.0] is not a range"),
        ({"values": 1.0}, "values = 1.0: should be a valid list"),
        ({"values": [1.0, None]}, "values.2 = None: should be a valid number"),
        ({"matrix": [[1.0], [1.0, 2.0]]}, "matrix = [[1.0], [1.0, 2.0]]: should have rows of one length"),
        ({"bands": {"x": {}}}, "key bands.x.low_hz is missing"),
        ({"bands": {"x": {"low_hz": 0.0}}}, "bands.x.low_hz = 0.0: should be greater than 0"),
        ({"bands": {"x": {"low_hz": 2.0, "high_hz": 1.0}}}, "bands.x: low_hz is not below high_hz; make it again"),
        ({"renamed": 3}, "renamed = 3: should be a table"),
        ({"double": "4"}, "double = '4'"),
    ],
)
def test_a_mistake_names_file_place_value_and_remedy(change, words):
    content = json.loads(to_json(to_content(WHOLE)))
    with pytest.raises(FileError) as raised:
        read(content | change)
    assert str(raised.value).startswith("it.json: ") and words in str(raised.value)
    assert "\n" not in str(raised.value)


def test_what_a_property_says_is_compared():
    content = json.loads(to_json(to_content(WHOLE)))
    check_agrees(content, to_content(read(content)), "it.json", remedy="make it again")
    wrong = content | {"double": 5}
    with pytest.raises(FileError, match=r"it\.json: double is 5, and the other keys make 4; make it again"):
        check_agrees(wrong, to_content(read(wrong)), "it.json", remedy="make it again")


def test_a_class_may_read_what_is_named_by_its_key():
    @record(eq=False)
    class Holder:
        members: NamedSet

    read_back = from_content(Holder, {"members": {"x": {"gain": 2.0}}}, "it.json", remedy="make it again")
    assert [(each.name, each.gain) for each in read_back.members.members] == [("x", 2.0)]


def test_an_edited_file_is_refused_by_its_digest():
    content = seal(json.loads(to_json(to_content(WHOLE))))
    assert read(content).count == 2
    with pytest.raises(FileError, match="edited"):
        read(content | {"count": 3})


def test_the_schema_is_that_of_the_file():
    schema, content = json_schema(Everything), json.loads(to_json(to_content(WHOLE)))
    jsonschema.validate(content, schema)
    assert schema["description"] == "One field of every kind." and "left_out" not in schema["properties"]
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate(content | {"bands": {"x": {"low_hz": 0.0}}}, schema)
