"""A job with results, as the sender finds it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from delivery_peers import TARGETS
from finished_study import FinishedStudy, make_study

from fluoromap_service.api.http import file_pool
from fluoromap_service.deliveries import outbox
from fluoromap_service.store.engine import writing


@pytest.fixture(scope="session")
def file_processes() -> Iterator[None]:
    """End the processes of the file pool with the session."""
    yield
    file_pool.close()


@pytest.fixture
def study(data_dir: Path, file_processes: None) -> FinishedStudy:
    """A job that succeeded after the targets were registered."""
    with writing() as session:
        outbox.register(session, TARGETS)
    made = make_study()
    made.finish()
    return made
