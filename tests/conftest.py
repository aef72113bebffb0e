"""Fixtures for all floors: real servers, private to the test session."""

from __future__ import annotations

import os
import sys
import uuid
from collections.abc import Iterator
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


@pytest.fixture
def postgres_url() -> Iterator[str]:
    """An empty database on a real PostgreSQL."""
    server = servers.postgresql(Path(os.environ[_FOLDER]))
    with servers.fresh_database(server, f"test_{uuid.uuid4().hex}") as url:
        yield url


@pytest.fixture
def redis_url() -> Iterator[str]:
    """An empty database number on a real Redis."""
    with servers.fresh_redis(servers.redis(Path(os.environ[_FOLDER]))) as url:
        yield url
