"""The epipolar line of a pixel in the other view."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from fastapi.testclient import TestClient
from small_runs import COLUMNS, ROWS, edited, run_uid, small_run

from fluoromap.geometry import Gantry, camera_from_gantry

Upload = Callable[..., Any]
POINT_MM = np.array([12.0, -7.0, 9.0])


def _pixel(primary_deg: float) -> list[float]:
    gantry = Gantry(primary_deg, 0.0, 1000.0, 750.0, (0.3, 0.3), ROWS, COLUMNS)
    pixel: list[float] = camera_from_gantry(gantry).project(POINT_MM).tolist()
    return pixel


def _line(service: TestClient, study_path: str, pixel: list[float], other: str) -> Any:
    query = {"other": other, "u_px": pixel[0], "v_px": pixel[1]}
    return service.get(f"{study_path}/instances/{run_uid(1)}/epipolar-line", params=query)


@pytest.mark.parametrize("other_deg", [0.0, 45.0])
def test_line_passes_through_the_same_point(
    service: TestClient, study_path: str, upload: Upload, other_deg: float
) -> None:
    upload((1, 90.0), (2, other_deg))
    line = _line(service, study_path, _pixel(90.0), run_uid(2)).json()
    start, end = np.array(line["start_px"]), np.array(line["end_px"])
    along = (end - start) / np.linalg.norm(end - start)
    off = np.array(_pixel(other_deg)) - start
    assert abs(off[0] * along[1] - off[1] * along[0]) < 0.01
    assert np.linalg.norm(end - start) > 100


def test_line_needs_geometry(service: TestClient, study_path: str, upload: Upload, tmp_path: Any) -> None:
    upload((1, 90.0))
    content = edited(small_run(tmp_path, 2, 0.0), DistanceSourceToDetector=None)
    files = [("file", ("run2.dcm", content, "application/dicom"))]
    assert service.post(f"{study_path}/instances", files=files).status_code == 201
    answer = _line(service, study_path, [3.0, 4.0], run_uid(2))
    assert (answer.status_code, answer.json()["code"]) == (409, "no_geometry")
    assert _line(service, study_path, [3.0, 4.0], "1.2.3").status_code == 404
