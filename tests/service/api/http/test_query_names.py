"""A query parameter that a route does not know is refused, on every route."""

from __future__ import annotations

import re

import pytest
from fastapi.testclient import TestClient

from fluoromap_service.api.app import create_app

OPERATIONS = [
    (method, re.sub(r"\{n\}", "1", path))
    for path, methods in create_app().openapi()["paths"].items()
    for method in methods
]


@pytest.mark.parametrize(("method", "path"), [*OPERATIONS, ("get", "/v1/openapi.json")])
def test_every_route_refuses_an_unknown_parameter(service: TestClient, method: str, path: str) -> None:
    answer = service.request(method, f"{path}?limt=5&origin2=isocentre")
    assert (answer.status_code, answer.json()["code"]) == (422, "unknown_parameter")
    assert [place["where"] for place in answer.json()["errors"]] == ["query.limt", "query.origin2"]


def test_the_known_parameters_are_in_the_answer(service: TestClient) -> None:
    places = service.get("/v1/jobs?stdy=1").json()["errors"]
    assert places == [{"where": "query.stdy", "message": "unknown; use cursor, limit, study"}]
    places = service.get("/v1/plugins?kind=fuser").json()["errors"]
    assert places == [{"where": "query.kind", "message": "unknown; this address has no parameters"}]


def test_known_parameters_pass(service: TestClient) -> None:
    assert service.get("/v1/jobs?limit=5&study=x").status_code == 200
    assert service.get("/v1/studies?limit=5").status_code == 200
