"""`seaopt schema` against what the commands read and write."""

from __future__ import annotations

import functools
import json
import tomllib
from pathlib import Path

import pytest

from seaopt.cli.schemas import DOCUMENTS, json_schema
from seaopt.control.laws.stored import CONTROLLER_SCHEMA
from seaopt.estimation.result.fit_result import FIT_SCHEMA
from seaopt.robustness.certificate.certificate import ROBUSTNESS_SCHEMA

jsonschema = pytest.importorskip("jsonschema")
PROBLEMS = Path(__file__).resolve().parents[2] / "problems"
RESULTS = {"fit": "fit.json", "controller": "controller.json", "robustness": "robustness.json"}


@functools.cache  # to check the schema of a problem file takes a second
def validator(document):
    schema = json_schema(document)
    jsonschema.Draft202012Validator.check_schema(schema)
    return jsonschema.Draft202012Validator(schema)


@pytest.mark.parametrize("path", sorted(PROBLEMS.glob("*.toml")), ids=lambda path: path.stem)
def test_problem_files_agree(path):
    content = tomllib.loads(path.read_text(encoding="utf-8"))
    assert not list(validator("problem").iter_errors(content))
    for wrong in ({"plants": {}}, {"plant": {"stand": {}}}, {"controller": {"plant": "stand", "bandwith_hz": 30}}):
        assert list(validator("problem").iter_errors(content | wrong))


@pytest.mark.parametrize("document", RESULTS)
def test_results_agree(done, document):
    content = json.loads((done.results / RESULTS[document]).read_text(encoding="utf-8"))
    check = validator(document)
    assert not [f"{error.json_path}: {error.message}" for error in check.iter_errors(content)]
    for key in check.schema["required"]:
        assert list(check.iter_errors({name: value for name, value in content.items() if name != key}))


@pytest.mark.parametrize(
    ("document", "written"),
    [("fit", FIT_SCHEMA), ("controller", CONTROLLER_SCHEMA), ("robustness", ROBUSTNESS_SCHEMA)],
)  # fmt: skip
def test_a_schema_has_the_version_of_the_files(document, written):
    assert json_schema(document)["$id"].rsplit(":", 1)[1] == written.rsplit("/", 1)[1]


@pytest.mark.parametrize("document", DOCUMENTS)
def test_every_schema_says_what_it_is_and_what_its_keys_mean(document):
    schema = json_schema(document)
    assert schema["$schema"].endswith("2020-12/schema") and schema["title"] and schema["description"]
    assert schema["$id"].startswith("https://") or schema["$id"].startswith("urn:")
    if document != "problem":
        return
    tables = [schema, *(table for table in schema["$defs"].values() if table.get("type") == "object")]
    bare = [f"{table['title']}.{key}" for table in tables for key, one in table["properties"].items()
            if not one.get("description")]  # fmt: skip
    assert not bare
