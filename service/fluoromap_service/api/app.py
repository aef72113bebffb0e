"""The HTTP service as an ASGI application."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, suppress

import structlog
from anyio import CapacityLimiter, to_thread
from fastapi import APIRouter, FastAPI, Request
from fastapi.responses import HTMLResponse, JSONResponse
from starlette.concurrency import run_in_threadpool
from starlette.middleware.cors import CORSMiddleware

from fluoromap import registry
from fluoromap_service.api.dicomweb import rendered, retrieve, search, store
from fluoromap_service.api.dicomweb.indexing import index_some_runs
from fluoromap_service.api.http import file_pool, problems
from fluoromap_service.api.http.middleware.access_log import AccessLog, RequestCounts
from fluoromap_service.api.http.middleware.audit_trail import FLUSH_SECONDS, Acts, AuditTrail
from fluoromap_service.api.http.middleware.body_limit import BodyLimit
from fluoromap_service.api.http.middleware.disk_space import DiskSpace
from fluoromap_service.api.http.middleware.download_limit import DownloadLimit
from fluoromap_service.api.http.middleware.request_body import RequestBody
from fluoromap_service.api.http.middleware.security_headers import SecurityHeaders
from fluoromap_service.api.http.middleware.trusted_proxies import TrustedProxies
from fluoromap_service.api.http.routers import new_router
from fluoromap_service.api.http.security import Doorkeeper, Reader
from fluoromap_service.api.http.sign_in_limit import SignInLimit
from fluoromap_service.api.jobs import events, jobs
from fluoromap_service.api.jobs.job_watch import JobWatch
from fluoromap_service.api.openapi import document
from fluoromap_service.api.results import (
    archive,
    deidentified,
    deliveries,
    dicom_files,
    maps,
    overlays,
    placements,
    points,
    report,
    report_page,
    tracks,
)
from fluoromap_service.api.service import health, metrics, pages, plugins, reasons
from fluoromap_service.api.service.api_page import api_page
from fluoromap_service.api.study import (
    activation_times,
    catheter_types,
    cine,
    deletions,
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
from fluoromap_service.jobs.pipeline import PIPELINE
from fluoromap_service.jobs.rule_watch import RuleWatch
from fluoromap_service.jobs.start_rules import read_rules
from fluoromap_service.settings import settings
from fluoromap_service.store.audit_head import HeadWatch
from fluoromap_service.store.codec import prepare
from fluoromap_service.study.orphans import remove_orphans
from fluoromap_service.study.upkeep import clean_up

SWEEP_SECONDS = 1.0
HEAD_SECONDS = 60.0
CLEAN_UP_SECONDS = 60.0
INDEX_SECONDS = 2.0
ORPHAN_SECONDS = 600.0
"""With the age of an orphan this is less than an hour."""
RULE_SECONDS = 2.0

ROUTERS = (
    studies.router,
    deletions.router,
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
    deliveries.router,
    points.router,
    tracks.router,
    maps.router,
    overlays.router,
    placements.router,
    report.router,
    archive.router,
    dicom_files.router,
    deidentified.router,
    plugins.router,
    reasons.router,
    health.router,
    metrics.router,
    store.router,
    search.router,
    retrieve.router,
    rendered.router,
    pages.router,
)

log = structlog.get_logger(__name__)


def create_app() -> FastAPI:
    """Make the application.

    Raises
    ------
    Problem
        422 when the configuration file cannot be used.
    """
    # FastAPI's documentation pages fetch scripts from the internet; hospital networks are closed.
    app = FastAPI(
        title="fluoromap",
        summary="Activation maps of a heart chamber from ordinary C-arm fluoroscopy",
        version="1",
        docs_url=None,
        redoc_url=None,
        openapi_url=None,
        redirect_slashes=False,
        # Not by include_router: it matches all routes of each router in turn, and those of the right router twice.
        routes=[route for router in (*ROUTERS, _description()) for route in router.routes],
        lifespan=_lifespan,
    )
    acts, counts, sign_ins = Acts(), RequestCounts(), SignInLimit()
    app.state.acts, app.state.counts, app.state.sign_ins = acts, counts, sign_ins
    app.state.audit_heads = HeadWatch()
    app.state.readiness, app.state.job_watch = health.ReadinessWatch(), JobWatch()
    rules = read_rules()
    app.state.rules = RuleWatch(rules) if rules else None
    problems.install(app)
    # The last one added is the outermost.
    app.add_middleware(DownloadLimit)
    app.add_middleware(BodyLimit)
    app.add_middleware(DiskSpace)
    app.add_middleware(Doorkeeper, sign_ins=sign_ins)
    app.add_middleware(AuditTrail, acts=acts)
    if settings().cors_origins:
        # Before the doorkeeper: a browser asks for permission without a token, and reads refusals too.
        app.add_middleware(
            CORSMiddleware,
            allow_origins=settings().allowed_origins,
            allow_methods=["GET", "POST", "PUT", "PATCH", "DELETE"],
            allow_headers=[
                "Authorization",
                "Content-Type",
                "Idempotency-Key",
                "If-Match",
                "If-None-Match",
                "Last-Event-ID",
            ],
            expose_headers=["Location", "Link", "ETag", "Retry-After", "Idempotency-Replayed", "Content-Disposition"],
        )
    app.add_middleware(RequestBody)
    app.add_middleware(AccessLog, counts=counts)
    app.add_middleware(SecurityHeaders)
    app.add_middleware(TrustedProxies, proxies=tuple(settings().trusted_proxies.split()))
    return app


def _description() -> APIRouter:
    """Return the routes of the application's own description."""
    router = new_router(include_in_schema=False)

    @router.get("/v1/openapi.json")
    def openapi(request: Request, caller: Reader) -> JSONResponse:
        return JSONResponse(document(request.app))

    @router.get("/docs")
    def docs(request: Request, caller: Reader) -> HTMLResponse:
        return HTMLResponse(api_page(document(request.app)))

    return router


@asynccontextmanager
async def _lifespan(app: FastAPI) -> AsyncIterator[None]:
    acts: Acts = app.state.acts
    tasks = [
        asyncio.create_task(_repeat("audit_not_written", acts.flush, FLUSH_SECONDS)),
        asyncio.create_task(_repeat("audit_head_not_published", app.state.audit_heads.publish, HEAD_SECONDS)),
        asyncio.create_task(_repeat("orphans_not_removed", remove_orphans, ORPHAN_SECONDS)),
        asyncio.create_task(_repeat("clean_up_failed", clean_up, CLEAN_UP_SECONDS)),
        asyncio.create_task(_repeat("runs_not_indexed", index_some_runs, INDEX_SECONDS)),
    ]
    rules: RuleWatch | None = app.state.rules
    if rules is not None:
        tasks.append(asyncio.create_task(_repeat("rules_not_applied", rules.look, RULE_SECONDS)))
    if not settings().eager:
        tasks += [
            asyncio.create_task(_repeat("sweep_failed", queue.sweep, SWEEP_SECONDS)),
            asyncio.create_task(_repeat("queue_not_watched", health.watch_queue, SWEEP_SECONDS)),
            asyncio.create_task(_warm_up()),
        ]
    try:
        yield
    finally:
        for task in tasks:
            task.cancel()
            with suppress(asyncio.CancelledError):
                await task
        try:
            await run_in_threadpool(acts.flush, ending=True)
        finally:
            file_pool.close()


async def _warm_up() -> None:
    await run_in_threadpool(file_pool.start)
    for stage in PIPELINE:
        await run_in_threadpool(prepare, stage.result)
    await run_in_threadpool(report_page.prepare)
    # The first job would wait for the imports of all plugins.
    await run_in_threadpool(registry.plugins)


async def _repeat(failure: str, act: Callable[[], object], seconds: float) -> None:
    """Repeat an act as long as the service runs.

    ``failure`` is the log event of an act that failed.
    """
    failing = False
    # Threads of its own: work on the service itself must go on when all requests wait.
    limiter = CapacityLimiter(1)
    while True:
        try:
            await to_thread.run_sync(act, limiter=limiter)
            failing = False
        except Exception as error:
            # The database may come back: log the first failure only.
            if not failing:
                log.warning(failure, error=type(error).__name__)
            failing = True
        await asyncio.sleep(seconds)
