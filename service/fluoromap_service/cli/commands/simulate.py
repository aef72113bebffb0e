"""The command ``fluoromap simulate``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from fluoromap.phantom import StudySpec
from fluoromap_service.cli.progress import progress_bars
from fluoromap_service.dicom import simulation

app = typer.Typer(add_completion=False)


@app.command()
def simulate(
    folder: Annotated[Path, typer.Argument(help="Folder for dicom/, activation_times.csv, truth.json.", metavar="DIR")],
    sites: Annotated[int, typer.Option(min=1, max=200, help="Number of mapping sites.")] = 8,
    frames: Annotated[int, typer.Option(min=1, max=1000, help="Frames of each run.")] = 30,
    rate: Annotated[float, typer.Option(min=1, max=120, help="Frames per second.")] = 15.0,
    seed: Annotated[int, typer.Option(min=0, help="Number of the heart; each number gives another heart.")] = 1,
    contrast: Annotated[
        str, typer.Option(help="Contrast of view a and of view b; each is LAT (good) or PA (poor).")
    ] = "LAT,LAT",
) -> None:
    """Simulate a study: DICOM runs, activation times and the truth."""
    try:
        spec = StudySpec(seed, sites, frames, rate, contrast=tuple(contrast.upper().split(",")))  # type: ignore[arg-type]
    except ValueError as error:
        raise typer.BadParameter(str(error)) from error
    with progress_bars(Console()) as progress:
        bar = progress.add_task("simulate", total=2 * sites)
        files = simulation.simulate(folder, spec, on_run=lambda: progress.advance(bar))
    typer.echo(f"{len(files.runs)} runs in {folder / 'dicom'}; {files.activation_times}; truth in {files.truth}")
