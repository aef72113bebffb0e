"""Jobs: their shape, entity tags, waiting, cancelling, listing and starting."""

from __future__ import annotations

import threading
from typing import Any

import pytest
from fastapi.testclient import TestClient
from finished_study import FinishedStudy, matching

from fluoromap_service.api.jobs import jobs as job_routes
from fluoromap_service.jobs import job_life
from fluoromap_service.store.engine import reading, writing
from fluoromap_service.store.models import Job
from fluoromap_service.study.snapshot import Snapshot


def _path(study: FinishedStudy) -> str:
    return f"/v1/jobs/{study.job_id}"


def test_a_job_has_exactly_the_promised_members(client: TestClient, study: FinishedStudy) -> None:
    job = client.get(_path(study)).json()
    assert set(job) == {
        "id", "study", "state", "progress", "stages", "error", "warnings", "created", "started", "finished", "links",
    }  # fmt: skip
    assert set(job["stages"][0]) == {
        "name", "subject", "plugin", "version", "state", "attempt", "progress", "reused", "error",
    }  # fmt: skip
    assert set(job["links"]) == {"points", "tracks", "map", "overlays", "report"}
    assert (job["state"], job["progress"], job["started"]) == ("queued", 0.0, None)
    assert job["created"].endswith("Z")
    assert [stage["name"] for stage in job["stages"]].count("segment") == 4


def test_progress_grows_to_one(client: TestClient, study: FinishedStudy) -> None:
    seen = [client.get(_path(study)).json()["progress"]]
    for step in (study.segmented, lambda: study.end("match", None, matching())):
        step()
        seen.append(client.get(_path(study)).json()["progress"])
    assert seen == sorted(set(seen))
    assert seen[-1] == pytest.approx(5 / 9, abs=1e-3)


def test_a_failed_stage_is_a_problem_in_its_stage_and_in_the_job(client: TestClient, study: FinishedStudy) -> None:
    study.segmented()
    study.fail("match")
    job = client.get(_path(study)).json()
    match = next(stage for stage in job["stages"] if stage["name"] == "match")
    for error in (job["error"], match["error"]):
        assert error["code"] == "plugin_failed"
        assert {"type", "title", "status", "detail", "errors"} <= set(error)
    assert (job["state"], job["progress"]) == ("failed", 1.0)


@pytest.mark.parametrize("code", ["internal", "plugin_failed", "worker_lost"])
def test_a_failed_stage_is_no_fault_of_the_data(client: TestClient, study: FinishedStudy, code: str) -> None:
    study.segmented()
    study.fail("match", code=code)
    job = client.get(_path(study)).json()
    match = next(stage for stage in job["stages"] if stage["name"] == "match")
    assert [(error["code"], error["status"]) for error in (job["error"], match["error"])] == [(code, 500)] * 2


def test_unchanged_jobs_are_not_sent_again(client: TestClient, study: FinishedStudy) -> None:
    etag = client.get(_path(study)).headers["etag"]
    again = client.get(_path(study), headers={"If-None-Match": etag})
    assert (again.status_code, again.content, again.headers["etag"]) == (304, b"", etag)
    with study.claimed("segment", study.uids["S01", "a"]) as (session, held):
        job_life.beat(session, held, 0.5)
    changed = client.get(_path(study), headers={"If-None-Match": f'"other", {etag}'})
    assert changed.status_code == 200
    assert changed.headers["etag"] != etag


def test_progress_alone_changes_the_tag(client: TestClient, study: FinishedStudy) -> None:
    with study.claimed("segment", study.uids["S01", "a"]) as (_, held):
        pass
    etag = client.get(_path(study)).headers["etag"]
    with writing() as session:
        job_life.beat(session, held, 0.25)
    assert client.get(_path(study), headers={"If-None-Match": etag}).status_code == 200


def test_waiting_ends_when_the_state_changes(
    client: TestClient, study: FinishedStudy, monkeypatch: pytest.MonkeyPatch
) -> None:
    looked = threading.Event()
    look = job_routes._state

    def noticed(job_id: str) -> tuple[str, str]:
        seen = look(job_id)
        looked.set()
        return seen

    monkeypatch.setattr(job_routes, "_state", noticed)
    answers: list[dict[str, Any]] = []
    waiting = threading.Thread(target=lambda: answers.append(client.get(f"{_path(study)}?wait=60").json()))
    waiting.start()
    assert looked.wait(30)
    with study.claimed("segment", study.uids["S01", "a"]):
        pass
    waiting.join(30)
    assert answers[0]["state"] == "running"


def test_waiting_with_a_tag_ends_unchanged_when_the_time_is_over(client: TestClient, study: FinishedStudy) -> None:
    etag = client.get(_path(study)).headers["etag"]
    assert client.get(f"{_path(study)}?wait=0.1", headers={"If-None-Match": etag}).status_code == 304
    assert client.get(f"{_path(study)}?wait=0.1").json()["state"] == "queued"


def test_nobody_waits_for_a_job_that_has_ended(client: TestClient, study: FinishedStudy) -> None:
    client.post(f"{_path(study)}:cancel")
    etag = client.get(f"{_path(study)}?wait=60").headers["etag"]
    assert client.get(f"{_path(study)}?wait=60", headers={"If-None-Match": etag}).status_code == 304


@pytest.mark.parametrize("wait", ["61", "-1", "nan", "soon"])
def test_waiting_has_limits(client: TestClient, study: FinishedStudy, wait: str) -> None:
    assert client.get(f"{_path(study)}?wait={wait}").status_code == 422


def test_cancelling(client: TestClient, study: FinishedStudy) -> None:
    with study.claimed("segment", study.uids["S01", "a"]) as (_, held):
        pass
    answer = client.post(f"{_path(study)}:cancel")
    assert answer.status_code == 202
    assert answer.json()["state"] == "running"
    assert {stage["state"] for stage in answer.json()["stages"]} == {"running", "cancelled"}
    with writing() as session:
        job_life.stopped(session, held)
    assert client.get(_path(study)).json()["state"] == "cancelled"
    refused = client.post(f"{_path(study)}:cancel")
    assert (refused.status_code, refused.json()["code"]) == (409, "job_ended")
    assert client.post("/v1/jobs/nothing:cancel").status_code == 404


def test_jobs_are_listed_newest_first_a_page_at_a_time(client: TestClient, study: FinishedStudy) -> None:
    with writing() as session:
        snapshot = Snapshot.model_validate(session.get_one(Job, study.job_id).snapshot)
        newer = job_life.create(session, study.study_id, snapshot).id
    first = client.get("/v1/jobs?limit=1")
    assert [job["id"] for job in first.json()["items"]] == [newer]
    assert 'rel="next"' in first.headers["link"]
    second = client.get(f"/v1/jobs?limit=1&cursor={first.json()['next']}").json()
    assert [job["id"] for job in second["items"]] == [study.job_id]
    assert second["next"] is None
    assert len(client.get(f"/v1/jobs?study={study.study_id}").json()["items"]) == 2
    assert client.get("/v1/jobs?study=other").json()["items"] == []


@pytest.fixture
def published(monkeypatch: pytest.MonkeyPatch, study: FinishedStudy) -> list[int]:
    """Starts jobs on the finished study's own snapshot; counts the committed jobs at each announcement."""
    counts: list[int] = []

    def announce() -> int:
        with reading() as session:
            counts.append(session.query(Job).count())
        return 0

    with reading() as session:
        snapshot = Snapshot.model_validate(session.get_one(Job, study.job_id).snapshot)
    monkeypatch.setattr(job_routes, "freeze", lambda *_: snapshot)
    monkeypatch.setattr(job_routes.queue, "publish_due", announce)
    return counts


def test_starting_a_job_announces_it_after_it_is_committed(
    client: TestClient, study: FinishedStudy, published: list[int]
) -> None:
    answer = client.post(f"/v1/studies/{study.study_id}/jobs", json={"view": "a"})
    assert answer.status_code == 202
    assert answer.headers["location"] == f"/v1/jobs/{answer.json()['id']}"
    assert int(answer.headers["retry-after"]) > 0
    assert published == [2]
    assert client.get(answer.headers["location"]).json() == answer.json()


def test_the_same_key_starts_one_job(client: TestClient, study: FinishedStudy, published: list[int]) -> None:
    path, headers = f"/v1/studies/{study.study_id}/jobs", {"Idempotency-Key": "once"}
    first, again = (client.post(path, headers=headers) for _ in range(2))
    assert first.json() == again.json()
    assert (again.status_code, again.headers["location"]) == (202, first.headers["location"])
    assert len(client.get("/v1/jobs").json()["items"]) == 2


@pytest.mark.parametrize(
    ("body", "status"),
    [({"view": "c"}, 422), ({"pipline": {}}, 422), ({"pipeline": {"segmenter": {"nam": 1}}}, 422)],
)
def test_a_wrong_request_starts_nothing(
    client: TestClient, study: FinishedStudy, published: list[int], body: Any, status: int
) -> None:
    assert client.post(f"/v1/studies/{study.study_id}/jobs", json=body).status_code == status
    assert client.post("/v1/studies/none/jobs").status_code == 404
    assert published == []


def test_a_list_holds_summaries(client: TestClient, study: FinishedStudy) -> None:
    def listed() -> dict[str, Any]:
        (item,) = client.get("/v1/jobs").json()["items"]
        return dict(item)

    whole = client.get(f"/v1/jobs/{study.job_id}").json()
    assert listed() == {name: value for name, value in whole.items() if name not in ("stages", "warnings")}
    study.segmented()
    assert listed()["progress"] == pytest.approx(client.get(f"/v1/jobs/{study.job_id}").json()["progress"])
    assert 0 < listed()["progress"] < 1
