"""Points: shapes, CSV, origins, and 409 before they are there."""

from __future__ import annotations

import csv
import io
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from fastapi.testclient import TestClient
from finished_study import REFERENCE_MM, TIP_MM, FinishedStudy, triangulation

from fluoromap.contracts import Calibration, ErrorBudget

HEADER = (
    "site,catheter,electrode,x_mm,y_mm,z_mm,cov_xx_mm2,cov_xy_mm2,cov_xz_mm2,cov_yy_mm2,cov_yz_mm2,cov_zz_mm2,"
    "frame_a,frame_b,residual_a_px,residual_b_px,ray_angle_deg,lat_ms,grade,reasons"
)


def test_points_are_relative_to_the_reference_by_default(client: TestClient, study: FinishedStudy) -> None:
    study.triangulated()
    answer = client.get(f"/v1/jobs/{study.job_id}/points")
    assert answer.status_code == 200
    assert answer.json()["frame"] == {"axes": "LPS", "origin": "reference", "unit": "mm"}
    located, rejected = answer.json()["points"]
    assert [located[axis] for axis in ("x_mm", "y_mm", "z_mm")] == pytest.approx((TIP_MM - REFERENCE_MM).tolist())
    assert located["grade"] == "A"
    assert located["covariance_mm2"] == [0.1, 0.01, 0.0, 0.1, 0.0, 0.1]
    assert located["views"]["a"] == {"sop_instance_uid": study.uids["S01", "a"], "frame": 2}
    assert located["residual_px"] == {"a": 0.25, "b": 0.5}
    assert located["reasons"] == ["identity_by_motion"]
    assert rejected["grade"] == "rejected"
    assert rejected["x_mm"] is rejected["covariance_mm2"] is rejected["views"]["a"] is None


def test_points_from_the_isocentre(client: TestClient, study: FinishedStudy) -> None:
    study.triangulated()
    located = client.get(f"/v1/jobs/{study.job_id}/points?origin=isocentre").json()["points"][0]
    assert [located[axis] for axis in ("x_mm", "y_mm", "z_mm")] == TIP_MM.tolist()
    assert located["grade"] == "C"


OTHER_TIP_MM = TIP_MM + np.array([10.0, 0.0, 0.0])


def self_calibrated() -> Any:
    """Return S01 with a calibrated gantry and a doubtful tip.

    The tip could be 10 mm farther to the left.
    """
    plain = triangulation()
    (site,) = plain.sites
    tip = replace(site.points[0], alternative_mm=OTHER_TIP_MM, alternative_probability=0.25)
    other = replace(site.points[0], catheter="reference", position_mm=REFERENCE_MM, relative_mm=np.zeros(3))
    return replace(
        plain,
        sites=(replace(site, points=(tip, other)),),
        notes=("View b was turned.",),
        calibration=Calibration(True, np.array([0.5, -1.0, 0.0]), np.array([0.0, 1.5, 0.0]), 5.5, 0.5),
        budget=ErrorBudget(0.125, 0.25, 0.5, 0.375, 1.0),
    )


@pytest.mark.parametrize(("origin", "zero"), [("reference", REFERENCE_MM), ("isocentre", np.zeros(3))])
def test_points_show_the_results_of_the_whole_study(
    client: TestClient, study: FinishedStudy, origin: str, zero: np.ndarray
) -> None:
    study.matched()
    study.end("triangulate", None, self_calibrated(), study._points())
    answer = client.get(f"/v1/jobs/{study.job_id}/points?origin={origin}").json()
    assert answer["calibration"] == {
        "applied": True, "rotation_deg": [0.5, -1.0, 0.0], "offset_mm": [0.0, 1.5, 0.0], "epipolar_before_px": 5.5,
        "epipolar_after_px": 0.5,
    }  # fmt: skip
    assert answer["error_budget"] == {
        "pixels_mm": 0.125, "angles_mm": 0.25, "source_distances_mm": 0.5, "phase_mismatch_mm": 0.375, "breathing_mm": 1.0,
    }  # fmt: skip
    assert answer["notes"] == ["View b was turned."]
    x, y, z = OTHER_TIP_MM - zero
    assert answer["alternatives"] == [
        {"site": "S01", "catheter": "mapping", "electrode": 1, "x_mm": x, "y_mm": y, "z_mm": z, "probability": 0.25}
    ]
    assert len(answer["points"]) == 2


def test_a_study_that_nobody_calibrated_says_so(client: TestClient, study: FinishedStudy) -> None:
    study.triangulated()
    answer = client.get(f"/v1/jobs/{study.job_id}/points").json()
    assert answer["calibration"] is answer["error_budget"] is None
    assert answer["notes"] == answer["alternatives"] == []


@pytest.mark.parametrize(
    ("path", "accept"), [("points.csv", "*/*"), ("points", "text/csv"), ("points", "application/json;q=0.5, text/csv")]
)
def test_points_as_csv(client: TestClient, study: FinishedStudy, path: str, accept: str) -> None:
    study.triangulated()
    answer = client.get(f"/v1/jobs/{study.job_id}/{path}", headers={"Accept": accept})
    assert answer.headers["content-type"].startswith("text/csv")
    assert answer.text.splitlines()[0] == HEADER
    located, rejected = csv.DictReader(io.StringIO(answer.text))
    np.testing.assert_allclose([float(located[f"{axis}_mm"]) for axis in "xyz"], TIP_MM - REFERENCE_MM)
    assert (located["frame_a"], located["grade"], located["lat_ms"]) == ("2", "A", "41.0")
    assert rejected["x_mm"] == rejected["cov_xx_mm2"] == rejected["frame_a"] == rejected["lat_ms"] == ""
    assert rejected["reasons"] == "one_view_only;no_activation_time"


@pytest.mark.parametrize("accept", ["application/json", "*/*", "text/csv;q=0", "text/csv;q=0.3, application/json"])
def test_points_stay_json_unless_csv_is_preferred(client: TestClient, study: FinishedStudy, accept: str) -> None:
    study.triangulated()
    answer = client.get(f"/v1/jobs/{study.job_id}/points", headers={"Accept": accept})
    assert answer.headers["content-type"] == "application/json"


def test_points_are_not_ready_before_triangulation(client: TestClient, study: FinishedStudy) -> None:
    study.matched()
    answer = client.get(f"/v1/jobs/{study.job_id}/points")
    assert answer.status_code == 409
    assert answer.headers["content-type"] == "application/problem+json"
    assert answer.json()["code"] == "not_ready"
    assert "retry-after" in answer.headers


def test_points_of_a_failed_job_say_what_broke(client: TestClient, study: FinishedStudy) -> None:
    study.segmented()
    study.fail("match")
    problem = client.get(f"/v1/jobs/{study.job_id}/points").json()
    assert problem["code"] == "not_ready"
    assert "it broke" in problem["detail"]


def test_points_of_a_cancelled_job(client: TestClient, study: FinishedStudy) -> None:
    assert client.post(f"/v1/jobs/{study.job_id}:cancel").status_code == 202
    problem = client.get(f"/v1/jobs/{study.job_id}/points").json()
    assert (problem["code"], "cancelled" in problem["detail"]) == ("not_ready", True)


def test_unknown_job_and_origin(client: TestClient, study: FinishedStudy) -> None:
    assert client.get("/v1/jobs/nothing/points").status_code == 404
    assert client.get(f"/v1/jobs/{study.job_id}/points?origin=moon").status_code == 422
