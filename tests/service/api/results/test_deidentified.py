"""The de-identified export: whole, consistent, and without the marks of the patient."""

from __future__ import annotations

import csv
import io
import os
import shutil
import subprocess
import zipfile
from pathlib import Path

import numpy as np
import pydicom
import pytest
from click.testing import CliRunner
from fastapi.testclient import TestClient
from finished_study import FinishedStudy, edit_runs, make_study, no_map
from pydicom.dataset import Dataset
from small_runs import edited

from fluoromap_service.cli.app import load
from fluoromap_service.store import audit, files, schema
from fluoromap_service.store.engine import reading
from fluoromap_service.store.models import Instance, Job

pytestmark = pytest.mark.usefixtures("file_processes")

MARK = "CANARY7"
NAMED = {
    "PatientName": f"{MARK}^Name", "PatientID": f"{MARK}-ID", "PatientBirthDate": "19520317", "OtherPatientNames": MARK,
    "PatientAddress": MARK, "AccessionNumber": f"{MARK}-ACC", "StudyID": MARK, "StudyDescription": MARK,
    "SeriesDescription": MARK, "InstitutionName": MARK, "ReferringPhysicianName": MARK, "OperatorsName": MARK,
    "StationName": MARK, "DeviceSerialNumber": MARK, "ImageComments": MARK, "ProtocolName": MARK,
}  # fmt: skip


@pytest.fixture
def study(client: TestClient) -> FinishedStudy:
    """A finished job whose runs name a patient."""
    made = make_study()
    edit_runs(made, lambda content: edited(content, **NAMED))
    return made


def members(client: TestClient, study: FinishedStudy, query: str = "") -> dict[str, bytes]:
    answer = client.get(f"/v1/jobs/{study.job_id}/deidentified.zip{query}")
    assert answer.status_code == 200, answer.text
    assert answer.headers["content-type"] == "application/zip"
    assert MARK not in str(answer.headers)
    with zipfile.ZipFile(io.BytesIO(answer.content)) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def objects(found: dict[str, bytes], folder: str) -> dict[str, Dataset]:
    return {
        name: pydicom.dcmread(io.BytesIO(content)) for name, content in found.items() if name.startswith(f"{folder}/")
    }


def originals() -> list[Dataset]:
    with reading() as session:
        return [pydicom.dcmread(files.path_of(instance.sha256)) for instance in session.query(Instance)]


@pytest.mark.parametrize("dates", ["remove", "shift", "keep"])
def test_no_identifier_is_in_the_export(client: TestClient, study: FinishedStudy, dates: str, data_dir: Path) -> None:
    study.finish()
    found = members(client, study, f"?dates={dates}")
    sources = originals()
    uids = {uid for run in sources for uid in (run.SOPInstanceUID, run.StudyInstanceUID, run.SeriesInstanceUID)}
    secret = (data_dir / "reidentification" / "secret").read_bytes()
    for name, content in found.items():
        for hidden in (MARK.encode(), b"19520317", secret, study.job_id.encode(), *(uid.encode() for uid in uids)):
            assert hidden not in content, name
            assert hidden.decode("latin-1") not in name
    for item in (*objects(found, "runs").values(), *objects(found, "results").values()):
        assert item.PatientIdentityRemoved == "YES"
        assert item.DeidentificationMethodCodeSequence[0].CodeValue == "113100"
        assert item.PatientName == f"{item.PatientID}^"
        assert str(item.PatientName).startswith("SUBJECT-")
    assert "burned" in found["README.txt"].decode()


def test_runs_and_results_refer_to_each_other(client: TestClient, study: FinishedStudy) -> None:
    study.finish()
    found = members(client, study, "?subject=S-001&dates=shift")
    runs, results = objects(found, "runs"), objects(found, "results")
    assert set(results) == {f"results/{name}.dcm" for name in ("report", "overlays-1", "map", "chamber")}
    assert [run.PatientID for run in runs.values()] == ["S-001"] * 4
    pixels = {run.pixel_array.tobytes() for run in originals()}
    assert {run.pixel_array.tobytes() for run in runs.values()} == pixels
    new = {str(run.SOPInstanceUID) for run in runs.values()}
    assert {f"runs/{uid}.dcm" for uid in new} == set(runs)
    (study_uid,) = {run.StudyInstanceUID for run in (*runs.values(), *results.values())}
    references = {item.ReferencedSOPInstanceUID for item in results["results/map.dcm"].SourceImageSequence}
    assert references
    assert references <= new
    (row, _) = csv.DictReader(io.StringIO(found["activation-times.csv"].decode()))
    assert (row["site"], row["lat_ms"]) == ("S01", "41.0")
    assert {row["view_a"], row["view_b"]} == references
    assert study_uid not in {run.StudyInstanceUID for run in originals()}
    days = {run.StudyDate for run in runs.values()}
    assert len(days) == 1
    assert days != {"20260301"}
    assert {run.StudyTime for run in runs.values()} == {run.StudyTime for run in originals()}


def test_exports_fit_each_other_and_the_list_leads_back(
    client: TestClient, study: FinishedStudy, data_dir: Path
) -> None:
    study.finish()
    first, second = members(client, study), members(client, study)
    assert first == second
    folder = data_dir / "reidentification"
    assert folder.stat().st_mode & 0o777 == 0o700
    listed = folder / f"{study.study_id}.csv"
    assert {path.stat().st_mode & 0o777 for path in folder.iterdir()} == {0o600}
    rows = list(csv.DictReader(listed.open(newline="")))
    assert len(rows) == len({row["original"] for row in rows})
    back = {row["replacement"]: row["original"] for row in rows}
    assert {back[run.SOPInstanceUID] for run in objects(first, "runs").values()} == set(study.uids.values())


def test_removed_dates(client: TestClient, study: FinishedStudy) -> None:
    study.finish()
    found = members(client, study)
    for item in (*objects(found, "runs").values(), *objects(found, "results").values()):
        dates = {str(element.value)[:8] for element in item.iterall() if element.VR in ("DA", "DT") and element.value}
        assert dates <= {"19000101"}


def test_objects_are_sound(client: TestClient, study: FinishedStudy, tmp_path: Path) -> None:
    if shutil.which("dciodvfy") is None:
        pytest.skip("dciodvfy is not installed, so it cannot check the DICOM objects")
    study.finish()
    for name, content in members(client, study).items():
        if not name.endswith(".dcm"):
            continue
        path = tmp_path / Path(name).name
        path.write_bytes(content)
        checked = subprocess.run(["dciodvfy", "-new", path], capture_output=True, text=True, timeout=60, check=False)
        assert not [line for line in checked.stderr.splitlines() if line.startswith("Error")], name


def test_without_a_map_there_are_runs_and_the_report(client: TestClient, study: FinishedStudy) -> None:
    study.finish(no_map())
    found = members(client, study)
    assert set(objects(found, "results")) == {"results/report.dcm"}
    assert len(objects(found, "runs")) == 4


def test_wrong_requests(client: TestClient, study: FinishedStudy, data_dir: Path) -> None:
    path = f"/v1/jobs/{study.job_id}/deidentified.zip"
    assert client.get(path).json()["code"] == "not_ready"
    study.finish()
    assert client.get(f"{path}?dates=some").status_code == 422
    assert client.get(f"{path}?subject=Doe%5EJane").status_code == 422
    assert client.get("/v1/jobs/none/deidentified.zip").status_code == 404
    with reading() as session:
        uid, run = next(iter(session.get_one(Job, study.job_id).snapshot["runs"].items()))
    content = files.read(run["sha256"])
    os.remove(files.path_of(run["sha256"]))
    assert client.get(path).json()["code"] == "run_broken"
    files.path_of(run["sha256"]).write_bytes(content)
    assert client.delete(f"/v1/studies/{study.study_id}/instances/{uid}").status_code == 204
    assert client.get(path).json()["code"] == "run_deleted"
    assert list(files.incoming_folder().iterdir()) == []


def test_pictures_are_the_same(client: TestClient, study: FinishedStudy) -> None:
    study.finish()
    with zipfile.ZipFile(io.BytesIO(client.get(f"/v1/jobs/{study.job_id}/dicom").content)) as archive:
        named = pydicom.dcmread(io.BytesIO(archive.read("map.dcm")))
    exported = objects(members(client, study), "results")["results/map.dcm"]
    assert np.array_equal(exported.pixel_array, named.pixel_array)
    assert exported.SOPInstanceUID != named.SOPInstanceUID


def test_command(study: FinishedStudy, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    study.finish()
    # The tables of a test are made without migrations.
    monkeypatch.setattr(schema, "upgrade", lambda: None)
    target = tmp_path / "export.zip"
    arguments = [study.job_id, str(target), "--dates", "shift", "--subject", "S-9"]
    answer = CliRunner().invoke(load("export"), arguments)
    assert answer.exit_code == 0, answer.output
    assert MARK not in answer.output
    with zipfile.ZipFile(target) as archive:
        run = next(name for name in archive.namelist() if name.startswith("runs/"))
        assert pydicom.dcmread(io.BytesIO(archive.read(run))).PatientID == "S-9"
    with reading() as session:
        assert [(entry.what, entry.job) for entry in audit.entries(session)] == [("export", study.job_id)]
    again = CliRunner().invoke(load("export"), arguments)
    assert "exists already" in str(again.exception)
    wrong = CliRunner().invoke(load("export"), [study.job_id, str(tmp_path / "other.zip"), "--subject", "Doe^Jane"])
    assert "subject" in str(wrong.exception)
    assert not (tmp_path / "other.zip").exists()
