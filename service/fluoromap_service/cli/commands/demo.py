"""The command ``fluoromap demo``."""

from __future__ import annotations

import json
import tempfile
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.table import Table

from fluoromap.phantom import StudySpec
from fluoromap_service.cli.accuracy import SiteAccuracy, accuracy, rms_mm
from fluoromap_service.cli.client import Client
from fluoromap_service.cli.progress import progress_bars
from fluoromap_service.cli.submission import StudyFiles, run_job, upload
from fluoromap_service.cli.supervisor import private_service, stop_on_signals
from fluoromap_service.dicom.simulation import simulate

SPEC = StudySpec(seed=2026, sites=8, frames=30, frame_rate_hz=15.0)
"""The simulated study."""

app = typer.Typer(add_completion=False)


@app.command()
def demo(
    out: Annotated[Path, typer.Option(help="Folder for the results.")] = Path("demo-results"),
    keep: Annotated[bool, typer.Option("--keep", help="Leave the service running at the end.")] = False,
    data_dir: Annotated[
        Path | None, typer.Option(help="Folder that keeps the service's data and the simulated study.")
    ] = None,
) -> None:
    """Simulate a study, run it through the real service and compare the results with the truth."""
    with tempfile.TemporaryDirectory(prefix="fluoromap-demo-") as temporary:
        _demonstrate(data_dir or Path(temporary), out, Console(), keep)


def _demonstrate(folder: Path, out: Path, console: Console, keep: bool) -> None:
    with progress_bars(console) as progress:
        bar = progress.add_task("simulate", total=2 * SPEC.sites)
        files = simulate(folder / "simulated", SPEC, on_run=lambda: progress.advance(bar))
        service_bar = progress.add_task("start service", total=None)
        with private_service(folder / "service") as service, Client(service.url, service.token) as client:
            progress.update(service_bar, total=1, completed=1)
            inputs = StudyFiles(folder / "simulated", files.runs, files.activation_times)
            sent = upload(client, inputs, "Demonstration", progress)
            job = run_job(client, sent.study, progress)
            points, chamber = client.points(job["id"]), client.fetch(job["id"], out)
            progress.stop()
            for note in sent.notes:
                console.print(f"note: {note}", highlight=False)
            _print_accuracy(console, accuracy(points, json.loads(files.truth.read_text())))
            if chamber is not None:
                _print_map(console, chamber)
            _print_line(console, f"Results: {out.resolve()} (report.html, points.csv, map.png, mesh/, overlays/)")
            if keep:
                _print_line(console, f"The service runs at {service.url} (study {sent.study}); Ctrl-C ends it.")
                _print_line(console, f"Open {service.sign_in_link()} (once, within 10 minutes).")
                stop_on_signals().wait()


def _print_accuracy(console: Console, rows: list[SiteAccuracy]) -> None:
    table = Table(title="Mapping tip against the truth, relative to the reference catheter (simulated)")
    for title, numeric in (("site", False), ("LAT ms", True), ("grade", False), ("error mm", True), ("reasons", False)):
        table.add_column(title, justify="right" if numeric else "left")
    for row in rows:
        error = "-" if row.error_mm is None else f"{row.error_mm:.2f}"
        time = "-" if row.lat_ms is None else f"{row.lat_ms:.1f}"
        table.add_row(row.site, time, row.grade, error, ", ".join(row.reasons))
    console.print(table)
    rms = rms_mm(rows)
    located = sum(row.error_mm is not None for row in rows)
    figure = "no site could be located" if rms is None else f"3D RMS error {rms:.2f} mm"
    extent = f"{located} of {len(rows)} sites, {SPEC.frames} frames a run, seed {SPEC.seed}"
    _print_line(console, f"Simulated accuracy: {figure} ({extent}).")


def _print_map(console: Console, chamber: dict[str, Any]) -> None:
    volume, total = chamber["volume_ml"], chamber["total_activation_time_ms"]
    coverage = f"{100 * chamber['coverage']:.0f} % of the surface is close enough to a site to have a colour"
    _print_line(console, f"Map: {volume:.0f} ml, total activation time {total:.0f} ms; {coverage}.")


def _print_line(console: Console, text: str) -> None:
    console.print(text, highlight=False, soft_wrap=True)
