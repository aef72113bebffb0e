"""Web pages of other origins: none may use the service, but those that a setting names."""

from __future__ import annotations

from pathlib import Path

import pytest
from fastapi.testclient import TestClient
from pydantic import ValidationError

from fluoromap_service import auth
from fluoromap_service.api.app import create_app
from fluoromap_service.settings import Settings, settings

VIEWER = "https://viewer.example:8443"
ASKED = {
    "Origin": VIEWER,
    "Access-Control-Request-Method": "PUT",
    "Access-Control-Request-Headers": "authorization, content-type",
}


@pytest.fixture
def shared(data_dir: Path, monkeypatch: pytest.MonkeyPatch) -> TestClient:
    """Return a client of a service that one other page may use."""
    monkeypatch.setenv("FLUOROMAP_CORS_ORIGINS", f"http://other.example {VIEWER}")
    settings.cache_clear()
    return TestClient(create_app(), base_url="http://127.0.0.1")


def test_off_by_default(service: TestClient) -> None:
    answer = service.options("/v1/studies", headers=ASKED)
    assert answer.status_code == 403
    assert "access-control-allow-origin" not in answer.headers


def test_a_named_page_asks_without_a_token_and_reads_with_one(shared: TestClient) -> None:
    token = auth.create_token("viewer", ["read", "write"])
    asked = shared.options("/v1/studies", headers=ASKED)
    assert asked.status_code == 200
    assert asked.headers["access-control-allow-origin"] == VIEWER
    answer = shared.post(
        "/v1/studies", json={"label": "x"}, headers={"Origin": VIEWER, "Authorization": f"Bearer {token}"}
    )
    assert answer.status_code == 201
    assert answer.headers["access-control-allow-origin"] == VIEWER
    assert "Location" in answer.headers["access-control-expose-headers"]
    refused = shared.get("/v1/studies", headers={"Origin": VIEWER})
    assert refused.status_code == 401
    assert refused.headers["access-control-allow-origin"] == VIEWER


def test_a_named_page_may_use_an_open_service_and_others_may_not(shared: TestClient) -> None:
    assert shared.get("/v1/studies", headers={"Origin": VIEWER}).status_code == 200
    answer = shared.get("/v1/studies", headers={"Origin": "https://viewer.example"})
    assert answer.status_code == 403
    assert "access-control-allow-origin" not in answer.headers


@pytest.mark.parametrize("origins", ["*", "viewer.example", "https://viewer.example/", "https://*.example"])
def test_only_whole_origins_can_be_named(origins: str) -> None:
    with pytest.raises(ValidationError, match="no origin"):
        Settings(cors_origins=origins)
