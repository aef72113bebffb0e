"""Security headers on every answer, also of the layers around the routes."""

from __future__ import annotations

import pytest
from fastapi.testclient import TestClient
from finished_study import make_study

from fluoromap_service import auth
from fluoromap_service.api.http.middleware.security_headers import HEADERS
from fluoromap_service.study import studies


def _check(answer: object) -> None:
    headers = answer.headers  # type: ignore[attr-defined]
    assert {name.lower() for name in HEADERS} <= set(headers)
    assert headers["x-content-type-options"] == "nosniff"
    assert headers["referrer-policy"] == "no-referrer"
    assert "frame-ancestors 'none'" in headers["content-security-policy"]
    assert headers["content-security-policy"].startswith("default-src 'none'")


def test_answers_of_all_kinds_carry_the_headers(service: TestClient, monkeypatch: pytest.MonkeyPatch) -> None:
    _check(service.get("/v1/studies"))
    _check(service.get("/v1/none"))
    _check(service.post("/v1/studies", json={}))
    _check(service.get("/v1/studies", headers={"Host": "evil.example"}))
    monkeypatch.setattr(studies, "get", None)
    broken = service.get("/v1/studies/1")
    assert broken.status_code == 500
    _check(broken)
    auth.create_token("x", ["read"])
    _check(service.get("/v1/studies"))


def test_an_answer_that_may_be_kept_says_so_itself(service: TestClient) -> None:
    study = make_study()
    assert service.get("/v1/studies").headers["cache-control"] == "no-store"
    assert service.get(f"/v1/jobs/{study.job_id}").headers["cache-control"] == "private, no-cache"


@pytest.mark.parametrize("site", ["cross-site", "same-site"])
def test_an_open_service_refuses_requests_of_other_sites(service: TestClient, site: str) -> None:
    for method in ("GET", "POST"):
        answer = service.request(method, "/v1/studies", headers={"Sec-Fetch-Site": site, "Sec-Fetch-Mode": "no-cors"})
        assert (answer.status_code, answer.json()["code"]) == (403, "foreign_origin")
    assert service.get("/v1/studies", headers={"Sec-Fetch-Site": "same-origin"}).status_code == 200
    link = {"Sec-Fetch-Site": site, "Sec-Fetch-Mode": "navigate", "Sec-Fetch-Dest": "document"}
    assert service.get("/v1/studies", headers=link).status_code == 200
    assert service.get("/v1/studies", headers=link | {"Sec-Fetch-Dest": "iframe"}).status_code == 403
