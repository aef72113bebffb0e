"""The OpenAPI document of the service, with its problem documents as errors."""

from __future__ import annotations

from typing import Any

from fastapi import FastAPI

from fluoromap_service.api.http.problems import MEDIA_TYPE

_PROBLEM = {MEDIA_TYPE: {"schema": {"$ref": "#/components/schemas/ProblemDocument"}}}
_UNUSED_SCHEMAS = ("HTTPValidationError", "ValidationError")


def document(app: FastAPI) -> dict[str, Any]:
    """Return the application's OpenAPI document.

    FastAPI describes its own form of validation errors; the service sends problem documents instead. It describes the items of an
    event stream in the words of OpenAPI 3.2, which generators of clients refuse in a document of version 3.1.
    """
    openapi = app.openapi()
    for operations in openapi["paths"].values():
        for operation in operations.values():
            for status, answer in operation["responses"].items():
                if status.startswith(("4", "5")) and "content" in answer:
                    problems = {kind: form for kind, form in answer["content"].items() if kind == MEDIA_TYPE and form}
                    answer["content"] = problems or _PROBLEM
                for form in answer.get("content", {}).values():
                    if form.pop("itemSchema", None):
                        form["schema"] = {"type": "string"}
    for name in _UNUSED_SCHEMAS:
        openapi["components"]["schemas"].pop(name, None)
    return openapi
