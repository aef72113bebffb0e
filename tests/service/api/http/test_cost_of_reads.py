"""A read takes one change of threads, and asks the database for nothing twice."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from typing import Any

import anyio.to_thread
import pytest
from fastapi.testclient import TestClient
from sql_statements import sql_statements


@pytest.fixture
def statements(data_dir: object) -> Iterator[list[str]]:
    """The SQL that the service runs."""
    with sql_statements() as found:
        yield found


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
    service.put(f"{study_path}/sites/S1", json={"lat_ms": 12.5}).raise_for_status()
    service.get(study_path)
    statements.clear()
    threads.clear()
    assert service.get(f"{study_path}{below}").status_code == 200
    assert len(threads) == 1
    assert max(Counter(statements).values()) == 1


def test_a_page_of_jobs(service: TestClient, statements: list[str], threads: list[str]) -> None:
    service.get("/v1/jobs")
    statements.clear()
    threads.clear()
    assert service.get("/v1/jobs?limit=10").status_code == 200
    assert len(threads) == len(statements) == 1
