"""The index of searches: every door fills it, it goes with its runs, and a search is right while it is being filled."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from dicom_service import STUDIES, found, store
from fastapi.testclient import TestClient
from finished_study import make_study
from small_runs import STUDY_UID, edited, run_uid, small_run
from sqlalchemy import delete, func, select, update

from fluoromap_service.api.dicomweb import indexing
from fluoromap_service.dicom import deterministic_uid
from fluoromap_service.store import files
from fluoromap_service.store.engine import reading, writing
from fluoromap_service.store.models import Base, DicomObject, DicomValue, Instance
from fluoromap_service.study.upkeep import delete_renderings

OTHER_STUDY = deterministic_uid("index", "study")


def rows(table: type[Base]) -> int:
    with reading() as session:
        return session.scalar(select(func.count()).select_from(table)) or 0


def forget_index() -> None:
    """Leave the database as an update from a version without the index does."""
    with writing() as session:
        session.execute(delete(DicomObject))
        session.execute(update(Instance).values(is_indexed=False))


@pytest.fixture
def archive(service: TestClient, tmp_path: Path) -> TestClient:
    """Three runs in two DICOM studies."""
    runs = [edited(small_run(tmp_path, number, 30.0 * number), PatientID=f"P{number}") for number in (1, 2, 3)]
    assert store(service, *runs[:2], edited(runs[2], StudyInstanceUID=OTHER_STUDY)).status_code == 200
    return service


def uids(service: TestClient, query: str = "") -> set[str]:
    return {each["00080018"]["Value"][0] for each in found(service, f"/dicom-web/instances{query}")}


def test_a_search_reads_no_file(
    archive: TestClient, upload: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert upload((4, 20.0)).status_code == 201

    def refuse(*_: Any) -> Any:
        raise AssertionError("a file was read")

    monkeypatch.setattr(indexing, "run_in_pool", refuse)
    assert uids(archive, "?includefield=all") == {run_uid(number) for number in (1, 2, 3, 4)}
    assert len(found(archive, f"{STUDIES}?PatientID=P3")) == 1


def test_runs_of_an_earlier_version_are_found(archive: TestClient) -> None:
    before = archive.get("/dicom-web/instances?includefield=all").json()
    forget_index()
    assert uids(archive, "?PatientID=P3") == {run_uid(3)}
    assert archive.get("/dicom-web/instances?includefield=all").json() == before
    forget_index()
    assert uids(archive, f"?StudyInstanceUID={OTHER_STUDY}") == {run_uid(3)}
    assert rows(DicomObject) == 1, "a search about one study indexes the runs of this study alone"
    assert len(archive.get(f"{STUDIES}/{STUDY_UID}/metadata").json()) == 2
    assert rows(DicomObject) == 3


def test_the_background_indexes_what_lacks(archive: TestClient) -> None:
    values = rows(DicomValue)
    forget_index()
    assert (rows(DicomObject), rows(DicomValue)) == (0, 0)
    indexing.index_some_runs()
    assert (rows(DicomObject), rows(DicomValue)) == (3, values)


def test_a_search_that_would_wait_too_long_is_refused(archive: TestClient, monkeypatch: pytest.MonkeyPatch) -> None:
    forget_index()
    assert uids(archive, f"?StudyInstanceUID={OTHER_STUDY}") == {run_uid(3)}
    monkeypatch.setattr(indexing, "LONGEST_WAIT_SECONDS", -1.0)
    answer = archive.get("/dicom-web/instances")
    assert (answer.status_code, answer.json()["code"]) == (503, "indexing")
    assert int(answer.headers["retry-after"]) > 0
    assert uids(archive, f"?StudyInstanceUID={OTHER_STUDY}") == {run_uid(3)}
    monkeypatch.undo()
    assert len(uids(archive)) == 3


def test_a_damaged_file_hides_no_other_run(archive: TestClient, tmp_path: Path) -> None:
    with reading() as session:
        run = session.get_one(Instance, run_uid(3))
    content = files.path_of(run.sha256).read_bytes()
    files.path_of(run.sha256).unlink()
    forget_index()
    answer = archive.get("/dicom-web/instances")
    assert {each["00080018"]["Value"][0] for each in answer.json()} == {run_uid(number) for number in (1, 2, 3)}
    assert "could not be read" in answer.headers["Warning"]
    searched = archive.get("/dicom-web/instances?PatientID=P3")
    assert searched.status_code == 204
    assert "could not be compared" in searched.headers["Warning"]
    assert uids(archive, "?PatientID=P1") == {run_uid(1)}
    # The same file again mends the run and its entry.
    assert store(archive, content).status_code == 200
    assert uids(archive, "?PatientID=P3") == {run_uid(3)}


def test_rows_go_with_their_run_and_study(archive: TestClient) -> None:
    studies = [item["id"] for item in archive.get("/v1/studies").json()["items"]]
    for study in studies:
        assert archive.delete(f"/v1/studies/{study}").status_code == 204
    assert (rows(DicomObject), rows(DicomValue)) == (0, 0)


def test_results_that_cannot_be_made_hide_no_run(service: TestClient, monkeypatch: pytest.MonkeyPatch) -> None:
    make_study().finish()
    study = deterministic_uid("study")

    def fail(*_: Any) -> Any:
        raise ValueError("an odd header")

    monkeypatch.setattr(indexing, "plan_objects", fail)
    answer = service.get(f"{STUDIES}/{study}/instances")
    assert (answer.status_code, len(answer.json())) == (200, 4)
    assert "results of 1 jobs of this study cannot be listed" in answer.headers["Warning"]
    assert len(service.get(f"{STUDIES}/{study}/metadata").json()) == 4
    monkeypatch.undo()
    assert len(service.get(f"{STUDIES}/{study}/instances").json()) == 8
    assert len(service.get("/dicom-web/instances?Modality=SR").json()) == 1
    delete_renderings()
    assert rows(DicomObject) == 4
    assert len(service.get(f"{STUDIES}/{study}/instances").json()) == 8
