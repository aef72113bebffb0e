"""A service with runs that came by STOW-RS, on either database."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient

from fluoromap_service.api.app import create_app
from fluoromap_service.settings import settings
from fluoromap_service.store import engine as store_engine
from fluoromap_service.store import schema
from fluoromap_service.store.engine import engine

STUDIES = "/dicom-web/studies"


@contextmanager
def service_on(database_url: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[TestClient]:
    """Yield a client of the API on a database; "" is SQLite in the folder."""
    monkeypatch.setenv("FLUOROMAP_DATA_DIR", str(folder / "data"))
    monkeypatch.setenv("FLUOROMAP_DATABASE_URL", database_url)
    settings.cache_clear()
    schema.upgrade()
    try:
        yield TestClient(create_app(), base_url="http://127.0.0.1")
    finally:
        engine().dispose()
        store_engine._engine.cache_clear()
        settings.cache_clear()


def store(service: TestClient, *files: bytes) -> Any:
    parts = [b"--edge\r\nContent-Type: application/dicom\r\n\r\n" + file + b"\r\n" for file in files]
    kind = 'multipart/related; type="application/dicom"; boundary=edge'
    return service.post(STUDIES, content=b"".join(parts) + b"--edge--\r\n", headers={"content-type": kind})


def found(service: TestClient, path: str) -> list[dict[str, Any]]:
    """Return the results of a search."""
    answer = service.get(path)
    if answer.status_code == 204:
        assert answer.content == b""
        return []
    assert answer.status_code == 200, answer.text
    results: list[dict[str, Any]] = answer.json()
    assert results != []
    return results
