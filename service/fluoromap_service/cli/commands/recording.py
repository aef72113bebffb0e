"""The command ``fluoromap recording``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from fluoromap.signals import Channel, NotARecording, Recording, read_recording
from fluoromap_service.cli.failures import CommandFailed

app = typer.Typer(add_completion=False)


@app.command()
def recording(
    files: Annotated[
        list[Path], typer.Argument(exists=True, help="All files of one export of an EP recorder, or their folder.")
    ],
) -> None:
    """Show the channels of an EP recorder's export, and check all its samples."""
    paths = [path for given in files for path in (sorted(given.iterdir()) if given.is_dir() else [given])]
    try:
        found = read_recording({path.name: path for path in paths if path.is_file()})
        ranges = _ranges(found)
    except NotARecording as problem:
        raise CommandFailed(str(problem)) from None
    began = "" if found.started is None else f", began {found.started.isoformat(timespec='seconds')}"
    typer.echo(f"{found.format}, {len(found.channels)} channels, {found.duration_ms / 1000.0:.3f} s{began}")
    table = Table("channel", "kind", "catheter", "electrodes", "rate Hz", "filter Hz", "range")
    for channel, (low, high) in zip(found.channels, ranges, strict=True):
        extent = f"{low:.3f} to {high:.3f} {channel.unit or 'not calibrated'}"
        table.add_row(
            channel.name, channel.kind, channel.catheter or "", _electrodes(channel), f"{channel.rate_hz:g}",
            _band(channel), extent,
        )  # fmt: skip
    Console().print(table)
    for warning in found.warnings:
        typer.echo(f"warning: {warning}")


def _ranges(found: Recording) -> list[tuple[float, float]]:
    """Read all samples, and return the lowest and highest of each channel."""
    low, high = np.full(len(found.channels), np.inf), np.full(len(found.channels), -np.inf)
    with Progress(transient=True) as bar:
        task = bar.add_task("reading", total=max(found.samples))
        for piece in found.blocks():
            low = np.minimum(low, [samples.min(initial=np.inf) for samples in piece])
            high = np.maximum(high, [samples.max(initial=-np.inf) for samples in piece])
            bar.advance(task, max(map(len, piece)))
    return list(zip(low.tolist(), high.tolist(), strict=True))


def _electrodes(channel: Channel) -> str:
    return "-".join(map(str, channel.electrodes)) or {"d": "distal", "m": "middle", "p": "proximal"}.get(
        channel.position or "", ""
    )


def _band(channel: Channel) -> str:
    edges = ["" if edge is None else f"{edge:g}" for edge in (channel.low_hz, channel.high_hz)]
    return f"{edges[0]} to {edges[1]}" if any(edges) else ""
