"""Uploads of small runs to the service in one process."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient
from small_runs import small_run

Upload = Callable[..., Any]


@pytest.fixture
def upload(service: TestClient, study_path: str, tmp_path: Path) -> Upload:
    """Send small runs given as (number, primary angle in degrees), all in one request; answers the response."""

    def send(*runs: tuple[int, float], **data: str) -> Any:
        files = [
            ("file", (f"run{number}.dcm", small_run(tmp_path, number, angle), "application/dicom"))
            for number, angle in runs
        ]
        return service.post(f"{study_path}/instances", files=files, data=data)

    return send
