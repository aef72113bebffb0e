"""Options that several commands share."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

Host = Annotated[str | None, typer.Option(help="Address to listen on (FLUOROMAP_HOST).")]
Port = Annotated[int | None, typer.Option(help="Port to listen on (FLUOROMAP_PORT).", min=0, max=65535)]
DataDir = Annotated[
    Path | None, typer.Option(help="Folder of the files and the embedded database (FLUOROMAP_DATA_DIR).")
]
