"""Large downloads: some at once for each token, and the others wait."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest
from fastapi import FastAPI
from fastapi.routing import APIRoute

from fluoromap_service.api.app import create_app
from fluoromap_service.api.http.middleware import download_limit
from fluoromap_service.api.http.middleware.download_limit import DownloadLimit
from fluoromap_service.auth import Caller, Scope
from fluoromap_service.problem import Problem
from fluoromap_service.settings import settings

LARGE = {
    "/dicom-web/studies/{study_uid}",
    "/dicom-web/studies/{study_uid}/series/{series_uid}",
    "/dicom-web/studies/{study_uid}/series/{series_uid}/instances/{uid}",
    "/v1/jobs/{job_id}/archive.zip",
    "/v1/jobs/{job_id}/deidentified.zip",
    "/v1/jobs/{job_id}/dicom",
    "/v1/jobs/{job_id}/tracks",
    "/v1/jobs/{job_id}/tracks.csv",
}


PICTURES = {
    "/dicom-web/studies/{study_uid}/series/{series_uid}/instances/{uid}/rendered",
    "/dicom-web/studies/{study_uid}/series/{series_uid}/instances/{uid}/frames/{number}/rendered",
    "/v1/studies/{study_id}/instances/{uid}/frames/{n}.png",
    "/v1/studies/{study_id}/instances/{uid}/frames/{n}/preview",
}


class _Downloads:
    """An application whose answers end when the test says so."""

    def __init__(self, what: str = "take_download") -> None:
        self._what = what
        self.end = asyncio.Event()
        self.running: list[str] = []
        self.limit = DownloadLimit(self._answer)

    async def _answer(self, scope: Any, receive: Any, send: Any) -> None:
        await scope["state"][self._what]()
        self.running.append(scope["state"]["caller"].name)
        await self.end.wait()

    def start(self, name: str) -> asyncio.Task[None]:
        scope = {"type": "http", "state": {"caller": Caller(name, frozenset({Scope.READ}))}}
        return asyncio.create_task(self.limit(scope, None, None))  # type: ignore[arg-type]


async def _begun(tasks: list[asyncio.Task[None]]) -> None:
    # Every task runs as far as it can without the end of another one.
    for _ in range(10):
        await asyncio.sleep(0)


def test_a_token_has_some_downloads_and_others_have_theirs(data_dir: object) -> None:
    async def run() -> None:
        downloads, most = _Downloads(), settings().downloads
        tasks = [downloads.start("greedy") for _ in range(most + 3)] + [downloads.start("other")]
        await _begun(tasks)
        assert sorted(downloads.running) == ["greedy"] * most + ["other"]
        downloads.end.set()
        await asyncio.gather(*tasks)
        assert downloads.running.count("greedy") == most + 3

    asyncio.run(run())


def test_a_download_that_waits_too_long_is_refused(data_dir: object, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(download_limit, "WAIT_SECONDS", 0.01)

    async def run() -> None:
        downloads, most = _Downloads(), settings().downloads
        tasks = [downloads.start("greedy") for _ in range(most)]
        await _begun(tasks)
        with pytest.raises(Problem) as refused:
            await downloads.start("greedy")
        assert (refused.value.status, refused.value.code) == (429, "too_many_downloads")
        assert refused.value.headers["Retry-After"]
        downloads.end.set()
        await asyncio.gather(*tasks)
        await downloads.start("greedy")

    asyncio.run(run())


def test_pictures_of_one_caller_wait_for_each_other(data_dir: object, monkeypatch: pytest.MonkeyPatch) -> None:
    async def run() -> None:
        pictures, most = _Downloads("take_picture"), download_limit.PICTURES
        tasks = [pictures.start("greedy") for _ in range(most + 60)] + [pictures.start("other")]
        await _begun(tasks)
        assert sorted(pictures.running) == ["greedy"] * most + ["other"]
        monkeypatch.setattr(download_limit, "WAIT_SECONDS", 0.01)
        with pytest.raises(Problem) as refused:
            await pictures.start("greedy")
        assert (refused.value.status, refused.value.code) == (429, "busy")
        pictures.end.set()
        await asyncio.gather(*tasks)

    asyncio.run(run())


def _limited_by(app: FastAPI, limit: Any) -> set[str]:
    return {
        route.path
        for route in app.routes
        if isinstance(route, APIRoute) and any(below.call is limit.dependency for below in route.dependant.dependencies)
    }


def test_the_routes_of_large_files_are_limited() -> None:
    app: FastAPI = create_app()
    limited = _limited_by(app, download_limit.LARGE_DOWNLOAD)
    assert limited == LARGE
    zipped = {
        route.path for route in app.routes if isinstance(route, APIRoute) and "application/zip" in str(route.responses)
    }
    assert zipped <= limited


def test_the_routes_of_pictures_are_limited() -> None:
    assert _limited_by(create_app(), download_limit.PICTURE) == PICTURES
