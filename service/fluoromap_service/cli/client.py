"""A client of the service: send a folder of runs and activation times, follow the job, fetch what came of it."""

from __future__ import annotations

import json
import tempfile
import time
import zipfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import httpx
from rich.console import Console
from rich.progress import BarColumn, Progress, SpinnerColumn, TaskProgressColumn, TextColumn, TimeElapsedColumn

from fluoromap_service.cli.supervisor import CommandFailed

POLL_SECONDS = 0.3
STAGES = {
    "segment": "find electrodes",
    "match": "name catheters",
    "triangulate": "locate in 3D",
    "fuse": "make the map",
    "monoplane": "follow one view",
}
"""Kind of stage -> what a progress bar calls it, in the order of the pipeline."""


@dataclass(frozen=True, slots=True)
class Inputs:
    """What is sent: DICOM files, and the table of activation times."""

    runs: tuple[Path, ...]
    activation_times: Path


def inputs_of(folder: Path) -> Inputs:
    """The DICOM files below a folder and the one activation-time table in it.

    Raises
    ------
    CommandFailed
        When either is missing or it is not clear which table is meant.
    """
    if not folder.is_dir():
        raise CommandFailed(f"{folder} is not a folder.")
    runs = tuple(sorted(path for path in folder.rglob("*") if path.is_file() and _is_dicom(path)))
    if not runs:
        raise CommandFailed(f"There is no DICOM file in {folder}.")
    named = folder / "activation_times.csv"
    tables = [named] if named.is_file() else sorted(folder.glob("*.csv"))
    if not tables:
        raise CommandFailed(f"There is no activation-time table in {folder}; add activation_times.csv (site,lat_ms).")
    if len(tables) > 1:
        raise CommandFailed(f"There are several CSV files in {folder}; name one of them activation_times.csv.")
    return Inputs(runs, tables[0])


def _is_dicom(path: Path) -> bool:
    # PS3.10 section 7.1: 128 bytes of preamble, then the prefix.
    with path.open("rb") as stream:
        return stream.read(132)[128:] == b"DICM"


class Client:
    """Talks to a running service as any client would.

    Parameters
    ----------
    url : str
        Address of the service.
    token : str, optional
        Access token; an open loopback service needs none.
    """

    def __init__(self, url: str, token: str | None = None) -> None:
        headers = {"Authorization": f"Bearer {token}"} if token else {}
        # A proxy of the environment has no business between this machine and itself.
        self._http = httpx.Client(base_url=url, headers=headers, timeout=120, trust_env=False)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._http.close()

    def make_study(self, label: str) -> str:
        """Make a mapping study; its id."""
        study: str = self._json("POST", "/v1/studies", json={"label": label})["id"]
        return study

    def upload(self, study: str, path: Path) -> list[str]:
        """Send one DICOM file; what the service says against it, nothing when it is accepted."""
        with path.open("rb") as stream:
            part = {"file": (path.name, stream, "application/dicom")}
            answer = self._http.post(f"/v1/studies/{study}/instances", files=part)
        if answer.is_server_error:
            raise CommandFailed(_sentence(answer))
        if answer.is_error:
            return [_sentence(answer)]
        return [problem["detail"] for problem in answer.json()["rejected"]]

    def put_activation_times(self, study: str, table: Path) -> list[str]:
        """Send the table; the sites of it that no run belongs to."""
        answer = self._json(
            "PUT",
            f"/v1/studies/{study}/activation-times",
            content=table.read_bytes(),
            headers={"Content-Type": "text/csv"},
        )
        unmatched: list[str] = answer["unmatched"]
        return unmatched

    def start_job(self, study: str) -> str:
        """Start the pipeline with its defaults; the job's id."""
        job: str = self._json("POST", f"/v1/studies/{study}/jobs", json={})["id"]
        return job

    def follow(self, job: str) -> Iterator[dict[str, Any]]:
        """The job again and again, as the service shows it, until it has ended."""
        while True:
            state = self._json("GET", f"/v1/jobs/{job}")
            yield state
            if state["state"] in ("succeeded", "failed", "cancelled"):
                return
            time.sleep(POLL_SECONDS)

    def points(self, job: str) -> list[dict[str, Any]]:
        """All points of a job, relative to the reference catheter."""
        points: list[dict[str, Any]] = self._json("GET", f"/v1/jobs/{job}/points")["points"]
        return points

    def fetch(self, job: str, out: Path) -> dict[str, Any] | None:
        """Write everything an ended job made into a folder: tables, map, meshes, overlays and a picture of the map.

        Returns the map as the service answers it; None when no site could be located.
        """
        out.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile() as archive:
            with self._http.stream("GET", f"/v1/jobs/{job}/archive.zip") as answer:
                if answer.is_error:
                    answer.read()
                    raise CommandFailed(_sentence(answer))
                for chunk in answer.iter_bytes():
                    archive.write(chunk)
            with zipfile.ZipFile(archive) as files:
                files.extractall(out)
                if "map.json" not in files.namelist():
                    return None
        chamber: dict[str, Any] = json.loads((out / "map.json").read_text())
        return chamber

    def _json(self, method: str, path: str, **request: Any) -> dict[str, Any]:
        content: dict[str, Any] = _good(self._http.request(method, path, **request)).json()
        return content


def _good(answer: httpx.Response) -> httpx.Response:
    if answer.is_error:
        raise CommandFailed(_sentence(answer))
    return answer


def _sentence(answer: httpx.Response) -> str:
    try:
        problem = answer.json()
        places = "; ".join(f"{place['where']}: {place['message']}" for place in problem.get("errors", []))
        return f"{problem['detail']} ({places})" if places else str(problem["detail"])
    except (ValueError, KeyError, TypeError):
        return f"The service answered {answer.request.method} {answer.request.url.path} with {answer.status_code}."


@contextmanager
def progress_bars(console: Console) -> Iterator[Progress]:
    """The bars of one command."""
    columns = (
        SpinnerColumn(), TextColumn("{task.description:<16}"), BarColumn(), TaskProgressColumn(), TimeElapsedColumn(),
    )  # fmt: skip
    with Progress(*columns, console=console) as progress:
        yield progress
    # Without a terminal bars are not drawn until the end; the finished ones then stand as a record.


def send(client: Client, inputs: Inputs, label: str, progress: Progress) -> tuple[str, list[str]]:
    """Make a study of those files; its id, and what the user should know."""
    study = client.make_study(label)
    notes = []
    bar = progress.add_task("upload", total=len(inputs.runs))
    for number, path in enumerate(inputs.runs, start=1):
        # Files are told by number: their names can hold patients' names.
        notes += [
            f"file {number} of {len(inputs.runs)} was not taken: {reason}" for reason in client.upload(study, path)
        ]
        progress.advance(bar)
    notes += [f"site {site} has no runs" for site in client.put_activation_times(study, inputs.activation_times)]
    return study, notes


def process(client: Client, study: str, progress: Progress) -> dict[str, Any]:
    """Run the pipeline over a study with a bar for each kind of stage; the ended job.

    Raises
    ------
    CommandFailed
        When the job fails.
    """
    bars = {name: progress.add_task(title, total=1.0) for name, title in STAGES.items()}
    state: dict[str, Any] = {}
    for state in client.follow(client.start_job(study)):
        for name, bar in bars.items():
            progress.update(bar, completed=_share_done([row for row in state["stages"] if row["name"] == name]))
    if state["state"] != "succeeded":
        raise CommandFailed(f"The job {state['state']}: {(state['error'] or {}).get('detail', 'no reason is known')}")
    return state


def _share_done(stages: Sequence[dict[str, Any]]) -> float:
    ended = ("done", "failed", "cancelled")
    return sum(1.0 if row["state"] in ended else row["progress"] for row in stages) / max(len(stages), 1)


def run_folder(folder: Path, out: Path, serve: Callable[[], Any], console: Console) -> dict[str, Any]:
    """Run the pipeline over a folder through a service of its own and write the results.

    Parameters
    ----------
    folder : Path
        DICOM files and an activation-time table.
    out : Path
        Folder for the results.
    serve : callable
        Gives a context manager that runs a service and yields its address.

    Returns
    -------
    dict
        The ended job.
    """
    inputs = inputs_of(folder)
    with console.status("starting the service"):
        service = serve()
        url = service.__enter__()
    try:
        with Client(url) as client:
            with progress_bars(console) as progress:
                study, notes = send(client, inputs, folder.resolve().name, progress)
                for note in notes:
                    console.print(f"note: {note}", highlight=False)
                job = process(client, study, progress)
            client.fetch(job["id"], out)
            console.print(f"Results: {out.resolve()}", highlight=False, soft_wrap=True)
            return job
    finally:
        service.__exit__(None, None, None)
