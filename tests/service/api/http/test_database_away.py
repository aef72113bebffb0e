"""The answers of the API while its database is away or locked."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from fastapi.testclient import TestClient
from sqlalchemy import text

from fluoromap_service.settings import settings
from fluoromap_service.store import engine as store_engine
from fluoromap_service.store.engine import engine


def _refused(client: TestClient, method: str, path: str) -> None:
    answer = client.request(method, path, json={"label": "x"} if method == "POST" else None)
    assert (answer.status_code, answer.json()["code"]) == (503, "database_unavailable"), answer.text
    assert int(answer.headers["retry-after"]) > 0


@pytest.fixture
def impatient(data_dir: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """An engine that waits for no lock."""
    engine().dispose()
    store_engine._engine.cache_clear()
    monkeypatch.setattr(store_engine, "BUSY_TIMEOUT_MS", 0)
    yield
    engine().dispose()
    store_engine._engine.cache_clear()


@pytest.mark.usefixtures("impatient")
def test_a_locked_database_asks_for_patience(service: TestClient) -> None:
    with engine().connect() as other:
        other.execution_options(writes=True).execute(text("SELECT 1"))
        _refused(service, "POST", "/v1/studies")
        assert service.get("/v1/studies").status_code == 200
    assert service.post("/v1/studies", json={"label": "x"}).status_code == 201


def test_a_server_that_is_away_asks_for_patience(service: TestClient, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FLUOROMAP_DATABASE_URL", "postgresql+psycopg://nobody@127.0.0.1:1/none")
    settings.cache_clear()
    # The first part that asks the database is the doorkeeper.
    for method, path in (("GET", "/v1/studies"), ("POST", "/v1/studies"), ("GET", "/v1/jobs/x")):
        _refused(service, method, path)
    assert service.get("/v1/health").status_code == 200
    assert service.get("/v1/ready").status_code == 503
