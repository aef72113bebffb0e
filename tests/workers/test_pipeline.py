"""The whole pipeline through the API, with the stages run at once in the calling process (eager)."""

from __future__ import annotations

import csv
import io
import json
import shutil
from collections import Counter
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pydicom
import pytest
from fastapi.testclient import TestClient
from pydicom.encaps import encapsulate, generate_frames

from fluoromap.contracts import Context, Marks, Matching, Refusal, Run, Segmentation
from fluoromap.drawing.symbols import time_text
from fluoromap.fuser.smooth_surface import SmoothSurface
from fluoromap.matching import match_study
from fluoromap.monoplane.motion_prior import MotionPrior
from fluoromap.reasons import Reason
from fluoromap.registry import Kind, Plugin
from fluoromap.segmenter.catheter_chain.plugin import CatheterChain
from fluoromap.triangulator import study_triangulation
from fluoromap.triangulator.maximum_likelihood import MaximumLikelihood
from fluoromap.triangulator.site_locator import SiteLocator
from fluoromap.triangulator.table_motion import Jump, table_jumps
from fluoromap_service.jobs import pipeline
from fluoromap_service.jobs.pipeline import STAGES
from fluoromap_service.results.fusion import fusion_of
from fluoromap_service.store.engine import reading
from fluoromap_service.store.models import Job
from fluoromap_workers import stage_inputs

SECOND_FRAMES = 12
"""Frames of the second real run: the first one has all 96."""
QUICK = {"pipeline": {"segmenter": {"name": "catheter-chain"}}}
"""What jobs do with the results of a segmenter shows with the quick one too."""


def _send(service: TestClient, study_path: str, folder: Path) -> None:
    for path in sorted((folder / "dicom").iterdir()):
        answer = service.post(
            f"{study_path}/instances", content=path.read_bytes(), headers={"Content-Type": "application/dicom"}
        )
        assert answer.status_code == 201, answer.text
    table = (folder / "activation_times.csv").read_bytes()
    # The table names its runs by uploaded file names; sent raw, they are bound by row order.
    rows = [row[:2] for row in csv.reader(io.StringIO(table.decode()))]
    content = "\n".join(",".join(row) for row in rows)
    answer = service.put(f"{study_path}/activation-times", content=content, headers={"Content-Type": "text/csv"})
    assert answer.json()["unmatched"] == [], answer.text


def _job(service: TestClient, study_path: str, body: dict[str, Any] = QUICK) -> dict[str, Any]:
    answer = service.post(f"{study_path}/jobs", json=body)
    assert answer.status_code == 202, answer.text
    job: dict[str, Any] = service.get(answer.headers["location"]).json()
    return job


def _fresh_stages(job: dict[str, Any]) -> Counter[str]:
    """Count the stages of each kind that were really computed."""
    return Counter(row["name"] for row in job["stages"] if row["state"] == "done" and not row["reused"])


@pytest.fixture
def sent(service: TestClient, study_path: str, simulated_study: Path) -> str:
    """A study with all its runs and activation times."""
    _send(service, study_path, simulated_study)
    return study_path


def test_a_study_becomes_points_map_meshes_and_overlays(service: TestClient, sent: str, simulated_study: Path) -> None:
    job = _job(service, sent, body={})
    assert job["state"] == "succeeded", job
    assert job["progress"] == 1.0
    base = f"/v1/jobs/{job['id']}"

    points = service.get(f"{base}/points").json()
    assert points["frame"] == {"axes": "LPS", "origin": "reference", "unit": "mm"}
    truth = {site["site"]: site for site in json.loads((simulated_study / "truth.json").read_text())["sites"]}
    tips = [
        p for p in points["points"] if p["catheter"] == "mapping" and p["electrode"] == 1 and p["grade"] != "rejected"
    ]
    assert len(tips) >= 4
    errors = [
        np.subtract([tip["x_mm"], tip["y_mm"], tip["z_mm"]], truth[tip["site"]]["relative_mm"]["mapping"][0])
        for tip in tips
    ]
    # Simulated; the demo's bound is 1.0 mm over eight sites of 30 frames, this study is smaller.
    assert np.sqrt(np.mean(np.sum(np.square(errors), axis=1))) <= 1.2
    for point in points["points"]:
        assert point["reasons"] or point["grade"] != "rejected"

    rows = list(csv.DictReader(io.StringIO(service.get(f"{base}/points.csv").text)))
    assert len(rows) == len(points["points"]) == 5 * 12

    overlays = service.get(f"{base}/overlays").json()["overlays"]
    assert overlays
    picture = service.get(overlays[0]["href"])
    assert picture.headers["content-type"] == "image/png"
    with reading() as session:
        job_row = session.get_one(Job, job["id"])
        fusions = [fusion_of(session, job_row, overlay["sop_instance_uid"], None) for overlay in overlays]
    for fusion in fusions:
        # The heart lay elsewhere in each of a site's runs; on the frame the site must lie where its tip is seen.
        drawn = next(site.position_mm for site in fusion.chamber.sites if site.site == fusion.site) + fusion.shift_mm
        assert np.linalg.norm(fusion.camera.project(drawn) - fusion.tip_uv) < 3
    tracks = service.get(f"{base}/tracks", params={"site": tips[0]["site"], "view": "a"}).json()["tracks"]
    assert {track["solver"] for track in tracks} == {"motion-prior"}
    assert all(len(track["samples"]) == 24 for track in tracks)
    chamber = service.get(f"{base}/map").json()
    assert len(chamber["lat_ms"]) == len(chamber["vertices_mm"])
    assert service.get(f"{base}/mesh.ply").content.startswith(b"ply")


def test_unchanged_work_is_not_done_again(service: TestClient, sent: str) -> None:
    first = _job(service, sent)
    assert _fresh_stages(first) == {"segment": 10, "match": 1, "triangulate": 1, "fuse": 1, "monoplane": 5}
    second = _job(service, sent)
    assert second["state"] == "succeeded"
    assert _fresh_stages(second) == {}
    answers = [service.get(f"/v1/jobs/{job['id']}/points").json() for job in (first, second)]
    assert answers[0] == answers[1]
    refused = service.post(f"/v1/jobs/{second['id']}:cancel")
    assert (refused.status_code, refused.json()["code"]) == (409, "job_ended")


def test_a_new_activation_time_redoes_the_map_alone(service: TestClient, sent: str) -> None:
    _job(service, sent)
    site = service.get(f"{sent}/sites").json()["items"][2]
    changed = service.put(f"{sent}/sites/{site['site']}", json={"lat_ms": site["lat_ms"] + 5})
    assert changed.status_code == 200, changed.text
    assert _fresh_stages(_job(service, sent)) == {"fuse": 1}


def test_a_correction_redoes_only_what_hangs_on_it(service: TestClient, sent: str) -> None:
    # With the electrodes of the quick segmenter, a second site is tracked again.
    first = _job(service, sent, body={})
    tip = next(
        p for p in service.get(f"/v1/jobs/{first['id']}/points").json()["points"]
        if p["catheter"] == "mapping" and p["electrode"] == 1 and p["grade"] != "rejected"
    )  # fmt: skip
    uid, frame = tip["views"]["a"]["sop_instance_uid"], tip["views"]["a"]["frame"]
    path = f"{sent}/instances/{uid}/frames/{frame}/electrodes"
    electrodes = service.get(path).json()
    # All catheters displaced alike would be breathing, and leave relative positions as they are.
    for electrode in electrodes:
        electrode["v_px"] += 6.0 * (electrode["catheter"] == "mapping")
    keys = ("catheter", "electrode", "u_px", "v_px", "sd_px")
    corrections = [
        {key: electrode[key] for key in keys} for electrode in electrodes if electrode["catheter"] == "mapping"
    ]
    kept = [{key: e[key] for key in keys} for e in electrodes if e["catheter"] != "mapping"]
    assert service.put(path, json=corrections + kept).status_code == 200
    second = _job(service, sent, body={})
    fresh = _fresh_stages(second)
    assert fresh["segment"] == 1
    assert fresh["monoplane"] <= 1
    assert fresh["match"] == fresh["triangulate"] == 1
    again = next(
        p for p in service.get(f"/v1/jobs/{second['id']}/points").json()["points"]
        if (p["site"], p["catheter"], p["electrode"]) == (tip["site"], "mapping", 1)
    )  # fmt: skip
    moved = np.subtract([again["x_mm"], again["y_mm"], again["z_mm"]], [tip["x_mm"], tip["y_mm"], tip["z_mm"]])
    assert np.linalg.norm(moved) > 0.05


def test_the_doubt_of_a_half_known_table_reaches_the_points(
    service: TestClient, study_path: str, simulated_study: Path, tmp_path: Path
) -> None:
    copy = tmp_path / "study"
    shutil.copytree(simulated_study, copy)
    path = min((copy / "dicom").iterdir())
    run = pydicom.dcmread(path)
    run.TableTopLateralPosition, run.TableTopLongitudinalPosition, run.TableTopVerticalPosition = 10, 20, 30
    run.save_as(path)
    _send(service, study_path, copy)
    sites = service.get(f"{study_path}/sites").json()["items"]
    doubtful = {site["site"] for site in sites if "table_moved" in site["warnings"]}
    assert len(doubtful) == 1
    points = service.get(f"/v1/jobs/{_job(service, study_path)['id']}/points").json()["points"]
    located = [point for point in points if point["grade"] != "rejected"]
    assert doubtful & {point["site"] for point in located}
    for point in located:
        assert ("table_moved" in point["reasons"]) == (point["site"] in doubtful)


def test_doubts_reach_points_tracks_map_overlays_and_report(
    service: TestClient, sent: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Matching doubts a catheter at one site, the headers' table another site, triangulation a third and a fourth."""
    found = match_study

    def doubting(*of: Any) -> Matching:
        matching = found(*of)
        sites = [
            replace(site, notes=(*site.notes, ("mapping", Reason.EXTRA_CATHETER))) if site.site == "S01" else site
            for site in matching.sites
        ]
        return replace(matching, sites=tuple(sites))

    jumps = table_jumps

    def jumping(sites: Any, *of: Any) -> list[Jump | None]:
        return [
            Jump("a", np.array([0.0, 0.0, 9.0])) if index == 1 else jump for index, jump in enumerate(jumps(sites, *of))
        ]

    locate = SiteLocator.locate

    def doubted_geometry(self: SiteLocator, site: Any, *of: Any) -> Any:
        belief = replace(self.belief, doubt=Reason.GEOMETRY_DOUBTFUL if site.site == "S04" else self.belief.doubt)
        return locate(replace(self, belief=belief), site, *of)

    monkeypatch.setattr(stage_inputs, "match_study", doubting)
    monkeypatch.setattr(study_triangulation, "table_jumps", jumping)
    monkeypatch.setattr(SiteLocator, "locate", doubted_geometry)
    expected = {"S01": "extra_catheter", "S02": "table_moved", "S04": "geometry_doubtful"}
    job = _job(service, sent)
    base = f"/v1/jobs/{job['id']}"
    tips = [
        p for p in service.get(f"{base}/points").json()["points"]
        if (p["catheter"], p["electrode"]) == ("mapping", 1) and p["grade"] != "rejected"
    ]  # fmt: skip
    tracks = service.get(f"{base}/tracks").json()["tracks"]
    on_map = {site["site"]: site for site in service.get(f"{base}/map").json()["sites"]}
    rows = service.get(f"{base}/report.html").text.split("<tr>")
    uids = {(o["site"], o["view"]): o["sop_instance_uid"] for o in service.get(f"{base}/overlays").json()["overlays"]}
    assert expected.keys() <= {tip["site"] for tip in tips}
    for tip in tips:
        site, doubt = tip["site"], expected.get(tip["site"])
        samples = [
            sample
            for track in tracks
            if (track["site"], track["catheter"]) == (site, "mapping")
            for sample in track["samples"]
        ]
        assert samples
        of_site = [row for row in rows if f">{site}</td>" in row]
        with reading() as session:
            fusion = fusion_of(session, session.get_one(Job, job["id"]), uids[site, "a"], None)
        mark = next(each for each in fusion.chamber.sites if each.site == site)
        for code in expected.values():
            is_expected = code == doubt
            assert (code in tip["reasons"]) == is_expected
            assert (code in on_map[site]["reasons"]) == is_expected
            assert all((code in sample["reasons"]) == is_expected for sample in samples)
            assert any(code in row for row in of_site) == is_expected
        if doubt:
            assert tip["grade"] == "C"
            assert {sample["grade"] for sample in samples} <= {"C", "rejected"}
            assert time_text(mark).endswith("?")


def test_a_segmenter_that_raises_rejects_its_site_and_the_job_goes_on(
    service: TestClient, sent: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    segment = CatheterChain.segment
    calls: list[int] = []

    def fails_once(self: CatheterChain, run: Run, catalogue: Any, corrections: Marks, context: Context) -> Segmentation:
        calls.append(1)
        if len(calls) == 1:
            raise ArithmeticError("the plugin's own words")
        return segment(self, run, catalogue, corrections, context)

    monkeypatch.setattr(CatheterChain, "segment", fails_once)
    job = _job(service, sent)
    assert job["state"] == "succeeded"
    failed = [row for row in job["stages"] if row["state"] == "failed"]
    assert [row["name"] for row in failed] == ["segment"]
    assert "the plugin's own words" in failed[0]["error"]["detail"]
    sites = service.get(f"{sent}/sites").json()["items"]
    site = next(site["site"] for site in sites if failed[0]["subject"] in (site["view_a"], site["view_b"]))
    points = [p for p in service.get(f"/v1/jobs/{job['id']}/points").json()["points"] if p["site"] == site]
    assert {p["grade"] for p in points} == {"rejected"}
    assert {tuple(p["reasons"]) for p in points} == {("plugin_failed", "paired_by_order")}


REFUSALS = {
    "segmenter": (CatheterChain, "segment", Reason.MANUAL_NEEDED),
    "triangulator": (MaximumLikelihood, "triangulate", Reason.TABLE_MOVED),
    "monoplane": (MotionPrior, "track", Reason.DEPTH_UNOBSERVABLE),
    "fuser": (SmoothSurface, "fuse", Reason.TOO_FEW_SITES),
}


@pytest.mark.parametrize("kind", REFUSALS)
def test_a_refusal_of_any_stage_reaches_the_user_with_its_reason(
    service: TestClient, sent: str, monkeypatch: pytest.MonkeyPatch, kind: str
) -> None:
    plugin, method, reason = REFUSALS[kind]

    def refuse(*arguments: Any) -> Any:
        raise Refusal(reason, "The plugin says why.")

    monkeypatch.setattr(plugin, method, refuse)
    job = _job(service, sent)
    assert job["state"] == "succeeded", job["error"]
    assert {row["state"] for row in job["stages"]} == {"done"}
    base = f"/v1/jobs/{job['id']}"
    if kind in ("segmenter", "triangulator"):
        points = service.get(f"{base}/points").json()["points"]
        assert len(points) == 5 * 12
        assert {tuple(point["reasons"]) for point in points} == {(str(reason), "paired_by_order")}
    elif kind == "monoplane":
        answer = service.get(f"{base}/tracks").json()
        assert answer["tracks"] == []
        assert {tuple(view["reasons"]) for view in answer["rejected"]} == {(str(reason),)}
    else:
        refused = service.get(f"{base}/map")
        assert (refused.status_code, refused.json()["code"]) == (409, "no_map")
        assert refused.json()["reasons"] == [str(reason)]
        assert refused.json()["detail"] == "The plugin says why."


RETURNED = {
    "segmenter": (CatheterChain, "segment", "catheter-chain returned NoneType, expected Segmentation"),
    "triangulator": (MaximumLikelihood, "triangulate", "maximum-likelihood returned NoneType, expected Triangulation"),
    "monoplane": (MotionPrior, "track", "motion-prior returned NoneType, expected Track"),
    "fuser": (SmoothSurface, "fuse", "smooth-surface returned NoneType, expected ChamberMap"),
}


@pytest.mark.parametrize("kind", RETURNED)
def test_a_plugin_that_returns_nothing_fails_in_its_own_stage(
    service: TestClient, sent: str, monkeypatch: pytest.MonkeyPatch, kind: str
) -> None:
    plugin, method, sentence = RETURNED[kind]
    monkeypatch.setattr(plugin, method, lambda *inputs: None)
    failed = [row for row in _job(service, sent)["stages"] if row["state"] == "failed"]
    assert {STAGES[row["name"]].kind for row in failed} == {kind}
    for row in failed:
        assert row["error"]["code"] == "plugin_failed"
        assert sentence in row["error"]["detail"]


def test_a_job_of_another_version_of_a_plugin_is_not_computed(
    service: TestClient, sent: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A worker that was not upgraded together with the API would store its results under the wrong version."""
    installed = pipeline.plugin

    def older(kind: Kind, name: str) -> Plugin:
        return replace(installed(kind, name), version="0")

    monkeypatch.setattr(pipeline, "plugin", older)
    job = _job(service, sent)
    assert job["state"] == "failed"
    failed = [row for row in job["stages"] if row["state"] == "failed"]
    assert {(row["name"], row["error"]["code"]) for row in failed} == {("segment", "plugin_changed")}
    assert "version 0" in failed[0]["error"]["detail"]


def test_a_real_cine_without_electrodes_is_rejected_and_the_job_succeeds(
    service: TestClient, study_path: str, sample_data: Path, tmp_path: Path
) -> None:
    """No electrode is invented on collimator, table marker or contrast-filled artery."""
    original = sample_data / "xa_512x512x96_jpeg_baseline.dcm"
    copy = pydicom.dcmread(original)
    few = islice(generate_frames(copy.PixelData, number_of_frames=96), SECOND_FRAMES)
    copy.PixelData, copy.NumberOfFrames = encapsulate(list(few)), SECOND_FRAMES
    copy.SOPInstanceUID = "2.25.4711"
    copy.file_meta.MediaStorageSOPInstanceUID = "2.25.4711"
    copy.save_as(tmp_path / "other.dcm")
    gantry = {"source_detector_mm": 1000, "source_isocentre_mm": 750, "pixel_spacing_mm": [0.3, 0.3]}
    views = []
    for path, primary_deg in ((original, -32.0), (tmp_path / "other.dcm", 58.0)):
        answer = service.post(
            f"{study_path}/instances", content=path.read_bytes(), headers={"Content-Type": "application/dicom"}
        )
        assert answer.status_code == 201, answer.text
        run = answer.json()["instances"][0]
        assert run["missing"] == ["DistanceSourceToDetector", "DistanceSourceToPatient", "ImagerPixelSpacing"]
        patched = service.patch(
            f"{study_path}/instances/{run['sop_instance_uid']}", json={"gantry": gantry | {"primary_deg": primary_deg}}
        )
        assert patched.json()["missing"] == []
        views.append(run["sop_instance_uid"])
    service.put(f"{study_path}/sites/S01", json={"lat_ms": 12.5, "view_a": views[1], "view_b": views[0]})
    job = _job(service, study_path, body={})
    assert job["state"] == "succeeded"
    points = service.get(f"/v1/jobs/{job['id']}/points").json()["points"]
    assert {point["grade"] for point in points} == {"rejected"}
    assert all(point["x_mm"] is None and point["reasons"] for point in points)
    for uid, frames in zip(views, (96, SECOND_FRAMES), strict=True):
        for frame in range(1, frames + 1):
            assert service.get(f"{study_path}/instances/{uid}/frames/{frame}/electrodes").json() == []
    answer = service.get(f"/v1/jobs/{job['id']}/map")
    assert (answer.status_code, answer.json()["code"]) == (409, "no_map")
