"""The command ``fluoromap check``."""

from __future__ import annotations

from typing import Annotated

import typer

from fluoromap_service.cli.database_failures import explain_database_failures
from fluoromap_service.cli.environment import apply_options
from fluoromap_service.cli.failures import CommandFailed
from fluoromap_service.cli.options import DataDir
from fluoromap_service.store import schema
from fluoromap_service.study.check import examine, mend

app = typer.Typer(add_completion=False)


@app.command()
def check(
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Report the faults and change nothing.")] = False,
    data_dir: DataDir = None,
) -> None:
    """Check every stored file, and mend the store."""
    apply_options(data_dir=data_dir)
    with explain_database_failures():
        schema.upgrade()
        found = examine()
        if not dry_run:
            mend(found)
    done = "found" if dry_run else "removed"
    typer.echo(f"files without a row: {len(found.orphans)} {done}")
    typer.echo(f"files that nothing uses: {len(found.unused)} {done}")
    typer.echo(
        f"damaged results: {len(found.broken_results)}" + ("" if dry_run else " forgotten; new jobs compute them")
    )
    for job in found.jobs:
        typer.echo(f"job {job}: a result is damaged; start a new job")
    for uid in found.broken_runs:
        typer.echo(f"run {uid}: its file is damaged; upload it again")
    if found.broken_runs:
        raise CommandFailed(f"{len(found.broken_runs)} runs are damaged; upload the same files again.")
    if dry_run and (found.orphans or found.unused or found.broken_results):
        raise CommandFailed("The store has faults; 'fluoromap check' without --dry-run mends them.")
