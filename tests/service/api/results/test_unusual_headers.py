"""Runs with headers that strict readers refuse: every door hands the results out, and the runs are listed."""

from __future__ import annotations

import io
import shutil
import subprocess
import zipfile
from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient
from finished_study import FinishedStudy, edit_runs
from raw_headers import UNUSUAL, strictly_read, with_raw_values

from fluoromap_service.dicom import deterministic_uid

pytestmark = pytest.mark.usefixtures("file_processes")

STUDY = deterministic_uid("study")
NAMES = {
    "charset_leading_empty_ISO2022IR87": "Yamada^Tarou=山田^太郎", "charset_without_underscore": "MÜLLER",
    "nothing_of_type_2": "", "everything_at_once": "MÜLLER A^B^C^D^E F",
}  # fmt: skip


def _zipped(client: TestClient, path: str) -> dict[str, bytes]:
    answer = client.get(path)
    assert answer.status_code == 200, answer.text
    with zipfile.ZipFile(io.BytesIO(answer.content)) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def _listed(client: TestClient, path: str) -> list[dict[str, Any]]:
    answer = client.get(path, headers={"Accept": "application/dicom+json"})
    assert answer.status_code == 200, answer.text
    listed: list[dict[str, Any]] = answer.json()
    return listed


@pytest.mark.parametrize("kind", UNUSUAL)
def test_results_leave_by_every_door(client: TestClient, study: FinishedStudy, kind: str) -> None:
    edit_runs(study, lambda content: with_raw_values(content, UNUSUAL[kind]))
    study.finish()
    # The runs and the results, before and after somebody has asked for the results.
    for _ in range(2):
        assert len(_listed(client, f"/dicom-web/studies/{STUDY}/instances")) == 8
        assert len(_listed(client, f"/dicom-web/studies/{STUDY}/metadata")) == 8
        assert len(_listed(client, f"/dicom-web/studies/{STUDY}/series")) == 5
        results = _zipped(client, f"/v1/jobs/{study.job_id}/dicom")
    assert len(results) == 4
    for content in results.values():
        found = strictly_read(content)
        assert str(found.PatientName or "") == NAMES.get(kind, "SIMULATED^PHANTOM")
        assert found.StudyInstanceUID == STUDY
        assert found.PatientSex in ("M", "F", "O", "", None)
    for name, content in _zipped(client, f"/v1/jobs/{study.job_id}/deidentified.zip?dates=shift").items():
        if name.endswith(".dcm"):
            assert str(strictly_read(content).PatientName).startswith("SUBJECT-")


@pytest.mark.parametrize("kind", ["charset_leading_empty_ISO2022IR87", "nothing_of_type_2", "everything_at_once"])
def test_dciodvfy_finds_no_fault(client: TestClient, study: FinishedStudy, kind: str, tmp_path: Path) -> None:
    if shutil.which("dciodvfy") is None:
        pytest.skip("dciodvfy is not installed, so it cannot check the DICOM objects")
    edit_runs(study, lambda content: with_raw_values(content, UNUSUAL[kind]))
    study.finish()
    for name, content in _zipped(client, f"/v1/jobs/{study.job_id}/dicom").items():
        path = tmp_path / name
        path.write_bytes(content)
        checked = subprocess.run(["dciodvfy", "-new", path], capture_output=True, text=True, timeout=60, check=False)
        lines = (checked.stdout + checked.stderr).splitlines()
        assert [line for line in lines if line.startswith("Error")] == [], name


def test_the_run_has_the_warning(client: TestClient, study: FinishedStudy) -> None:
    run = _run_of(client, study)
    sent = with_raw_values(run, {"SOPInstanceUID": b"2.25.77", "PatientSex": b"?", "PatientID": None})
    path = client.post("/v1/studies", json={"label": "rhythm"}).headers["location"]
    answer = client.post(f"{path}/instances", content=sent, headers={"Content-Type": "application/dicom"})
    assert answer.status_code == 201, answer.text
    assert answer.json()["instances"][0]["warnings"] == ["patient_or_study_repaired", "unbound"]


def _run_of(client: TestClient, study: FinishedStudy) -> bytes:
    uid = next(iter(study.uids.values()))
    series = _listed(client, f"/dicom-web/instances?SOPInstanceUID={uid}")[0]["0020000E"]["Value"][0]
    path = f"/dicom-web/studies/{STUDY}/series/{series}/instances/{uid}"
    answer = client.get(path, headers={"Accept": 'multipart/related; type="application/dicom"; transfer-syntax=*'})
    content = answer.content[answer.content.index(b"\r\n\r\n") + 4 :]
    return content[: content.rindex(b"\r\n--")]
