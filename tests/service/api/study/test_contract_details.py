"""Details that clients rely on: order of arrival, exact angles, content types, round trips."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from fastapi.testclient import TestClient

Upload = Callable[..., Any]


def _pairs(service: TestClient, study_path: str) -> dict[str | int, set[str]]:
    items = service.get(f"{study_path}/sites").json()["items"]
    return {item["site"] or item["pair"]: {item["view_a"], item["view_b"]} for item in items}


def test_an_upload_answers_with_the_pairs_it_made(upload: Upload) -> None:
    runs = upload((1, 0.0), (2, 90.0)).json()["instances"]
    assert {run["site"] for run in runs} == {None}
    assert {run["view"] for run in runs} == {"a", "b"}
    assert all("unbound" not in run["warnings"] for run in runs)


def test_reading_changes_nothing(service: TestClient, study_path: str, upload: Upload) -> None:
    """Two studies, one of them read between the uploads, end with the same pairs."""
    upload((3, 0.0), (4, 90.0))
    (first,) = _pairs(service, study_path).values()
    upload((1, 0.0), (2, 90.0))
    assert _pairs(service, study_path)[2] == first
    other = service.post("/v1/studies", json={"label": "unread"}).headers["location"]
    assert len(service.get(f"{study_path}/instances").json()["items"]) == 4
    assert set(_pairs(service, study_path)) == {1, 2}
    assert _pairs(service, other) == {}


def test_runs_that_arrive_out_of_order_pair_with_their_neighbours(
    service: TestClient, study_path: str, upload: Upload
) -> None:
    uid = {}
    for number, angle in ((1, 0.0), (4, 90.0), (2, 90.0), (3, 0.0)):
        uid[number] = upload((number, angle)).json()["instances"][0]["sop_instance_uid"]
    assert _pairs(service, study_path) == {1: {uid[1], uid[2]}, 2: {uid[3], uid[4]}}


def test_a_third_run_of_a_site_stays_unbound_however_early_it_was_acquired(upload: Upload) -> None:
    upload((2, 0.0), (3, 90.0), site="X")
    third = upload((1, 45.0), site="X").json()["instances"][0]
    assert third["site"] is None
    assert "unbound" in third["warnings"]


@pytest.mark.parametrize("angles", [(0.0, 30.0), (30.0, 60.0), (0.0, -30.0), (15.0, 45.0)])
def test_exactly_30_degrees_pair(upload: Upload, angles: tuple[float, float]) -> None:
    runs = upload((1, angles[0]), (2, angles[1])).json()["instances"]
    assert {run["view"] for run in runs} == {"a", "b"}


@pytest.mark.parametrize("angles", [(0.0, 20.0), (10.0, -10.0), (20.0, 40.0)])
def test_exactly_20_degrees_are_computed(
    service: TestClient, study_path: str, upload: Upload, angles: tuple[float, float]
) -> None:
    uids = [run["sop_instance_uid"] for run in upload((1, angles[0]), (2, angles[1])).json()["instances"]]
    site = service.put(f"{study_path}/sites/K", json={"lat_ms": 1, "view_a": uids[0], "view_b": uids[1]}).json()
    assert site["warnings"] == []


@pytest.mark.parametrize("kind", ["text/plain", "application/x-www-form-urlencoded"])
def test_a_body_that_is_not_json_is_415(service: TestClient, kind: str) -> None:
    answer = service.post("/v1/studies", content=b'{"label": "x"}', headers={"Content-Type": kind})
    assert (answer.status_code, answer.json()["code"]) == (415, "unsupported_media_type")


def test_no_body_is_400(service: TestClient) -> None:
    answer = service.post("/v1/studies", headers={"Content-Type": "application/json"})
    assert (answer.status_code, answer.json()["code"]) == (400, "malformed")


@pytest.mark.parametrize("label", ["", "   ", "\0", "a\nb"])
def test_a_label_is_one_line_of_text(service: TestClient, label: str) -> None:
    assert service.post("/v1/studies", json={"label": label}).status_code == 422


def test_what_get_answers_can_be_put(service: TestClient, study_path: str, upload: Upload) -> None:
    uid = upload((1, 0.0)).json()["instances"][0]["sop_instance_uid"]
    path = f"{study_path}/instances/{uid}/frames/1/electrodes"
    marked = [{"catheter": "mapping", "electrode": 1, "u_px": 5.0, "v_px": 6.0, "sd_px": 1.0}]
    assert service.put(path, json=marked).status_code == 200
    answer = service.get(path).json()
    assert answer == [{**marked[0], "source": "manual"}]
    assert service.put(path, json=answer).status_code == 200
    assert service.delete(path).json() == []


def test_an_isocentre_behind_the_detector_is_refused(service: TestClient, study_path: str, upload: Upload) -> None:
    uid = upload((1, 0.0)).json()["instances"][0]["sop_instance_uid"]
    gantry = {"source_detector_mm": 1000, "source_isocentre_mm": 2000}
    answer = service.patch(f"{study_path}/instances/{uid}", json={"gantry": gantry})
    assert (answer.status_code, answer.json()["code"]) == (422, "invalid_gantry")


def test_a_table_that_names_a_run_nobody_sent_says_so(service: TestClient, study_path: str, upload: Upload) -> None:
    upload((1, 0.0), (2, 90.0))
    table = "site,lat_ms,view_a,view_b\nP1,1,run1.dcm,run2.dcm\nP2,2,run1.dcm,run9.dcm\n"
    answer = service.put(f"{study_path}/activation-times", content=table, headers={"Content-Type": "text/csv"})
    assert answer.json() == {"sites": 2, "unmatched": ["P2"]}


def test_a_smooth_plateau_is_not_saturation(service: TestClient, study_path: str) -> None:
    time = np.arange(600.0)
    reference, mapping = (np.round(-np.tanh((time - at) / 4), 6) for at in (200.0, 241.3))
    rows = "\n".join(f"{t:g},{r:.6f},{m:.6f}" for t, r, m in zip(time, reference, mapping, strict=True))
    answer = service.put(
        f"{study_path}/electrograms/E1",
        content=f"time_ms,reference,mapping\n{rows}\n",
        headers={"Content-Type": "text/csv"},
    )
    assert answer.status_code == 200, answer.text
    assert answer.json()["lat_ms"] == pytest.approx(41.3, abs=0.2)


def test_an_unknown_study_is_reported_before_its_table_is_read(service: TestClient) -> None:
    answer = service.put("/v1/studies/nope/electrograms/x", content="?", headers={"Content-Type": "text/csv"})
    assert answer.status_code == 404


def test_a_cursor_of_null_is_refused(service: TestClient) -> None:
    assert service.get("/v1/studies", params={"cursor": "bnVsbA=="}).status_code == 400
