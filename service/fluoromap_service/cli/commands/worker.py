"""The command ``fluoromap worker``."""

from __future__ import annotations

import socket
from typing import Annotated

import typer

from fluoromap_service import logs
from fluoromap_service.cli.database_failures import explain_database_failures
from fluoromap_service.cli.environment import apply_options, end_with_supervisor, keep_compiled_kernels
from fluoromap_service.cli.failures import CommandFailed
from fluoromap_service.cli.options import DataDir
from fluoromap_service.jobs import living_workers
from fluoromap_service.jobs.queue import celery_app
from fluoromap_service.store import schema
from fluoromap_service.store.engine import reading

app = typer.Typer(add_completion=False)


@app.command()
def worker(
    data_dir: DataDir = None,
    check: Annotated[
        bool, typer.Option("--check", help="Only check whether the worker of this host gives signs of life.")
    ] = False,
) -> None:
    """Run a worker, which computes the stages of jobs."""
    end_with_supervisor()
    apply_options(data_dir=data_dir)
    with explain_database_failures():
        schema.check()
        if check:
            _check_life()
            return
    keep_compiled_kernels()
    logs.configure()
    celery_app().worker_main(
        ["--quiet", "worker", "-n", _name(), "--without-gossip", "--without-mingle", "--loglevel", "WARNING"]
    )


def _name() -> str:
    return f"fluoromap@{socket.gethostname()}"


def _check_life() -> None:
    with reading() as session:
        if not living_workers.living_workers(session, _name()):
            raise CommandFailed(f"The worker {_name()} gave no sign of life in the last 30 s; start it again.")
