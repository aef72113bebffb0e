"""Electrodes that are shown before the geometry of a run is complete."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest
from fastapi.testclient import TestClient
from PIL import Image
from small_runs import START, STUDY_UID, edited, run_uid

from fluoromap.phantom import SimulatedRun, StudySpec, simulate_study
from fluoromap_service.dicom import write_cine

FRAMES = 5
PX_PER_MM = 512 / 178 * 2
GEOMETRY = {"DistanceSourceToDetector": 1000.0, "DistanceSourceToPatient": 500.0}


@pytest.fixture(scope="module")
def simulated() -> tuple[SimulatedRun, ...]:
    spec = StudySpec(313, sites=1, frames=FRAMES, frame_rate_hz=60.0, heart="dog", contrast=("LAT", "LAT"))
    return simulate_study(spec).sites[0].runs


def file_of(run: SimulatedRun, number: int, folder: Path) -> bytes:
    path = folder / f"{number}.dcm"
    write_cine(
        path,
        iter([run.frames[k] for k in range(FRAMES)]),
        frame_count=FRAMES,
        gantry=run.gantry,
        frame_time_ms=1000 / 60,
        acquired=START,
        study_instance_uid=STUDY_UID,
        series_number=number,
        sop_instance_uid=run_uid(number),
    )
    return path.read_bytes()


def send(service: TestClient, study_path: str, *contents: bytes) -> None:
    parts = [("file", (f"{k}.dcm", content, "application/dicom")) for k, content in enumerate(contents)]
    assert service.post(f"{study_path}/instances", files=parts).status_code == 201


def near_truth(electrodes: list[dict[str, float]], run: SimulatedRun, frame: int) -> int:
    true = np.concatenate([uv[frame] for uv in run.truth.pixels_uv.values()])
    return sum(np.linalg.norm(true - [one["u_px"], one["v_px"]], axis=1).min() < 5.0 for one in electrodes)


def test_a_run_without_distances_shows_its_electrodes_at_a_scale_that_is_found(
    service: TestClient, study_path: str, simulated: tuple[SimulatedRun, ...], tmp_path: Path
) -> None:
    bare = [edited(file_of(run, k, tmp_path), **dict.fromkeys(GEOMETRY)) for k, run in enumerate(simulated)]
    send(service, study_path, *bare)
    run = f"{study_path}/instances/{run_uid(0)}"
    assert service.get(run).json()["missing"] == list(GEOMETRY)

    found = service.get(f"{run}/frames/3/preview")
    assert found.status_code == 200
    answer = found.json()
    assert answer["scale"] == "found"
    assert not answer["inverted"]
    assert 0.75 * PX_PER_MM < answer["px_per_mm"] < 1.25 * PX_PER_MM
    assert len(answer["electrodes"]) >= 8
    assert near_truth(answer["electrodes"], simulated[0], 2) == len(answer["electrodes"])

    plain = Image.open(io.BytesIO(service.get(f"{run}/frames/3.png").content))
    marked = Image.open(io.BytesIO(service.get(f"{run}/frames/3.png", params={"electrodes": "true"}).content))
    assert marked.size == plain.size
    differ = np.abs(np.asarray(marked, np.int64) - np.asarray(plain.convert("RGB"), np.int64)).max(axis=2) > 0
    rows, columns = np.nonzero(differ)
    places = np.array([[one["u_px"], one["v_px"]] for one in answer["electrodes"]])
    assert len(rows) >= 10 * len(places)
    assert all(np.hypot(columns - u, rows - v).min() < 6 for u, v in places)

    put = service.put(f"{study_path}/sites/X", json={"lat_ms": 1, "view_a": run_uid(0), "view_b": run_uid(1)})
    assert put.json()["missing"] == ["gantry:view_a", "gantry:view_b"]
    refused = service.post(f"{study_path}/jobs", json={})
    assert refused.status_code == 422
    assert "/preview" in refused.json()["detail"]
    assert "found" in refused.json()["detail"]

    gantry = {"source_detector_mm": 1000.0, "source_isocentre_mm": 500.0}
    assert service.patch(run, json={"gantry": gantry}).status_code == 200
    answer = service.get(f"{run}/frames/3/preview").json()
    assert (answer["scale"], answer["px_per_mm"]) == ("measured", pytest.approx(PX_PER_MM))
    assert near_truth(answer["electrodes"], simulated[0], 2) == len(answer["electrodes"]) >= 8


def test_a_picture_without_catheters_has_no_scale_and_no_electrodes(
    service: TestClient, study_path: str, simulated: tuple[SimulatedRun, ...], tmp_path: Path
) -> None:
    path = tmp_path / "noise.dcm"
    random = np.random.default_rng(0)
    write_cine(
        path,
        iter([random.poisson(500, (128, 128)).astype(np.uint16) for _ in range(FRAMES)]),
        frame_count=FRAMES,
        gantry=type(simulated[0].gantry)(90.0, 0.0, 1000.0, 500.0, (0.3, 0.3), 128, 128),
        frame_time_ms=16.7,
        acquired=START,
        study_instance_uid=STUDY_UID,
        series_number=1,
        sop_instance_uid=run_uid(7),
    )
    send(service, study_path, edited(path.read_bytes(), **dict.fromkeys(GEOMETRY)))
    run = f"{study_path}/instances/{run_uid(7)}"
    answer = service.get(f"{run}/frames/1/preview").json()
    assert answer == {"px_per_mm": None, "scale": "unknown", "inverted": False, "electrodes": []}
    assert service.get(f"{run}/frames/{FRAMES + 1}/preview").status_code == 404
