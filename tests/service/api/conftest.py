"""Fixtures for the output half of the API."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from fastapi import FastAPI
from fastapi.testclient import TestClient
from finished_study import FinishedStudy, make_study

from fluoromap_service.api.app import create_app
from fluoromap_service.api.http import file_pool


@pytest.fixture(scope="session")
def application() -> FastAPI:
    """The whole application; it asks for its settings at each request."""
    return create_app()


@pytest.fixture
def client(application: FastAPI, data_dir: Path) -> TestClient:
    """A client from the same machine, on an empty database."""
    return TestClient(application, base_url="http://127.0.0.1")


@pytest.fixture
def study(client: TestClient) -> FinishedStudy:
    """A job none of whose stages has begun."""
    return make_study()


@pytest.fixture(scope="session")
def file_processes() -> Iterator[None]:
    """End the processes of the file pool with the session."""
    yield
    file_pool.close()
