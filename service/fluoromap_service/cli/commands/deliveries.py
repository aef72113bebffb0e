"""The command ``fluoromap deliveries``."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.table import Table
from sqlalchemy import select

from fluoromap_service.cli.database_failures import explain_database_failures
from fluoromap_service.cli.environment import apply_options
from fluoromap_service.cli.options import DataDir
from fluoromap_service.deliveries import outbox
from fluoromap_service.problem import not_found
from fluoromap_service.store import schema
from fluoromap_service.store.engine import reading, writing
from fluoromap_service.store.models import Delivery, DeliveryState

app = typer.Typer(add_completion=False, no_args_is_help=True)

LINE_WIDTH = 1000
"""Characters of a line; a narrower terminal shows it as several."""

DeliveryId = Annotated[str, typer.Argument(help="Id of the delivery, as 'list' shows it.")]


@app.callback()
def deliveries() -> None:
    """Show and repeat the deliveries of results to targets."""


@app.command("list")
def list_deliveries(
    state: Annotated[DeliveryState | None, typer.Option(help="Only the deliveries in this state.")] = None,
    target: Annotated[str | None, typer.Option(help="Only the deliveries to this target.")] = None,
    limit: Annotated[int, typer.Option(help="Most deliveries to show.", min=1)] = 50,
    data_dir: DataDir = None,
) -> None:
    """List the deliveries, the newest first."""
    query = select(Delivery).order_by(Delivery.created.desc(), Delivery.id.desc()).limit(limit)
    if state is not None:
        query = query.where(Delivery.state == state)
    if target is not None:
        query = query.where(Delivery.target == target)
    with _current_database(data_dir), reading() as session:
        rows = session.scalars(query).all()
    table = Table("id", "target", "job", "state", "attempts", "next attempt", "ended", "error", box=None)
    for row in rows:
        due = row.due if row.state == DeliveryState.PENDING else None
        error = (row.error or {}).get("code", "")
        table.add_row(
            row.id, row.target, row.job_id, row.state, str(row.attempt), _second(due), _second(row.finished), error
        )
    # A column that is cut off would hide the ids that the other commands take.
    Console(width=LINE_WIDTH).print(table)


@app.command()
def show(delivery: DeliveryId, data_dir: DataDir = None) -> None:
    """Show the objects and the history of a delivery."""
    with _current_database(data_dir), reading() as session:
        row = session.get(Delivery, delivery)
        if row is None:
            raise not_found("delivery")
        objects, attempts = outbox.objects_of(session, delivery), outbox.attempts_of(session, delivery)
    typer.echo(f"{row.state}: job {row.job_id} to {row.target}")
    for item in objects:
        typer.echo(f"  {item.name}  {item.state}  {_second(item.delivered)}".rstrip())
    for attempt in attempts:
        outcome = "delivered" if attempt.code is None else f"{attempt.code}: {attempt.detail}"
        typer.echo(f"  attempt {attempt.number}  {_second(attempt.ended)}  {outcome}")


@app.command()
def retry(delivery: DeliveryId, data_dir: DataDir = None) -> None:
    """Try a delivery again at once, also one that was given up."""
    with _current_database(data_dir), writing() as session:
        outbox.retry(session, delivery)


@app.command()
def send(
    job: Annotated[str, typer.Argument(help="Id of a job that has ended.")],
    target: Annotated[str, typer.Argument(help="Name of the target.")],
    data_dir: DataDir = None,
) -> None:
    """Send the results of an ended job to a target."""
    with _current_database(data_dir), writing() as session:
        typer.echo(outbox.request(session, job, target).id)


@contextmanager
def _current_database(data_dir: Path | None) -> Iterator[None]:
    apply_options(data_dir=data_dir)
    with explain_database_failures():
        schema.check()
        yield


def _second(seconds: float | None) -> str:
    """Return a time as a UTC date and second.

    The time is in seconds since 1970. None gives an empty text.
    """
    return "" if seconds is None else datetime.fromtimestamp(seconds, UTC).strftime("%Y-%m-%d %H:%M:%S")
