"""The command ``fluoromap backup``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from fluoromap_service.cli.database_failures import explain_database_failures
from fluoromap_service.cli.environment import apply_options
from fluoromap_service.cli.failures import CommandFailed
from fluoromap_service.cli.options import DataDir
from fluoromap_service.store import backup as archives
from fluoromap_service.store import schema

app = typer.Typer(add_completion=False)


@app.command()
def backup(
    file: Annotated[Path, typer.Argument(help="Archive to write; its folder must exist.", metavar="FILE")],
    data_dir: DataDir = None,
) -> None:
    """Write database and files into one archive, while the service runs."""
    apply_options(data_dir=data_dir)
    try:
        with explain_database_failures():
            schema.upgrade()
            made = archives.backup(file)
    except archives.BackupFailed as failure:
        raise CommandFailed(str(failure)) from failure
    typer.echo(f"{file}: the database and {made.files} files")
    if made.broken:
        raise CommandFailed(
            f"{len(made.broken)} files of the store are missing or damaged, so the backup lacks them; run 'fluoromap check'."
        )
