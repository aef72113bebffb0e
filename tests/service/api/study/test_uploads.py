"""Runs over HTTP: what is taken, what is refused, and that nothing half-stored is left behind."""

from __future__ import annotations

import io
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pydicom
import pytest
from fastapi.testclient import TestClient
from small_runs import COLUMNS, FRAMES, ROWS, edited, run_uid, small_run
from sqlalchemy import func, select

from fluoromap_service.dicom import InstanceFacts
from fluoromap_service.settings import settings
from fluoromap_service.store import files
from fluoromap_service.store.engine import reading
from fluoromap_service.store.models import File, Instance, StudyInstance
from fluoromap_service.study import instances

Upload = Callable[..., Any]


def _stored(data_dir: Path) -> tuple[int, int, int, int]:
    """Count rows of File, Instance and StudyInstance, and the disk's files."""
    with reading() as session:
        rows = [
            session.scalar(select(func.count()).select_from(table)) or 0 for table in (File, Instance, StudyInstance)
        ]
    on_disk = [path for path in (data_dir / "files").rglob("*") if path.is_file()]
    return rows[0], rows[1], rows[2], len(on_disk)


def _raw(service: TestClient, study_path: str, content: bytes, **parameters: str) -> Any:
    headers = {"Content-Type": "application/dicom"}
    return service.post(f"{study_path}/instances", content=content, headers=headers, params=parameters)


def test_a_run_is_stored_and_described(upload: Upload, data_dir: Path) -> None:
    answer = upload((1, -90.0), site="P1")
    assert answer.status_code == 201, answer.text
    assert answer.json()["rejected"] == []
    (run,) = answer.json()["instances"]
    assert run == {
        "sop_instance_uid": run_uid(1),
        "site": "P1",
        "view": "a",
        "frames": FRAMES,
        "rows": ROWS,
        "columns": COLUMNS,
        "frame_time_ms": pytest.approx(16.7),
        "acquired": "2026-03-01T09:30:20.000Z",
        "plane": "single",
        "gantry": {
            "primary_deg": -90.0, "secondary_deg": 0.0, "source_detector_mm": 1000.0, "source_isocentre_mm": 750.0,
            "pixel_spacing_mm": [0.3, 0.3], "table_mm": None, "table_origin": None,
        },
        "missing": [],
        "warnings": run["warnings"],
        "simulated": True,
    }  # fmt: skip
    assert "unbound" not in run["warnings"]
    assert _stored(data_dir) == (1, 1, 1, 1)


def test_the_stored_file_is_the_file_sent(service: TestClient, study_path: str, tmp_path: Path, data_dir: Path) -> None:
    content = small_run(tmp_path, 1, 0.0)
    assert _raw(service, study_path, content, site="P1").json()["instances"][0]["site"] == "P1"
    with reading() as session:
        (sha256,) = session.scalars(select(Instance.sha256))
    assert files.path_of(sha256).read_bytes() == content


def test_same_bytes_again_double_nothing(upload: Upload, data_dir: Path) -> None:
    assert upload((1, -90.0)).status_code == 201
    again = upload((1, -90.0))
    assert again.status_code == 200
    assert [run["sop_instance_uid"] for run in again.json()["instances"]] == [run_uid(1)]
    assert upload((1, -90.0), (2, 0.0)).status_code == 201
    assert _stored(data_dir) == (2, 2, 2, 2)


def test_one_instance_serves_two_studies(service: TestClient, study_path: str, tmp_path: Path, data_dir: Path) -> None:
    content = small_run(tmp_path, 1, 0.0)
    other = service.post("/v1/studies", json={"label": "other rhythm"}).headers["location"]
    assert _raw(service, study_path, content).status_code == _raw(service, other, content).status_code == 201
    assert _stored(data_dir) == (1, 1, 2, 1)
    assert service.delete(study_path).status_code == 204
    assert _stored(data_dir) == (1, 1, 1, 1)
    assert service.delete(f"{other}/instances/{run_uid(1)}").status_code == 204
    assert _stored(data_dir) == (0, 0, 0, 0)


def test_other_bytes_under_a_known_uid_conflict(
    service: TestClient, study_path: str, tmp_path: Path, data_dir: Path
) -> None:
    content = small_run(tmp_path, 1, 0.0)
    assert _raw(service, study_path, content).status_code == 201
    answer = _raw(service, study_path, edited(content, PositionerPrimaryAngle=10))
    assert (answer.status_code, answer.json()["code"]) == (409, "sop_instance_uid_taken")
    assert _stored(data_dir) == (1, 1, 1, 1)


def _ct(run: bytes) -> bytes:
    return edited(run, SOPClassUID="1.2.840.10008.5.1.4.1.1.2", Modality="CT")


def _undecodable(run: bytes) -> bytes:
    dataset = pydicom.dcmread(io.BytesIO(run))
    dataset.NumberOfFrames = 1
    dataset.PixelData = pydicom.encaps.encapsulate([b"\xff\xd8\xff\xd9" * 20])
    dataset["PixelData"].VR = "OB"
    dataset.file_meta.TransferSyntaxUID = pydicom.uid.JPEGLSLossless
    stream = io.BytesIO()
    pydicom.dcmwrite(stream, dataset)
    content: bytes = stream.getvalue()
    return content


BAD: list[tuple[str, Callable[[bytes], bytes], int, set[str]]] = [
    ("not DICOM", lambda run: b"%PDF-1.7 " * 100, 415, {"not_dicom"}),
    ("empty", lambda run: b"", 415, {"not_dicom"}),
    ("truncated", lambda run: run[:-1000], 400, {"truncated"}),
    ("truncated in the header", lambda run: run[:400], 400, {"truncated", "malformed"}),
    ("CT", _ct, 422, {"not_xa"}),
    ("no pixel data", lambda run: edited(run, PixelData=None), 422, {"no_pixel_data"}),
    ("NumberOfFrames lies", lambda run: edited(run, NumberOfFrames=500), 400, {"truncated", "pixel_data_mismatch"}),
    ("undecodable", _undecodable, 422, {"undecodable"}),
]


@pytest.mark.parametrize(("damage", "status", "codes"), [row[1:] for row in BAD], ids=[row[0] for row in BAD])
def test_a_bad_file_is_refused_and_leaves_nothing(
    service: TestClient, study_path: str, tmp_path: Path, data_dir: Path, damage: Any, status: int, codes: set[str]
) -> None:
    answer = _raw(service, study_path, damage(small_run(tmp_path, 1, 0.0)))
    assert answer.status_code == status, answer.text
    assert answer.headers["content-type"] == "application/problem+json"
    assert answer.json()["code"] in codes
    assert _stored(data_dir) == (0, 0, 0, 0)


def test_some_rejected_is_still_created(service: TestClient, study_path: str, tmp_path: Path, data_dir: Path) -> None:
    good = small_run(tmp_path, 1, 0.0)
    parts = [("file", ("DOE_JOHN.dcm", b"nonsense" * 50)), ("file", ("good.dcm", good))]
    answer = service.post(f"{study_path}/instances", files=parts)
    assert answer.status_code == 201
    assert len(answer.json()["instances"]) == 1
    (rejected,) = answer.json()["rejected"]
    assert (rejected["status"], rejected["code"], rejected["part"]) == (415, "not_dicom", 1)
    assert "DOE" not in answer.text
    assert _stored(data_dir) == (1, 1, 1, 1)


def test_all_rejected_answers_as_the_first(
    service: TestClient, study_path: str, tmp_path: Path, data_dir: Path
) -> None:
    run = small_run(tmp_path, 1, 0.0)
    parts = [("file", ("a", _ct(run))), ("file", ("b", b"nonsense" * 50))]
    answer = service.post(f"{study_path}/instances", files=parts)
    assert (answer.status_code, answer.json()["code"]) == (422, "not_xa")
    assert [problem["code"] for problem in answer.json()["rejected"]] == ["not_xa", "not_dicom"]
    assert _stored(data_dir) == (0, 0, 0, 0)


def test_a_syntax_no_decoder_reads_is_refused(
    service: TestClient, study_path: str, data_dir: Path, sample_data: Path
) -> None:
    answer = _raw(service, study_path, (sample_data / "xa_1024_jpeg_extended_12bit.dcm").read_bytes())
    assert (answer.status_code, answer.json()["code"]) == (422, "undecodable")
    assert _stored(data_dir) == (0, 0, 0, 0)


def test_a_real_cine_reports_what_it_lacks(service: TestClient, study_path: str, sample_data: Path) -> None:
    answer = _raw(service, study_path, (sample_data / "xa_512x512x96_jpeg_baseline.dcm").read_bytes())
    assert answer.status_code == 201
    run = answer.json()["instances"][0]
    assert run["frames"] == 96
    assert {"DistanceSourceToDetector", "DistanceSourceToPatient"} <= set(run["missing"])
    path = f"{study_path}/instances/{run['sop_instance_uid']}"
    gantry = {"source_detector_mm": 1000, "source_isocentre_mm": 750, "pixel_spacing_mm": [0.3, 0.4]}
    patched = service.patch(path, json={"gantry": gantry})
    assert patched.json()["missing"] == []
    assert patched.json()["gantry"]["primary_deg"] == pytest.approx(-32, abs=1)
    back = service.patch(path, json={"gantry": {"source_detector_mm": None}})
    assert back.json()["missing"] == ["DistanceSourceToDetector"]


@pytest.mark.parametrize(
    ("content", "headers", "status"),
    [
        (b"{}", {"Content-Type": "application/json"}, 415),
        (b"x", {"Content-Type": "multipart/form-data"}, 400),
        (b"--b\r\nContent-Disp", {"Content-Type": "multipart/form-data; boundary=b"}, 400),
        (b"--b--\r\n", {"Content-Type": "multipart/form-data; boundary=b"}, 422),
        (
            b'--b\r\nContent-Disposition: form-data; name="other"\r\n\r\nx\r\n--b--\r\n',
            {"Content-Type": "multipart/form-data; boundary=b"},
            422,
        ),
        (
            b'--b\r\nContent-Disposition: form-data; name="file"; filename="x"\r\n\r\ncut here',
            {"Content-Type": "multipart/form-data; boundary=b"},
            400,
        ),
    ],
    ids=["json", "no boundary", "cut header", "no part", "other part", "cut body"],
)
def test_bodies_that_are_no_upload(
    service: TestClient, study_path: str, data_dir: Path, content: bytes, headers: dict[str, str], status: int
) -> None:
    answer = service.post(f"{study_path}/instances", content=content, headers=headers)
    assert answer.status_code == status, answer.text
    assert _stored(data_dir) == (0, 0, 0, 0)


@pytest.mark.parametrize("streamed", [False, True])
def test_a_body_beyond_the_limit_is_refused(
    service: TestClient,
    study_path: str,
    tmp_path: Path,
    data_dir: Path,
    monkeypatch: pytest.MonkeyPatch,
    streamed: bool,
) -> None:
    monkeypatch.setenv("FLUOROMAP_MAX_UPLOAD_BYTES", "5000")
    settings.cache_clear()
    content: Any = small_run(tmp_path, 1, 0.0)
    answer = _raw(service, study_path, iter([content[:4000], content[4000:]]) if streamed else content)  # type: ignore[arg-type]
    assert (answer.status_code, answer.json()["code"]) == (413, "too_large")
    assert _stored(data_dir) == (0, 0, 0, 0)


def test_a_json_body_beyond_the_limit_is_refused(service: TestClient, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FLUOROMAP_MAX_UPLOAD_BYTES", "5000")
    settings.cache_clear()
    answer = service.post(
        "/v1/studies", content=iter([b'{"label": "', b"x" * 6000, b'"}']), headers={"Content-Type": "application/json"}
    )
    assert (answer.status_code, answer.json()["code"]) == (413, "too_large")


def test_a_displayed_frame(service: TestClient, upload: Upload, study_path: str) -> None:
    from PIL import Image

    upload((1, 0.0))
    path = f"{study_path}/instances/{run_uid(1)}/frames"
    answer = service.get(f"{path}/2.png", params={"window": "2048,4096"})
    assert answer.headers["content-type"] == "image/png"
    picture = Image.open(io.BytesIO(answer.content))
    assert (picture.size, picture.mode) == ((COLUMNS, ROWS), "L")
    assert (
        service.get(f"{path}/2.png?window=2048,4096", headers={"If-None-Match": answer.headers["etag"]}).status_code
        == 304
    )
    assert service.get(f"{path}/{FRAMES + 1}.png").status_code == 404
    assert service.get(f"{path}/0.png").status_code == 422
    assert service.get(f"{path}/1.png?window=nan,1").status_code == 422


def test_gantry_values_that_do_not_fit_are_refused(service: TestClient, upload: Upload, study_path: str) -> None:
    upload((1, 0.0))
    path = f"{study_path}/instances/{run_uid(1)}"
    answer = service.patch(path, json={"gantry": {"source_detector_mm": 700}})
    assert (answer.status_code, answer.json()["code"]) == (422, "invalid_gantry")
    assert service.get(path).json()["gantry"]["source_detector_mm"] == 1000
    assert service.patch(path, json={"gantry": {"primary_deg": 500}}).status_code == 422


def test_an_upload_decodes_no_facts_of_the_runs_before_it(upload: Upload, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every upload pairs all runs of the study; it must not read each of their headers again."""
    decoded = []
    decode = InstanceFacts.from_json

    def count(value: dict[str, Any]) -> InstanceFacts:
        decoded.append(value["sop_instance_uid"])
        return decode(value)

    instances._facts.cache_clear()
    monkeypatch.setattr(InstanceFacts, "from_json", count)
    for number in range(1, 6):
        assert upload((number, 90.0 * (number % 2))).status_code == 201
    assert decoded == [run_uid(number) for number in range(1, 6)]
