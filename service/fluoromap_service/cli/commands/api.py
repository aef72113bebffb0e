"""The command ``fluoromap api``."""

from __future__ import annotations

import gc
import sys
from contextlib import suppress
from types import FrameType

import structlog
import typer
import uvicorn

from fluoromap_service import auth, logs
from fluoromap_service.allocator import return_freed_memory
from fluoromap_service.api.app import create_app
from fluoromap_service.api.http import stopping
from fluoromap_service.api.http.connections import TimedConnection
from fluoromap_service.cli.database_failures import explain_database_failures
from fluoromap_service.cli.environment import (
    apply_options,
    end_with_supervisor,
    keep_compiled_kernels,
)
from fluoromap_service.cli.failures import CommandFailed
from fluoromap_service.cli.options import DataDir, Host, Port
from fluoromap_service.deliveries import outbox
from fluoromap_service.deliveries.targets import read_targets
from fluoromap_service.settings import settings
from fluoromap_service.store import schema
from fluoromap_service.store.engine import writing

STOP_SECONDS = 5
"""Time that open requests get at the end."""

SWITCH_SECONDS = 0.001
"""Longest time that a thread computes while the event loop waits for the interpreter; Python's own default is 5 ms."""

COLLECTOR_THRESHOLDS = (10_000, 20, 20)
"""Rarer runs of the garbage collector than Python's own: answers and jobs of a large study make thousands of small objects."""

app = typer.Typer(add_completion=False)
log = structlog.get_logger(__name__)


@app.command()
def api(host: Host = None, port: Port = None, data_dir: DataDir = None) -> None:
    """Run the API alone."""
    end_with_supervisor()
    apply_options(host, port, data_dir)
    keep_compiled_kernels()
    return_freed_memory()
    logs.configure()
    with explain_database_failures():
        schema.check()
        auth.check_may_start(settings().host)
        if not auth.any_token():
            log.warning("open_to_all_users_of_this_machine")
        # A request may name a target before the sender has started.
        with writing() as session:
            outbox.register(session, read_targets())
    sys.setswitchinterval(SWITCH_SECONDS)
    service = create_app()
    # The loaded code stays. Else the collector would walk through it, and a request would wait for it.
    gc.freeze()
    gc.set_threshold(*COLLECTOR_THRESHOLDS)
    config = uvicorn.Config(
        service,
        http=TimedConnection,
        log_config=None,
        host=settings().host,
        port=settings().port,
        # The application itself reads the headers of trusted proxies.
        proxy_headers=False,
        log_level="warning",
        server_header=False,
        timeout_graceful_shutdown=STOP_SECONDS,
    )
    server = _Server(config)
    # Ctrl-C is the usual end.
    with suppress(KeyboardInterrupt):
        server.run()
    if not server.started:
        raise CommandFailed(
            f"The API cannot listen on {settings().host} port {settings().port}; read its message above."
        )


class _Server(uvicorn.Server):
    """A server that ends the answers which wait for a job as soon as it is asked to stop."""

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        stopping.begin()
        super().handle_exit(sig, frame)
