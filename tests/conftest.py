"""Fixtures for all floors: real servers, private to the test session."""

from __future__ import annotations

import os
import sys
import uuid
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))
for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ.setdefault(variable, "1")

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
