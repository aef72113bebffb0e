"""Studies, their catheters, pages, and the same request sent twice."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient
from small_runs import run_uid, small_run
from sqlalchemy import update

from fluoromap_service.api.app import create_app
from fluoromap_service.settings import settings
from fluoromap_service.store.engine import engine, writing
from fluoromap_service.store.models import Base, Idempotency, Job

Upload = Callable[..., Any]


def _catheter(name: str, tip_mm: float = 2.0, **change: Any) -> dict[str, Any]:
    return {"name": name, "electrodes": 4, "spacing_mm": [3.5, 6, 3], "tip_mm": tip_mm, "ring_mm": 1, **change}


def test_the_default_catheters(service: TestClient, study_path: str) -> None:
    study = service.get(study_path).json()
    assert [catheter["name"] for catheter in study["catheters"]] == ["reference", "pacing", "mapping"]
    assert study["catheters"][2] == _catheter("mapping", 4.0, spacing_mm=[4.65, 6.3, 3.3], ring_mm=1.3)
    assert (study["reference"], study["mapping"]) == ("reference", "mapping")
    assert study["created"].endswith("Z")


def test_roles_of_named_catheters(service: TestClient) -> None:
    edges = _catheter("abl", 8.0, edge_spacing_mm=[2, 5, 2])
    del edges["spacing_mm"]
    body = {"label": "x", "catheters": [_catheter("cs"), edges, _catheter("his")], "reference": "his"}
    study = service.post("/v1/studies", json=body).json()
    assert (study["reference"], study["mapping"]) == ("his", "abl")
    assert study["catheters"][1]["spacing_mm"] == [6.5, 6.0, 3.0]
    del body["reference"]
    assert service.post("/v1/studies", json=body).json()["reference"] == "cs"


def test_a_single_catheter_maps_and_the_study_has_no_reference(service: TestClient) -> None:
    body = {"label": "x", "catheters": [_catheter("only")]}
    answer = service.post("/v1/studies", json=body)
    assert answer.status_code == 201, answer.text
    study = answer.json()
    assert (study["reference"], study["mapping"]) == (None, "only")
    path = answer.headers["location"]
    assert service.get(path).json() == study
    named = service.post("/v1/studies", json=body | {"reference": "only"})
    assert "leave this out" in named.json()["errors"][0]["message"]
    assert service.patch(path, json={"reference": "only"}).status_code == 422
    assert service.patch(path, json={"notes": "apex"}).json()["reference"] is None


def test_a_study_changes_to_a_single_catheter_and_back(service: TestClient, study_path: str) -> None:
    single = service.patch(study_path, json={"catheters": [_catheter("reference")]}).json()
    assert (single["reference"], single["mapping"]) == (None, "reference")
    again = service.patch(study_path, json={"catheters": [_catheter("cs"), _catheter("mapping")]}).json()
    assert (again["reference"], again["mapping"]) == ("cs", "mapping")


@pytest.mark.parametrize(
    ("body", "where"),
    [
        ({}, "body.label"),
        ({"label": ""}, "body.label"),
        ({"label": "x", "surprise": 1}, "body.surprise"),
        ({"label": "x", "catheters": [_catheter("only")], "reference": "only"}, "reference"),
        ({"label": "x", "catheters": [_catheter("only")], "reference": "nobody"}, "reference"),
        ({"label": "x", "catheters": [_catheter("a"), _catheter("a")]}, "catheters"),
        ({"label": "x", "catheters": [_catheter("a"), _catheter("mapping")], "reference": "mapping"}, "reference"),
        ({"label": "x", "reference": "nobody"}, "reference"),
        ({"label": "x", "catheters": [_catheter("a", spacing_mm=[1.0]), _catheter("b")]}, "body.catheters.0"),
        ({"label": "x", "catheters": [_catheter("a", edge_spacing_mm=[2, 5, 2])]}, "body.catheters.0"),
        ({"label": "x", "catheters": [_catheter("a", tip_mm=-1)]}, "body.catheters.0.tip_mm"),
    ],
)
def test_studies_that_cannot_be(service: TestClient, body: dict[str, Any], where: str) -> None:
    answer = service.post("/v1/studies", json=body)
    assert answer.status_code == 422, answer.text
    assert where in [error["where"] for error in answer.json()["errors"]]
    assert service.get("/v1/studies").json() == {"items": [], "next": None}


def test_a_mistake_is_explained_in_plain_words(service: TestClient) -> None:
    catheter = {"name": "mapping", "electrodes": 4, "spacing_mm": [4.65, 6.3], "tip_mm": 4, "ring_mm": 1.3}
    answer = service.post("/v1/studies", json={"label": "one spacing short", "catheters": [catheter]})
    assert answer.status_code == 422
    assert answer.json()["errors"][0]["message"] == "catheter 'mapping': 4 electrodes need 3 spacings"


def test_broken_json_is_malformed(service: TestClient) -> None:
    answer = service.post("/v1/studies", content=b"{", headers={"Content-Type": "application/json"})
    assert (answer.status_code, answer.json()["code"]) == (400, "malformed")


def test_changing_a_study(service: TestClient, study_path: str) -> None:
    changed = service.patch(study_path, json={"notes": "apex", "reference": "pacing"}).json()
    assert (changed["notes"], changed["reference"], changed["label"]) == ("apex", "pacing", "test")
    assert service.patch(study_path, json={"reference": "mapping"}).status_code == 422
    assert service.patch(study_path, json={"label": None}).status_code == 422
    assert service.patch(study_path, json={"notes": None}).json()["notes"] is None
    assert service.get(study_path).json()["reference"] == "pacing"
    assert service.patch("/v1/studies/none", json={}).status_code == 404


def test_a_study_with_a_running_job_stays(service: TestClient, study_path: str, upload: Upload) -> None:
    upload((1, -90.0))
    snapshot: dict[str, Any] = {"runs": {run_uid(1): {}}}
    with writing() as session:
        session.add(Job(id="j", study_id=study_path.rsplit("/", 1)[1], state="running", snapshot=snapshot))
    assert service.delete(study_path).status_code == 409
    assert service.delete(f"{study_path}/instances/{run_uid(1)}").status_code == 409
    with writing() as session:
        session.execute(update(Job).values(state="succeeded"))
    assert service.delete(study_path).status_code == 204
    assert service.get(study_path).status_code == 404
    assert service.delete(study_path).status_code == 404


def test_pages(service: TestClient) -> None:
    made = [service.post("/v1/studies", json={"label": str(number)}).json()["id"] for number in range(5)]
    seen: list[str] = []
    address: str | None = "/v1/studies?limit=2"
    while address is not None:
        answer = service.get(address)
        assert answer.status_code == 200, answer.text
        seen += [study["id"] for study in answer.json()["items"]]
        following = answer.links.get("next")
        assert (following is None) == (answer.json()["next"] is None)
        address = following["url"] if following else None
    assert seen == made[::-1]


def test_pages_of_a_study(service: TestClient, study_path: str, upload: Upload) -> None:
    upload((1, -90.0), (2, 0.0), (3, -90.0), (4, 0.0))
    for what, key, expected in (("instances", "sop_instance_uid", 4), ("sites", "pair", 2)):
        first = service.get(f"{study_path}/{what}?limit=1").json()
        rest = service.get(f"{study_path}/{what}", params={"cursor": first["next"]}).json()
        assert len({item[key] for item in [*first["items"], *rest["items"]]}) == expected
        assert rest["next"] is None


@pytest.mark.parametrize(
    ("query", "status"),
    [
        ("limit=0", 422),
        ("limit=501", 422),
        ("limit=x", 422),
        ("cursor=%21", 400),
        ("cursor=e30", 400),
        ("cursor=WzFd", 400),
    ],
)
def test_pages_that_cannot_be(service: TestClient, query: str, status: int) -> None:
    assert service.get(f"/v1/studies?{query}").status_code == status


def test_the_same_key_and_content_give_the_same_answer(service: TestClient) -> None:
    def send(label: str, key: str) -> Any:
        return service.post("/v1/studies", json={"label": label}, headers={"Idempotency-Key": key})

    first, again, other_key = send("x", "k1"), send("x", "k1"), send("x", "k2")
    assert first.status_code == again.status_code == 201
    assert (again.json(), again.headers["location"]) == (first.json(), first.headers["location"])
    assert other_key.json()["id"] != first.json()["id"]
    answer = send("y", "k1")
    assert (answer.status_code, answer.json()["code"]) == (422, "idempotency_key_reused")
    with writing() as session:
        session.execute(update(Idempotency).values(created=Idempotency.created - 25 * 3600))
    assert send("y", "k1").status_code == 201


def test_a_refused_request_leaves_its_key_free(service: TestClient) -> None:
    headers = {"Idempotency-Key": "k"}
    bad = {"label": "x", "reference": "nobody"}
    assert service.post("/v1/studies", json=bad, headers=headers).status_code == 422
    assert service.post("/v1/studies", json={"label": "x"}, headers=headers).status_code == 201


def test_uploads_with_a_key_compare_their_parts(service: TestClient, study_path: str, tmp_path: Path) -> None:
    runs = {number: small_run(tmp_path, number, 0.0) for number in (1, 2)}

    def send(number: int, boundary: str) -> Any:
        body = b"\r\n".join(
            [
                f"--{boundary}".encode(),
                b'Content-Disposition: form-data; name="file"',
                b"",
                runs[number],
                f"--{boundary}--\r\n".encode(),
            ]
        )
        headers = {"Content-Type": f"multipart/form-data; boundary={boundary}", "Idempotency-Key": "k"}
        return service.post(f"{study_path}/instances", content=body, headers=headers)

    first, again = send(1, "one"), send(1, "two")
    assert first.status_code == again.status_code == 201
    assert first.json() == again.json()
    assert send(2, "one").status_code == 422


@pytest.fixture(params=["sqlite", "postgresql"])
def anywhere(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[TestClient]:
    """The service on each kind of database."""
    monkeypatch.setenv("FLUOROMAP_DATA_DIR", str(tmp_path / "data"))
    if request.param == "postgresql":
        monkeypatch.setenv("FLUOROMAP_DATABASE_URL", request.getfixturevalue("postgres_url"))
    settings.cache_clear()
    Base.metadata.create_all(engine())
    yield TestClient(create_app(), base_url="http://127.0.0.1")
    engine().dispose()
    settings.cache_clear()


def _at_once(acts: list[Callable[[], Any]]) -> list[Any]:
    answers: list[Any] = [None] * len(acts)
    gate = threading.Barrier(len(acts))

    def run(index: int) -> None:
        gate.wait()
        answers[index] = acts[index]()

    threads = [threading.Thread(target=run, args=(index,)) for index in range(len(acts))]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return answers


def test_the_same_key_at_the_same_time(anywhere: TestClient) -> None:
    def send() -> Any:
        return anywhere.post("/v1/studies", json={"label": "x"}, headers={"Idempotency-Key": "k"})

    answers = _at_once([send] * 6)
    assert {answer.status_code for answer in answers} == {201}
    assert len({answer.json()["id"] for answer in answers}) == 1
    assert len(anywhere.get("/v1/studies").json()["items"]) == 1


def test_the_same_run_at_the_same_time(anywhere: TestClient, tmp_path: Path) -> None:
    content = small_run(tmp_path, 1, 0.0)
    paths = [anywhere.post("/v1/studies", json={"label": "x"}).headers["location"] for _ in range(2)]

    def send(path: str) -> Callable[[], Any]:
        headers = {"Content-Type": "application/dicom"}
        return lambda: anywhere.post(f"{path}/instances", content=content, headers=headers)

    answers = _at_once([send(path) for path in paths * 2])
    assert sorted(answer.status_code for answer in answers) == [200, 200, 201, 201]
    for path in paths:
        assert anywhere.delete(path).status_code == 204
    assert not [path for path in (tmp_path / "data" / "files").rglob("*") if path.is_file()]
