"""The command ``fluoromap``. Exit codes: 0 done, 1 failed with a sentence that says what to do, 2 wrong usage.

What is heavy is imported inside the commands: settings and thread limits have to stand in the environment before NumPy and
the queue are imported.
"""

from __future__ import annotations

import os
import re
import sys
import tempfile
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

import typer
from pydantic import ValidationError
from rich.console import Console
from rich.table import Table

from fluoromap_service.settings import settings

app = typer.Typer(
    help="Activation maps of a heart chamber from ordinary C-arm fluoroscopy.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    add_completion=False,
)
database = typer.Typer(help="The database.", no_args_is_help=True)
token = typer.Typer(help="Access tokens.", no_args_is_help=True)
app.add_typer(database, name="db")
app.add_typer(token, name="token")

Host = Annotated[str | None, typer.Option(help="Address to listen on (FLUOROMAP_HOST).")]
Port = Annotated[int | None, typer.Option(help="Port to listen on (FLUOROMAP_PORT).", min=0, max=65535)]
DataDir = Annotated[Path | None, typer.Option(help="Folder of files and embedded database (FLUOROMAP_DATA_DIR).")]

_UNITS_S = {"s": 1, "m": 60, "h": 3600, "d": 86400, "w": 7 * 86400}


def _configure(host: str | None = None, port: int | None = None, data_dir: Path | None = None) -> None:
    """Options into the environment, where this process's settings and those of its children come from."""
    for name, value in (("HOST", host), ("PORT", port), ("DATA_DIR", data_dir)):
        if value is not None:
            os.environ[f"FLUOROMAP_{name}"] = str(value)
    settings.cache_clear()


def _one_thread_each() -> None:
    # The pool has a process a processor; threads inside each would only fight over them.
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"):
        os.environ.setdefault(name, "1")


def _keep_compiled_kernels() -> None:
    # The folder the package is installed in need not be writable, the data folder is.
    os.environ.setdefault("NUMBA_CACHE_DIR", str(settings().data_dir.resolve() / "numba"))


@app.command()
def demo(
    out: Annotated[Path, typer.Option(help="Folder for the results.")] = Path("demo-results"),
    keep: Annotated[bool, typer.Option("--keep", help="Leave the service up at the end.")] = False,
    data_dir: Annotated[Path | None, typer.Option(help="Keep the service's data there.")] = None,
) -> None:
    """Simulate a study, run it through the real service, compare with the truth."""
    _one_thread_each()
    from fluoromap_service.cli import demonstration

    with tempfile.TemporaryDirectory(prefix="fluoromap-demo-") as temporary:
        demonstration.run(data_dir or Path(temporary), out, Console(), keep=keep)


@app.command()
def up(host: Host = None, port: Port = None, data_dir: DataDir = None) -> None:
    """Run API and worker on the embedded default: SQLite and files, no server needed."""
    _configure(host, port, data_dir)
    from fluoromap_service import auth
    from fluoromap_service.cli.supervisor import Supervisor, check_port, run_until_stopped, stop_on_signals
    from fluoromap_service.store import schema

    configured = settings()
    schema.upgrade()
    auth.check_may_start(configured.host)
    check_port(configured.host, configured.port)
    supervisor = Supervisor(configured.host, configured.port, os.environ)
    typer.echo(f"fluoromap: starting with the data in {configured.data_dir}")
    if not auth.any_token():
        typer.echo("fluoromap: open to every user of this machine, because no access token was made yet")
    run_until_stopped(
        supervisor, stop_on_signals(), lambda: typer.echo(f"fluoromap: ready at {supervisor.url}; Ctrl-C ends it")
    )


@app.command()
def api(host: Host = None, port: Port = None, data_dir: DataDir = None) -> None:
    """Run the API alone."""
    _configure(host, port, data_dir)
    _one_thread_each()
    _keep_compiled_kernels()
    import uvicorn

    from fluoromap_service import auth, logs
    from fluoromap_service.api.app import create_app

    logs.configure()
    auth.check_may_start(settings().host)
    uvicorn.run(
        create_app(),
        host=settings().host,
        port=settings().port,
        log_level="warning",
        server_header=False,
        # An event stream has no end of its own to wait for.
        timeout_graceful_shutdown=5,
    )


@app.command()
def worker(data_dir: DataDir = None) -> None:
    """Run a worker: it computes the stages of jobs."""
    _configure(data_dir=data_dir)
    _one_thread_each()
    _keep_compiled_kernels()
    from fluoromap_service import logs
    from fluoromap_service.jobs.queue import app as celery

    logs.configure()
    celery.worker_main(
        [
            "--quiet", "worker", "--pool", "prefork", "-c", str(settings().workers), "-n", "fluoromap@%h",
            "--without-gossip", "--without-mingle", "--loglevel", "WARNING",
        ]
    )  # fmt: skip


@app.command()
def run(
    folder: Annotated[Path, typer.Argument(help="DICOM files and activation_times.csv (site,lat_ms).", metavar="DIR")],
    out: Annotated[Path | None, typer.Option(help="Folder for the results; by default DIR/results.")] = None,
    data_dir: Annotated[
        Path | None, typer.Option(help="Keep the service's data there, for a quicker next run.")
    ] = None,
) -> None:
    """Run the pipeline over a folder, on a private service of its own."""
    from fluoromap_service.cli.client import run_folder
    from fluoromap_service.cli.supervisor import private_service

    with tempfile.TemporaryDirectory(prefix="fluoromap-run-") as temporary:
        run_folder(folder, out or folder / "results", lambda: private_service(data_dir or Path(temporary)), Console())


@app.command()
def simulate(
    folder: Annotated[Path, typer.Argument(help="Folder for dicom/, activation_times.csv, truth.json.", metavar="DIR")],
    sites: Annotated[int, typer.Option(min=1, max=200, help="Mapping sites.")] = 8,
    frames: Annotated[int, typer.Option(min=1, max=1000, help="Frames a run.")] = 30,
    rate: Annotated[float, typer.Option(min=1, max=120, help="Frames a second.")] = 15.0,
    seed: Annotated[int, typer.Option(min=0, help="Another heart for each number.")] = 1,
    contrast: Annotated[str, typer.Option(help="Appearance of view a and b, of LAT (good) and PA (poor).")] = "LAT,LAT",
) -> None:
    """Simulate a study: DICOM runs, activation times and the truth."""
    _one_thread_each()
    from fluoromap.phantom import StudySpec
    from fluoromap_service.cli.client import progress_bars
    from fluoromap_service.dicom.simulation import simulate as write_study

    try:
        spec = StudySpec(seed, sites, frames, rate, contrast=tuple(contrast.upper().split(",")))  # type: ignore[arg-type]
    except ValueError as error:
        raise typer.BadParameter(str(error)) from error
    with progress_bars(Console()) as progress:
        bar = progress.add_task("simulate", total=2 * sites)
        files = write_study(folder, spec, on_run=lambda: progress.advance(bar))
    typer.echo(f"{len(files.runs)} runs in {folder / 'dicom'}; {files.activation_times}; truth in {files.truth}")


@app.command()
def tables(
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
    as_csv: Annotated[bool, typer.Option("--csv", help="Print comma-separated values.")] = False,
) -> None:
    """Print the paper's tables beside ours: what one view tells of depth, on simulated data."""
    if as_json and as_csv:
        raise typer.BadParameter("--json and --csv exclude each other")
    _one_thread_each()
    from fluoromap.paper.tables import one_view_tables
    from fluoromap_service.cli import one_view_report
    from fluoromap_service.cli.client import progress_bars

    with progress_bars(Console(stderr=True)) as progress:
        bar = progress.add_task("simulate, follow", total=1.0)
        made = one_view_tables(one_view_report.Bar(lambda fraction: progress.update(bar, completed=fraction)))
    if as_json:
        typer.echo(one_view_report.as_json(made))
    elif as_csv:
        typer.echo(one_view_report.as_csv(made), nl=False)
    else:
        one_view_report.show(made, Console())


@app.command()
def figures(
    folder: Annotated[Path, typer.Argument(help="Folder for the pictures; it is made where missing.", metavar="DIR")],
    seed: Annotated[int, typer.Option(min=0, help="Another simulated heart for each number.")] = 9401,
) -> None:
    """Make the paper's Figures 3, 4 and 5 on a simulated study: exact depth above, single-view depth below.

    figure3.png is the isochronal map in 3D, figure4.png the map fused on a lateral frame, figure5.png on a postero-anterior
    frame; figures.json holds the positions and the differences in mm and ms. Files of those names are replaced. Takes less
    than a minute.
    """
    # Better now than after a minute's work.
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryFile(dir=folder):
        pass
    _one_thread_each()
    from fluoromap.contracts import Refusal
    from fluoromap.paper.figures import paper_figures
    from fluoromap_service.cli import one_view_report
    from fluoromap_service.cli.client import progress_bars
    from fluoromap_service.cli.supervisor import CommandFailed

    with progress_bars(Console(stderr=True)) as progress:
        bar = progress.add_task("simulate, follow", total=1.0)
        try:
            made = paper_figures(seed, one_view_report.Bar(lambda fraction: progress.update(bar, completed=fraction)))
        except Refusal as refusal:
            raise CommandFailed(f"There are no figures of the heart {seed}: {refusal} Take another seed.") from refusal
    for name, content in made.files().items():
        (folder / name).write_bytes(content)
        typer.echo(folder / name)


@app.command()
def plugins() -> None:
    """List the installed plugins, and why a broken one does not load."""
    from fluoromap.registry import plugins as installed

    table = Table("kind", "name", "version", "from", "default")
    broken = [row for row in installed() if row.error is not None]
    for row in installed():
        version = "does not load" if row.error is not None else row.version
        table.add_row(row.kind, row.name, version, row.distribution, "yes" if row.default else "")
    Console().print(table)
    for row in broken:
        typer.echo(f"\n{row.kind} {row.name}:\n{row.error}")


@database.command()
def upgrade(data_dir: DataDir = None) -> None:
    """Make or migrate the tables."""
    _configure(data_dir=data_dir)
    from fluoromap_service.store import schema

    schema.upgrade()


def _known_scopes(scopes: list[str]) -> list[str]:
    from fluoromap_service.auth import Scope

    for scope in scopes:
        if scope not in list(Scope):
            raise typer.BadParameter(f"{scope!r} is not one of {', '.join(Scope)}")
    return scopes


@token.command()
def create(
    name: Annotated[str, typer.Option(help="What to call it.")],
    scope: Annotated[
        list[str], typer.Option(help="read, write or admin; may be given more than once.", callback=_known_scopes)
    ],
    expires: Annotated[str | None, typer.Option(help="Lifetime, for example 12h or 90d; by default for ever.")] = None,
    from_file: Annotated[
        Path | None, typer.Option(help="Take the token from this file instead of drawing one; done when it is known.")
    ] = None,
    data_dir: DataDir = None,
) -> None:
    """Make an access token and print it once."""
    _configure(data_dir=data_dir)
    lifetime = None if expires is None else _seconds(expires)
    from fluoromap_service import auth
    from fluoromap_service.store import schema

    schema.upgrade()
    if from_file is None:
        typer.echo(auth.create_token(name, scope, lifetime))
        return
    text = from_file.read_text().strip()
    if auth.verify(text) is None:
        auth.create_token(name, scope, lifetime, text=text)


@token.command("list")
def list_tokens(data_dir: DataDir = None) -> None:
    """List the tokens that were made; their text is not kept."""
    _configure(data_dir=data_dir)
    from fluoromap_service import auth
    from fluoromap_service.store import schema

    schema.upgrade()
    table = Table("name", "scopes", "created", "expires", "revoked")
    for row in auth.list_tokens():
        table.add_row(row.name, " ".join(row.scopes), _day(row.created), _day(row.expires), _day(row.revoked))
    Console().print(table)


@token.command()
def revoke(name: Annotated[str, typer.Argument(help="The token's name.")], data_dir: DataDir = None) -> None:
    """End a token at once."""
    _configure(data_dir=data_dir)
    from fluoromap_service import auth
    from fluoromap_service.store import schema

    schema.upgrade()
    auth.revoke_token(name)


def _seconds(text: str) -> float:
    found = re.fullmatch(r"([1-9]\d{0,8})([smhdw])", text)
    if found is None:
        raise typer.BadParameter("a lifetime is a number and one of s, m, h, d, w, for example 90d")
    return float(found[1]) * _UNITS_S[found[2]]


def _day(seconds: float | None) -> str:
    return "" if seconds is None else datetime.fromtimestamp(seconds, UTC).strftime("%Y-%m-%d %H:%M")


def _sentence(error: Exception) -> str | None:
    """What to tell the user of an expected failure; None of a bug."""
    if isinstance(error, ValidationError):
        fields = ", ".join(f"FLUOROMAP_{part['loc'][0]}".upper() + f": {part['msg']}" for part in error.errors())
        return f"A setting is wrong: {fields}."
    from sqlalchemy.exc import DBAPIError

    from fluoromap_service.cli.supervisor import CommandFailed
    from fluoromap_service.problem import Problem

    if isinstance(error, CommandFailed | Problem):
        return str(error)
    if isinstance(error, DBAPIError):
        return f"The database cannot be used ({str(error.orig).splitlines()[0]}); see FLUOROMAP_DATABASE_URL."
    if isinstance(error, OSError) and error.filename is not None:
        return f"{error.filename}: {error.strerror}."
    return None


def main() -> None:
    """Entry point of the program."""
    try:
        app()
    except Exception as error:
        sentence = _sentence(error)
        if sentence is None:
            raise
        print(f"fluoromap: {sentence}", file=sys.stderr)
        sys.exit(1)


if __name__ == "__main__":
    main()
