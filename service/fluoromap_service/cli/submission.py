"""Send a folder of runs and activation times to the service, and wait for the job."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.progress import Progress

from fluoromap_service.cli.client import Client
from fluoromap_service.cli.failures import CommandFailed
from fluoromap_service.jobs.pipeline import PIPELINE


@dataclass(frozen=True, slots=True)
class StudyFiles:
    """The files of one study: DICOM runs and the table of activation times."""

    runs: tuple[Path, ...]
    activation_times: Path


def find_files(folder: Path) -> StudyFiles:
    """Find the DICOM files below a folder and its activation-time table.

    Raises
    ------
    CommandFailed
        When there are no runs or no table, or when several tables are possible.
    """
    if not folder.is_dir():
        raise CommandFailed(f"{folder} is not a folder; name a folder of DICOM files.")
    runs = tuple(sorted(path for path in folder.rglob("*") if path.is_file() and _is_dicom(path)))
    if not runs:
        raise CommandFailed(f"There is no DICOM file in {folder}; copy the runs there.")
    default = folder / "activation_times.csv"
    tables = [default] if default.is_file() else sorted(folder.glob("*.csv"))
    if not tables:
        raise CommandFailed(f"There is no activation-time table in {folder}; add activation_times.csv (site,lat_ms).")
    if len(tables) > 1:
        raise CommandFailed(f"There are several CSV files in {folder}; name one of them activation_times.csv.")
    return StudyFiles(runs, tables[0])


def _is_dicom(path: Path) -> bool:
    # PS3.10 section 7.1: 128 bytes of preamble, then the prefix.
    with path.open("rb") as stream:
        return stream.read(132)[128:] == b"DICM"


def upload(client: Client, files: StudyFiles, label: str, progress: Progress) -> tuple[str, list[str]]:
    """Make a study and send its files.

    Returns
    -------
    study : str
        Id of the study.
    notes : list of str
        One sentence for each rejected file and for each site without runs.
    """
    study = client.make_study(label)
    notes = []
    bar = progress.add_task("upload", total=len(files.runs))
    for number, path in enumerate(files.runs, start=1):
        # A note gives the number of a file, because its name can hold a patient's name.
        notes += [f"file {number} of {len(files.runs)} was rejected: {reason}" for reason in client.upload(study, path)]
        progress.advance(bar)
    notes += [f"site {site} has no runs" for site in client.put_activation_times(study, files.activation_times)]
    return study, notes


def run_job(client: Client, study: str, progress: Progress) -> dict[str, Any]:
    """Run a job with a progress bar for each kind of stage.

    Returns
    -------
    dict
        The job at its end, as the API shows it.

    Raises
    ------
    CommandFailed
        When the job fails.
    """
    bars = {stage.name: progress.add_task(stage.title, total=1.0) for stage in PIPELINE}
    job: dict[str, Any] = {}
    for job in client.follow(client.start_job(study)):
        for name, bar in bars.items():
            progress.update(bar, completed=_progress_of([row for row in job["stages"] if row["name"] == name]))
    if job["state"] != "succeeded":
        raise CommandFailed(f"The job {job['state']}: {(job['error'] or {}).get('detail', 'no reason is known')}")
    return job


def _progress_of(stages: Sequence[dict[str, Any]]) -> float:
    """Return the mean progress of stages, 0 to 1.

    A stage that ended counts as 1.
    """
    ended = ("done", "failed", "cancelled")
    return sum(1.0 if row["state"] in ended else row["progress"] for row in stages) / max(len(stages), 1)
