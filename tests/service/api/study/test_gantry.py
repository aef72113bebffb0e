"""Gantry values that headers lack: for a whole study or one run, by field or by DICOM keyword."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient
from small_runs import edited, run_uid, small_run

from fluoromap_service.study.instances import GANTRY_KEYWORDS

LACKING = ("DistanceSourceToDetector", "DistanceSourceToPatient")


@pytest.fixture
def two_runs(service: TestClient, study_path: str, tmp_path: Path) -> list[str]:
    """Upload a run without source distances and a complete one; return their addresses."""
    for number, angle, lacking in ((1, 0.0, LACKING), (2, 90.0, ())):
        content = edited(small_run(tmp_path, number, angle), **dict.fromkeys(lacking))
        answer = service.post(f"{study_path}/instances", content=content, headers={"Content-Type": "application/dicom"})
        assert answer.status_code == 201, answer.text
    return [f"{study_path}/instances/{run_uid(number)}" for number in (1, 2)]


def _patch(service: TestClient, path: str, gantry: Any) -> Any:
    return service.patch(path, json={"gantry": gantry})


def test_values_of_the_study_complete_headers_and_override_none(
    service: TestClient, study_path: str, two_runs: list[str]
) -> None:
    assert service.get(two_runs[0]).json()["missing"] == list(LACKING)
    answer = _patch(service, study_path, {"source_detector_mm": 1190, "source_isocentre_mm": 780})
    assert answer.status_code == 200, answer.text
    assert answer.json()["gantry"] == {
        **dict.fromkeys(GANTRY_KEYWORDS),
        "source_detector_mm": 1190,
        "source_isocentre_mm": 780,
    }
    lacking, complete = (service.get(path).json() for path in two_runs)
    assert lacking["missing"] == []
    assert (lacking["gantry"]["source_detector_mm"], complete["gantry"]["source_detector_mm"]) == (1190, 1000)
    assert service.get(f"{study_path}/sites").json()["items"][0]["missing"] == ["site", "lat_ms"]
    assert _patch(service, two_runs[0], {"source_detector_mm": 1200}).json()["gantry"]["source_detector_mm"] == 1200
    assert _patch(service, two_runs[0], None).json()["gantry"]["source_detector_mm"] == 1190
    assert _patch(service, study_path, {"source_detector_mm": None}).status_code == 200
    assert service.get(two_runs[0]).json()["missing"] == ["DistanceSourceToDetector"]
    assert _patch(service, study_path, None).json()["gantry"] == dict.fromkeys(GANTRY_KEYWORDS)


@pytest.mark.parametrize(
    ("attributes", "table_mm", "origin"),
    [
        (
            {"TableTopVerticalPosition": 900, "TableTopLongitudinalPosition": 40, "TableTopLateralPosition": 3},
            [40.0, 900.0, 3.0],  # lateral is towards the head, PS3.3 C.8.7.4.1.3
            "table_top",
        ),
        (
            {"TableXPositionToIsocenter": 1, "TableYPositionToIsocenter": -2, "TableZPositionToIsocenter": 3.5},
            [1.0, -2.0, 3.5],
            "isocentre",
        ),
        ({"TableTopVerticalPosition": 900}, None, None),
    ],
)
def test_the_position_of_the_table_is_shown(
    service: TestClient,
    study_path: str,
    tmp_path: Path,
    attributes: dict[str, float],
    table_mm: list[float] | None,
    origin: str | None,
) -> None:
    content = edited(small_run(tmp_path, 1, 0.0), PatientPosition="HFS", **attributes)
    answer = service.post(f"{study_path}/instances", content=content, headers={"content-type": "application/dicom"})
    assert answer.status_code == 201, answer.text
    path = f"{study_path}/instances/{run_uid(1)}"
    for run in (answer.json()["instances"][0], service.get(path).json(), _patch(service, path, None).json()):
        assert (run["gantry"]["table_mm"], run["gantry"]["table_origin"]) == (table_mm, origin)
    assert _patch(service, path, {"table_mm": [0, 0, 0]}).status_code == 422


def test_the_keywords_of_missing_are_names_too(service: TestClient, study_path: str, two_runs: list[str]) -> None:
    missing = service.get(two_runs[0]).json()["missing"]
    answer = _patch(service, two_runs[0], dict(zip(missing, (1190, 780), strict=True)))
    assert answer.status_code == 200, answer.text
    assert (answer.json()["missing"], answer.json()["gantry"]["source_isocentre_mm"]) == ([], 780)
    every = {
        "PositionerPrimaryAngle": -30,
        "PositionerSecondaryAngle": 10,
        "DistanceSourceToDetector": 1100,
        "DistanceSourceToPatient": 760,
        "ImagerPixelSpacing": [0.2, 0.2],
    }
    assert list(_patch(service, study_path, every).json()["gantry"].values()) == list(every.values())
    assert list(_patch(service, two_runs[1], every).json()["gantry"].values()) == [*every.values(), None, None]
    assert _patch(service, two_runs[1], dict.fromkeys(every)).json()["gantry"]["primary_deg"] == 90


@pytest.mark.parametrize(
    "gantry",
    [
        {"source_detector_mm": 1000, "DistanceSourceToDetector": 1000},
        {"DistanceSourceToDetector": "far"},
        {"DistanceSourceToDetector": 1},
        {"TableHeight": 3},
        {"PatientName": "x"},
        [1000],
        {"source_detector_mm": 800, "source_isocentre_mm": 800},
        {"source_detector_mm": 500, "source_isocentre_mm": 780},
    ],
    ids=["twice", "text", "too near", "unknown", "other keyword", "list", "contradiction", "behind the detector"],
)
def test_values_that_cannot_be_are_refused(
    service: TestClient, study_path: str, two_runs: list[str], gantry: Any
) -> None:
    for path in (study_path, two_runs[0]):
        answer = _patch(service, path, gantry)
        assert answer.status_code == 422, answer.text
        assert answer.json()["errors"]
    assert service.get(two_runs[0]).json()["missing"] == list(LACKING)


def test_a_default_that_contradicts_a_header_is_refused(service: TestClient, study_path: str, tmp_path: Path) -> None:
    lacking = {"DistanceSourceToPatient": None, "EstimatedRadiographicMagnificationFactor": None}
    content = edited(small_run(tmp_path, 1, 0.0), **lacking)
    service.post(f"{study_path}/instances", content=content, headers={"Content-Type": "application/dicom"})
    answer = _patch(service, study_path, {"source_isocentre_mm": 1010})
    assert (answer.status_code, answer.json()["code"]) == (422, "invalid_gantry")
    assert service.get(study_path).json()["gantry"]["source_isocentre_mm"] is None


def test_a_default_does_not_count_for_a_later_run_that_it_contradicts(
    service: TestClient, study_path: str, tmp_path: Path
) -> None:
    assert _patch(service, study_path, {"source_isocentre_mm": 1010}).status_code == 200
    lacking = {"DistanceSourceToPatient": None, "EstimatedRadiographicMagnificationFactor": None}
    content = edited(small_run(tmp_path, 1, 0.0), **lacking)
    answer = service.post(f"{study_path}/instances", content=content, headers={"Content-Type": "application/dicom"})
    (run,) = answer.json()["instances"]
    assert (run["missing"], run["gantry"]["source_isocentre_mm"]) == (["DistanceSourceToPatient"], None)
    path = f"{study_path}/instances/{run['sop_instance_uid']}"
    assert _patch(service, path, {"source_isocentre_mm": 760}).json()["missing"] == []
