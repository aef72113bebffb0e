"""The command ``fluoromap audit``."""

from __future__ import annotations

import json
import sys
from contextlib import nullcontext
from pathlib import Path
from typing import Annotated

import typer

from fluoromap_service.cli.database_failures import explain_database_failures
from fluoromap_service.cli.environment import apply_options
from fluoromap_service.cli.failures import CommandFailed
from fluoromap_service.cli.options import DataDir
from fluoromap_service.problem import Problem
from fluoromap_service.store import audit as trail
from fluoromap_service.store import audit_head, schema
from fluoromap_service.store.engine import reading
from fluoromap_service.study.deletion import certificate_of

app = typer.Typer(add_completion=False, no_args_is_help=True)


@app.callback()
def audit() -> None:
    """Read the audit trail: who did what to which study."""


@app.command()
def export(
    file: Annotated[Path | None, typer.Argument(help="File to write; standard output by default.")] = None,
    data_dir: DataDir = None,
) -> None:
    """Write all entries as JSON lines, oldest first."""
    apply_options(data_dir=data_dir)
    with explain_database_failures():
        schema.upgrade()
        with reading() as session, nullcontext(sys.stdout) if file is None else file.open("x") as stream:
            for entry in trail.entries(session):
                stream.write(json.dumps(trail.as_json(entry)) + "\n")


@app.command()
def verify(
    against: Annotated[
        list[str] | None,
        typer.Option(
            "--against",
            "--head",
            help="A hash that an earlier check printed, or a file with hashes that the service published: the file of "
            "FLUOROMAP_AUDIT_HEAD_FILE or a log. They must still be in the trail.",
        ),
    ] = None,
    data_dir: DataDir = None,
) -> None:
    """Check that nobody changed, removed or inserted an entry."""
    apply_options(data_dir=data_dir)
    heads = [sha256 for given in against or () for sha256 in _heads(given)]
    with explain_database_failures():
        schema.upgrade()
        try:
            with reading() as session:
                count, last = trail.verify(session, heads)
        except trail.BrokenChain as broken:
            raise CommandFailed(f"{broken} Compare with an earlier export.") from broken
    compared = f"; {len(set(heads))} earlier hashes are in it" if heads else ""
    typer.echo(f"{count} entries, unbroken; the last hash is {last}{compared}")


@app.command()
def certificate(
    study: Annotated[str, typer.Argument(help="Id of the deleted study.")],
    data_dir: DataDir = None,
) -> None:
    """Write the certificate of a deleted study as JSON: what went, without patient data."""
    apply_options(data_dir=data_dir)
    with explain_database_failures():
        schema.upgrade()
        try:
            with reading() as session:
                typer.echo(json.dumps(certificate_of(session, study), indent=2))
        except Problem as problem:
            raise CommandFailed(problem.detail) from problem


def _heads(given: str) -> list[str]:
    if audit_head.is_hash(given):
        return [given]
    try:
        found = audit_head.published_hashes(Path(given))
    except OSError as error:
        raise CommandFailed(f"{given} is no hash of 64 digits and no readable file: {error.strerror}.") from error
    if not found:
        raise CommandFailed(f"{given} holds no hash of the audit trail; give the log of the API or its file of hashes.")
    return found
