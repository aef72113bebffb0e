"""Fixtures for all floors: private real servers, the service in one process, a simulated study, real sample files."""

from __future__ import annotations

import fcntl
import os
import uuid
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from fastapi.testclient import TestClient

for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ.setdefault(variable, "1")
# The Celery application is configured when it is imported.
os.environ.setdefault("FLUOROMAP_BROKER_URL", "eager")

import servers  # noqa: E402 - stands beside this file

_FOLDER = "FLUOROMAP_TEST_SERVERS_FOLDER"


def pytest_configure(config: pytest.Config) -> None:
    # Only the process that was called; its xdist workers inherit the folder's name.
    if not hasattr(config, "workerinput"):
        os.environ[_FOLDER] = str(servers.session_folder())


def pytest_unconfigure(config: pytest.Config) -> None:
    if not hasattr(config, "workerinput"):
        servers.stop(Path(os.environ.pop(_FOLDER)))


Fresh = Callable[[], AbstractContextManager[str]]


@pytest.fixture
def fresh_postgres() -> Fresh:
    """Each call: an empty database on a real PostgreSQL, as a context manager that gives its URL."""
    folder = Path(os.environ[_FOLDER])
    return lambda: servers.fresh_database(servers.postgresql(folder), f"test_{uuid.uuid4().hex}")


@pytest.fixture
def fresh_redis() -> Fresh:
    """Each call: an empty database number on a real Redis, as a context manager that gives its URL."""
    folder = Path(os.environ[_FOLDER])
    return lambda: servers.fresh_redis(servers.redis(folder))


@pytest.fixture
def postgres_url(fresh_postgres: Fresh) -> Iterator[str]:
    """An empty database on a real PostgreSQL."""
    with fresh_postgres() as url:
        yield url


@pytest.fixture
def redis_url(fresh_redis: Fresh) -> Iterator[str]:
    """An empty database number on a real Redis."""
    with fresh_redis() as url:
        yield url


@pytest.fixture
def sample_data() -> Path:
    """Folder of real XA and RF files, which are not part of the project."""
    folder = os.environ.get("FLUOROMAP_SAMPLE_DATA")
    if not folder:
        pytest.skip("FLUOROMAP_SAMPLE_DATA does not name a folder of real XA files")
    return Path(folder)


@pytest.fixture(scope="session")
def simulated_study(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Files of a simulated study of five sites, made once for all xdist workers."""
    from fluoromap.phantom import StudySpec
    from fluoromap_service.dicom.simulation import simulate

    root = tmp_path_factory.getbasetemp()
    root = root.parent if "PYTEST_XDIST_WORKER" in os.environ else root
    folder = root / "simulated-study"
    with (root / "simulated-study.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not (folder / "truth.json").exists():
            simulate(folder, StudySpec(seed=7, sites=5, frames=24, frame_rate_hz=15.0), processes=1)
    return folder


@pytest.fixture
def data_dir(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The data folder of a configured service with empty tables."""
    folder = tmp_path / "data"
    monkeypatch.setenv("FLUOROMAP_DATA_DIR", str(folder))
    monkeypatch.setenv("FLUOROMAP_BROKER_URL", "eager")
    monkeypatch.delenv("FLUOROMAP_DATABASE_URL", raising=False)
    from fluoromap_service.settings import settings
    from fluoromap_service.store.engine import engine
    from fluoromap_service.store.models import Base

    settings.cache_clear()
    Base.metadata.create_all(engine())
    yield folder
    engine().dispose()
    settings.cache_clear()


@pytest.fixture
def service(data_dir: Path) -> TestClient:
    """A client of the whole application, as from the same machine; decoding processes stay for the next test."""
    from fastapi.testclient import TestClient

    from fluoromap_service.api.app import create_app

    return TestClient(create_app(), base_url="http://127.0.0.1")


@pytest.fixture
def study_path(service: TestClient) -> str:
    """Address of an empty study with the default catheters."""
    answer = service.post("/v1/studies", json={"label": "test"})
    assert answer.status_code == 201
    return str(answer.headers["location"])
