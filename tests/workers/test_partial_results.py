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
from sqlalchemy import delete, select
from sqlalchemy.exc import OperationalError

from fluoromap.contracts import Matching, RejectedSite, Silent
from fluoromap.matching import study_matching
from fluoromap.reasons import Reason
from fluoromap.segmenter.runs import run_segmentation
from fluoromap.triangulator import study_triangulation
from fluoromap.triangulator.site_locator import SiteLocator
from fluoromap_service.jobs import job_life
from fluoromap_service.store import files
from fluoromap_service.store.codec import StoredOtherwise, block_of, decode
from fluoromap_service.store.engine import writing
from fluoromap_service.store.models import StageResult, StageRow
from fluoromap_workers import partial_results
from fluoromap_workers.partial_results import StageContext

COUNTED: tuple[tuple[Any, str], ...] = (
    (run_segmentation, "_detect"),
    (study_matching, "compare_views"),
    (study_matching, "_matched"),
    (study_triangulation, "_check_study"),
    (SiteLocator, "diastole"),
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
    """Count the calls of the functions that compute the parts.

    ``replace_by`` is ``setattr``, or a function that can undo it.
    """
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
    started = service.post(f"{study_path}/jobs", json={"pipeline": {"segmenter": {"name": "catheter-chain"}}})
    job: dict[str, Any] = service.get(started.headers["location"]).json()
    return job


def _correct(service: TestClient, study_path: str, job: dict[str, Any], moved_px: float) -> None:
    """Move the mapping catheter's tip in one frame.

    The frame belongs to the fourth site and is far from its diastole, which stays the same.
    """
    site = service.get(f"{study_path}/sites").json()["items"][3]
    points = service.get(f"/v1/jobs/{job['id']}/points").json()["points"]
    diastole = next(point["views"]["a"]["frame"] for point in points if point["site"] == site["site"])
    for frame in sorted(range(1, 25), key=lambda frame: -abs(frame - diastole)):
        path = f"{study_path}/instances/{site['view_a']}/frames/{frame}/electrodes"
        shown = [each for each in service.get(path).json() if each["catheter"] == "mapping"]
        if shown:
            break
    keys = ("catheter", "electrode", "u_px", "v_px", "sd_px")
    electrodes = [{key: electrode[key] for key in keys} for electrode in shown]
    electrodes[0]["u_px"] += moved_px
    assert service.put(path, json=electrodes).status_code == 200


def _damage_results() -> None:
    """Overwrite all stored results, so that the next job computes everything."""
    with writing() as session:
        session.execute(delete(StageResult))
        for sha256 in session.scalars(select(StageRow.result).where(StageRow.result.is_not(None))):
            assert sha256 is not None
            files.path_of(sha256).write_bytes(b"damaged")


def test_a_corrected_frame_computes_its_own_site_again_in_another_process(
    service: TestClient, study_path: str, simulated_study: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patched:
        counts = count(patched.setattr)
        _send(service, study_path, simulated_study)
        job = _job(service, study_path)
    assert counts == {"_detect": 10, "compare_views": 5, "_matched": 5, "_check_study": 1, "diastole": 5}
    _correct(service, study_path, job, 2.0)
    ended = subprocess.run(
        [sys.executable, "-c", _ANOTHER_PROCESS, __file__, study_path], capture_output=True, text=True, check=False
    )
    assert ended.returncode == 0, ended.stderr
    counts, again, state = json.loads(ended.stdout.splitlines()[-1])
    assert state == "succeeded"
    assert counts == {"_detect": 0, "compare_views": 1, "_matched": 1, "_check_study": 0, "diastole": 1}

    _damage_results()
    whole = _job(service, study_path)
    assert whole["state"] == "succeeded"
    points = [service.get(f"/v1/jobs/{of}/points").json()["points"] for of in (again, whole["id"])]
    assert points[0] == points[1]


@pytest.mark.parametrize("error", [OperationalError("", {}, Exception("no connection")), OSError("read error")])
def test_a_stage_computes_all_parts_where_the_earlier_ones_cannot_be_read(
    error: Exception, data_dir: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def away() -> Any:
        raise error

    monkeypatch.setattr(partial_results, "reading", away)
    context = StageContext(Silent(), job_life.Claim(1, "a job", 1, "match", "study"), "a")
    rejected = RejectedSite("S01", (Reason.NO_ELECTRODES,))
    assert context.recall(RejectedSite, ("S01",), lambda: rejected) == rejected


def test_a_partial_result_is_used_for_equal_inputs_only(data_dir: Path) -> None:
    held = job_life.Claim(1, "no such job", 1, "match", "study")
    computed: list[object] = []

    def recall(context: StageContext, *inputs: object) -> RejectedSite:
        def compute() -> RejectedSite:
            computed.append(inputs)
            return RejectedSite("S01", (Reason.NO_ELECTRODES,))

        return context.recall(RejectedSite, inputs, compute)

    context = StageContext(Silent(), held, "a")
    first = recall(context, "S01", np.arange(3.0), None)
    assert recall(context, "S01", np.arange(3.0), None) == first
    assert len(computed) == 1
    recall(context, "S01", np.arange(3), None)
    recall(context, "S02", np.arange(3.0), None)
    recall(StageContext(Silent(), held, "b"), "S01", np.arange(3.0), None)
    assert len(computed) == 4


def test_a_process_decodes_a_partial_result_once(data_dir: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    values = partial_results._Values()
    monkeypatch.setattr(partial_results, "_values", values)
    decoded: list[str] = []
    monkeypatch.setattr(
        partial_results, "decode", lambda kind, content: decoded.append(kind.__name__) or decode(kind, content)
    )
    blocks = [block_of(RejectedSite(f"S{number:02}", (Reason.NO_ELECTRODES,))) for number in range(4)]
    first = values.value(RejectedSite, blocks[0])
    assert first == RejectedSite("S00", (Reason.NO_ELECTRODES,))
    assert values.value(RejectedSite, blocks[0]) is first
    assert len(decoded) == 1
    with pytest.raises(StoredOtherwise):
        values.value(Matching, blocks[0])


def test_a_process_remembers_partial_results_up_to_a_size(monkeypatch: pytest.MonkeyPatch) -> None:
    blocks = [block_of(RejectedSite(f"S{number:02}", (Reason.NO_ELECTRODES,))) for number in range(4)]
    monkeypatch.setattr(partial_results, "_REMEMBERED_BYTES", sum(len(block.content) for block in blocks[:2]))
    values = partial_results._Values()
    first = [values.value(RejectedSite, block) for block in blocks[:2]]
    # The second was used last, so the first gives way.
    assert values.value(RejectedSite, blocks[1]) is first[1]
    values.value(RejectedSite, blocks[2])
    assert values.value(RejectedSite, blocks[1]) is first[1]
    assert values.value(RejectedSite, blocks[0]) is not first[0]
