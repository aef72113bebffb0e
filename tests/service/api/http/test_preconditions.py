"""Changes with ``If-Match``: of two writers that have read the same version, the second one is refused."""

from __future__ import annotations

import re
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient
from small_runs import run_uid, small_run
from starlette.routing import Route

from fluoromap_service.api.app import create_app
from fluoromap_service.settings import settings
from fluoromap_service.store import schema
from fluoromap_service.store.engine import forget_engine

CHANGING = ("POST", "PUT", "PATCH", "DELETE")
TIP = {"catheter": "mapping", "electrode": 1, "u_px": 10.25, "v_px": 20.5}
ELECTRODES = "/v1/studies/{study_id}/instances/{uid}/frames/{n}/electrodes"


@pytest.fixture(params=["sqlite", "postgresql"])
def both(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[TestClient]:
    """A client of a service on either database."""
    url = request.getfixturevalue("postgres_url") if request.param == "postgresql" else ""
    monkeypatch.setenv("FLUOROMAP_DATA_DIR", str(tmp_path / "data"))
    monkeypatch.setenv("FLUOROMAP_DATABASE_URL", url)
    settings.cache_clear()
    schema.upgrade()
    yield TestClient(create_app(), base_url="http://127.0.0.1")
    forget_engine()
    settings.cache_clear()


@pytest.fixture
def frame(both: TestClient, tmp_path: Path) -> str:
    """The address of the electrodes of a frame."""
    study = both.post("/v1/studies", json={"label": "x"}).headers["location"]
    sent = both.post(
        f"{study}/instances", content=small_run(tmp_path, 1, 0.0), headers={"Content-Type": "application/dicom"}
    )
    assert sent.status_code == 201
    return f"{study}/instances/{run_uid(1)}/frames/2/electrodes"


def _changing_routes() -> list[tuple[str, str]]:
    routes = [route for route in create_app().routes if isinstance(route, Route)]
    return sorted((method, route.path) for route in routes for method in route.methods or () if method in CHANGING)


def _send(client: TestClient, method: str, path: str, etag: str, **more: Any) -> tuple[int, str]:
    body = {"json": [TIP]} if method == "PUT" else {}
    answer = client.request(method, path, headers={"If-Match": etag}, **body, **more)
    return answer.status_code, answer.json()["code"] if answer.status_code >= 400 else answer.headers["ETag"]


@pytest.mark.parametrize("method", ["PUT", "DELETE"])
def test_of_two_writers_at_once_the_second_is_refused(both: TestClient, frame: str, method: str) -> None:
    if method == "DELETE":
        assert _send(both, "PUT", frame, '"0"') == (200, '"1"')
    before = both.get(frame).headers["ETag"]
    start, answers = threading.Barrier(2), []

    def write() -> None:
        start.wait()
        answers.append(_send(both, method, frame, before))

    writers = [threading.Thread(target=write) for _ in range(2)]
    for writer in writers:
        writer.start()
    for writer in writers:
        writer.join()
    after = f'"{int(before.strip(chr(34))) + 1}"'
    assert sorted(answers) == [(200, after), (412, "precondition_failed")]
    assert both.get(frame).headers["ETag"] == after


@pytest.mark.parametrize(("tags", "status"), [('"1"', 412), ('W/"0"', 412), ('"7", "0"', 200), ("*", 200)])
def test_the_tags_of_a_condition(both: TestClient, frame: str, tags: str, status: int) -> None:
    assert _send(both, "PUT", frame, tags)[0] == status
    assert both.get(frame).headers["ETag"] == ('"1"' if status == 200 else '"0"')


def test_no_route_changes_anything_under_a_condition_that_it_cannot_judge(service: TestClient, study_path: str) -> None:
    routes = _changing_routes()
    conditional = {
        (method, path)
        for method, path in routes
        for parameter in service.get("/v1/openapi.json").json()["paths"].get(path, {}).get(method.lower(), {}).get("parameters", [])
        if parameter["name"] == "If-Match"
    }  # fmt: skip
    assert conditional == {("PUT", ELECTRODES), ("DELETE", ELECTRODES)}
    assert len(routes) > 15
    before = service.get(study_path).json()
    for method, path in routes:
        if (method, path) in conditional:
            continue
        named = path.replace("{study_id}", study_path.rpartition("/")[2])
        address = re.sub(r"\{[^}]*\}", "1", named)
        status = service.request(method, address, headers={"If-Match": '"0"'}).status_code
        assert status == 412, (method, path, status)
    assert service.get(study_path).json() == before
