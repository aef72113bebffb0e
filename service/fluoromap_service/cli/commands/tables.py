"""The command ``fluoromap tables``."""

from __future__ import annotations

from typing import Annotated

import typer
from rich.console import Console

from fluoromap.paper.tables import one_view_tables
from fluoromap_service.cli import one_view_report
from fluoromap_service.cli.progress import one_bar

app = typer.Typer(add_completion=False)


@app.command()
def tables(
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
    as_csv: Annotated[bool, typer.Option("--csv", help="Print comma-separated values.")] = False,
) -> None:
    """Print the paper's tables beside our own, computed on simulated data.

    They show how well the depth of an electrode can be measured in a single view.
    """
    if as_json and as_csv:
        raise typer.BadParameter("--json and --csv exclude each other")
    with one_bar("simulate, follow") as context:
        result = one_view_tables(context)
    if as_json:
        typer.echo(one_view_report.as_json(result))
    elif as_csv:
        typer.echo(one_view_report.as_csv(result), nl=False)
    else:
        one_view_report.show(result, Console())
