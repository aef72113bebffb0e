"""The command ``fluoromap worker``."""

from __future__ import annotations

import typer

from fluoromap_service import logs
from fluoromap_service.cli.environment import apply_options, keep_compiled_kernels
from fluoromap_service.cli.options import DataDir
from fluoromap_service.jobs.queue import celery_app

app = typer.Typer(add_completion=False)


@app.command()
def worker(data_dir: DataDir = None) -> None:
    """Run a worker, which computes the stages of jobs."""
    apply_options(data_dir=data_dir)
    keep_compiled_kernels()
    logs.configure()
    celery_app().worker_main(
        [
            "--quiet", "worker", "-n", "fluoromap@%h", "--without-gossip", "--without-mingle", "--loglevel", "WARNING",
        ]
    )  # fmt: skip
