"""The command ``fluoromap sender``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from fluoromap_service import logs
from fluoromap_service.api.http import file_pool
from fluoromap_service.cli.database_failures import explain_database_failures
from fluoromap_service.cli.environment import apply_options, apply_settings, end_with_supervisor
from fluoromap_service.cli.failures import CommandFailed
from fluoromap_service.cli.options import DataDir
from fluoromap_service.cli.supervisor import stop_on_signals
from fluoromap_service.deliveries import outbox
from fluoromap_service.deliveries.targets import read_targets
from fluoromap_service.store import schema
from fluoromap_service.store.engine import writing

app = typer.Typer(add_completion=False)


@app.command()
def sender(
    config: Annotated[Path | None, typer.Option(help="TOML file with the targets (FLUOROMAP_CONFIG).")] = None,
    data_dir: DataDir = None,
) -> None:
    """Send the results of jobs to the configured targets."""
    end_with_supervisor()
    apply_options(data_dir=data_dir)
    apply_settings(config=config)
    logs.configure()
    targets = read_targets()
    if not targets:
        raise CommandFailed(
            "There are no targets; add a table [targets.NAME] to the file of --config or FLUOROMAP_CONFIG."
        )
    with explain_database_failures():
        schema.check()
        with writing() as session:
            outbox.register(session, targets)
    # Importing pynetdicom takes a second: the help does not need it.
    from fluoromap_service.sender.service import Sender

    stop = stop_on_signals()
    running = Sender(targets)
    running.start()
    typer.echo(f"fluoromap: sending results to {', '.join(target.name for target in targets)}")
    stop.wait()
    running.stop()
    file_pool.close()
