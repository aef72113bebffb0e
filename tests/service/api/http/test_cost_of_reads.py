"""A read takes one change of threads, and asks the database for nothing twice."""

from __future__ import annotations

from collections import Counter
from typing import Any

import anyio.to_thread
import pytest
from fastapi.testclient import TestClient
from sqlalchemy import event

from fluoromap_service.store.engine import engine


@pytest.fixture
def statements(data_dir: object) -> Any:
    """The SQL that the service runs."""
    found: list[str] = []

    def add(connection: Any, cursor: Any, statement: str, *_: Any) -> None:
        found.append(statement)

    event.listen(engine(), "before_cursor_execute", add)
    yield found
    event.remove(engine(), "before_cursor_execute", add)


@pytest.fixture
def threads(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The functions that the service runs in threads."""
    called: list[str] = []
    run_sync = anyio.to_thread.run_sync

    async def counted(function: Any, *arguments: Any, **options: Any) -> Any:
        called.append(getattr(function, "__name__", repr(function)))
        return await run_sync(function, *arguments, **options)

    monkeypatch.setattr(anyio.to_thread, "run_sync", counted)
    return called


@pytest.mark.parametrize("below", ["", "/instances", "/sites", "/sites/S1"])
def test_a_read_of_a_study(
    service: TestClient, study_path: str, statements: list[str], threads: list[str], below: str
) -> None:
    service.get(study_path)
    statements.clear()
    threads.clear()
    service.get(f"{study_path}{below}")
    assert len(threads) == 1
    assert max(Counter(statements).values()) == 1


def test_a_page_of_jobs(service: TestClient, statements: list[str], threads: list[str]) -> None:
    service.get("/v1/jobs")
    statements.clear()
    threads.clear()
    assert service.get("/v1/jobs?limit=10").status_code == 200
    assert len(threads) == len(statements) == 1
