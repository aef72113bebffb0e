"""A study with a single catheter, which maps: nothing rests in it, so that positions count from the isocentre."""

from __future__ import annotations

import csv
import io
import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pydicom
import pytest
from fastapi.testclient import TestClient

from fluoromap.catheters import Catalogue, catheter_type
from fluoromap.phantom import StudySpec
from fluoromap_service.dicom.simulation import simulate

CATHETER = {"name": "ablation", "type": "ablation-4"}
SPEC = StudySpec(
    seed=7, sites=5, frames=16, breathing_mm=1.0,
    catalogue=Catalogue((catheter_type("ablation-4", "ablation"),), reference=None, mapping="ablation"),
)  # fmt: skip
ISOCENTRE = {"axes": "LPS", "origin": "isocentre", "unit": "mm"}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of a simulated study with one catheter."""
    path = tmp_path_factory.mktemp("one") / "study"
    simulate(path, SPEC, processes=1)
    return path


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
    started = service.post(f"{path}/jobs", json={"view": "both"})
    assert started.status_code == 202, started.text
    job: dict[str, Any] = service.get(started.headers["location"]).json()
    assert job["state"] == "succeeded", job
    return str(job["id"])


def test_a_study_with_one_catheter_is_located_from_the_isocentre_and_mapped(service: TestClient, folder: Path) -> None:
    base = f"/v1/jobs/{_finished_job(service, folder)}"
    truth = {site["site"]: site for site in json.loads((folder / "truth.json").read_text())["sites"]}

    points = service.get(f"{base}/points").json()
    print(json.dumps(points, indent=1)[:3000])
    for site, true in truth.items():
        for p in points["points"]:
            if p["site"] == site and p["x_mm"] is not None:
                e = np.subtract([p["x_mm"], p["y_mm"], p["z_mm"]], true["diastole_mm"]["ablation"][p["electrode"]-1])
                c = np.array(p["covariance_mm2"]); C = np.array([[c[0],c[1],c[2]],[c[1],c[3],c[4]],[c[2],c[4],c[5]]])
                print(site, p["electrode"], e.round(2), np.sqrt(np.linalg.eigvalsh(C)*7.815).round(1), p["grade"], p["reasons"])
    for path in ("points?origin=isocentre", "tracks", "tracks?origin=isocentre", "map", "map?origin=isocentre", "mesh.ply", "mesh.mat", "map.png", "overlays", "report.html", "archive.zip", "dicom", "points.csv"):
        r = service.get(f"{base}/{path}")
        print(path, r.status_code, len(r.content), r.headers.get("content-disposition"), r.text[:300] if "json" in r.headers["content-type"] else "")
    uid = service.get(f"{base}/overlays").json()["overlays"][0]["sop_instance_uid"]
    print(service.get(f"{base}/overlays/{uid}.png").status_code, service.get(f"{base}/overlays/{uid}/placement").text[:600])
    t = service.get(f"{base}/tracks").json()
    from collections import Counter
    print(Counter((s["grade"], tuple(s["reasons"])) for tr in t["tracks"] for s in tr["samples"]), t["rejected"])
    m = service.get(f"{base}/map").json()
    print(m["warnings"], m["sites"][0], m["frame"], m["volume_ml"], m["leave_one_out_rms_ms"])
