"""The HTTP service as an ASGI application."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress

import structlog
from fastapi import Depends, FastAPI
from fastapi.responses import HTMLResponse, JSONResponse
from fastapi.routing import APIRoute
from starlette.concurrency import run_in_threadpool
from starlette.middleware.cors import CORSMiddleware

from fluoromap_service.api.http import file_pool, problems
from fluoromap_service.api.http.body_limit import BodyLimit
from fluoromap_service.api.http.query_names import check_query_names
from fluoromap_service.api.http.security import Doorkeeper, Reader
from fluoromap_service.api.jobs import events, jobs
from fluoromap_service.api.openapi import document
from fluoromap_service.api.results import archive, maps, overlays, points, report, tracks
from fluoromap_service.api.service import health, pages, plugins, reasons
from fluoromap_service.api.service.api_page import api_page
from fluoromap_service.api.study import (
    activation_times,
    catheter_types,
    cine,
    electrodes,
    electrograms,
    epipolar,
    frames,
    instances,
    run_electrodes,
    sites,
    studies,
)
from fluoromap_service.jobs import queue
from fluoromap_service.settings import settings

SWEEP_SECONDS = 1.0

ROUTERS = (
    studies.router,
    catheter_types.router,
    instances.router,
    frames.router,
    cine.router,
    epipolar.router,
    electrodes.router,
    run_electrodes.router,
    activation_times.router,
    electrograms.router,
    sites.router,
    jobs.router,
    events.router,
    points.router,
    tracks.router,
    maps.router,
    overlays.router,
    report.router,
    archive.router,
    plugins.router,
    reasons.router,
    health.router,
    pages.router,
)

log = structlog.get_logger(__name__)


def create_app() -> FastAPI:
    """Make the application."""
    # FastAPI's documentation pages fetch scripts from the internet; hospital networks are closed.
    app = FastAPI(
        title="fluoromap",
        summary="Activation maps of a heart chamber from ordinary C-arm fluoroscopy",
        version="1",
        docs_url=None,
        redoc_url=None,
        openapi_url=None,
        redirect_slashes=False,
        dependencies=[Depends(check_query_names)],
        generate_unique_id_function=_operation_id,
        lifespan=_lifespan,
    )
    problems.install(app)
    for router in ROUTERS:
        app.include_router(router)

    @app.get("/v1/openapi.json", include_in_schema=False)
    def openapi(caller: Reader) -> JSONResponse:
        return JSONResponse(document(app))

    @app.get("/docs", include_in_schema=False)
    def docs(caller: Reader) -> HTMLResponse:
        return HTMLResponse(api_page(document(app)))

    app.add_middleware(BodyLimit)
    app.add_middleware(Doorkeeper)
    if settings().cors_origins:
        # The outermost layer: a browser asks for permission without a token, and reads refusals too.
        app.add_middleware(
            CORSMiddleware,
            allow_origins=settings().allowed_origins,
            allow_methods=["GET", "POST", "PUT", "PATCH", "DELETE"],
            allow_headers=["Authorization", "Content-Type", "Idempotency-Key", "If-None-Match", "Last-Event-ID"],
            expose_headers=["Location", "Link", "ETag", "Retry-After", "Idempotency-Replayed", "Content-Disposition"],
        )
    return app


def _operation_id(route: APIRoute) -> str:
    """Return the name of a route's function.

    Generators of clients name their calls after it.
    """
    return route.name


@asynccontextmanager
async def _lifespan(app: FastAPI) -> AsyncIterator[None]:
    tasks = [] if settings().eager else [asyncio.create_task(_sweep()), asyncio.create_task(_warm_up())]
    try:
        yield
    finally:
        for task in tasks:
            task.cancel()
            with suppress(asyncio.CancelledError):
                await task
        file_pool.close()


async def _warm_up() -> None:
    await run_in_threadpool(file_pool.start)


async def _sweep() -> None:
    """Free the stages of dead workers and announce ready stages.

    It repeats this as long as the service runs.
    """
    failing = False
    while True:
        try:
            await run_in_threadpool(queue.sweep)
            await run_in_threadpool(health.watch_queue)
            failing = False
        except Exception as error:
            # The database may come back: log the first failure only.
            if not failing:
                log.warning("sweep_failed", error=type(error).__name__)
            failing = True
        await asyncio.sleep(SWEEP_SECONDS)
