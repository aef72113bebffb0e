"""Canaries: identifiers of a patient stay in the DICOM file and the index of headers, file names in their one column."""

from __future__ import annotations

import logging
import sqlite3
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pydicom
import pytest
import structlog
from fastapi import FastAPI
from fastapi.testclient import TestClient
from finished_study import make_study
from small_runs import edited, run_uid, small_run
from sqlalchemy import select

from fluoromap_service.store.engine import reading
from fluoromap_service.store.models import Instance

MARK = "CANARY7"
NAMED = {
    "PatientName": f"{MARK}^Name",
    "PatientID": f"{MARK}-ID",
    "OtherPatientNames": f"{MARK}^Other",
    "PatientBirthName": f"{MARK}^Birth",
    "PatientMotherBirthName": f"{MARK}^Mother",
    "PatientAddress": f"{MARK} Street 1",
    "PatientTelephoneNumbers": f"{MARK}-555",
    "PatientComments": f"{MARK} comment",
    "EthnicGroup": MARK,
    "AccessionNumber": f"{MARK}-ACC",
    "StudyID": f"{MARK}-STU",
    "StudyDescription": f"{MARK} study",
    "SeriesDescription": f"{MARK} series",
    "ProtocolName": f"{MARK} protocol",
    "InstitutionName": f"{MARK} Hospital",
    "InstitutionAddress": f"{MARK} Road",
    "ReferringPhysicianName": f"{MARK}^Referring",
    "PerformingPhysicianName": f"{MARK}^Performing",
    "OperatorsName": f"{MARK}^Operator",
    "StationName": MARK,
    "DeviceSerialNumber": f"{MARK}-DEV",
    "ImageComments": f"{MARK} image",
    "AdditionalPatientHistory": f"{MARK} history",
    "RequestedProcedureDescription": f"{MARK} requested",
    "ContrastBolusAgent": f"{MARK} agent",
}
FILE_NAME = f"{MARK}-Doe_Jane_19520317.dcm"


class _Everything(logging.Handler):
    def __init__(self) -> None:
        super().__init__()
        self.lines: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.lines.append(self.format(record))


@pytest.fixture
def lines() -> Iterator[list[str]]:
    """All log lines of this test."""
    handler = _Everything()
    before = structlog.get_config()

    def keep(_: Any, __: str, event: Any) -> Any:
        handler.lines.append(repr(event))
        raise structlog.DropEvent

    structlog.configure(processors=[structlog.processors.format_exc_info, keep])
    logging.getLogger().addHandler(handler)
    yield handler.lines
    logging.getLogger().removeHandler(handler)
    structlog.configure(**before)


def _marked(folder: Path, number: int, angle: float) -> bytes:
    content = edited(small_run(folder, number, angle), **NAMED)
    path = folder / "marked.dcm"
    path.write_bytes(content)
    dataset = pydicom.dcmread(path)
    private = dataset.private_block(0x0019, f"{MARK} CREATOR", create=True)
    private.add_new(0x01, "LO", f"{MARK} private")
    dataset.save_as(path)
    content = path.read_bytes()
    path.unlink()
    return content


def test_identifiers_stay_in_the_stored_file(
    service: TestClient, study_path: str, tmp_path: Path, data_dir: Path, lines: list[str], capfd: Any
) -> None:
    good = [_marked(tmp_path, number, 90.0 * number) for number in (0, 1)]
    truncated, no_pixels = (
        good[0][: len(good[0]) // 2],
        edited(good[1], Modality="CT", SOPClassUID="1.2.840.10008.5.1.4.1.1.2"),
    )
    parts = [
        ("file", (FILE_NAME, content, "application/dicom")) for content in (*good, truncated, no_pixels, b"x" * 300)
    ]
    answers = [service.post(f"{study_path}/instances", files=parts)]
    assert answers[0].status_code == 201
    assert len(answers[0].json()["rejected"]) == 3
    job = make_study()
    job.finish()
    for uid in (run_uid(0), run_uid(1)):
        run = f"{study_path}/instances/{uid}"
        answers += [service.get(run), service.get(f"{run}/frames/1.png"), service.get(f"{run}/frames/1/electrodes")]
    table = f"site,lat_ms,view_a,view_b\nS01,1,{FILE_NAME},{FILE_NAME}\n"
    csv = {"Content-Type": "text/csv"}
    # The answer names an unknown column to its sender, and nothing may keep the name.
    service.put(f"{study_path}/activation-times", content=f"{MARK},lat\n1", headers=csv)
    answers += [
        service.put(f"{study_path}/activation-times", content=table, headers=csv),
        service.put(f"{study_path}/activation-times", content=f"site,lat_ms\nS01,{MARK}\n", headers=csv),
        service.post(f"{study_path}/jobs", json={}),
        service.get(f"{study_path}/sites"),
        service.get("/v1/jobs"),
        service.get("/metrics"),
    ]
    results = ("points.csv", "tracks.csv", "map", "mesh.ply", "mesh.glb", "overlays", "report.html", "archive.zip")
    answers += [service.get(f"/v1/jobs/{job.job_id}/{name}") for name in results]
    app = service.app
    assert isinstance(app, FastAPI)
    app.state.acts.flush()

    mark = MARK.encode()
    for answer in answers:
        assert answer.status_code < 500, answer.url
        assert mark not in answer.content, answer.url
        assert MARK not in str(answer.headers), answer.url
    assert len(lines) >= len(answers)
    assert not [line for line in lines if MARK in line]
    captured = capfd.readouterr()
    assert MARK not in captured.out + captured.err
    _check_disk(data_dir)


def _check_disk(data_dir: Path) -> None:
    with reading() as session:
        runs = set(session.scalars(select(Instance.sha256)))
    for path in data_dir.rglob("*"):
        assert MARK not in path.name
        if path.is_file() and path.name not in runs and not path.name.startswith("fluoromap.sqlite"):
            assert MARK.encode() not in path.read_bytes(), path
    allowed = {("study_instance", "file_name"), ("site", "csv_a"), ("site", "csv_b")}
    # DICOMweb searches match the attributes of the header.
    allowed |= {("dicom_object", "header"), ("dicom_value", "first")}
    found = set()
    with closing(sqlite3.connect(data_dir / "fluoromap.sqlite")) as database:
        for (table,) in database.execute("SELECT name FROM sqlite_master WHERE type = 'table'").fetchall():
            rows = database.execute(f"SELECT * FROM {table}")
            names = [column[0] for column in rows.description]
            found |= {
                (table, name) for row in rows for name, value in zip(names, row, strict=True) if MARK in str(value)
            }
    assert found <= allowed, found - allowed
    assert ("study_instance", "file_name") in found, "the canary was not there to be found"
