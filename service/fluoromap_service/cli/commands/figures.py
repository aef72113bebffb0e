"""The command ``fluoromap figures``."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Annotated

import typer

from fluoromap.contracts import Refusal
from fluoromap.paper.figures import paper_figures
from fluoromap_service.cli.failures import CommandFailed
from fluoromap_service.cli.progress import one_bar

app = typer.Typer(add_completion=False)


@app.command()
def figures(
    folder: Annotated[Path, typer.Argument(help="Folder for the pictures; made when it is missing.", metavar="DIR")],
    seed: Annotated[int, typer.Option(min=0, help="Number of the simulated heart; each number gives another.")] = 9401,
) -> None:
    """Make the paper's Figures 3, 4 and 5 on a simulated study.

    Each figure has two rows: exact depth above, the depth from a single view below. figure3.png is the isochronal map in
    3D, figure4.png the map drawn on a lateral frame, figure5.png on a postero-anterior frame. figures.json holds the
    positions and the differences in mm and ms. Files with these names are replaced. The command takes less than a minute.
    """
    _check_writable(folder)
    try:
        with one_bar("simulate, follow") as context:
            result = paper_figures(seed, context)
    except Refusal as refusal:
        raise CommandFailed(f"There are no figures of the heart {seed}: {refusal} Choose another --seed.") from refusal
    for name, content in result.files().items():
        (folder / name).write_bytes(content)
        typer.echo(folder / name)


def _check_writable(folder: Path) -> None:
    """Make the folder and write to it.

    So a failure comes before the long computation.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryFile(dir=folder):
        pass
