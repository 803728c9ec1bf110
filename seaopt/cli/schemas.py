"""The JSON Schemas of the files that seaopt reads, for editors."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from pydantic import BaseModel

from seaopt.codec import json_schema as record_schema
from seaopt.errors import SeaoptError, suggestion
from seaopt.problem.schema import json_schema as problem_schema

DIALECT = "https://json-schema.org/draft/2020-12/schema"
DOCUMENTS = {  # the module and model of each, its title, and the version that it stands for
    "problem": ("seaopt.problem.schema", "ProblemTable", "seaopt problem file", 1),
    "fit": ("seaopt.estimation.result.fit_result", "Fit", "seaopt fit.json", 2),
    "controller": ("seaopt.control.laws.stored", "StoredController", "seaopt controller.json", 3),
    "schedule": ("seaopt.control.scheduling.stored", "StoredSchedule", "seaopt schedule.json", 2),
    "robustness": ("seaopt.robustness.certificate.stored", "StoredCertificate", "seaopt robustness.json", 2),
}


def json_schema(document: str) -> dict[str, Any]:
    """Return a document's JSON Schema; raise a SeaoptError where there is no such document."""
    if document not in DOCUMENTS:
        raise SeaoptError(
            f'schema "{document}" is not known; {suggestion(document, DOCUMENTS)} (type seaopt schema problem)'
        )
    module, name, title, version = DOCUMENTS[document]
    loaded = import_module(module)
    model: type[Any] = getattr(loaded, name)
    if document == "problem":
        schema = problem_schema()
    else:
        schema = model.model_json_schema(by_alias=True) if issubclass(model, BaseModel) else record_schema(model)
    return {"$schema": DIALECT, "$id": f"urn:seaopt:{document}:{version}", **schema, "title": title}
