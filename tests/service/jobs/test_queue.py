"""Announcements to a broker that accepts connections and says nothing."""

from __future__ import annotations

import functools
import socket
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest

from fluoromap_service.jobs import queue
from fluoromap_service.settings import settings


@pytest.fixture
def silent_broker(data_dir: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[list[str]]:
    """A silent broker; the connections that the service asks of it."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        monkeypatch.setenv("FLUOROMAP_BROKER_URL", f"redis://127.0.0.1:{server.getsockname()[1]}/0")
        settings.cache_clear()
        monkeypatch.setattr(queue, "_transport_options", lambda url: {"socket_timeout": 0.1, "max_retries": 0})
        monkeypatch.setattr(queue, "_silent_since", -queue.SILENCE_SECONDS)
        made = functools.cache(queue.celery_app.__wrapped__)
        asked: list[str] = []

        def noted() -> object:
            asked.append("ask")
            return made()

        monkeypatch.setattr(queue, "celery_app", noted)
        yield asked
        settings.cache_clear()


def test_after_a_failure_nobody_waits_again(silent_broker: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    now = [100.0]
    monkeypatch.setattr(queue, "time", SimpleNamespace(monotonic=lambda: now[0]))
    queue.publish([1, 2, 3])
    queue.publish([4])
    assert len(silent_broker) == 1
    now[0] += queue.SILENCE_SECONDS
    queue.publish([5])
    assert len(silent_broker) == 2
