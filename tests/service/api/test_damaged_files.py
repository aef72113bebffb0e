"""Every route beside a damaged or missing file: it answers as before, or it names the damage."""

from __future__ import annotations

import itertools
import re
from collections import OrderedDict
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from fastapi.routing import APIRoute
from fastapi.testclient import TestClient
from finished_study import FinishedStudy, make_study
from sqlalchemy import delete, select

from fluoromap_service.api.app import create_app
from fluoromap_service.api.http import file_pool
from fluoromap_service.dicom import deterministic_uid
from fluoromap_service.jobs import stage_results
from fluoromap_service.store import files
from fluoromap_service.store.engine import reading, writing
from fluoromap_service.store.models import DicomObject, Instance, Rendering, StageRow, Study

DICOM_STUDY = deterministic_uid("study")
DAMAGES: dict[str, Callable[[Path], Any]] = {
    # The length stays, so that only the hash shows the damage.
    "damaged": lambda path: path.write_bytes(path.read_bytes()[:-4000] + bytes(4000)),
    "missing": lambda path: path.unlink(),
}
FOREVER = "/v1/jobs/{job_id}/events"


@pytest.fixture(scope="module", autouse=True)
def _file_processes() -> Iterator[None]:
    yield
    file_pool.close()


@pytest.fixture
def study(service: TestClient) -> FinishedStudy:
    made = make_study()
    with writing() as session:
        session.get_one(Study, made.study_id).catheters = [
            {"name": name, "electrodes": 2, "spacing_mm": [4.0], "tip_mm": 2.0, "ring_mm": 1.0}
            for name in ("reference", "mapping")
        ]
    made.finish()
    return made


def routes() -> list[str]:
    """Return the paths of all routes that read a study or a job."""
    paths = [
        route.path for route in create_app().routes if isinstance(route, APIRoute) and "GET" in (route.methods or ())
    ]
    return [path for path in paths if re.search(r"\{(study_id|study_uid|job_id)\}", path) and path != FOREVER]


def addresses(service: TestClient, study: FinishedStudy) -> dict[str, list[str]]:
    """Return addresses of each route; over DICOMweb also those of results."""
    instances = service.get(f"/dicom-web/studies/{DICOM_STUDY}/instances").json()
    places = [(item["0020000E"]["Value"][0], item["00080018"]["Value"][0]) for item in instances]
    run = study.uids["S01", "a"]
    values = {
        "study_id": study.study_id, "job_id": study.job_id, "uid": run, "n": "1", "site": "S01", "delivery_id": "0" * 32,
        "mesh_format": "stl", "study_uid": DICOM_STUDY, "numbers": "2,1", "number": "1",
    }  # fmt: skip
    filled: dict[str, list[str]] = {}
    for path in routes():
        chosen = [{"series_uid": series, "uid": uid} for series, uid in places] if "{series_uid}" in path else [{}]
        filled[path] = [path.format(**values | each) for each in chosen]
    other = study.uids["S01", "b"]
    line = "/v1/studies/{study_id}/instances/{uid}/epipolar-line"
    filled[line] = [f"{address}?other={other}&u_px=4&v_px=4" for address in filled[line]]
    return filled


def forget_everything_made(monkeypatch: pytest.MonkeyPatch) -> None:
    """Forget the renderings and results, so that every route reads again."""
    with writing() as session:
        session.execute(delete(Rendering))
        session.execute(delete(DicomObject).where(DicomObject.job_id.is_not(None)))
    monkeypatch.setattr(stage_results, "_remembered", OrderedDict())


def hashes(query: Any) -> list[str]:
    with reading() as session:
        return list(session.scalars(query))


READ_RUNS = {
    "/v1/studies/{study_id}/instances/{uid}/frames",
    "/v1/studies/{study_id}/instances/{uid}/frames/{n}.png",
    "/v1/studies/{study_id}/instances/{uid}/frames/{n}/preview",
    "/v1/jobs/{job_id}/overlays/{uid}.png",
    "/v1/jobs/{job_id}/overlays/{uid}.gif",
    "/v1/jobs/{job_id}/report.html",
    "/v1/jobs/{job_id}/archive.zip",
    "/v1/jobs/{job_id}/dicom",
    "/v1/jobs/{job_id}/deidentified.zip",
    *(path for path in routes() if path.startswith("/dicom-web/") and not path.endswith(("/series", "/instances"))),
}
"""The routes that cannot answer without the files of the runs."""


@pytest.mark.parametrize("damage", DAMAGES)
def test_no_route_answers_from_a_damaged_run(
    service: TestClient, study: FinishedStudy, damage: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = addresses(service, study)
    whole = {each: service.get(each) for each in itertools.chain(*asked.values())}
    forget_everything_made(monkeypatch)
    for sha256 in hashes(select(Instance.sha256)):
        DAMAGES[damage](files.path_of(sha256))
    for path, of_path in asked.items():
        for each in of_path:
            answer = service.get(each)
            if path in READ_RUNS and whole[each].status_code == 200:
                assert (answer.status_code, answer.json()["code"]) == (409, "run_broken"), each
                known = service.get(each, headers={"If-None-Match": whole[each].headers.get("etag", '"x"')})
                assert known.status_code == 409, each
            elif path.startswith("/dicom-web/"):
                # A search may leave out what it cannot read, and a result that no header describes is not known.
                assert answer.status_code in (whole[each].status_code, 204, 409), (each, answer.text)
            else:
                assert answer.status_code == whole[each].status_code, (each, answer.text)


@pytest.mark.parametrize("damage", DAMAGES)
def test_no_route_answers_from_a_damaged_result(
    service: TestClient, study: FinishedStudy, damage: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = addresses(service, study)
    whole = {each: service.get(each) for each in itertools.chain(*asked.values())}
    forget_everything_made(monkeypatch)
    results = hashes(select(StageRow.result).where(StageRow.result.is_not(None)))
    for sha256 in set(results):
        path = files.path_of(sha256)
        path.write_bytes(b"") if damage == "damaged" else path.unlink()
    named = set()
    for path, of_path in asked.items():
        for each in of_path:
            answer = service.get(each)
            if answer.status_code == 409 and whole[each].status_code != 409:
                assert answer.json()["code"] == "result_broken", each
                named.add(path)
            elif "{uid}" in path or not path.startswith("/dicom-web/"):
                assert answer.status_code == whole[each].status_code, (each, answer.text)
                # A page differs in its nonce; lists of a DICOM study leave the job's objects out.
                if answer.status_code == 200 and not path.startswith("/studies/"):
                    assert answer.content == whole[each].content, each
    assert named >= {"/v1/jobs/{job_id}/map", "/v1/jobs/{job_id}/tracks", "/v1/jobs/{job_id}/report.html"}
    assert "/v1/jobs/{job_id}/archive.zip" in named
