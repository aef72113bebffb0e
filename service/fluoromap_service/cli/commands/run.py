"""The command ``fluoromap run``."""

from __future__ import annotations

import tempfile
from contextlib import ExitStack
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from fluoromap.reasons import Reason
from fluoromap_service.cli.client import Client
from fluoromap_service.cli.progress import progress_bars
from fluoromap_service.cli.submission import find_files, run_job, upload
from fluoromap_service.cli.supervisor import private_service

app = typer.Typer(add_completion=False)


@app.command()
def run(
    folder: Annotated[
        Path, typer.Argument(help="Folder of DICOM files and activation_times.csv (site,lat_ms).", metavar="DIR")
    ],
    out: Annotated[Path | None, typer.Option(help="Folder for the results; DIR/results by default.")] = None,
    data_dir: Annotated[
        Path | None, typer.Option(help="Folder that keeps the service's data, so that the next run is faster.")
    ] = None,
) -> None:
    """Run the pipeline over a folder, on a private service."""
    files = find_files(folder)
    out = out or folder / "results"
    console = Console()
    with ExitStack() as stack:
        service_dir = data_dir or Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="fluoromap-run-")))
        with console.status("starting the service"):
            url = stack.enter_context(private_service(service_dir))
        client = stack.enter_context(Client(url))
        with progress_bars(console) as progress:
            study, notes = upload(client, files, folder.resolve().name, progress)
            for note in notes:
                console.print(f"note: {note}", highlight=False)
            job = run_job(client, study, progress)
            for warning in job["warnings"]:
                console.print(f"warning: {Reason(warning).sentence} ({warning})", highlight=False)
        client.fetch(job["id"], out)
    console.print(f"Results: {out.resolve()}", highlight=False, soft_wrap=True)
