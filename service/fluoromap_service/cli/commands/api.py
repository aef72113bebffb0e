"""The command ``fluoromap api``."""

from __future__ import annotations

import typer
import uvicorn

from fluoromap_service import auth, logs
from fluoromap_service.api.app import create_app
from fluoromap_service.api.http.connections import TimedConnection
from fluoromap_service.cli.database_failures import explain_database_failures
from fluoromap_service.cli.environment import apply_options, keep_compiled_kernels
from fluoromap_service.cli.options import DataDir, Host, Port
from fluoromap_service.settings import settings

STOP_SECONDS = 5
"""Time that open requests get at the end. An event stream never ends by itself."""

app = typer.Typer(add_completion=False)


@app.command()
def api(host: Host = None, port: Port = None, data_dir: DataDir = None) -> None:
    """Run the API alone."""
    apply_options(host, port, data_dir)
    keep_compiled_kernels()
    logs.configure()
    with explain_database_failures():
        auth.check_may_start(settings().host)
    uvicorn.run(
        create_app(),
        http=TimedConnection,
        log_config=None,
        host=settings().host,
        port=settings().port,
        log_level="warning",
        server_header=False,
        timeout_graceful_shutdown=STOP_SECONDS,
    )
