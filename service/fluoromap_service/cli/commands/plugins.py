"""The command ``fluoromap plugins``."""

from __future__ import annotations

import typer
from rich.console import Console
from rich.table import Table

from fluoromap import registry

app = typer.Typer(add_completion=False)


@app.command()
def plugins() -> None:
    """List the installed plugins, and why a broken plugin does not load."""
    rows = registry.plugins()
    table = Table("kind", "name", "version", "from", "default")
    for row in rows:
        version = "does not load" if row.error is not None else row.version
        table.add_row(row.kind, row.name, version, row.distribution, "yes" if row.default else "")
    Console().print(table)
    for row in rows:
        if row.error is not None:
            typer.echo(f"\n{row.kind} {row.name}:\n{row.error}")
