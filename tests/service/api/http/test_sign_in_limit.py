"""Wrong tokens are counted and limited; the people who are signed in already go on."""

from __future__ import annotations

from fastapi import FastAPI
from fastapi.testclient import TestClient

from fluoromap_service import auth
from fluoromap_service.api.http.sign_in_limit import MOST_FAILURES


def _status(service: TestClient, token: str) -> int:
    return service.get("/v1/studies", headers={"Authorization": f"Bearer {token}"}).status_code


def test_wrong_tokens_are_limited(service: TestClient) -> None:
    used, fresh = auth.create_token("used", ["read"]), auth.create_token("fresh", ["read"])
    assert _status(service, used) == 200
    assert [_status(service, f"wrong{n}") for n in range(MOST_FAILURES + 2)] == [401] * MOST_FAILURES + [429] * 2
    answer = service.get("/v1/studies", headers={"Authorization": "Bearer wrong"})
    assert answer.json()["code"] == "too_many_failures"
    assert 1 <= int(answer.headers["retry-after"]) <= 61
    assert _status(service, used) == 200
    assert _status(service, fresh) == 429
    auth.revoke_token("used")
    assert _status(service, used) == 401
    app = service.app
    assert isinstance(app, FastAPI)
    assert app.state.sign_ins.failures == MOST_FAILURES + 1
