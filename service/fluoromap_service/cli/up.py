"""The command ``fluoromap up``."""

from __future__ import annotations

import os

import typer

from fluoromap_service import auth
from fluoromap_service.cli.database_failures import explain_database_failures
from fluoromap_service.cli.environment import apply_options
from fluoromap_service.cli.options import DataDir, Host, Port
from fluoromap_service.cli.supervisor import Supervisor, check_port, run_until_stopped, stop_on_signals
from fluoromap_service.settings import settings
from fluoromap_service.store import schema

app = typer.Typer(add_completion=False)


@app.command()
def up(host: Host = None, port: Port = None, data_dir: DataDir = None) -> None:
    """Run the API and a worker on SQLite and files; no server is needed.

    A worker that dies is started again.
    """
    apply_options(host, port, data_dir)
    configured = settings()
    with explain_database_failures():
        schema.upgrade()
        auth.check_may_start(configured.host)
        needs_token = auth.any_token()
    check_port(configured.host, configured.port)
    supervisor = Supervisor(configured.host, configured.port, os.environ)
    typer.echo(f"fluoromap: starting with the data in {configured.data_dir}")
    if not needs_token:
        typer.echo("fluoromap: open to every user of this machine, because no access token exists yet")
    run_until_stopped(
        supervisor, stop_on_signals(), lambda: typer.echo(f"fluoromap: ready at {supervisor.url}; Ctrl-C ends it")
    )
