"""The command ``fluoromap export``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from fluoromap_service.api.http import file_pool
from fluoromap_service.api.results.deidentified import ExportOptions, write_export
from fluoromap_service.cli.database_failures import explain_database_failures
from fluoromap_service.cli.environment import apply_options
from fluoromap_service.cli.failures import CommandFailed
from fluoromap_service.cli.options import DataDir
from fluoromap_service.dicom.deidentification.pseudonyms import Dates
from fluoromap_service.store import audit, schema
from fluoromap_service.store.engine import writing

app = typer.Typer(add_completion=False)


@app.command()
def export(
    job: Annotated[str, typer.Argument(help="Id of a job that has ended.", metavar="JOB")],
    file: Annotated[Path, typer.Argument(help="Zip to write; it must not exist.", metavar="FILE")],
    dates: Annotated[
        Dates, typer.Option(help="Remove dates, shift them by a secret number of days, or keep them.")
    ] = Dates.REMOVE,
    subject: Annotated[str, typer.Option(help="New name and ID of the patient; by default a pseudonym.")] = "",
    data_dir: DataDir = None,
) -> None:
    """Write the runs and results of a job without the patient's identity.

    Text that is burned into the pixels stays: look at every run before you pass it on.
    """
    apply_options(data_dir=data_dir)
    if file.exists():
        raise CommandFailed(f"{file} exists already; choose another name.")
    with explain_database_failures():
        schema.upgrade()
        try:
            with file.open("xb") as stream:
                listed = write_export(job, stream, ExportOptions(dates, subject))
            with writing() as session:
                audit.append(session, [audit.Act("command line", "export", job=job, status=None)])
        except BaseException:
            file.unlink(missing_ok=True)
            raise
        finally:
            file_pool.close()
    typer.echo(f"{file}: the runs and results of job {job}, de-identified")
    typer.echo(f"{listed}: the original UIDs; keep it secret")
