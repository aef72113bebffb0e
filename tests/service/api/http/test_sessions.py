"""Sessions of browsers: sign in with a token, and no request of another origin."""

from __future__ import annotations

import pytest
from fastapi.testclient import TestClient

from fluoromap_service import auth
from fluoromap_service.api.http.session import COOKIE

HOST = "http://127.0.0.1"


@pytest.fixture
def token(service: TestClient) -> str:
    """Return a token that may read and write."""
    return auth.create_token("doctor", ["read", "write"])


def _sign_in(service: TestClient, token: str) -> None:
    answer = service.post("/session", headers={"Authorization": f"Bearer {token}"})
    assert answer.status_code == 204
    cookie = answer.headers["set-cookie"].lower()
    assert "httponly" in cookie
    assert "samesite=strict" in cookie


def test_open_service_shows_its_pages(service: TestClient) -> None:
    for path in ("/", "/docs", "/sign-in", "/studies/any", "/assets/studies/page.js"):
        assert service.get(path).status_code == 200
    assert service.get("/assets/../report.html.j2").status_code == 404
    assert service.get("/assets/missing.js").status_code == 404


def test_pages_may_run_their_own_scripts_only(service: TestClient) -> None:
    policy = service.get("/").headers["content-security-policy"]
    assert "script-src 'self'" in policy
    assert "unsafe" not in policy
    # A browser that has the page takes over the headers of the answer "unchanged".
    again = service.get("/", headers={"If-None-Match": service.get("/").headers["etag"]})
    assert (again.status_code, again.headers["content-security-policy"]) == (304, policy)


def test_page_without_session_leads_to_sign_in(service: TestClient, token: str) -> None:
    answer = service.get("/", headers={"Accept": "text/html"}, follow_redirects=False)
    assert (answer.status_code, answer.headers["location"]) == (303, "/sign-in")
    assert service.get("/sign-in").status_code == 200
    assert service.get("/assets/sign-in.js").status_code == 200
    assert service.get("/assets/studies/page.js", headers={"Accept": "*/*"}).status_code == 401
    assert service.get("/v1/studies", headers={"Accept": "text/html"}).status_code == 401


def test_session_reads_and_writes(service: TestClient, token: str) -> None:
    _sign_in(service, token)
    assert service.get("/v1/studies").status_code == 200
    assert service.post("/v1/studies", json={"label": "x"}, headers={"Origin": HOST}).status_code == 201


@pytest.mark.parametrize("headers", [{"Origin": "http://127.0.0.1:9"}, {"Origin": "null"}, {}])
def test_session_writes_from_own_pages_only(service: TestClient, token: str, headers: dict[str, str]) -> None:
    _sign_in(service, token)
    answer = service.post("/v1/studies", json={"label": "x"}, headers=headers)
    assert (answer.status_code, answer.json()["code"]) == (403, "foreign_origin")


def test_wrong_token_begins_no_session(service: TestClient, token: str) -> None:
    answer = service.post("/session", headers={"Authorization": "Bearer wrong"})
    assert answer.status_code == 401
    assert COOKIE not in answer.cookies


def test_reading_token_begins_a_session_that_cannot_write(service: TestClient, token: str) -> None:
    _sign_in(service, auth.create_token("guest", ["read"]))
    assert service.get("/v1/studies").status_code == 200
    assert service.post("/v1/studies", json={"label": "x"}, headers={"Origin": HOST}).status_code == 403


def test_session_ends_with_sign_out_and_with_revocation(service: TestClient, token: str) -> None:
    _sign_in(service, token)
    auth.revoke_token("doctor")
    assert service.get("/v1/studies").status_code == 401
    _sign_in(service, auth.create_token("again", ["read"]))
    assert service.delete("/session", headers={"Origin": HOST}).status_code == 204
    service.cookies.clear()
    assert service.get("/v1/studies").status_code == 401
