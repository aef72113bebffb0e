"""The command ``fluoromap token``."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.table import Table

from fluoromap_service import auth
from fluoromap_service.auth import sessions
from fluoromap_service.cli.database_failures import explain_database_failures
from fluoromap_service.cli.environment import apply_options
from fluoromap_service.cli.options import DataDir
from fluoromap_service.store import schema

SECONDS_OF_UNIT = {"s": 1, "m": 60, "h": 3600, "d": 86400, "w": 7 * 86400}

app = typer.Typer(add_completion=False, no_args_is_help=True)


@app.callback()
def token() -> None:
    """Manage access tokens."""


def _check_scopes(scopes: list[str]) -> list[str]:
    for scope in scopes:
        if scope not in list(auth.Scope):
            raise typer.BadParameter(f"{scope!r} is not a scope; use {', '.join(auth.Scope)}")
    return scopes


@app.command()
def create(
    name: Annotated[str, typer.Option(help="Name of the token.")],
    scope: Annotated[
        list[str],
        typer.Option(
            help="metrics, read, write or admin; repeat the option for several scopes.", callback=_check_scopes
        ),
    ],
    expires: Annotated[
        str | None, typer.Option(help="Lifetime, for example 12h or 90d; without it the token never expires.")
    ] = None,
    from_file: Annotated[
        Path | None,
        typer.Option(help="File that holds the token's text; without it a random text is made. A known token is kept."),
    ] = None,
    data_dir: DataDir = None,
) -> None:
    """Make an access token and print it once."""
    lifetime_seconds = None if expires is None else _seconds(expires)
    with _migrated_database(data_dir):
        auth.check_first_token(scope)
        if from_file is None:
            typer.echo(auth.create_token(name, scope, lifetime_seconds))
            return
        text = from_file.read_text().strip()
        if auth.verify(text) is None:
            auth.create_token(name, scope, lifetime_seconds, text=text)


@app.command("list")
def list_tokens(data_dir: DataDir = None) -> None:
    """List all tokens; the service does not store their text."""
    with _migrated_database(data_dir):
        rows = auth.list_tokens()
    table = Table("name", "scopes", "created", "expires", "revoked")
    for row in rows:
        table.add_row(row.name, " ".join(row.scopes), _minute(row.created), _minute(row.expires), _minute(row.revoked))
    Console().print(table)


@app.command()
def revoke(name: Annotated[str, typer.Argument(help="Name of the token.")], data_dir: DataDir = None) -> None:
    """Revoke a token at once."""
    with _migrated_database(data_dir):
        auth.revoke_token(name)


@app.command("sessions")
def list_sessions(data_dir: DataDir = None) -> None:
    """List the sessions of browsers. Revoking a token ends its sessions."""
    with _migrated_database(data_dir):
        rows = sessions.list_sessions()
    table = Table("token", "began", "expires")
    for row in rows:
        table.add_row(row.token, _minute(row.opened), _minute(row.expires))
    Console().print(table)


@contextmanager
def _migrated_database(data_dir: Path | None) -> Iterator[None]:
    apply_options(data_dir=data_dir)
    with explain_database_failures():
        schema.upgrade()
        yield


def _seconds(lifetime: str) -> float:
    match = re.fullmatch(r"([1-9]\d{0,8})([smhdw])", lifetime)
    if match is None:
        raise typer.BadParameter("a lifetime is a number and one of s, m, h, d, w, for example 90d")
    return float(match[1]) * SECONDS_OF_UNIT[match[2]]


def _minute(seconds: float | None) -> str:
    """Return a time as a UTC date and minute.

    The time is in seconds since 1970. None gives an empty text.
    """
    return "" if seconds is None else datetime.fromtimestamp(seconds, UTC).strftime("%Y-%m-%d %H:%M")
