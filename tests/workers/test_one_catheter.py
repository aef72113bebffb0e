"""A study with a single catheter, which maps: nothing rests in it, so that positions count from the isocentre."""

from __future__ import annotations

import io
import json
import re
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pydicom
import pytest
from fastapi.testclient import TestClient

from fluoromap.catheters import Catalogue, catheter_type
from fluoromap.contracts import CHI2_95_3D
from fluoromap.phantom import StudySpec
from fluoromap_service.dicom.simulation import simulate

CATHETER = {"name": "ablation", "type": "ablation-4"}
DOUBTS = {"no_resting_catheter", "no_reference"}
SPEC = StudySpec(
    seed=7, sites=5, frames=16,
    catalogue=Catalogue((catheter_type("ablation-4", "ablation"),), reference=None, mapping="ablation"),
)  # fmt: skip
ISOCENTRE = {"axes": "LPS", "origin": "isocentre", "unit": "mm"}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of a simulated study with one catheter."""
    path = tmp_path_factory.mktemp("one") / "study"
    simulate(path, SPEC, processes=1)
    return path


def _covariance(six: list[float]) -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
    xx, xy, xz, yy, yz, zz = six
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def _finished_job(service: TestClient, folder: Path) -> str:
    study = service.post("/v1/studies", json={"label": "one catheter", "catheters": [CATHETER]})
    assert study.status_code == 201, study.text
    path = study.headers["location"]
    for run in sorted((folder / "dicom").iterdir()):
        with run.open("rb") as stream:
            sent = service.post(f"{path}/instances", files={"file": (run.name, stream)})
        assert sent.status_code == 201, sent.text
    table = (folder / "activation_times.csv").read_bytes()
    answer = service.put(f"{path}/activation-times", content=table, headers={"Content-Type": "text/csv"})
    assert answer.json()["unmatched"] == [], answer.text
    started = service.post(f"{path}/jobs", json={"view": "both", "pipeline": {"segmenter": {"name": "catheter-chain"}}})
    assert started.status_code == 202, started.text
    job: dict[str, Any] = service.get(started.headers["location"]).json()
    assert job["state"] == "succeeded", job
    return str(job["id"])


def test_one_catheter_is_located_from_the_isocentre_mapped_and_exported(service: TestClient, folder: Path) -> None:
    base = f"/v1/jobs/{_finished_job(service, folder)}"
    truth = {site["site"]: site for site in json.loads((folder / "truth.json").read_text())["sites"]}

    points = service.get(f"{base}/points").json()
    assert points == service.get(f"{base}/points?origin=isocentre").json()
    assert points["frame"] == ISOCENTRE
    located = [point for point in points["points"] if point["grade"] != "rejected"]
    assert {point["site"] for point in located} == set(truth)
    inside = []
    for point in located:
        true_mm = truth[point["site"]]["diastole_mm"]["ablation"][point["electrode"] - 1]
        error_mm = np.subtract([point["x_mm"], point["y_mm"], point["z_mm"]], true_mm)
        assert np.linalg.norm(error_mm) < 2.5
        inside.append(error_mm @ np.linalg.solve(_covariance(point["covariance_mm2"]), error_mm) <= CHI2_95_3D)
        assert point["grade"] == "C"
        assert set(point["reasons"]) >= DOUBTS
    assert np.mean(inside) >= 0.9
    assert service.get(f"{base}/points.csv").text.count("no_resting_catheter") == len(located)

    tracks = service.get(f"{base}/tracks").json()
    assert tracks["frame"] == ISOCENTRE
    samples = [sample for track in tracks["tracks"] for sample in track["samples"]]
    assert sum(sample["x_mm"] is not None for sample in samples) > len(samples) / 2
    assert {sample["grade"] for sample in samples} <= {"C", "rejected"}
    assert all(set(sample["reasons"]) >= DOUBTS for sample in samples)

    chamber = service.get(f"{base}/map").json()
    assert chamber["frame"] == ISOCENTRE
    assert "no_resting_catheter" in chamber["warnings"]
    tips = {point["site"]: point for point in located if point["electrode"] == 1}
    for site in chamber["sites"]:
        assert [site[axis] for axis in ("x_mm", "y_mm", "z_mm")] == pytest.approx(
            [tips[site["site"]][axis] for axis in ("x_mm", "y_mm", "z_mm")]
        )
    mesh = service.get(f"{base}/mesh.mat")
    assert (mesh.status_code, "chamber-isocentre.mat" in mesh.headers["content-disposition"]) == (200, True)
    overlay = service.get(f"{base}/overlays").json()["overlays"][0]
    assert service.get(overlay["href"]).status_code == 200

    report = re.sub(r"\s+", " ", service.get(f"{base}/report.html").text)
    assert "from the isocentre: the study has no reference catheter" in report
    assert "no_resting_catheter" in report
    archive = zipfile.ZipFile(io.BytesIO(service.get(f"{base}/archive.zip").content))
    assert json.loads(archive.read("map.json"))["frame"] == ISOCENTRE
    assert b"no_resting_catheter" in archive.read("points.csv")

    deidentified = zipfile.ZipFile(io.BytesIO(service.get(f"{base}/deidentified.zip").content))
    assert any(name.endswith("points.csv") for name in deidentified.namelist())

    objects = zipfile.ZipFile(io.BytesIO(service.get(f"{base}/dicom").content))
    written = str(pydicom.dcmread(io.BytesIO(objects.read("report.dcm"))))
    graphics = re.findall(r"Graphic Data\s+FL: \[(.+?)\]", written)
    assert len(graphics) == len(tips)
    for graphic, site in zip(graphics, sorted(tips), strict=True):
        tip = [tips[site][axis] for axis in ("x_mm", "y_mm", "z_mm")]
        assert [float(value) for value in graphic.split(",")] == pytest.approx(tip, abs=1e-3)
    assert "chamber.dcm" in objects.namelist()
