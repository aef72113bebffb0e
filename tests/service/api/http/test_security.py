"""Who is let in: tokens, scopes, an open service on a loopback address, and no route that forgot to ask."""

from __future__ import annotations

import re
import sqlite3
import time
from pathlib import Path

import pytest
from fastapi.testclient import TestClient
from sql_statements import sql_statements

from fluoromap_service import auth
from fluoromap_service.api.app import create_app
from fluoromap_service.api.http.security import OPEN_PATHS
from fluoromap_service.auth import callers
from fluoromap_service.problem import Problem
from fluoromap_service.settings import settings
from fluoromap_service.store import schema


def _bearer(token: str) -> dict[str, str]:
    return {"Authorization": f"Bearer {token}"}


def test_without_a_token_made_the_service_is_open_on_loopback(service: TestClient) -> None:
    for host in ("localhost:8000", "127.0.0.1", "[::1]:9", "LOCALHOST"):
        assert service.get("/v1/studies", headers={"Host": host}).status_code == 200
    assert service.get("/v1/studies", headers={"Origin": "http://127.0.0.1"}).status_code == 200


@pytest.mark.parametrize(
    "headers",
    [
        {"Host": "evil.example"},
        {"Host": "127.0.0.1.evil.example:8000"},
        {"Host": ""},
        {"Host": "[broken"},
        {"Origin": "http://evil.example"},
        {"Origin": "null"},
        {"Origin": "http://127.0.0.1:8001"},
        {"Origin": "https://127.0.0.1"},
        {"Host": "localhost:8000", "Origin": "http://localhost:9000"},
    ],
)
def test_an_open_service_answers_no_foreign_page(service: TestClient, headers: dict[str, str]) -> None:
    answer = service.post("/v1/studies", json={"label": "x"}, headers=headers)
    assert answer.status_code == 403
    assert answer.headers["content-type"] == "application/problem+json"


@pytest.mark.parametrize(
    "header",
    ["Forwarded", "Via", "X-Forwarded-For", "X-Forwarded-Proto", "X-Forwarded-Host", "X-Forwarded-Prefix", "X-Real-IP"],
)
def test_an_open_service_answers_no_proxy(service: TestClient, header: str) -> None:
    for path in ("/v1/studies", "/", "/metrics", "/dicom-web/studies"):
        answer = service.get(path, headers={"Host": "127.0.0.1:8000", header: "192.0.2.7"})
        assert (answer.status_code, answer.json()["code"]) == (403, "forwarded"), path
    assert service.get("/v1/health", headers={header: "192.0.2.7"}).status_code == 200
    token = auth.create_token("first", ["write"])
    assert service.get("/v1/studies", headers={header: "192.0.2.7", **_bearer(token)}).status_code == 200


def test_an_open_service_on_another_address_answers_nobody(data_dir: object) -> None:
    client = TestClient(create_app(), base_url="http://192.0.2.7")
    assert client.get("/v1/studies").status_code == 401
    assert client.get("/v1/studies", headers={"Host": "localhost"}).status_code == 401


def test_the_first_token_closes_the_service_at_once(service: TestClient) -> None:
    assert service.get("/v1/studies").status_code == 200
    token = auth.create_token("first", ["read"])
    answer = service.get("/v1/studies")
    assert answer.status_code == 401
    assert answer.headers["www-authenticate"].startswith("Bearer")
    assert service.get("/v1/studies", headers=_bearer(token)).status_code == 200
    assert (
        service.get("/v1/studies", headers={"Authorization": f"bearer {token}", "Host": "any.name"}).status_code == 200
    )
    auth.revoke_token("first")
    assert service.get("/v1/studies", headers=_bearer(token)).status_code == 401
    assert service.get("/v1/studies").status_code == 401


def _asks_for_tokens(service: TestClient, headers: dict[str, str]) -> bool:
    with sql_statements() as statements:
        assert service.get("/v1/studies", headers=headers).status_code == 200
    return any("FROM token" in statement for statement in statements)


def test_a_sign_in_is_remembered_until_the_database_changes(service: TestClient) -> None:
    assert [_asks_for_tokens(service, {}) for _ in range(2)] == [True, False]
    first, second = auth.create_token("first", ["read"]), auth.create_token("second", ["write"])
    for token in (first, second):
        assert [_asks_for_tokens(service, _bearer(token)) for _ in range(2)] == [True, False]
    service.post("/v1/studies", json={"label": "x"}, headers=_bearer(second))
    assert [_asks_for_tokens(service, _bearer(first)) for _ in range(2)] == [True, False]
    # A token that is remembered gives another one no rights.
    assert service.post("/v1/studies", json={"label": "x"}, headers=_bearer(first)).status_code == 403
    for headers in ({}, _bearer("wrong"), _bearer(f"{first}x")):
        assert service.get("/v1/studies", headers=headers).status_code == 401


def test_another_program_revokes_a_remembered_token(service: TestClient, data_dir: Path) -> None:
    token = auth.create_token("x", ["read"])
    for _ in range(2):
        assert service.get("/v1/studies", headers=_bearer(token)).status_code == 200
    program = sqlite3.connect(data_dir / "fluoromap.sqlite")
    program.execute("UPDATE token SET revoked = 1")
    assert service.get("/v1/studies", headers=_bearer(token)).status_code == 200
    program.commit()
    program.close()
    assert service.get("/v1/studies", headers=_bearer(token)).status_code == 401


def test_a_remembered_token_expires(service: TestClient, monkeypatch: pytest.MonkeyPatch) -> None:
    token = auth.create_token("brief", ["read"], expires_seconds=3600)
    assert [_asks_for_tokens(service, _bearer(token)) for _ in range(2)] == [True, False]
    later = time.time() + 3601
    monkeypatch.setattr(callers.time, "time", lambda: later)
    # Only the memory believes that the hour is over; the database's clock says that the token is valid.
    assert _asks_for_tokens(service, _bearer(token))


def test_postgresql_is_asked_each_time(postgres_url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FLUOROMAP_DATABASE_URL", postgres_url)
    settings.cache_clear()
    schema.upgrade()
    service = TestClient(create_app(), base_url="http://127.0.0.1")
    assert service.get("/v1/studies").status_code == 200
    token = auth.create_token("x", ["read"])
    assert service.get("/v1/studies").status_code == 401
    assert [_asks_for_tokens(service, _bearer(token)) for _ in range(2)] == [True, True]
    auth.revoke_token("x")
    assert service.get("/v1/studies", headers=_bearer(token)).status_code == 401


@pytest.mark.parametrize("header", ["Bearer", "Bearer ", "Bearer wrong", "Basic dXNlcjpwYXNz", "wrong", "Bearer \xe4"])
def test_what_is_no_token(service: TestClient, header: str) -> None:
    auth.create_token("one", ["admin"])
    assert service.get("/v1/studies", headers={"Authorization": header.encode("latin-1")}).status_code == 401


def test_scopes_imply_the_lower_ones(service: TestClient) -> None:
    read, write, admin = (auth.create_token(scope, [scope]) for scope in ("read", "write", "admin"))
    answer = service.post("/v1/studies", json={"label": "x"}, headers=_bearer(read))
    assert (answer.status_code, answer.json()["code"]) == (403, "forbidden")
    for token in (write, admin):
        assert service.post("/v1/studies", json={"label": "x"}, headers=_bearer(token)).status_code == 201
        assert service.get("/v1/studies", headers=_bearer(token)).status_code == 200


def test_a_token_for_the_metrics_reads_nothing_else(service: TestClient) -> None:
    monitor, reader = auth.create_token("prometheus", ["metrics"]), auth.create_token("reader", ["read"])
    for token in (monitor, reader):
        assert service.get("/metrics", headers=_bearer(token)).status_code == 200
    assert service.post("/metrics", headers=_bearer(monitor)).status_code == 403
    assert service.post("/session", headers=_bearer(monitor)).status_code == 403
    for path, methods in create_app().openapi()["paths"].items():
        if path in OPEN_PATHS or path == "/metrics":
            continue
        for method in methods:
            answer = service.request(method, re.sub(r"\{[^}]*\}", "1", path), headers=_bearer(monitor))
            assert (answer.status_code, answer.json()["code"]) == (403, "forbidden"), (method, path)


def test_a_token_expires(service: TestClient) -> None:
    token = auth.create_token("brief", ["read"], expires_seconds=1e-6)
    assert service.get("/v1/studies", headers=_bearer(token)).status_code == 401


def test_only_the_hash_is_kept(service: TestClient, data_dir: object) -> None:
    token = auth.create_token("one", ["read", "write"], 3600)
    (listed,) = auth.list_tokens()
    assert (listed.name, listed.scopes, listed.revoked) == ("one", ("read", "write"), None)
    assert listed.expires == pytest.approx(listed.created + 3600)
    assert token not in repr(listed)


@pytest.mark.parametrize(
    ("name", "scopes", "lifetime"),
    [("", ["read"], None), ("x" * 101, ["read"], None), ("x", [], None), ("x", ["root"], None), ("x", ["read"], 0)],
)
def test_tokens_that_cannot_be_made(data_dir: object, name: str, scopes: list[str], lifetime: float | None) -> None:
    with pytest.raises(Problem) as problem:
        auth.create_token(name, scopes, lifetime)
    assert (problem.value.status, problem.value.code) == (422, "invalid_token")
    assert not auth.any_token()


def test_a_name_is_taken_once(data_dir: object) -> None:
    auth.create_token("x", ["read"])
    with pytest.raises(Problem, match="already"):
        auth.create_token("x", ["read"])
    with pytest.raises(Problem, match="no token"):
        auth.revoke_token("y")


def test_other_addresses_need_a_token_to_start(data_dir: object) -> None:
    for host in ("127.0.0.1", "localhost", "::1"):
        auth.check_may_start(host)
    for host in ("0.0.0.0", "::", "192.0.2.7", "fluoromap.example"):
        with pytest.raises(Problem, match="token create"):
            auth.check_may_start(host)
    auth.create_token("x", ["read"])
    auth.check_may_start("0.0.0.0")


def test_every_route_but_the_open_ones_asks_for_a_token(service: TestClient) -> None:
    auth.create_token("x", ["admin"])
    paths = create_app().openapi()["paths"]
    assert len(paths) > 20
    asked = [(method, path) for path, methods in paths.items() for method in methods]
    for method, path in [*asked, ("get", "/v1/openapi.json"), ("get", "/"), ("get", "/metrics"), ("get", "/docs")]:
        answer = service.request(method, re.sub(r"\{[^}]*\}", "1", path))
        if path in OPEN_PATHS:
            assert answer.status_code in (200, 503)
        else:
            assert answer.status_code == 401, (method, path)


def test_a_reading_token_changes_nothing(service: TestClient) -> None:
    token = auth.create_token("x", ["read"])
    for path, methods in create_app().openapi()["paths"].items():
        for method in set(methods) - {"get"}:
            answer = service.request(method, re.sub(r"\{[^}]*\}", "1", path), headers=_bearer(token))
            assert answer.status_code == 403, (method, path)


def test_the_document_of_the_doors(service: TestClient) -> None:
    document = service.get("/v1/openapi.json").json()
    for path, methods in document["paths"].items():
        for method, operation in methods.items():
            assert operation.get("summary"), (method, path)
            if path not in OPEN_PATHS:
                assert operation.get("security"), (method, path)
                assert "401" in operation["responses"], (method, path)
            for status, answer in operation["responses"].items():
                if status.startswith("4"):
                    assert list(answer["content"]) == ["application/problem+json"], (method, path, status)
    assert service.get("/redoc").status_code == 404
