"""The JSON Schemas of the files that seaopt reads, for editors."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from pydantic import BaseModel

from seaopt.errors import SeaoptError, suggestion

DOCUMENTS = {
    "problem": ("seaopt.problem.schema", "ProblemTable"),
    "controller": ("seaopt.control.laws.stored", "StoredController"),
    "fit": ("seaopt.estimation.result.stored", "StoredFit"),
    "robustness": ("seaopt.robustness.certificate.stored", "StoredCertificate"),
}


def json_schema(document: str) -> dict[str, Any]:
    """Return a document's JSON Schema.

    Raises
    ------
    SeaoptError
        There is no such document.

    """
    if document not in DOCUMENTS:
        raise SeaoptError(f'schema "{document}" is not known; {suggestion(document, DOCUMENTS)}')
    module, name = DOCUMENTS[document]
    model: type[BaseModel] = getattr(import_module(module), name)
    return model.model_json_schema(by_alias=True)
