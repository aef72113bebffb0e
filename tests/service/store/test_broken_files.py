"""Damaged files in the store: found when read, computed again or named, and replaced by the same upload."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient
from finished_study import FinishedStudy, make_study, matching
from small_runs import run_uid
from sqlalchemy import select

from fluoromap.contracts import Matching
from fluoromap_service.jobs import job_life
from fluoromap_service.jobs.stage_results import load_file
from fluoromap_service.settings import settings
from fluoromap_service.store import files
from fluoromap_service.store.codec import encode
from fluoromap_service.store.engine import reading, writing
from fluoromap_service.store.files import BrokenFile
from fluoromap_service.store.models import Instance, Point, StageRow, StageState


def _stored(content: bytes) -> str:
    with writing() as session:
        return files.keep_bytes(session, content)


@pytest.mark.parametrize("damage", [lambda path: path.write_bytes(b"x" * 7), lambda path: path.unlink()])
def test_a_damaged_file_is_never_read(data_dir: Path, damage: Callable[[Path], Any]) -> None:
    sha256 = _stored(b"content")
    assert files.read(sha256) == b"content"
    assert files.checked_path(sha256).read_bytes() == b"content"
    damage(files.path_of(sha256))
    assert not files.is_whole(sha256)
    for read in (files.read, files.checked_path):
        with pytest.raises(BrokenFile):
            read(sha256)


def test_a_file_that_is_checked_meanwhile_counts_only_when_it_is_whole(data_dir: Path) -> None:
    sha256 = _stored(b"content")
    with files.checked_meanwhile(sha256) as path:
        assert path.read_bytes() == b"content"
    with pytest.raises(ZeroDivisionError), files.checked_meanwhile(sha256):
        raise ZeroDivisionError
    files.path_of(sha256).write_bytes(b"damaged content")
    with pytest.raises(BrokenFile), files.checked_meanwhile(sha256):
        pass
    with pytest.raises(BrokenFile), files.checked_meanwhile(sha256):
        raise ZeroDivisionError("the damage broke the reader")


def test_a_process_does_not_read_a_file_again_that_it_stored(data_dir: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def never(_: Path) -> str:
        raise AssertionError("read again")

    sha256 = _stored(b"content")
    monkeypatch.setattr(files, "sha256_of", never)
    assert files.is_whole(sha256)


def test_a_process_does_not_read_a_long_file_that_another_process_has_just_flushed(
    data_dir: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def stored(content: bytes, *, durable: bool = True) -> str:
        with files.incoming() as path, writing() as session:
            path.write_bytes(content)
            return files.keep(session, path, durable=durable)

    def sha256_of(path: Path) -> str:
        read.append(path.name)
        return hashlib.sha256(path.read_bytes()).hexdigest()

    read: list[str] = []
    long, short = stored(bytes(files._LONG_BYTES)), stored(b"content")
    not_flushed = stored(b"1" * files._LONG_BYTES, durable=False)
    # What another process knows: the database alone.
    files._checked.clear()
    monkeypatch.setattr(files, "sha256_of", sha256_of)
    assert all(map(files.is_whole, (long, short, not_flushed)))
    assert read == [short, not_flushed]
    files._checked.clear()
    with monkeypatch.context() as later:
        in_an_hour = files.path_of(long).stat().st_ctime_ns + files._RECENT_NS + 1
        later.setattr(files.time, "time_ns", lambda: in_an_hour)
        assert files.is_whole(long)
    assert read == [short, not_flushed, long]
    files._checked.clear()
    with files.path_of(long).open("r+b") as stream:
        stream.write(b"damage")
    assert not files.is_whole(long)


def test_storing_the_same_content_mends_a_damaged_file(data_dir: Path) -> None:
    sha256 = _stored(b"content")
    files.path_of(sha256).write_bytes(b"")
    assert _stored(b"content") == sha256
    assert files.is_whole(sha256)


def test_the_same_upload_mends_a_damaged_run(service: TestClient, study_path: str, upload: Callable[..., Any]) -> None:
    assert upload((1, 0.0)).status_code == 201
    with reading() as session:
        sha256 = session.scalars(select(Instance.sha256)).one()
    path = files.path_of(sha256)
    path.write_bytes(os.urandom(path.stat().st_size))
    frame = f"{study_path}/instances/{run_uid(1)}/frames/1.png"
    answer = service.get(frame)
    assert (answer.status_code, answer.json()["code"]) == (409, "run_broken")
    assert upload((1, 0.0)).status_code == 200
    assert files.is_whole(sha256)
    assert service.get(frame).status_code == 200


def test_a_damaged_result_is_named(service: TestClient) -> None:
    study = make_study()
    study.mapped()
    with reading() as session:
        sha256 = session.scalars(select(StageRow.result).where(StageRow.name == "fuse")).one()
    assert sha256 is not None
    files.path_of(sha256).write_bytes(files.path_of(sha256).read_bytes()[:100])
    answer = service.get(f"/v1/jobs/{study.job_id}/map")
    assert (answer.status_code, answer.json()["code"]) == (409, "result_broken")


def _states(study: FinishedStudy) -> dict[str, set[str]]:
    with reading() as session:
        rows = session.execute(select(StageRow.name, StageRow.state)).all()
    return {name: {state for each, state in rows if each == name} for name, _ in rows}


def test_a_damaged_result_of_the_job_is_computed_again(data_dir: Path) -> None:
    study = make_study()
    study.triangulated()
    sha256 = _stored(encode(matching()))
    files.path_of(sha256).write_bytes(b"")
    with study.claimed("monoplane", "S01") as (session, held), pytest.raises(BrokenFile):
        load_file(Matching, sha256)
    with writing() as session:
        job_life.mend_input(session, held, sha256)
    assert _states(study) == {
        "segment": {"done"}, "match": {"ready"}, "triangulate": {"pending"}, "fuse": {"pending"}, "monoplane": {"pending"},
    }  # fmt: skip
    with reading() as session:
        assert session.scalars(select(Point)).all() == []
    study.end("match", None, matching())
    assert _states(study)["triangulate"] == {"ready"}
    assert files.is_whole(sha256)


def test_a_damaged_run_fails_the_stage_with_its_reason(data_dir: Path) -> None:
    study = make_study()
    uid = study.uids["S01", "a"]
    with study.claimed("segment", uid) as (session, held):
        job_life.mend_input(session, held, "0" * 64)
    with reading() as session:
        row = session.get_one(StageRow, study.stage("segment", uid))
        assert (row.state, (row.error or {})["code"]) == (StageState.FAILED, "input_broken")


def test_a_result_that_stays_damaged_fails_after_the_last_attempt(data_dir: Path) -> None:
    study = make_study()
    study.matched()
    sha256 = _stored(encode(matching()))
    for attempt in range(1, settings().max_attempts + 1):
        with study.claimed("triangulate") as (session, held):
            job_life.mend_input(session, held, sha256)
        state = "failed" if attempt == settings().max_attempts else "pending"
        assert _states(study)["triangulate"] == {state}
        if state == "pending":
            study.end("match", None, matching())
