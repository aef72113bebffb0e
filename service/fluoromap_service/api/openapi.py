"""The OpenAPI document, with the errors as the service sends them."""

from __future__ import annotations

from typing import Any

from fastapi import FastAPI

from fluoromap_service.api.http.problems import MEDIA_TYPE

_PROBLEM = {MEDIA_TYPE: {"schema": {"$ref": "#/components/schemas/ProblemDocument"}}}
_NOT_SENT = ("HTTPValidationError", "ValidationError")


def document(app: FastAPI) -> dict[str, Any]:
    """The application's OpenAPI document; FastAPI would describe its own form of validation errors."""
    described = app.openapi()
    for operations in described["paths"].values():
        for operation in operations.values():
            for status, answer in operation["responses"].items():
                if status.startswith(("4", "5")) and "content" in answer:
                    kept = {kind: form for kind, form in answer["content"].items() if kind == MEDIA_TYPE and form}
                    answer["content"] = kept or _PROBLEM
    for name in _NOT_SENT:
        described["components"]["schemas"].pop(name, None)
    return described
