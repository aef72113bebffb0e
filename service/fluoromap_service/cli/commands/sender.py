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
from fluoromap_service.settings import settings
from fluoromap_service.store import schema
from fluoromap_service.store.engine import writing

app = typer.Typer(add_completion=False)


@app.command()
def sender(
    targets: Annotated[Path | None, typer.Option(help="TOML file of the targets (FLUOROMAP_DELIVERY_TARGETS).")] = None,
    data_dir: DataDir = None,
) -> None:
    """Send the results of jobs to the configured targets."""
    end_with_supervisor()
    apply_options(data_dir=data_dir)
    apply_settings(delivery_targets=targets)
    logs.configure()
    if not settings().delivery_targets:
        raise CommandFailed("There is no file of targets; name it with --targets or FLUOROMAP_DELIVERY_TARGETS.")
    configured = read_targets(Path(settings().delivery_targets))
    with explain_database_failures():
        schema.check()
        with writing() as session:
            for target in configured:
                outbox.register(session, target.name)
    # Importing pynetdicom takes a second: the help does not need it.
    from fluoromap_service.sender.service import Sender

    stop = stop_on_signals()
    running = Sender(configured)
    running.start()
    typer.echo(f"fluoromap: sending results to {', '.join(target.name for target in configured)}")
    stop.wait()
    running.stop()
    file_pool.close()
