"""The JSON Schemas of the files that seaopt reads, for editors."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from seaopt.codec import json_schema as record_schema
from seaopt.errors import SeaoptError, suggestion

DIALECT = "https://json-schema.org/draft/2020-12/schema"
DOCUMENTS = {  # the module of each, its record or what makes its schema, its title, and the version that it stands for
    "problem": ("seaopt.problem.schema", "json_schema", "seaopt problem file", 1),
    "fit": ("seaopt.estimation.result.fit_result", "Fit", "seaopt fit.json", 2),
    "controller": ("seaopt.control.scheduling.stored", "controller_schema", "seaopt controller.json", 3),
    "robustness": ("seaopt.robustness.certificate.stored", "robustness_schema", "seaopt robustness.json", 3),
}


def json_schema(document: str) -> dict[str, Any]:
    """Return a document's JSON Schema; raise a SeaoptError where there is no such document."""
    if document not in DOCUMENTS:
        raise SeaoptError(
            f'schema "{document}" is not known; {suggestion(document, DOCUMENTS)} (type seaopt schema problem)'
        )
    module, name, title, version = DOCUMENTS[document]
    made = getattr(import_module(module), name)
    schema = record_schema(made) if isinstance(made, type) else made()
    return {"$schema": DIALECT, "$id": f"urn:seaopt:{document}:{version}", **schema, "title": title}
