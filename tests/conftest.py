"""Fixtures of all floors: private real servers, the service in one process, a simulated study, real sample files.

Three fixtures import the service in their body, so that a test of the science starts without it.
"""

from __future__ import annotations

import fcntl
import os
import uuid
from collections import OrderedDict
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
import servers
import structlog

from fluoromap_service.cli.environment import limit_threads

if TYPE_CHECKING:
    from fastapi.testclient import TestClient

_FOLDER = "FLUOROMAP_TEST_SERVERS_FOLDER"

Fresh = Callable[[], AbstractContextManager[str]]
"""Returns a context manager that yields the URL of an empty database."""


def pytest_configure(config: pytest.Config) -> None:
    """Prepare the environment before pytest imports the test modules; xdist workers inherit it."""
    limit_threads()
    # structlog's own lines show the variables of every frame of a failure, which takes a minute.
    structlog.configure(processors=[structlog.processors.format_exc_info, structlog.processors.JSONRenderer()])
    # Tests run jobs within the calling process, unless they start servers of their own.
    os.environ["FLUOROMAP_BROKER_URL"] = "eager"
    if not _is_xdist_worker(config):
        os.environ[_FOLDER] = str(servers.session_folder())
        # Kernels are compiled once for the tests and all programs that they start.
        os.environ.setdefault("NUMBA_CACHE_DIR", str(config.cache.mkdir("numba")))


def pytest_unconfigure(config: pytest.Config) -> None:
    """Stop the servers that the tests have started."""
    if not _is_xdist_worker(config):
        servers.stop(Path(os.environ.pop(_FOLDER)))


def _is_xdist_worker(config: pytest.Config) -> bool:
    return hasattr(config, "workerinput")


@pytest.fixture(scope="session")
def fresh_postgres() -> Fresh:
    """Return a function that makes an empty database on a real PostgreSQL."""
    folder = Path(os.environ[_FOLDER])
    return lambda: servers.fresh_database(servers.postgresql(folder), f"test_{uuid.uuid4().hex}")


@pytest.fixture
def fresh_redis() -> Fresh:
    """Return a function that makes an empty database on a real Redis."""
    folder = Path(os.environ[_FOLDER])
    return lambda: servers.fresh_redis(servers.redis(folder))


@pytest.fixture
def postgres_url(fresh_postgres: Fresh) -> Iterator[str]:
    """Yield the URL of an empty database on a real PostgreSQL."""
    with fresh_postgres() as url:
        yield url


@pytest.fixture
def redis_url(fresh_redis: Fresh) -> Iterator[str]:
    """Yield the URL of an empty database on a real Redis."""
    with fresh_redis() as url:
        yield url


@pytest.fixture
def sample_data() -> Path:
    """Return the folder of real XA and RF files, which are not part of the project."""
    folder = os.environ.get("FLUOROMAP_SAMPLE_DATA")
    if not folder:
        pytest.skip("FLUOROMAP_SAMPLE_DATA is not set; set it to a folder of real XA files")
    return Path(folder)


@pytest.fixture(scope="session")
def simulated_study(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of a simulated study of five sites, made once for all xdist workers."""
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
    """Yield the data folder of a configured service with empty tables."""
    folder = tmp_path / "data"
    monkeypatch.setenv("FLUOROMAP_DATA_DIR", str(folder))
    monkeypatch.delenv("FLUOROMAP_DATABASE_URL", raising=False)
    from fluoromap_service.jobs import stage_results
    from fluoromap_service.results import finished
    from fluoromap_service.settings import settings
    from fluoromap_service.store.engine import engine
    from fluoromap_service.store.models import Base

    settings.cache_clear()
    # Results of equal content have the same address in the folders of all tests.
    monkeypatch.setattr(stage_results, "_remembered", OrderedDict())
    monkeypatch.setattr(finished, "_snapshots", OrderedDict())
    Base.metadata.create_all(engine())
    yield folder
    engine().dispose()
    settings.cache_clear()


@pytest.fixture
def service(data_dir: Path) -> TestClient:
    """Return a client of the whole API, which acts as a program on the same machine."""
    from fastapi.testclient import TestClient

    from fluoromap_service.api.app import create_app

    return TestClient(create_app(), base_url="http://127.0.0.1")


@pytest.fixture
def study_path(service: TestClient) -> str:
    """Return the address of an empty study with the default catheters."""
    answer = service.post("/v1/studies", json={"label": "test"})
    assert answer.status_code == 201
    return str(answer.headers["location"])
