"""Electrodes of one frame: by hand, found automatically, and back."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from fastapi.testclient import TestClient
from small_runs import FRAMES, run_uid
from sqlalchemy import select

from fluoromap.contracts import Chain, FrameChains, Segmentation
from fluoromap_service import auth
from fluoromap_service.store import files
from fluoromap_service.store.codec import encode
from fluoromap_service.store.engine import reading, writing
from fluoromap_service.store.models import Correction, Job, StageRow

Upload = Callable[..., Any]
TIP = {"catheter": "mapping", "electrode": 1, "u_px": 10.25, "v_px": 20.5, "sd_px": 0.5}


@pytest.fixture
def frame(study_path: str, upload: Upload) -> str:
    """Address of the electrodes of the second frame of a run."""
    assert upload((1, -90.0)).status_code == 201
    return f"{study_path}/instances/{run_uid(1)}/frames/2/electrodes"


def _segmented(frame: str, u_px: float) -> None:
    chain = Chain(
        electrodes=(1, 2),
        pixels_uv=np.array([[u_px, 6.0], [7.0, 8.0]]),
        covariance_px2=np.stack([np.eye(2) * 0.25] * 2),
        scores=np.ones(2),
        kinds=(("pacing", 0.3), ("mapping", 0.6)),
    )
    found = Segmentation(
        frames=tuple(FrameChains(index, (chain,) if index == 1 else ()) for index in range(FRAMES)),
        diastole=None,
        diastole_frames=(),
        motion=np.zeros(FRAMES),
        frame_times_ms=np.arange(FRAMES) * 16.7,
    )
    with writing() as session:
        job = Job(id=f"job{u_px}", study_id=frame.split("/")[3], state="succeeded", snapshot={"runs": {}}, created=u_px)
        session.add(job)
        session.flush()
        sha256 = files.keep_bytes(session, encode(found))
        session.add(
            StageRow(
                job_id=job.id, name="segment", subject=run_uid(1), plugin="p", plugin_version="1", depends_on=[],
                state="done", result=sha256,
            )
        )  # fmt: skip


def test_nothing_is_known_before_a_job(service: TestClient, frame: str) -> None:
    assert service.get(frame).json() == []
    assert service.get(frame.replace("/2/", f"/{FRAMES + 1}/")).status_code == 404


def test_by_hand_comes_before_automatic(service: TestClient, frame: str) -> None:
    _segmented(frame, 3.0)
    _segmented(frame, 5.0)
    automatic = [
        {"catheter": "mapping", "electrode": 1, "u_px": 5.0, "v_px": 6.0, "sd_px": 0.5, "source": "automatic"},
        {"catheter": "mapping", "electrode": 2, "u_px": 7.0, "v_px": 8.0, "sd_px": 0.5, "source": "automatic"},
    ]
    assert service.get(frame).json() == automatic
    manual = [{**TIP, "source": "manual"}]
    assert service.put(frame, json=[TIP]).json() == manual
    assert service.get(frame).json() == manual
    assert service.get(frame.replace("/2/", "/1/")).json() == []
    assert service.delete(frame).json() == automatic
    assert service.get(frame).json() == automatic


def test_all_frames_of_a_run_in_one_answer(service: TestClient, frame: str) -> None:
    run = frame.split("/frames/")[0]
    assert service.get(f"{run}/electrodes").json() == []
    _segmented(frame, 5.0)
    pacing = {**TIP, "catheter": "pacing"}
    service.put(frame.replace("/2/", "/3/"), json=[TIP])
    service.put(frame, json=[pacing])
    first, second = service.get(f"{run}/electrodes").json()
    assert (first["frame"], second["frame"]) == (2, 3)
    # The catheter that nobody marked is still shown as detected.
    assert [(e["catheter"], e["source"]) for e in first["electrodes"]] == [
        ("mapping", "automatic"), ("mapping", "automatic"), ("pacing", "manual"),
    ]  # fmt: skip
    assert second["electrodes"] == [{**TIP, "source": "manual"}]
    assert service.get(f"{run}1/electrodes").status_code == 404


def test_versions_keep_author_and_time(service: TestClient, frame: str) -> None:
    headers = {"Authorization": f"Bearer {auth.create_token('dr-a', ['write'])}"}
    service.put(frame, json=[TIP], headers=headers)
    service.put(frame, json=[], headers=headers)
    service.delete(frame, headers=headers)
    service.delete(frame, headers=headers)
    with reading() as session:
        versions = session.scalars(select(Correction).order_by(Correction.version)).all()
    assert [correction.version for correction in versions] == [1, 2, 3]
    assert [correction.electrodes for correction in versions] == [[TIP], [], None]
    assert {correction.author for correction in versions} == {"dr-a"}
    assert all(correction.created > 1.7e9 for correction in versions)


@pytest.mark.parametrize(
    ("change", "where"),
    [
        ({"catheter": "lasso"}, "body.0.catheter"),
        ({"electrode": 5}, "body.0.electrode"),
        ({"electrode": 0}, "body.0.electrode"),
        ({"u_px": 64.0}, "body.0.u_px"),
        ({"v_px": -1.0}, "body.0.v_px"),
        ({"sd_px": 0}, "body.0.sd_px"),
        ({"u_px": "left"}, "body.0.u_px"),
        ({"extra": 1}, "body.0.extra"),
    ],
)
def test_electrodes_that_cannot_be(service: TestClient, frame: str, change: dict[str, Any], where: str) -> None:
    answer = service.put(frame, json=[{**TIP, **change}])
    assert answer.status_code == 422
    assert where in [error["where"] for error in answer.json()["errors"]]
    assert service.get(frame).json() == []


def test_an_electrode_occurs_once(service: TestClient, frame: str) -> None:
    answer = service.put(frame, json=[TIP, TIP])
    assert [error["where"] for error in answer.json()["errors"]] == ["body.1.electrode"]


def test_two_electrodes_do_not_share_a_pixel(service: TestClient, frame: str) -> None:
    answer = service.put(frame, json=[TIP, {**TIP, "electrode": 2}])
    assert [error["where"] for error in answer.json()["errors"]] == ["body.1"]
    assert service.put(frame, json=[TIP, {**TIP, "electrode": 2, "u_px": TIP["u_px"] + 0.5}]).status_code == 200


def test_a_marked_catheter_stays_in_the_study(service: TestClient, frame: str, study_path: str) -> None:
    service.put(frame, json=[{**TIP, "catheter": "pacing"}])
    catheters = [row for row in service.get(study_path).json()["catheters"] if row["name"] != "pacing"]
    answer = service.patch(study_path, json={"catheters": catheters})
    assert (answer.status_code, answer.json()["code"]) == (409, "electrodes_marked")
    service.delete(frame)
    assert service.patch(study_path, json={"catheters": catheters}).status_code == 200
