"""The command ``fluoromap up``."""

from __future__ import annotations

import os
from contextlib import suppress

import typer
from sqlalchemy.exc import SQLAlchemyError

from fluoromap_service import auth
from fluoromap_service.cli.database_failures import explain_database_failures
from fluoromap_service.cli.environment import apply_options
from fluoromap_service.cli.failures import CommandFailed
from fluoromap_service.cli.folder_lock import only_one
from fluoromap_service.cli.options import DataDir, Host, Port
from fluoromap_service.cli.own_token import make_token, sign_in_link, token_file, valid_token
from fluoromap_service.cli.supervisor import Supervisor, check_port, run_until_stopped, stop_on_signals
from fluoromap_service.deliveries.targets import read_targets
from fluoromap_service.settings import settings
from fluoromap_service.store import schema

app = typer.Typer(add_completion=False)


@app.command()
def up(host: Host = None, port: Port = None, data_dir: DataDir = None) -> None:
    """Run the API and a worker.

    The first start makes an access token for this user. A link signs a browser in. By default they use SQLite and files, no
    server. A part that dies or hangs is started again. The DICOM listener runs too when FLUOROMAP_DICOM_ALLOW names its senders,
    and the sender of results when the file of FLUOROMAP_CONFIG names its targets.
    """
    apply_options(host, port, data_dir)
    host, port = settings().host, settings().port
    with only_one(settings().data_dir):
        with explain_database_failures():
            schema.upgrade()
            auth.check_may_start(host)
            # Tokens that somebody made himself suffice; then this folder gets no further one.
            token = valid_token() if auth.any_token() else make_token()
        check_port(host, port)
        dicom = bool(settings().dicom_allow.strip())
        if dicom:
            check_port(settings().dicom_host, settings().dicom_port)
        supervisor = Supervisor(host, port, os.environ, dicom=dicom, sender=bool(read_targets()))
        typer.echo(f"fluoromap: starting with the data in {settings().data_dir}")
        run_until_stopped(supervisor, stop_on_signals(), lambda: _welcome(supervisor.url, token))


def _welcome(url: str, token: str | None) -> None:
    """Print where the service is, and how its user gets in."""
    typer.echo(f"fluoromap: ready at {url}; Ctrl-C ends it")
    if token is None:
        typer.echo("fluoromap: 'fluoromap sign-in' prints a link that signs a browser in without a token")
        return
    with suppress(CommandFailed, SQLAlchemyError):
        # The service runs in any case.
        typer.echo(f"fluoromap: open {sign_in_link(url, token)} (once, within 10 minutes)")
    typer.echo(
        f"fluoromap: your programs find their access token in {token_file(settings().data_dir)}; 'fluoromap sign-in' "
        "prints another link"
    )
