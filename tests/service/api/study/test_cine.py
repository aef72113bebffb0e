"""Many frames of a run in one answer."""

from __future__ import annotations

import io
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from fastapi.testclient import TestClient
from PIL import Image
from small_runs import COLUMNS, FRAMES, ROWS, run_uid

from fluoromap_service.api.study import cine

SIZE = ROWS * COLUMNS


@pytest.fixture
def run(study_path: str, upload: Callable[..., Any]) -> str:
    """Address of a run of three frames."""
    assert upload((1, -90.0)).status_code == 201
    return f"{study_path}/instances/{run_uid(1)}"


def test_frames_follow_each_other_with_one_window(service: TestClient, run: str) -> None:
    answer = service.get(f"{run}/frames")
    assert answer.headers["content-type"] == "application/octet-stream"
    frames = np.frombuffer(answer.content, np.uint8).reshape(FRAMES, ROWS, COLUMNS)
    single = np.asarray(Image.open(io.BytesIO(service.get(f"{run}/frames/1.png").content)))
    assert np.abs(frames[0].astype(int) - single).max() <= 1
    assert service.get(f"{run}/frames?first=2&count=1").content == frames[1].tobytes()
    assert service.get(f"{run}/frames?first=3&count=9").content == frames[2].tobytes()


def test_frames_are_not_sent_twice(service: TestClient, run: str) -> None:
    etag = service.get(f"{run}/frames").headers["etag"]
    assert service.get(f"{run}/frames", headers={"If-None-Match": etag}).status_code == 304
    assert service.get(f"{run}/frames?first=2", headers={"If-None-Match": etag}).status_code == 200


def test_answer_is_bounded(service: TestClient, run: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cine, "MOST_BYTES", 2 * SIZE + 1)
    assert len(service.get(f"{run}/frames").content) == 2 * SIZE
    monkeypatch.setattr(cine, "MOST_BYTES", 1)
    assert len(service.get(f"{run}/frames").content) == SIZE


def test_frames_that_do_not_exist(service: TestClient, run: str) -> None:
    assert service.get(f"{run}/frames?first={FRAMES + 1}").status_code == 404
    assert service.get(f"{run}/frames?first=0").status_code == 422
    assert service.get(f"{run}1/frames").status_code == 404
