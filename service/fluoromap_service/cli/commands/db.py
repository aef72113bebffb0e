"""The command ``fluoromap db``."""

from __future__ import annotations

import typer

from fluoromap_service.cli.database_failures import explain_database_failures
from fluoromap_service.cli.environment import apply_options
from fluoromap_service.cli.options import DataDir
from fluoromap_service.store import schema

app = typer.Typer(add_completion=False, no_args_is_help=True)


@app.callback()
def db() -> None:
    """Manage the database."""


@app.command()
def upgrade(data_dir: DataDir = None) -> None:
    """Create the tables, or migrate them to the newest version."""
    apply_options(data_dir=data_dir)
    with explain_database_failures():
        schema.upgrade()
