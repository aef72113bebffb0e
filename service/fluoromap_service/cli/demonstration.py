"""The demonstration: simulate a study, send it through the real service, compare what comes back with the truth."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from fluoromap.phantom import StudySpec
from fluoromap_service.cli.client import Client, Inputs, process, progress_bars, send
from fluoromap_service.cli.supervisor import private_service, stop_on_signals
from fluoromap_service.dicom.simulation import simulate

SPEC = StudySpec(seed=2026, sites=8, frames=30, frame_rate_hz=15.0)
"""The study that is simulated."""


@dataclass(frozen=True, slots=True)
class SiteAccuracy:
    """One site's mapping tip against the truth, both relative to the reference catheter; no error where not located."""

    site: str
    error_mm: float | None
    grade: str
    reasons: tuple[str, ...]
    lat_ms: float | None


def accuracy(points: list[dict[str, Any]], truth: dict[str, Any], catheter: str = "mapping") -> list[SiteAccuracy]:
    """Distance of each site's tip from where it truly is at diastole.

    Parameters
    ----------
    points : list of dict
        As the service answers ``/points`` with the origin at the reference catheter.
    truth : dict
        As :func:`fluoromap_service.dicom.simulation.truth_of` writes it.
    """
    tips = {point["site"]: point for point in points if point["catheter"] == catheter and point["electrode"] == 1}
    rows = []
    for site in truth["sites"]:
        tip = tips.get(site["site"])
        if tip is None:
            rows.append(SiteAccuracy(site["site"], None, "rejected", (), None))
            continue
        located = tip["x_mm"] is not None
        place = [tip["x_mm"], tip["y_mm"], tip["z_mm"]]
        error = math.dist(place, site["relative_mm"][catheter][0]) if located else None
        rows.append(SiteAccuracy(site["site"], error, tip["grade"], tuple(tip["reasons"]), tip["lat_ms"]))
    return rows


def rms_mm(rows: list[SiteAccuracy]) -> float | None:
    """Root mean square error over the located sites; None when there are none."""
    errors = [row.error_mm for row in rows if row.error_mm is not None]
    return math.sqrt(sum(error**2 for error in errors) / len(errors)) if errors else None


def run(data_dir: Path, out: Path, console: Console, *, keep: bool, spec: StudySpec = SPEC) -> None:
    """Run the demonstration and print its result.

    Parameters
    ----------
    data_dir : Path
        Folder of the service's database and files, and of the simulated study.
    out : Path
        Folder for the results.
    keep : bool
        Leave the service running at the end until a signal comes.

    Raises
    ------
    CommandFailed
        When the service or the job fails.
    """
    with progress_bars(console) as progress:
        bar = progress.add_task("simulate", total=2 * spec.sites)
        files = simulate(data_dir / "simulated", spec, on_run=lambda: progress.advance(bar))
        starting = progress.add_task("start service", total=None)
        with private_service(data_dir / "service") as url, Client(url) as client:
            progress.update(starting, total=1, completed=1)
            study, notes = send(client, Inputs(files.runs, files.activation_times), "Demonstration", progress)
            job = process(client, study, progress)
            points, chamber = client.points(job["id"]), client.fetch(job["id"], out)
            progress.stop()
            for note in notes:
                console.print(f"note: {note}", highlight=False)
            rows = accuracy(points, json.loads(files.truth.read_text()))
            _print_result(console, spec, rows, chamber, out)
            if keep:
                console.print(f"The service is up at {url} (study {study}); Ctrl-C ends it.", highlight=False)
                stop_on_signals().wait()


def _print_result(
    console: Console, spec: StudySpec, rows: list[SiteAccuracy], chamber: dict[str, Any] | None, out: Path
) -> None:
    table = Table(title="Mapping tip against the truth, relative to the reference catheter (simulated)")
    for title, side in (("site", "left"), ("LAT ms", "right"), ("grade", "left"), ("error mm", "right")):
        table.add_column(title, justify="right" if side == "right" else "left")
    table.add_column("reasons")
    for row in rows:
        error = "-" if row.error_mm is None else f"{row.error_mm:.2f}"
        time = "-" if row.lat_ms is None else f"{row.lat_ms:.1f}"
        table.add_row(row.site, time, row.grade, error, ", ".join(row.reasons))
    console.print(table)
    rms = rms_mm(rows)
    located = sum(row.error_mm is not None for row in rows)
    figure = "no site could be located" if rms is None else f"3D RMS error {rms:.2f} mm"
    console.print(
        f"Simulated accuracy: {figure} ({located} of {len(rows)} sites, {spec.frames} frames a run, seed {spec.seed}).",
        highlight=False,
        soft_wrap=True,
    )
    if chamber is not None:
        console.print(
            f"Map: {chamber['volume_ml']:.0f} ml, total activation {chamber['total_activation_time_ms']:.0f} ms,"
            f" {100 * chamber['coverage']:.0f} % of the surface near enough to a site to be coloured.",
            highlight=False,
            soft_wrap=True,
        )
    console.print(
        f"Results: {out.resolve()} (report.html, points.csv, map.png, mesh/, overlays/)",
        highlight=False,
        soft_wrap=True,
    )
