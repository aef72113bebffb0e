"""Authorisation of every route, found by walking the application itself: no list can forget one."""

from __future__ import annotations

import re
from collections.abc import Iterator

import pytest
from fastapi.testclient import TestClient
from starlette.routing import Mount, Route

from fluoromap_service import auth
from fluoromap_service.api.app import create_app
from fluoromap_service.api.http.security import OPEN_PATHS, SESSION

READING = frozenset({"GET", "HEAD", "OPTIONS"})
EXTRA = [
    ("GET", "/"),
    ("GET", "/docs"),
    ("GET", "/dicom-web/studies"),
    ("POST", "/dicom-web/studies"),
    ("GET", "/v1/none"),
]
"""Addresses that need not exist: also an unknown one must not show to a stranger whether it exists."""


def _walk(routes: object, prefix: str = "") -> Iterator[tuple[str, str]]:
    for route in routes:  # type: ignore[attr-defined]
        if isinstance(route, Mount):
            yield from _walk(route.routes, prefix + route.path)
        elif isinstance(route, Route):
            for method in route.methods or {"GET"}:
                yield method, prefix + route.path
        elif hasattr(route, "path"):
            yield from ((method, prefix + route.path) for method in getattr(route, "methods", None) or {"GET"})
        elif hasattr(route, "original_router"):
            yield from _walk(route.original_router.routes, prefix)


def _all_routes() -> list[tuple[str, str]]:
    app = create_app()
    found = set(_walk(app.routes))
    described = {
        (method.upper(), path) for path, methods in app.openapi()["paths"].items() for method in methods
    }  # fmt: skip
    assert described <= found, "the walk misses routes"
    return sorted({*found, *EXTRA})


ROUTES = _all_routes()


def _ask(service: TestClient, method: str, path: str, token: str | None) -> int:
    headers = {} if token is None else {"Authorization": f"Bearer {token}"}
    return service.request(method, re.sub(r"\{[^}]*\}", "1", path), headers=headers).status_code


@pytest.mark.parametrize("kind", ["none", "wrong", "expired", "revoked"])
def test_no_route_answers_without_a_valid_token(service: TestClient, kind: str) -> None:
    auth.create_token("x", ["admin"])
    tokens = {
        "none": None,
        "wrong": "fm_wrong",
        "expired": auth.create_token("expired", ["admin"], 1e-6),
        "revoked": auth.create_token("revoked", ["admin"]),
    }
    auth.revoke_token("revoked")
    assert len(ROUTES) > 40
    for method, path in ROUTES:
        status = _ask(service, method, path, tokens[kind])
        if path in OPEN_PATHS and method == "GET":
            assert status in (200, 503), (method, path)
        elif path not in OPEN_PATHS:
            # 429: after some wrong tokens the address is refused before anybody looks at the route.
            assert status in ((401,) if kind == "none" else (401, 429)), (method, path)


def test_a_reading_token_reaches_no_route_that_writes(service: TestClient) -> None:
    token = auth.create_token("x", ["read"])
    # A session of a browser changes no study.
    writing = [
        (method, path) for method, path in ROUTES if method not in READING and path not in {SESSION, *OPEN_PATHS}
    ]
    assert len(writing) > 10
    for method, path in writing:
        assert _ask(service, method, path, token) == 403, (method, path)


def test_a_valid_token_passes_the_door_of_every_route(service: TestClient) -> None:
    token = auth.create_token("x", ["write"])
    for method, path in ROUTES:
        if path not in OPEN_PATHS:
            assert _ask(service, method, path, token) not in (401, 403, 429, 500), (method, path)
