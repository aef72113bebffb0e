"""The results as DICOM objects: what they hold, to which patient and runs they belong, and that they never change."""

from __future__ import annotations

import io
import re
import shutil
import subprocess
import zipfile
from pathlib import Path

import numpy as np
import pydicom
import pytest
from fastapi.testclient import TestClient
from finished_study import FinishedStudy, no_map
from highdicom.sr import GraphicTypeValues3D, srread
from PIL import Image
from pydicom.dataset import Dataset
from pydicom.uid import (
    Comprehensive3DSRStorage,
    EncapsulatedSTLStorage,
    MultiFrameTrueColorSecondaryCaptureImageStorage,
)

from fluoromap_service.store import files
from fluoromap_service.store.engine import reading
from fluoromap_service.store.models import Instance

pytestmark = pytest.mark.usefixtures("file_processes")


def content(client: TestClient, study: FinishedStudy) -> bytes:
    answer = client.get(f"/v1/jobs/{study.job_id}/dicom")
    assert answer.status_code == 200, answer.text
    assert answer.headers["content-type"] == "application/zip"
    return answer.content


def objects(zipped: bytes) -> dict[str, Dataset]:
    with zipfile.ZipFile(io.BytesIO(zipped)) as archive:
        return {name: pydicom.dcmread(io.BytesIO(archive.read(name))) for name in archive.namelist()}


def measured(group: Dataset) -> dict[str, float]:
    """Return the numbers of a measurement group by the meaning of their names."""
    return {
        item.ConceptNameCodeSequence[0].CodeMeaning: float(item.MeasuredValueSequence[0].NumericValue)
        for item in group.ContentSequence
        if item.ValueType == "NUM"
    }


def groups_of(report: Dataset) -> dict[str, Dataset]:
    """Return the measurement groups by their tracking identifier."""
    (measurements,) = [item for item in report.ContentSequence if item.ConceptNameCodeSequence[0].CodeValue == "126010"]
    return {
        next(
            item.TextValue for item in group.ContentSequence if item.ConceptNameCodeSequence[0].CodeValue == "112039"
        ): group
        for group in measurements.ContentSequence
    }


def test_objects_belong_to_patient_study_and_runs(client: TestClient, study: FinishedStudy) -> None:
    study.finish()
    found = objects(content(client, study))
    assert {name: item.SOPClassUID for name, item in found.items()} == {
        "report.dcm": Comprehensive3DSRStorage,
        "overlays-1.dcm": MultiFrameTrueColorSecondaryCaptureImageStorage,
        "map.dcm": MultiFrameTrueColorSecondaryCaptureImageStorage,
        "chamber.dcm": EncapsulatedSTLStorage,
    }
    with reading() as session:
        source = pydicom.dcmread(files.path_of(session.query(Instance).first().sha256), stop_before_pixels=True)
    for item in found.values():
        assert (item.PatientName, item.PatientID) == (source.PatientName, source.PatientID)
        assert item.StudyInstanceUID == source.StudyInstanceUID
        assert item.SeriesDescription == "Research result, preliminary"
        assert source.SOPInstanceUID in str(item)
    assert len({item.SeriesInstanceUID for item in found.values()}) == 4
    assert found["report.dcm"].PreliminaryFlag == "PRELIMINARY"


def test_report_has_point_time_and_deviation_of_each_site(client: TestClient, study: FinishedStudy) -> None:
    study.finish()
    report = objects(content(client, study))["report.dcm"]
    assert report.ContentTemplateSequence[0].TemplateIdentifier == "1500"
    points = {
        point["site"]: point
        for point in client.get(f"/v1/jobs/{study.job_id}/points").json()["points"]
        if (point["catheter"], point["electrode"]) == ("mapping", 1) and point["x_mm"] is not None
    }
    groups = groups_of(report)
    assert set(groups) == {*points, "chamber"}
    for site, point in points.items():
        (region,) = [item for item in groups[site].ContentSequence if item.ValueType == "SCOORD3D"]
        assert region.GraphicType == "POINT"
        np.testing.assert_allclose(region.GraphicData, [point["x_mm"], point["y_mm"], point["z_mm"]], atol=1e-4)
        numbers = measured(groups[site])
        assert numbers["Local activation time"] == pytest.approx(point["lat_ms"], abs=1e-3)
        xx, xy, xz, yy, yz, zz = point["covariance_mm2"]
        sd = np.sqrt(np.linalg.eigvalsh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])[-1])
        assert numbers["Largest standard deviation of the position"] == pytest.approx(sd, abs=1e-3)
    volume = client.get(f"/v1/jobs/{study.job_id}/map").json()["volume_ml"]
    assert measured(groups["chamber"])["Volume"] == pytest.approx(volume, abs=0.05)


def test_pictures_are_the_overlays_and_the_surface_is_the_mesh(client: TestClient, study: FinishedStudy) -> None:
    study.finish()
    found = objects(content(client, study))
    links = [entry["href"] for entry in client.get(f"/v1/jobs/{study.job_id}/overlays").json()["overlays"]]
    drawn = [np.asarray(Image.open(io.BytesIO(client.get(link).content)).convert("RGB")) for link in links]
    assert np.array_equal(found["overlays-1.dcm"].pixel_array.reshape(len(drawn), *drawn[0].shape), np.stack(drawn))
    six_views = np.asarray(Image.open(io.BytesIO(client.get(f"/v1/jobs/{study.job_id}/map.png").content)))
    assert np.array_equal(found["map.dcm"].pixel_array, six_views)
    chamber = found["chamber.dcm"]
    stl = client.get(f"/v1/jobs/{study.job_id}/mesh.stl").content
    assert chamber.EncapsulatedDocument[: chamber.EncapsulatedDocumentLength] == stl
    region = next(
        item for item in groups_of(found["report.dcm"])["S01"].ContentSequence if item.ValueType == "SCOORD3D"
    )
    assert region.ReferencedFrameOfReferenceUID == chamber.FrameOfReferenceUID


def test_same_job_gives_the_same_bytes(client: TestClient, study: FinishedStudy) -> None:
    study.finish()
    assert content(client, study) == content(client, study)


def _read_with(program: str, *arguments: str) -> str:
    """Return the output of an installed program about a file; skip without the program."""
    if shutil.which(program) is None:
        pytest.skip(f"{program} is not installed, so it cannot check the DICOM objects")
    result = subprocess.run([program, *arguments], capture_output=True, text=True, timeout=60, check=False)
    return result.stdout + result.stderr


@pytest.fixture
def written(client: TestClient, study: FinishedStudy, tmp_path: Path) -> dict[str, Path]:
    """The object files of a finished job by their names."""
    study.finish()
    with zipfile.ZipFile(io.BytesIO(content(client, study))) as archive:
        archive.extractall(tmp_path)
        return {name: tmp_path / name for name in archive.namelist()}


@pytest.mark.parametrize("name", ["report.dcm", "overlays-1.dcm", "map.dcm", "chamber.dcm"])
def test_dciodvfy_finds_no_fault(written: dict[str, Path], name: str) -> None:
    lines = _read_with("dciodvfy", "-new", str(written[name])).splitlines()
    # dciodvfy knows no private coding scheme. PS3.16 section 8.2 allows schemes whose designators begin with 99.
    private = "Unrecognized defined term = <99FLUOROMAP>"
    assert [line for line in lines if line.startswith(("Error", "Warning")) and private not in line] == []
    assert lines[0] in ("Comprehensive3DSR", "MultiframeTrueColorSCImage", "EncapsulatedSTL")


def test_dcmtk_reads_the_report(written: dict[str, Path]) -> None:
    text = _read_with("dsrdump", str(written["report.dcm"]))
    assert "Comprehensive 3D SR Document" in text
    assert re.search(r"Preliminary Flag +: PRELIMINARY", text)
    assert '"Local activation time")="' in text
    assert "SCOORD3D" in text
    assert not re.search(r"^[EF]:", text, re.M)


def test_dcmtk_draws_the_pictures(written: dict[str, Path], tmp_path: Path) -> None:
    for name in ("overlays-1.dcm", "map.dcm"):
        picture = tmp_path / f"{name}.ppm"
        assert "E:" not in _read_with("dcmj2pnm", "--write-raw-pnm", str(written[name]), str(picture))
        first = pydicom.dcmread(written[name]).pixel_array
        assert np.array_equal(np.asarray(Image.open(picture)), first.reshape(-1, *first.shape[-3:])[0])


def test_highdicom_reads_the_report(written: dict[str, Path]) -> None:
    groups = srread(written["report.dcm"]).content.get_planar_roi_measurement_groups(
        graphic_type=GraphicTypeValues3D.POINT
    )
    assert [group.tracking_identifier for group in groups] == ["S01"]


def test_objects_stay_the_same_when_the_service_draws_otherwise(
    client: TestClient, study: FinishedStudy, monkeypatch: pytest.MonkeyPatch
) -> None:
    study.finish()
    before = content(client, study)
    monkeypatch.setattr("fluoromap.drawing.VERSION", "later")
    assert content(client, study) == before


def test_without_a_map_there_is_the_report(client: TestClient, study: FinishedStudy) -> None:
    study.finish(no_map())
    assert set(objects(content(client, study))) == {"report.dcm"}


def test_they_wait_for_the_end(client: TestClient, study: FinishedStudy) -> None:
    study.mapped()
    answer = client.get(f"/v1/jobs/{study.job_id}/dicom")
    assert (answer.status_code, answer.json()["code"]) == (409, "not_ready")


def test_conformance_statement_lists_the_objects(client: TestClient, study: FinishedStudy) -> None:
    study.finish()
    page = (Path(__file__).parents[4] / "docs" / "dicom-conformance.md").read_text()
    listed = re.findall(
        r"^\| (.+) \| `([\d.]+)` \| SCU \|$", page.partition("## Objects created")[2].partition("## ")[0], re.M
    )
    made = dict.fromkeys(item.SOPClassUID for item in objects(content(client, study)).values())
    assert listed == [(uid.name, str(uid)) for uid in made]
