"""After a correction a job computes again only the parts that depend on the corrected run, in any process."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fastapi.testclient import TestClient
from sqlalchemy import delete, update

from fluoromap.contracts import Array, Silent
from fluoromap.matching import study_matching
from fluoromap.segmenter import run_segmentation
from fluoromap.triangulator import study_triangulation
from fluoromap.triangulator.site_locator import SiteLocator
from fluoromap_service.jobs import job_life
from fluoromap_service.store import files
from fluoromap_service.store.engine import reading, writing
from fluoromap_service.store.models import Job, StageResult, StageRow
from fluoromap_workers.partial_results import StageContext

COUNTED: tuple[tuple[Any, str], ...] = (
    (run_segmentation, "_detect"),
    (study_matching, "compare_views"),
    (study_matching, "_matched"),
    (study_triangulation, "_check_study"),
    (SiteLocator, "locate"),
)
_ANOTHER_PROCESS = """
import json, runpy, sys
from fastapi.testclient import TestClient
from fluoromap_service.api.app import create_app

test = runpy.run_path(sys.argv[1])
counts = test["count"](setattr)
job = test["_job"](TestClient(create_app(), base_url="http://127.0.0.1"), sys.argv[2])
print("\\n" + json.dumps([counts, job["id"], job["state"]]))
"""


def count(replace_by: Any) -> dict[str, int]:
    """Count the calls of the functions that compute the parts; ``replace_by`` is ``setattr``, or one that undoes itself."""
    counts: dict[str, int] = {}
    for owner, name in COUNTED:
        counts[name] = 0

        def counting(*arguments: Any, original: Any = getattr(owner, name), name: str = name) -> Any:
            counts[name] += 1
            return original(*arguments)

        replace_by(owner, name, counting)
    return counts


def _send(service: TestClient, study_path: str, folder: Path) -> None:
    for path in sorted((folder / "dicom").iterdir()):
        headers = {"Content-Type": "application/dicom"}
        assert service.post(f"{study_path}/instances", content=path.read_bytes(), headers=headers).status_code == 201
    # The table names its runs by uploaded file names; sent raw, they are bound by row order.
    rows = (folder / "activation_times.csv").read_text().splitlines()
    table = "\n".join(",".join(row.split(",")[:2]) for row in rows)
    headers = {"Content-Type": "text/csv"}
    assert service.put(f"{study_path}/activation-times", content=table, headers=headers).status_code == 200


def _job(service: TestClient, study_path: str) -> dict[str, Any]:
    job: dict[str, Any] = service.get(service.post(f"{study_path}/jobs", json={}).headers["location"]).json()
    return job


def _correct(service: TestClient, study_path: str, job: dict[str, Any], moved_px: float) -> None:
    """Move the tip of the mapping catheter in a frame of the third site that is far from its diastole."""
    site = service.get(f"{study_path}/sites").json()["items"][2]
    points = service.get(f"/v1/jobs/{job['id']}/points").json()["points"]
    diastole = next(point["views"]["a"]["frame"] for point in points if point["site"] == site["site"])
    for frame in sorted(range(1, 25), key=lambda frame: -abs(frame - diastole)):
        path = f"{study_path}/instances/{site['view_a']}/frames/{frame}/electrodes"
        shown = service.get(path).json()
        if any(electrode["catheter"] == "mapping" for electrode in shown):
            break
    keys = ("catheter", "electrode", "u_px", "v_px", "sd_px")
    electrodes = [{key: electrode[key] for key in keys} for electrode in shown]
    next(each for each in electrodes if each["catheter"] == "mapping")["u_px"] += moved_px
    assert service.put(path, json=electrodes).status_code == 200


@pytest.fixture
def corrected(service: TestClient, study_path: str, simulated_study: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """A study after its first job, with a correction in one frame of one run."""
    counts = count(monkeypatch.setattr)
    _send(service, study_path, simulated_study)
    job = _job(service, study_path)
    assert counts == {"_detect": 10, "compare_views": 5, "_matched": 5, "_check_study": 1, "locate": 5}
    monkeypatch.undo()
    _correct(service, study_path, job, 2.0)
    return study_path


def test_a_corrected_frame_computes_its_own_site_again_in_another_process(service: TestClient, corrected: str) -> None:
    ended = subprocess.run(
        [sys.executable, "-c", _ANOTHER_PROCESS, __file__, corrected], capture_output=True, text=True, check=False
    )
    assert ended.returncode == 0, ended.stderr
    counts, job, state = json.loads(ended.stdout.splitlines()[-1])
    assert state == "succeeded"
    assert counts == {"_detect": 0, "compare_views": 1, "_matched": 1, "_check_study": 0, "locate": 1}
    # A job without partial results of earlier jobs comes to the same points.
    found = service.get(f"/v1/jobs/{job}/points").json()["points"]
    _forget_results()
    again = _job(service, corrected)
    assert service.get(f"/v1/jobs/{again['id']}/points").json()["points"] == found


def _forget_results() -> None:
    """Make the next job compute everything."""
    with writing() as session:
        session.execute(delete(StageResult))
        session.execute(update(StageRow).values(result=None))


def test_a_damaged_earlier_result_is_computed_again(service: TestClient, corrected: str) -> None:
    with reading() as session:
        for row in session.query(StageRow).filter(StageRow.name.in_(("match", "triangulate"))):
            assert row.result is not None
            files.path_of(row.result).write_bytes(b"damaged")
    assert _job(service, corrected)["state"] == "succeeded"


def test_a_partial_result_is_used_for_equal_inputs_only(service: TestClient, corrected: str) -> None:
    with reading() as session:
        job = session.query(Job).order_by(Job.created.desc()).first()
        assert job is not None
        row = session.query(StageRow).filter_by(job_id=job.id, name="match").one()
        held = job_life.Claim(row.id, job.id, 1, "match", row.subject)
    computed: list[Array] = []

    def recall(plugin: str, *inputs: object) -> None:
        context = StageContext(Silent(), held, plugin)
        for _ in range(2):
            context.recall(job_life.Claim, inputs, lambda: computed.append(np.zeros(1)) or held)

    recall("a", "S01", np.arange(3.0))
    assert len(computed) == 1, "the same stage recalls its own partial results"
    recall("a", "S01", np.arange(3))
    recall("a", "S02", np.arange(3.0))
    recall("b", "S01", np.arange(3.0))
    assert len(computed) == 4
