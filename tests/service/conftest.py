"""The whole service in one process, on an empty embedded database."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

sys.path.insert(0, str(Path(__file__).parent))
# The Celery application is configured when it is imported.
os.environ.setdefault("FLUOROMAP_BROKER_URL", "eager")

from fastapi.testclient import TestClient
from small_runs import small_run

from fluoromap.api.app import create_app
from fluoromap.settings import settings
from fluoromap.store.engine import engine
from fluoromap.store.models import Base

Upload = Callable[..., Any]


@pytest.fixture
def data_dir(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The data folder of a configured service with empty tables."""
    folder = tmp_path / "data"
    monkeypatch.setenv("FLUOROMAP_DATA_DIR", str(folder))
    monkeypatch.setenv("FLUOROMAP_BROKER_URL", "eager")
    monkeypatch.delenv("FLUOROMAP_DATABASE_URL", raising=False)
    settings.cache_clear()
    Base.metadata.create_all(engine())
    yield folder
    engine().dispose()
    settings.cache_clear()


@pytest.fixture
def service(data_dir: Path) -> TestClient:
    """A client of the whole application, as from the same machine; decoding processes stay for the next test."""
    return TestClient(create_app(), base_url="http://127.0.0.1")


@pytest.fixture
def study_path(service: TestClient) -> str:
    """Address of an empty study with the default catheters."""
    answer = service.post("/v1/studies", json={"label": "test"})
    assert answer.status_code == 201
    return str(answer.headers["location"])


@pytest.fixture
def upload(service: TestClient, study_path: str, tmp_path: Path) -> Upload:
    """Send small runs given as (number, primary angle in degrees), all in one request; answers the response."""

    def send(*runs: tuple[int, float], **data: str) -> Any:
        files = [
            ("file", (f"run{number}.dcm", small_run(tmp_path, number, angle), "application/dicom"))
            for number, angle in runs
        ]
        return service.post(f"{study_path}/instances", files=files, data=data)

    return send
