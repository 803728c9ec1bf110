"""Options that are written once: what a record, its documentation, a problem file and its page make of them."""

from __future__ import annotations

import runpy
from dataclasses import fields
from typing import Literal

import pytest

import seaopt as so
from seaopt.documents import check_table
from seaopt.errors import ControlError, ProblemError
from seaopt.options import check_options, option
from seaopt.problem.option_tables import make_record, table_of
from seaopt.problem.schema import ControllerTable
from seaopt.records import record
from tests.pages import DOCS


@record
class Inner:
    """A part."""

    corner_hz: float | None = option("Where it bends.", default=None, unit="Hz", above=0.0)


@record(keywords=True)
class Invented:
    """A record that no table knows yet.

    Raises
    ------
    ControlError
        A value is out of range.

    """

    share: float = option("How much.", default=0.25, least=0.0, below=0.5)
    count: int = option("How many.", default=3, least=1, most=10)
    way: Literal["up", "down"] = option("Which way.", default="up", stated=True)
    part: Inner | None = option("A part.", default=None, switch=True)
    source: str = option("Where from.", default="here", key="from")

    def __post_init__(self):
        check_options(self, ControlError)


def read(**content):
    return make_record(Invented, check_table(table_of(Invented), content, "p.toml", error=ProblemError))


def test_a_file_gives_the_record():
    assert read(way="down") == Invented(way="down")
    written = read(way="up", share=0.1, count=5, part={"corner_hz": 3}, **{"from": "there"})
    assert written == Invented(share=0.1, count=5, part=Inner(corner_hz=3.0), source="there")
    assert read(way="up", part=True).part == Inner()
    assert read(way="up", part=False).part is None


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ({}, "key way is missing"),
        ({"way": "up", "share": 0.5}, "share = 0.5: should be less than 0.5; correct it: share = 0.25"),
        ({"way": "up", "count": 11}, "count = 11: should be less than or equal to 10; correct it: count = 10"),
        ({"way": "up", "count": True}, "count = True: should be a valid integer"),
        ({"way": "up", "shar": 0.1}, 'unknown key shar; did you mean "share"'),
        ({"way": "up", "part": {"corner_hz": 0}}, "part.corner_hz = 0: should be greater than 0"),
        ({"way": "side"}, "way = 'side': should be 'up' or 'down'"),
    ],
)
def test_a_file_is_refused_by_key(content, words):
    with pytest.raises(ProblemError) as raised:
        read(**content)
    assert words in str(raised.value)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"share": 0.5}, "share = 0.5 is not from 0 to below 0.5; give share = 0.25"),
        ({"share": float("nan")}, "share = nan is not a finite number"),
        ({"count": 2.5}, "count = 2.5 is not a whole number"),
        ({"count": True}, "count = True is not a whole number"),
        ({"way": "side"}, 'way = "side" is not known'),
        ({"shar": 0.1}, 'Invented has no shar; did you mean "share"'),
    ],
)
def test_the_record_refuses_the_same(given, words):
    with pytest.raises(so.SeaoptError) as raised:
        Invented(**given)
    assert words in str(raised.value)


def test_the_documentation_has_each_option_before_the_errors():
    text = Invented.__doc__
    assert "share : float, from 0 to below 0.5, default 0.25\n        How much." in text
    assert 'way : {"up", "down"}, default "up"' in text and "part : Inner, optional" in text
    assert text.index("Parameters\n") < text.index("source : str") < text.index("Raises\n")


def test_the_schema_has_ranges_units_and_texts():
    schema = table_of(Invented).model_json_schema()
    assert schema["required"] == ["way"] and schema["additionalProperties"] is False
    share = schema["properties"]["share"]
    assert (share["minimum"], share["exclusiveMaximum"], share["default"]) == (0.0, 0.5, 0.25)
    assert schema["properties"]["from"]["description"] == "Where from."
    assert schema["$defs"]["InnerTable"]["properties"]["corner_hz"]["unit"] == "Hz"


def test_a_specification_has_no_field_that_is_no_option():
    assert all("option" in one.metadata for one in fields(so.ControllerSpec))
    assert {one.name for one in fields(so.ControllerSpec)} - {*ControllerTable.model_fields} == {"bandwidth_tolerance"}


def test_the_page_of_keys_is_that_of_the_schema():
    page = runpy.run_path(str(DOCS / "problem_keys.py"))
    written = page["PAGE"].read_text(encoding="utf-8")
    assert written == page["format_page"](), "python docs/problem_keys.py writes it"
