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
from fluoromap_service.cli.failures import CommandFailed
from fluoromap_service.cli.progress import progress_bars
from fluoromap_service.cli.site_table import SiteTable
from fluoromap_service.cli.study_file import NAME
from fluoromap_service.cli.submission import find_files, run_job, upload
from fluoromap_service.cli.supervisor import private_service

PLAIN_WIDTH = 140
"""Least width of the table of sites, in characters, when the output is no terminal."""

app = typer.Typer(add_completion=False)


@app.command()
def run(
    folder: Annotated[
        Path,
        typer.Argument(
            help="Folder of DICOM files, activation_times.csv (site,lat_ms) and optionally study.toml.", metavar="DIR"
        ),
    ],
    out: Annotated[Path | None, typer.Option(help="Folder for the results; DIR/results by default.")] = None,
    data_dir: Annotated[
        Path | None, typer.Option(help="Folder that keeps the service's data, so that the next run is faster.")
    ] = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Show which runs belong to which site, and compute nothing.")
    ] = False,
) -> None:
    """Run the pipeline over a folder, on a private service."""
    files = find_files(folder)
    out = out or folder / "results"
    console = Console()
    with ExitStack() as stack:
        service_dir = data_dir or Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="fluoromap-run-")))
        with console.status("starting the service"):
            service = stack.enter_context(private_service(service_dir, computes=not dry_run))
        client = stack.enter_context(Client(service.url, service.token))
        with progress_bars(console) as progress:
            sent = upload(client, files, folder.resolve().name, progress)
            sites = SiteTable.of(client, sent)
            refusal = sites.refusal()
            if refusal is None and not dry_run:
                for note in (*sent.notes, *sites.not_ready()):
                    _print_line(console, f"note: {note}")
                job = run_job(client, sent.study, progress, files.settings.job)
                client.fetch(job["id"], out)
        if refusal is not None or dry_run:
            _print_sites(console, sites, sent.notes)
            _print_lines_to_confirm(console, sites, folder / NAME)
            if refusal is not None:
                raise CommandFailed(refusal)
            _print_line(console, f"{len(sites.ready)} of {len(sites.sites)} sites are ready.")
            return
    for warning in job["warnings"]:
        _print_line(console, f"warning: {Reason(warning).sentence} ({warning})")
    _print_lines_to_confirm(console, sites, folder / NAME)
    _print_line(console, f"Results: {out.resolve()}")


def _print_sites(console: Console, sites: SiteTable, notes: tuple[str, ...]) -> None:
    wide = console if console.is_terminal else Console(width=max(console.width, PLAIN_WIDTH))
    wide.print(sites.table())
    for line in (*(f"note: {note}" for note in notes), *sites.explanations()):
        _print_line(console, line)


def _print_lines_to_confirm(console: Console, sites: SiteTable, path: Path) -> None:
    lines = sites.lines_to_confirm()
    if lines:
        _print_line(
            console,
            f"Check these runs with the log of the procedure, correct wrong names, and add the lines to {path}:\n\n{lines}\n",
        )


def _print_line(console: Console, text: str) -> None:
    console.print(text, highlight=False, markup=False, soft_wrap=True)
