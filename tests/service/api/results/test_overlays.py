"""Overlays and the archive: what is drawn, of which frame, and that it is drawn once."""

from __future__ import annotations

import io
import json
import zipfile
from dataclasses import replace

import numpy as np
import pytest
from fastapi.testclient import TestClient
from finished_study import (
    BREATH_MM,
    DIASTOLE,
    REFERENCE_ELECTRODES_MM,
    REFERENCE_MM,
    SIZE,
    STEP_MM,
    TIP_MM,
    TIP_PIXEL,
    FinishedStudy,
    camera,
    map_result,
    matching,
    no_map,
    triangulation,
)
from numpy.typing import NDArray
from PIL import Image
from sqlalchemy import select

from fluoromap.contracts import NamedChain
from fluoromap.drawing.animation import PICTURES
from fluoromap_service.api.results import archive, archive_files, maps, report_page, tracks
from fluoromap_service.api.results import overlays as overlay_routes
from fluoromap_service.results.fusion import Fusion, fusion_of
from fluoromap_service.store import files
from fluoromap_service.store.engine import reading, writing
from fluoromap_service.store.models import Job, JobState, Rendering, Study
from fluoromap_service.store.renderings import kept_rendering

pytestmark = pytest.mark.usefixtures("file_processes")


def _fusion(study: FinishedStudy, view: str, frame: int | None) -> Fusion:
    with reading() as session:
        return fusion_of(session, session.get_one(Job, study.job_id), study.uids["S01", view], frame)


def test_each_view_of_each_located_site_is_listed(client: TestClient, study: FinishedStudy) -> None:
    study.mapped()
    listed = client.get(f"/v1/jobs/{study.job_id}/overlays").json()["overlays"]
    assert [(entry["site"], entry["view"], entry["frame"]) for entry in listed] == [
        ("S01", "a", DIASTOLE + 1),
        ("S01", "b", DIASTOLE + 1),
    ]
    assert [entry["sop_instance_uid"] for entry in listed] == [study.uids["S01", "a"], study.uids["S01", "b"]]
    assert client.get(listed[0]["href"]).headers["content-type"] == "image/png"


def test_size_and_cache(client: TestClient, study: FinishedStudy, monkeypatch: pytest.MonkeyPatch) -> None:
    study.mapped()
    path = f"/v1/jobs/{study.job_id}/overlays/{study.uids['S01', 'a']}.png"
    first = client.get(path)
    assert first.status_code == 200, first.text
    picture = Image.open(io.BytesIO(first.content))
    assert (picture.size, picture.mode) == ((SIZE, SIZE), "RGB")
    assert Image.open(io.BytesIO(client.get(f"{path}?scale=2").content)).size == (2 * SIZE, 2 * SIZE)

    def never(*_: object) -> bytes:
        raise AssertionError("drawn again")

    monkeypatch.setattr(overlay_routes, "run_in_pool", never)
    assert client.get(path).content == first.content
    assert client.get(f"{path}?frame={DIASTOLE + 1}").content == first.content
    assert client.get(path, headers={"If-None-Match": first.headers["etag"]}).status_code == 304
    with reading() as session:
        assert len(session.scalars(select(Rendering)).all()) == 2


def test_the_file_name_has_site_and_frame_only(client: TestClient, study: FinishedStudy) -> None:
    study.mapped()
    answer = client.get(f"/v1/jobs/{study.job_id}/overlays/{study.uids['S01', 'b']}.png?frame=1")
    assert answer.headers["content-disposition"] == 'inline; filename="overlay-S01-1.png"'


@pytest.mark.parametrize(
    "query",
    [
        "frame=0",
        "frame=4",
        "scale=3",
        "frame=x",
        "colours=rainbow",
        "step_ms=7",
        "until_ms=nan",
        "ellipses=perhaps",
        "electrodes=perhaps",
    ],
)
def test_wrong_frames_and_scales(client: TestClient, study: FinishedStudy, query: str) -> None:
    study.mapped()
    answer = client.get(f"/v1/jobs/{study.job_id}/overlays/{study.uids['S01', 'a']}.png?{query}")
    assert answer.status_code == 422


@pytest.mark.parametrize("query", ["colours=red-early", "step_ms=10", "until_ms=25", "electrodes=true"])
def test_each_wish_changes_the_picture(client: TestClient, study: FinishedStudy, query: str) -> None:
    study.mapped()
    path = f"/v1/jobs/{study.job_id}/overlays/{study.uids['S01', 'a']}.png"
    plain, wished = client.get(path), client.get(f"{path}?{query}")
    assert wished.status_code == 200, wished.text
    assert wished.content != plain.content


def test_ellipses_are_of_the_tip_from_the_reference(client: TestClient, study: FinishedStudy) -> None:
    study.mapped()
    path = f"/v1/jobs/{study.job_id}/overlays/{study.uids['S01', 'a']}.png"
    assert client.get(f"{path}?ellipses=true").status_code == 200
    np.testing.assert_allclose(_fusion(study, "a", None).covariances_mm2["S01"], 0.1 * np.eye(3))


def test_the_propagation_is_a_moving_picture(client: TestClient, study: FinishedStudy) -> None:
    study.mapped()
    path = f"/v1/jobs/{study.job_id}/overlays/{study.uids['S01', 'a']}.gif"
    answer = client.get(path)
    assert answer.headers["content-type"] == "image/gif"
    assert answer.headers["content-disposition"] == 'inline; filename="propagation-S01-2.gif"'
    moving = Image.open(io.BytesIO(answer.content))
    assert (moving.size, moving.n_frames) == ((SIZE, SIZE), PICTURES)
    assert client.get(path, headers={"If-None-Match": answer.headers["etag"]}).status_code == 304


def test_runs_without_overlay(client: TestClient, study: FinishedStudy) -> None:
    study.mapped()
    for uid in (study.uids["S02", "a"], "1.2.3"):
        assert client.get(f"/v1/jobs/{study.job_id}/overlays/{uid}.png").status_code == 404


def _is_at(fusion: Fusion, view: str, place_mm: NDArray[np.float64]) -> None:
    """Check that the map lies where this view shows ``place_mm``, at its depth."""
    np.testing.assert_allclose(fusion.camera.project(fusion.shift_mm), camera(view).project(place_mm), atol=0.01)
    assert abs(fusion.camera.depth_mm(fusion.shift_mm) - camera(view).depth_mm(place_mm)) < 0.1


def test_the_map_follows_the_reference_as_the_frame_shows_it(client: TestClient, study: FinishedStudy) -> None:
    study.mapped()
    for view in ("a", "b"):
        for frame in (None, 1):
            _is_at(_fusion(study, view, frame), view, REFERENCE_MM + BREATH_MM[view])
    # Frame 3 does not show the reference.
    np.testing.assert_allclose(_fusion(study, "a", 3).shift_mm, REFERENCE_MM)
    study.followed()
    np.testing.assert_allclose(_fusion(study, "a", 1).shift_mm, REFERENCE_MM + STEP_MM)
    _is_at(_fusion(study, "a", None), "a", REFERENCE_MM + BREATH_MM["a"])
    np.testing.assert_allclose(_fusion(study, "a", 3).shift_mm, REFERENCE_MM)
    _is_at(_fusion(study, "b", 1), "b", REFERENCE_MM + BREATH_MM["b"])


@pytest.mark.parametrize("shown", [(1,), (2,), (1, 2, 3), (3,)])
def test_the_reference_may_be_shown_in_part(study: FinishedStudy, shown: tuple[int, ...]) -> None:
    study.segmented()
    whole = matching()
    third = np.array([[7.0, 7.0]])
    pixels = np.concatenate([camera("a").project(REFERENCE_ELECTRODES_MM + BREATH_MM["a"]), third])
    chosen = [number - 1 for number in shown]
    chain = NamedChain("reference", shown, pixels[chosen], np.tile(np.eye(2), (len(shown), 1, 1)))
    site = whole.sites[0]
    diastole = replace(site.runs.diastole, a=replace(site.runs.diastole.a, chains=(chain,)))
    study.end("match", None, replace(whole, sites=(replace(site, runs=replace(site.runs, diastole=diastole)),)))
    study.end("triangulate", None, triangulation())
    study.end("fuse", None, map_result())
    # The third was not located: it does not show where the catheter is.
    breath = BREATH_MM["a"] if shown != (3,) else 0.0
    _is_at(_fusion(study, "a", None), "a", REFERENCE_MM + breath)


def test_the_star_is_where_the_tip_was_seen(client: TestClient, study: FinishedStudy) -> None:
    study.finish()
    np.testing.assert_array_equal(_fusion(study, "a", 1).tip_uv, TIP_PIXEL["a"])
    np.testing.assert_array_equal(_fusion(study, "b", None).tip_uv, TIP_PIXEL["b"])
    np.testing.assert_allclose(_fusion(study, "a", 3).tip_uv, camera("a").project(TIP_MM))


def test_a_missing_runs_overlay_stays_when_it_was_drawn(client: TestClient, study: FinishedStudy) -> None:
    study.mapped()
    path = f"/v1/jobs/{study.job_id}/overlays/{study.uids['S01', 'a']}.png"
    kept = client.get(path).content
    files.path_of(_fusion(study, "a", None).sha256).unlink()
    assert client.get(path).content == kept
    answer = client.get(f"{path}?frame=1")
    assert (answer.status_code, answer.json()["code"]) == (409, "run_broken")


def test_a_deleted_run_takes_the_pictures_of_it_along(client: TestClient, study: FinishedStudy) -> None:
    study.finish()
    uid = study.uids["S01", "a"]
    path = f"/v1/jobs/{study.job_id}/overlays/{uid}.png"
    assert client.get(path).status_code == 200
    assert client.delete(f"/v1/studies/{study.study_id}/instances/{uid}").status_code == 204
    with reading() as session:
        assert session.scalars(select(Rendering)).all() == []
    answer = client.get(path)
    assert (answer.status_code, answer.json()["code"]) == (409, "run_deleted")
    # Other runs' pictures are drawn again.
    assert client.get(f"/v1/jobs/{study.job_id}/overlays/{study.uids['S01', 'b']}.png").status_code == 200


def test_a_run_that_does_not_decode(client: TestClient, study: FinishedStudy) -> None:
    study.mapped()
    files.path_of(_fusion(study, "b", None).sha256).write_bytes(b"\0" * 128 + b"DICM")
    answer = client.get(f"/v1/jobs/{study.job_id}/overlays/{study.uids['S01', 'b']}.png")
    assert 400 <= answer.status_code < 500
    assert answer.headers["content-type"] == "application/problem+json"


def test_the_archive_holds_everything(client: TestClient, study: FinishedStudy) -> None:
    study.finish()
    path = f"/v1/jobs/{study.job_id}/archive.zip"
    answer = client.get(path)
    assert answer.headers["content-type"] == "application/zip"
    with zipfile.ZipFile(io.BytesIO(answer.content)) as content:
        assert content.testzip() is None
        assert set(content.namelist()) == {
            "job.json", "parameters.json", "points.csv", "tracks.csv", "map.json", "map.png", "mesh/chamber.ply",
            "mesh/chamber.stl", "mesh/chamber.glb", "mesh/chamber.vtp", "mesh/chamber.mat", "mesh/chamber.csv", "report.html",
            "overlays/S01-a.png", "overlays/S01-b.png",
        }  # fmt: skip
        assert json.loads(content.read("job.json"))["state"] == "succeeded"
        assert json.loads(content.read("parameters.json"))["segmenter"]["name"] == "by-hand"
        assert content.read("points.csv").decode() == client.get(f"/v1/jobs/{study.job_id}/points.csv").text
        assert json.loads(content.read("map.json")) == client.get(f"/v1/jobs/{study.job_id}/map").json()
    assert client.get(path).content == answer.content


def test_the_archive_without_a_map(client: TestClient, study: FinishedStudy) -> None:
    study.finish(no_map())
    content = client.get(f"/v1/jobs/{study.job_id}/archive.zip").content
    names = set(zipfile.ZipFile(io.BytesIO(content)).namelist())
    assert names == {"job.json", "parameters.json", "points.csv", "tracks.csv", "report.html"}


def test_the_archive_waits_for_the_end(client: TestClient, study: FinishedStudy) -> None:
    study.mapped()
    answer = client.get(f"/v1/jobs/{study.job_id}/archive.zip")
    assert (answer.status_code, answer.json()["code"]) == (409, "not_ready")


def test_the_archive_begins_before_its_pictures_exist(
    client: TestClient, study: FinishedStudy, monkeypatch: pytest.MonkeyPatch
) -> None:
    study.finish()

    def never(*_: object) -> object:
        raise AssertionError("made before the first bytes were sent")

    for name in ("report_of", "tracks_table_of", "picture_of"):
        monkeypatch.setattr(archive_files, name, never)
    pieces = archive._zipped(archive_files.archive_files(study.job_id))
    first = next(pieces)
    assert first.startswith(b"PK")
    assert b"job.json" in first


def test_a_second_archive_takes_the_files_of_the_first(
    client: TestClient, study: FinishedStudy, monkeypatch: pytest.MonkeyPatch
) -> None:
    study.finish()
    path = f"/v1/jobs/{study.job_id}/archive.zip"
    first = client.get(path).content

    def never(*_: object) -> object:
        raise AssertionError("made again")

    for module, name in (
        (overlay_routes, "run_in_pool"),
        (maps, "run_in_pool"),
        (report_page, "write_report_page"),
        (tracks, "tracks_csv"),
    ):
        monkeypatch.setattr(module, name, never)
    assert client.get(path).content == first
    assert client.get(f"/v1/jobs/{study.job_id}/report.html").status_code == 200


def test_the_jobs_of_a_study_share_their_pictures(study: FinishedStudy) -> None:
    made = []

    def make() -> bytes:
        made.append(len(made))
        return b"picture"

    with writing() as session:
        session.add(Study(id="other", label="x", catheters=[], reference="r", mapping="m"))
        session.flush()
        session.add(Job(id="later", study_id=study.study_id, state=JobState.QUEUED, snapshot={}))
        session.add(Job(id="elsewhere", study_id="other", state=JobState.QUEUED, snapshot={}))
    for job, times_made in ((study.job_id, 1), ("later", 1), ("elsewhere", 2)):
        assert kept_rendering(job, {"kind": "test"}, make).path.read_bytes() == b"picture"
        assert len(made) == times_made
    assert kept_rendering("later", {"kind": "another"}, make).path.read_bytes() == b"picture"
    assert len(made) == 3
