"""The access log: one line a request, one for an unexpected error, and no patient data."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from typing import Any

import pytest
import structlog
from fastapi.testclient import TestClient
from small_runs import run_uid
from structlog.testing import LogCapture

from fluoromap_service.study import studies

Lines = list[dict[str, Any]]


@pytest.fixture
def lines(monkeypatch: pytest.MonkeyPatch) -> Iterator[Lines]:
    """The log lines of this test."""
    capture = LogCapture()
    before = structlog.get_config()
    structlog.configure(processors=[capture])
    yield capture.entries  # type: ignore[misc]
    structlog.configure(**before)


def test_a_request_is_one_line_without_uids(
    service: TestClient, study_path: str, upload: Callable[..., Any], lines: Lines
) -> None:
    upload((1, 0.0), site="Doe-Jane")
    service.get(f"{study_path}/instances/{run_uid(1)}")
    requests = [line for line in lines if line["event"] == "request"]
    assert [line["path"] for line in requests] == [
        "/v1/studies/{study_id}/instances",
        "/v1/studies/{study_id}/instances/{uid}",
    ]
    assert [line["status"] for line in requests] == [201, 200]
    assert {line["caller"] for line in requests} == {"open"}
    assert run_uid(1) not in json.dumps(requests)
    assert "Jane" not in json.dumps(requests)


def test_an_unexpected_error_is_logged_once_with_its_path(
    service: TestClient, lines: Lines, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(studies, "get", None)
    answer = service.get("/v1/studies/1")
    assert (answer.status_code, answer.json()["code"]) == (500, "internal")
    errors = [line for line in lines if line["event"] == "unexpected_error"]
    assert [(line["path"], line["error"]) for line in errors] == [("/v1/studies/{study_id}", "TypeError")]
