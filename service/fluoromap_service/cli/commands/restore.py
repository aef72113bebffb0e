"""The command ``fluoromap restore``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from fluoromap_service.cli.database_failures import explain_database_failures
from fluoromap_service.cli.environment import apply_options
from fluoromap_service.cli.failures import CommandFailed
from fluoromap_service.cli.options import DataDir
from fluoromap_service.store import backup as archives

app = typer.Typer(add_completion=False)


@app.command()
def restore(
    file: Annotated[Path, typer.Argument(help="Archive that 'fluoromap backup' wrote.", metavar="FILE", exists=True)],
    data_dir: DataDir = None,
) -> None:
    """Bring a backup into an empty data folder."""
    apply_options(data_dir=data_dir)
    try:
        with explain_database_failures():
            restored = archives.restore(file)
    except archives.BackupFailed as failure:
        raise CommandFailed(str(failure)) from failure
    typer.echo(f"{file}: the database and {restored.files} files")
    if restored.broken:
        raise CommandFailed(f"The backup lacks {len(restored.broken)} files; 'fluoromap check' names the runs.")
