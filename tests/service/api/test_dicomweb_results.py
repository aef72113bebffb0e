"""Results over DICOMweb beside the runs, read with dicomweb-client and with the queries of a viewer; rendered frames."""

from __future__ import annotations

import io
import zipfile
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import pydicom
import pytest
import requests
from fastapi.testclient import TestClient
from finished_study import FRAMES, SIZE, FinishedStudy, make_study, no_map
from numpy.typing import NDArray
from PIL import Image
from pydicom.dataset import Dataset

from fluoromap_service.api.http import file_pool
from fluoromap_service.api.results import result_objects
from fluoromap_service.dicom import deterministic_uid

dicomweb_client = pytest.importorskip("dicomweb_client", reason="dicomweb-client is not installed")

STUDY = deterministic_uid("study")
ADDRESS = f"/dicom-web/studies/{STUDY}"


class _InProcess(requests.adapters.BaseAdapter):
    """Sends the requests of ``requests`` to the application in this process."""

    def __init__(self, client: TestClient) -> None:
        super().__init__()
        self._client = client

    def send(self, request: Any, *args: Any, **kwargs: Any) -> requests.Response:
        headers = {name: value for name, value in request.headers.items() if name.lower() != "connection"}
        answer = self._client.request(request.method, request.url, content=request.body, headers=headers)
        response = requests.Response()
        response.status_code = answer.status_code
        response.headers.update(answer.headers)
        response.raw = io.BytesIO(answer.content)
        response.url = request.url
        response.request = request
        return response

    def close(self) -> None:
        pass


@pytest.fixture(scope="module", autouse=True)
def _file_processes() -> Any:
    yield
    file_pool.close()


@pytest.fixture
def study(service: TestClient) -> FinishedStudy:
    """A job that has succeeded, over four runs of one DICOM study."""
    made = make_study()
    made.finish()
    return made


@pytest.fixture
def peer(service: TestClient, study: FinishedStudy) -> Any:
    """dicomweb-client, connected to the application."""
    session = requests.Session()
    session.mount("http://", _InProcess(service))
    return dicomweb_client.DICOMwebClient("http://127.0.0.1/dicom-web", session=session)


def zipped(service: TestClient, study: FinishedStudy) -> dict[str, Dataset]:
    content = service.get(f"/v1/jobs/{study.job_id}/dicom").content
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        return {name: pydicom.dcmread(io.BytesIO(archive.read(name))) for name in archive.namelist()}


def place(item: Dataset) -> tuple[str, str, str]:
    return item.StudyInstanceUID, item.SeriesInstanceUID, item.SOPInstanceUID


def address(item: Dataset) -> str:
    study_uid, series_uid, uid = place(item)
    return f"/dicom-web/studies/{study_uid}/series/{series_uid}/instances/{uid}"


def picture(answer: Any, media_type: str = "image/png") -> NDArray[np.uint8]:
    assert answer.status_code == 200, answer.text
    assert answer.headers["content-type"] == media_type
    return np.asarray(Image.open(io.BytesIO(answer.content)))


def test_results_are_series_of_the_study(service: TestClient, study: FinishedStudy, peer: Any) -> None:
    series = [Dataset.from_json(item) for item in peer.search_for_series(STUDY)]
    results = [item for item in series if item.SeriesDescription == "Research result, preliminary"]
    assert sorted(item.Modality for item in results) == ["M3D", "SR", "XA", "XA"]
    assert {item.SeriesInstanceUID for item in results} == {
        item.SeriesInstanceUID for item in zipped(service, study).values()
    }
    (run_series,) = [item for item in series if item not in results]
    assert (run_series.Modality, run_series.NumberOfSeriesRelatedInstances) == ("XA", 4)
    (found,) = [Dataset.from_json(item) for item in peer.search_for_studies(search_filters={"StudyInstanceUID": STUDY})]
    assert set(found.ModalitiesInStudy) == {"XA", "SR", "M3D"}
    assert (found.NumberOfStudyRelatedSeries, found.NumberOfStudyRelatedInstances) == (5, 8)
    (report,) = peer.search_for_instances(STUDY, search_filters={"Modality": "SR"})
    assert Dataset.from_json(report).SOPInstanceUID == zipped(service, study)["report.dcm"].SOPInstanceUID


def test_results_are_retrieved(service: TestClient, study: FinishedStudy, peer: Any) -> None:
    expected = zipped(service, study)
    for item in expected.values():
        assert peer.retrieve_instance(*place(item)) == item
        header = Dataset.from_json(peer.retrieve_instance_metadata(*place(item)))
        assert place(header) == place(item)
        assert "PixelData" not in header
    assert len(peer.retrieve_study(STUDY)) == 8
    assert len(peer.retrieve_study_metadata(STUDY)) == 8
    (only,) = peer.retrieve_series(STUDY, expected["chamber.dcm"].SeriesInstanceUID)
    assert only.EncapsulatedDocument == expected["chamber.dcm"].EncapsulatedDocument


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The kinds of pictures that the service asked for, in order."""
    pictures: list[str] = []
    for name in ("picture_of", "map_picture_of"):
        real = getattr(result_objects, name)

        def noted(*arguments: Any, name: str = name, real: Any = real) -> Any:
            pictures.append(name)
            return real(*arguments)

        monkeypatch.setattr(result_objects, name, noted)
    return pictures


def test_searches_and_headers_draw_nothing(
    service: TestClient, study: FinishedStudy, peer: Any, drawn: list[str]
) -> None:
    assert len(peer.search_for_series(STUDY)) == 5
    assert len(peer.search_for_instances(STUDY)) == 8
    headers = peer.retrieve_study_metadata(STUDY)
    assert len(headers) == 8
    assert service.post(f"/v1/jobs/{study.job_id}/deliveries", json={"target": "nobody"}).status_code == 422
    assert drawn == []
    pictures = [Dataset.from_json(item) for item in headers if "NumberOfFrames" in Dataset.from_json(item)]
    for item in (each for each in pictures if each.SOPClassUID.name.startswith("Multi-frame True Color")):
        whole = peer.retrieve_instance(*place(item))
        assert whole.pixel_array.size == int(item.NumberOfFrames) * item.Rows * item.Columns * 3
        del whole.PixelData
        assert whole == item
    assert drawn.count("map_picture_of") == 1


def test_each_object_is_made_alone_and_once(
    service: TestClient, study: FinishedStudy, peer: Any, drawn: list[str]
) -> None:
    objects = {item["0020000E"]["Value"][0]: item for item in peer.search_for_instances(STUDY)}
    headers = [Dataset.from_json(item) for item in objects.values()]
    (report,) = [item for item in headers if item.Modality == "SR"]
    (surface,) = [item for item in headers if item.Modality == "M3D"]
    for item in (report, surface):
        peer.retrieve_instance(*place(item))
    assert drawn == []
    zipped(service, study)
    assert sorted(drawn) == ["map_picture_of", "picture_of", "picture_of"]
    assert len(peer.retrieve_study(STUDY)) == 8
    zipped(service, study)
    assert len(drawn) == 3


def test_frames_that_are_asked_for_at_once_are_drawn_once(
    service: TestClient, study: FinishedStudy, drawn: list[str]
) -> None:
    (item,) = [
        Dataset.from_json(each)
        for each in service.get(f"{ADDRESS}/metadata").json()
        if each.get("00200011", {}).get("Value") == [9011]
    ]
    # Entered, the client runs all requests in one event loop, as a server does.
    with service, ThreadPoolExecutor(4) as threads:
        numbers = [1, 2, 1, 2]
        frames = list(
            threads.map(
                lambda number: picture(service.get(f"{address(item)}/frames/{number}/rendered?accept=image/png")),
                numbers,
            )
        )
    assert drawn == ["picture_of", "picture_of"]
    assert [np.array_equal(frame, frames[number - 1]) for frame, number in zip(frames, numbers, strict=True)] == [
        True
    ] * 4


def test_frames_of_pictures(service: TestClient, study: FinishedStudy, peer: Any) -> None:
    overlays = zipped(service, study)["overlays-1.dcm"]
    frames = peer.retrieve_instance_frames(*place(overlays), frame_numbers=[2, 1])
    expected = overlays.pixel_array
    assert [frame == expected[index].tobytes() for frame, index in zip(frames, (1, 0), strict=True)] == [True, True]
    assert service.get(f"{address(overlays)}/frames/3").status_code == 404
    report = zipped(service, study)["report.dcm"]
    assert service.get(f"{address(report)}/frames/1").status_code == 404


def test_rendered_pictures(service: TestClient, study: FinishedStudy, peer: Any) -> None:
    overlays = zipped(service, study)["overlays-1.dcm"]
    drawn = peer.retrieve_instance_frames_rendered(*place(overlays), frame_numbers=[2], media_types=("image/png",))
    assert np.array_equal(np.asarray(Image.open(io.BytesIO(drawn))), overlays.pixel_array[1])
    first = peer.retrieve_instance_rendered(*place(overlays), media_types=("image/jpeg",))
    assert np.asarray(Image.open(io.BytesIO(first))).shape == overlays.pixel_array.shape[1:]
    report = zipped(service, study)["report.dcm"]
    assert service.get(f"{address(report)}/rendered").status_code == 406


@pytest.fixture
def run(service: TestClient, study: FinishedStudy) -> str:
    """Address of a run, a ramp from 200 to 3000 along its rows."""
    (item,) = service.get(f"{ADDRESS}/instances?SOPInstanceUID={study.uids['S01', 'a']}").json()
    return address(Dataset.from_json(item))


def test_rendered_runs_have_windows(service: TestClient, run: str) -> None:
    png = {"accept": "image/png"}
    ramp = picture(service.get(f"{run}/rendered", headers=png))
    assert ramp.shape == (SIZE, SIZE)
    assert (ramp[0, 0], ramp[0, -1]) == (0, 255)
    exact = picture(service.get(f"{run}/frames/1/rendered?window=1600,2800,linear-exact", headers=png))
    stored = np.linspace(200, 3000, SIZE, dtype=np.uint16)
    np.testing.assert_allclose(exact[5], (stored - 200.0) / 2800 * 255, atol=0.51)
    sigmoid = picture(service.get(f"{run}/frames/1/rendered?window=1600,2800,SIGMOID&accept=image/png"))
    np.testing.assert_allclose(sigmoid[5], 255 / (1 + np.exp(-4 * (stored - 1600.0) / 2800)), atol=0.51)
    linear = picture(service.get(f"{run}/frames/{FRAMES}/rendered?window=1600,1", headers=png))
    assert set(np.unique(linear)) == {0, 255}


def test_rendered_runs_have_viewports(service: TestClient, run: str) -> None:
    png = {"accept": "image/png"}
    whole = picture(service.get(f"{run}/rendered", headers=png))
    assert picture(service.get(f"{run}/rendered?viewport=48,200", headers=png)).shape == (48, 48)
    part = picture(service.get(f"{run}/rendered?viewport=20,10,8,4,20,10", headers=png))
    assert np.array_equal(part, whole[4:14, 8:28])
    flipped = picture(service.get(f"{run}/rendered?viewport=20,10,8,4,-20,10", headers=png))
    assert np.array_equal(flipped, part[:, ::-1])
    small = service.get(f"{run}/rendered?viewport=32,32&quality=20")
    assert picture(small, "image/jpeg").shape == (32, 32)


@pytest.mark.parametrize(
    ("path", "status"),
    [
        ("rendered?window=5", 422), ("rendered?window=5,0", 422), ("rendered?window=5,nan", 422),
        ("rendered?window=5,5,cubic", 422), ("rendered?viewport=0,5", 422), ("rendered?viewport=5", 422),
        ("rendered?viewport=9999,5", 422), ("rendered?viewport=5,5,90,0,20,5", 422), ("rendered?viewport=5,5,0,0,0,5", 422),
        ("rendered?quality=0", 422), ("rendered?quality=9.5", 422), ("rendered?annotation=patient", 422),
        ("frames/0/rendered", 404), ("frames/4/rendered", 404), ("frames/x/rendered", 400),
        ("rendered?accept=image/tiff", 406),
    ],
)  # fmt: skip
def test_wrong_parameters_of_rendered_frames(service: TestClient, run: str, path: str, status: int) -> None:
    answer = service.get(f"{run}/{path}")
    assert answer.status_code == status, answer.text
    assert answer.headers["content-type"] == "application/problem+json"


def test_queries_of_a_viewer(service: TestClient, study: FinishedStudy, peer: Any) -> None:
    query = "limit=101&offset=0&fuzzymatching=false&includefield=00081030,00080060,SoftwareVersions"
    (found,) = service.get(f"/dicom-web/studies?{query}&PatientName=*phantom*").json()
    assert found["00181020"]["Value"] == ["simulation"]
    pages = [service.get(f"{ADDRESS}/instances?limit=3&offset={offset}") for offset in (0, 3, 6)]
    uids = [item["00080018"]["Value"][0] for page in pages for item in page.json()]
    assert len(set(uids)) == 8
    assert ["Warning" in page.headers for page in pages] == [True, True, False]
    assert service.get(f"{ADDRESS}/instances?offset=8").status_code == 204
    assert peer.search_for_studies(search_filters={"PatientID": "nobody"}) == []
    assert len(peer.search_for_instances(STUDY, get_remaining=True, limit=3)) == 8
    (header,) = service.get(f"{ADDRESS}/instances?Modality=SR&includefield=all").json()
    assert header["0040A496"]["Value"] == ["PRELIMINARY"]


def test_a_search_over_all_studies_makes_no_results(service: TestClient, study: FinishedStudy) -> None:
    assert len(service.get("/dicom-web/instances").json()) == 4
    service.get(f"{ADDRESS}/series")
    assert len(service.get("/dicom-web/instances").json()) == 8


def test_without_a_map_there_is_the_report(service: TestClient) -> None:
    make_study().finish(no_map())
    assert len(service.get(f"{ADDRESS}/instances").json()) == 5


def test_results_go_with_a_run(service: TestClient, study: FinishedStudy) -> None:
    assert len(service.get(f"{ADDRESS}/instances").json()) == 8
    uid = study.uids["S01", "a"]
    assert service.delete(f"/v1/studies/{study.study_id}/instances/{uid}").status_code == 204
    assert len(service.get(f"{ADDRESS}/instances").json()) == 3
