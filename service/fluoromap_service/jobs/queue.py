"""The Celery application and the one way to announce a stage."""

from __future__ import annotations

import functools
import math
import time
from typing import Any
from urllib.parse import urlsplit

import structlog
from celery import Celery
from celery.loaders.app import AppLoader

from fluoromap_service.jobs import job_life, turns
from fluoromap_service.settings import settings
from fluoromap_service.store.engine import writing

RUN_STAGE = "fluoromap.run_stage"
"""Name of the registered task that runs a stage by its id."""

POLL_SECONDS = 0.02
"""Time between two looks into the folder of messages. A correction waits for it; a look takes 0.1 ms."""

SILENCE_SECONDS = 5.0
"""Time for which nobody waits again for a broker that did not answer."""

DRAIN_SECONDS = 20
"""How long a worker that must end waits for its running stages before it gives them back."""

log = structlog.get_logger(__name__)


def _transport_options(url: str) -> dict[str, Any]:
    scheme = urlsplit(url).scheme
    if scheme == "filesystem":
        queue = settings().data_dir.resolve() / "queue"
        for folder in (queue / "messages", queue / "control"):
            folder.mkdir(parents=True, exist_ok=True)
        return {
            "data_folder_in": str(queue / "messages"),
            "data_folder_out": str(queue / "messages"),
            "control_folder": str(queue / "control"),
            "polling_interval": POLL_SECONDS,
        }
    # Without timeouts a silently dropped network would block a publisher for ever.
    return {"socket_timeout": 5, "socket_connect_timeout": 2}


class InstalledModules(AppLoader):  # type: ignore[misc]
    """A loader of tasks that imports installed modules only.

    Celery's own looks into the current folder first, and leaves that folder in the import path of everything that the module
    imports in turn.
    """

    def import_from_cwd(self, module: str, imp: Any = None, package: str | None = None) -> Any:
        """Import an installed module."""
        return self.import_module(module, package=package)


@functools.cache
def celery_app() -> Celery:
    """Return the process's Celery application, configured from the settings at the first call."""
    configured = settings()
    url = "memory://" if configured.eager else configured.broker_url or "filesystem://localhost/"
    # No fixups: that of Django adds the current folder to the import path.
    app = Celery("fluoromap", broker=url, loader=InstalledModules, fixups=[])
    app.conf.update(
        imports=("fluoromap_workers.tasks",),
        task_always_eager=configured.eager,
        task_eager_propagates=True,
        task_ignore_result=True,
        task_acks_late=False,
        task_serializer="json",
        accept_content=["json"],
        worker_prefetch_multiplier=1,
        # Each thread runs its stages in a process of its own.
        worker_pool="threads",
        worker_concurrency=configured.workers,
        worker_consumer="fluoromap_workers.message_consumer:MessageConsumer",
        worker_send_task_events=False,
        worker_hijack_root_logger=False,
        worker_redirect_stdouts=False,
        broker_connection_retry_on_startup=True,
        broker_transport_options=_transport_options(url),
    )
    return app


_silent_since = -math.inf
"""When the broker last failed, by the monotonic clock."""


def publish(stage_ids: list[int]) -> None:
    """Announce ready stages.

    A failure is only logged: the committed rows are announced again until a worker claims them. A silent broker takes seconds to
    fail. So for a time after a failure nothing is announced, and the requests that start jobs go on.
    """
    global _silent_since
    if time.monotonic() - _silent_since < SILENCE_SECONDS:
        return
    app = celery_app()
    if app.conf.task_always_eager:
        app.loader.import_default_modules()
    for stage_id in stage_ids:
        try:
            # A signature that was made before the task was registered would bypass eager mode.
            app.signature(RUN_STAGE, args=(stage_id,)).apply_async(retry=False)
        except Exception as error:
            # The rows are committed, so the request that made them must not fail.
            log.warning("broker_unreachable", error=type(error).__name__)
            _silent_since = time.monotonic()
            return


def publish_due() -> int:
    """Announce all stages that are due and return how many.

    Call it after each commit that made stages ready.
    """
    with writing() as session:
        ids = turns.take_due(session)
    publish(ids)
    return len(ids)


def sweep() -> None:
    """Free the stages of dead workers and announce stages that are due.

    Any process may call it at any time.
    """
    publish_due()
    with writing() as session:
        freed = job_life.reap(session)
    if freed:
        publish_due()
