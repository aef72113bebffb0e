"""The OpenAPI document serves generators of clients: short names, and the media type of every body and answer."""

from __future__ import annotations

import re
from typing import Any

import pytest
from fastapi.routing import APIRoute

from fluoromap_service.api.app import create_app
from fluoromap_service.api.dicomweb import rendered, retrieve, search, store
from fluoromap_service.api.openapi import document

PATHS: dict[str, dict[str, Any]] = document(create_app())["paths"]
OPERATIONS = [
    (f"{method} {path}", operation) for path, methods in PATHS.items() for method, operation in methods.items()
]
FILES = {
    ".csv": {"text/csv"},
    ".png": {"image/png"},
    ".gif": {"image/gif"},
    ".html": {"text/html"},
    ".zip": {"application/zip"},
}
MEDIA_OF_TABLES = {"text/csv", "application/octet-stream"}
EMPTY = {"204", "304"}
Operation = dict[str, Any]


def test_operation_ids_are_short_and_unique() -> None:
    ids = [operation["operationId"] for _, operation in OPERATIONS]
    assert len(set(ids)) == len(ids)
    assert not [name for name in ids if not re.fullmatch(r"[a-z]+(_[a-z]+){0,3}", name) or len(name) > 30]


@pytest.mark.parametrize(("name", "operation"), OPERATIONS, ids=[name for name, _ in OPERATIONS])
def test_every_answer_has_its_media_type_and_schema(name: str, operation: Operation) -> None:
    for status, answer in operation["responses"].items():
        content = answer.get("content", {})
        assert bool(content) == (status not in EMPTY), status
        for form in content.values():
            assert form.get("schema"), status
            assert "itemSchema" not in form, "a word of OpenAPI 3.2"
        if status >= "400" and status != "503":
            assert set(content) == {"application/problem+json"}, status
    path = name.split()[1]
    for ending, media in FILES.items():
        if path.endswith(ending):
            assert set(operation["responses"]["200"]["content"]) == media


@pytest.mark.parametrize(("name", "operation"), OPERATIONS, ids=[name for name, _ in OPERATIONS])
def test_every_body_has_its_media_type_and_schema(name: str, operation: Operation) -> None:
    method, path = name.split()
    body = operation.get("requestBody")
    if body is None:
        assert method in ("get", "delete") or path.endswith((":cancel", ":retry"))
        return
    assert all(form["schema"] for form in body["content"].values())
    if path.endswith(("/activation-times", "/electrograms/{site}")):
        assert set(body["content"]) == MEDIA_OF_TABLES
    elif path.startswith("/dicom-web/"):
        assert set(body["content"]) == {"multipart/related"}
    elif path.endswith("/instances"):
        assert set(body["content"]) == {"multipart/form-data", "application/dicom"}
    else:
        assert set(body["content"]) == {"application/json"}


def test_the_routes_of_dicomweb_are_described() -> None:
    modules = (store, search, retrieve, rendered)
    routes = [route for module in modules for route in module.router.routes if isinstance(route, APIRoute)]
    assert {(route.path, method.lower()) for route in routes for method in route.methods} == {
        (path, method) for path, methods in PATHS.items() if path.startswith("/dicom-web/") for method in methods
    }
    for path, kinds in {
        "/studies": {"application/dicom+json", "application/json"},
        "/studies/{study_uid}/metadata": {"application/dicom+json", "application/json"},
        "/studies/{study_uid}": {"multipart/related", "application/dicom"},
        "/studies/{study_uid}/series/{series_uid}/instances/{uid}/frames/{numbers}": {
            "multipart/related",
            "application/octet-stream",
        },
        "/studies/{study_uid}/series/{series_uid}/instances/{uid}/rendered": {"image/jpeg", "image/png"},
    }.items():
        operation = PATHS[f"/dicom-web{path}"]["get"]
        assert set(operation["responses"]["200"]["content"]) == kinds
        assert "406" in operation["responses"]
        assert operation["tags"] == ["dicomweb"]


def test_binary_answers_and_texts_are_declared_as_such() -> None:
    for name, operation in OPERATIONS:
        for answer in operation["responses"].values():
            for media, form in answer.get("content", {}).items():
                if media in ("text/csv", "text/html"):
                    assert form["schema"]["type"] == "string", (name, media)
                    assert "format" not in form["schema"], (name, media)
                if media.startswith(("image/", "model/")) or media in ("application/zip", "application/x-matlab-data"):
                    assert form["schema"] == {"type": "string", "format": "binary"}, (name, media)
