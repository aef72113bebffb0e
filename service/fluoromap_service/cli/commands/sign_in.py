"""The command ``fluoromap sign-in``."""

from __future__ import annotations

import typer

from fluoromap_service.cli.database_failures import explain_database_failures
from fluoromap_service.cli.environment import apply_options
from fluoromap_service.cli.options import DataDir, Host, Port
from fluoromap_service.cli.own_token import make_token, sign_in_link
from fluoromap_service.cli.supervisor import url_of
from fluoromap_service.settings import settings
from fluoromap_service.store import schema

app = typer.Typer(add_completion=False)


@app.command()
def sign_in(host: Host = None, port: Port = None, data_dir: DataDir = None) -> None:
    """Print a link that signs a browser in.

    The link works once, within 10 minutes. The data folder gets an access token when it has none.
    """
    apply_options(host, port, data_dir)
    with explain_database_failures():
        schema.upgrade()
        typer.echo(sign_in_link(url_of(settings().host, settings().port), make_token()))
