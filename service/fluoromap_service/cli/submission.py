"""Send a folder of runs, activation times and settings to the service, and wait for the job."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rich.progress import Progress

from fluoromap_service.cli.client import Client
from fluoromap_service.cli.failures import CommandFailed
from fluoromap_service.cli.study_file import NAME, StudyFile, read_study_file
from fluoromap_service.jobs.pipeline import PIPELINE
from fluoromap_service.store.names import normal_name

LISTED_NAMES = 10
"""Most file names that a message lists."""


@dataclass(frozen=True, slots=True)
class NamedRun:
    """A run that ``study.toml`` gives to a view ("view_a" or "view_b") of a site."""

    site: str
    view: str
    run: Path

    @property
    def key(self) -> str:
        """The key in ``study.toml``."""
        return f"sites.{self.site}.{self.view}"


@dataclass(frozen=True, slots=True)
class StudyFiles:
    """The files of one study: DICOM runs, the table of activation times and ``study.toml``.

    Parameters
    ----------
    folder : Path
    runs : tuple of Path
        DICOM files below the folder.
    activation_times : Path or None
        None when ``study.toml`` gives all times.
    settings : StudyFile
        Content of ``study.toml``; empty without that file.
    named_runs : tuple of NamedRun
        The runs that ``study.toml`` names.
    """

    folder: Path
    runs: tuple[Path, ...]
    activation_times: Path | None
    settings: StudyFile = field(default_factory=StudyFile)
    named_runs: tuple[NamedRun, ...] = ()

    def name_of(self, run: Path) -> str:
        """Return a run's path below the folder, with slashes."""
        return _name_below(self.folder, run)


def _name_below(folder: Path, run: Path) -> str:
    # A file name may have bytes that are no UTF-8; neither a request nor a terminal takes them.
    return normal_name(os.fsencode(run.relative_to(folder).as_posix()).decode("utf-8", "replace"))


def _named_runs(folder: Path, runs: Sequence[Path], settings: StudyFile) -> Iterator[NamedRun]:
    """Yield the runs that ``study.toml`` names.

    Each key must name one file that no other key names.
    """
    names = {_name_below(folder, run): run for run in runs}
    keys: dict[Path, str] = {}
    for site, entry in settings.sites.items():
        for view, name in entry.files.items():
            named = NamedRun(site, view, _run_named(name, names, f"{folder / NAME}: sites.{site}.{view}"))
            other = keys.setdefault(named.run, named.key)
            if other != named.key:
                raise CommandFailed(
                    f"{folder / NAME}: {named.key}: {other} has the same file {name!r}; give each view its own run."
                )
            yield named


def _run_named(name: str, names: Mapping[str, Path], where: str) -> Path:
    """Return the run of a path below the folder.

    A file name is enough where only one run has it.
    """
    if name in names:
        return names[name]
    found = [path for path in names if path.rsplit("/", 1)[-1] == name]
    if len(found) == 1:
        return names[found[0]]
    if found:
        raise CommandFailed(f"{where}: several files have the name {name!r}; write one of {', '.join(found)}.")
    listed = ", ".join(list(names)[:LISTED_NAMES]) + (", ..." if len(names) > LISTED_NAMES else "")
    raise CommandFailed(f"{where}: the folder has no DICOM file {name!r}; write one of {listed}.")


@dataclass(frozen=True, slots=True)
class Submission:
    """A study that was sent.

    Parameters
    ----------
    study : str
        Id of the study.
    files : dict of str to str
        SOP Instance UID -> path below the folder, of the accepted runs.
    notes : tuple of str
        One sentence for each rejected file.
    """

    study: str
    files: Mapping[str, str]
    notes: tuple[str, ...]


def find_files(folder: Path) -> StudyFiles:
    """Find the DICOM files below a folder, its activation-time table and its ``study.toml``.

    Raises
    ------
    CommandFailed
        When there are no runs or no activation times, when several tables are possible, or when ``study.toml`` is wrong.
    """
    if not folder.is_dir():
        raise CommandFailed(f"{folder} is not a folder; name a folder of DICOM files.")
    runs = tuple(sorted(path for path in folder.rglob("*") if path.is_file() and _is_dicom(path)))
    if not runs:
        raise CommandFailed(f"There is no DICOM file in {folder}; copy the runs there.")
    settings = read_study_file(folder / NAME) if (folder / NAME).is_file() else StudyFile()
    default = folder / "activation_times.csv"
    tables = [default] if default.is_file() else sorted(folder.glob("*.csv"))
    if not tables and all(entry.lat_ms is None for entry in settings.sites.values()):
        raise CommandFailed(f"There is no activation-time table in {folder}; add activation_times.csv (site,lat_ms).")
    if len(tables) > 1:
        raise CommandFailed(f"There are several CSV files in {folder}; name one of them activation_times.csv.")
    return StudyFiles(folder, runs, tables[0] if tables else None, settings, tuple(_named_runs(folder, runs, settings)))


def _is_dicom(path: Path) -> bool:
    # PS3.10 section 7.1: 128 bytes of preamble, then the prefix.
    with path.open("rb") as stream:
        return stream.read(132)[128:] == b"DICM"


def upload(client: Client, files: StudyFiles, label: str, progress: Progress) -> Submission:
    """Make a study, send its files and apply its ``study.toml``.

    Raises
    ------
    CommandFailed
        When ``study.toml`` names a run that the service rejected, or a value that the service refuses.
    """
    study = client.make_study(label, **files.settings.study)
    bar = progress.add_task("upload", total=len(files.runs))
    uids: dict[Path, str] = {}
    notes = []
    for number, path in enumerate(files.runs, start=1):
        sent = client.upload(study, path, files.name_of(path))
        if sent.uid is not None:
            uids[path] = sent.uid
        # A note gives the number of a file, because its name can hold a patient's name.
        notes += [f"file {number} of {len(files.runs)} was rejected: {reason}" for reason in sent.objections]
        progress.advance(bar)
    _complete_geometry(client, study, files)
    if files.activation_times is not None:
        client.put_activation_times(study, files.activation_times)
    _bind_sites(client, study, files, uids)
    return Submission(study, {uid: files.name_of(path) for path, uid in uids.items()}, tuple(notes))


def _complete_geometry(client: Client, study: str, files: StudyFiles) -> None:
    """Give the study the default geometry, for the values that headers lack."""
    if files.settings.default_gantry:
        try:
            client.complete_gantry(study, files.settings.default_gantry)
        except CommandFailed as failure:
            raise CommandFailed(f"{files.folder / NAME}: gantry does not fit a run's header: {failure}") from None


def _bind_sites(client: Client, study: str, files: StudyFiles, uids: Mapping[Path, str]) -> None:
    """Set the runs and the times that ``study.toml`` gives."""
    path = files.folder / NAME
    with_time = {site["site"] for site in client.sites(study) if site["lat_ms"] is not None}
    changes: dict[str, dict[str, Any]] = {site: {} for site in files.settings.sites}
    for site, entry in files.settings.sites.items():
        if entry.lat_ms is None:
            continue
        if site in with_time:
            # A time alone would also confirm the runs that row order gave the site.
            raise CommandFailed(
                f"{path}: sites.{site}.lat_ms: the table of activation times has this site too; keep one of the two times."
            )
        changes[site]["lat_ms"] = entry.lat_ms
    for named in files.named_runs:
        if named.run not in uids:
            name = files.name_of(named.run)
            raise CommandFailed(f"{path}: {named.key}: the service rejected the file {name!r}; name another one.")
        changes[named.site][named.view] = uids[named.run]
    for site, change in changes.items():
        client.put_site(study, site, change)


def run_job(client: Client, study: str, progress: Progress, request: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """Run a job with a progress bar for each kind of stage.

    Parameters
    ----------
    client : Client
    study : str
        Id of the study.
    progress : Progress
    request : mapping, optional
        Plugins and views as ``POST /v1/studies/{id}/jobs`` takes them; by default the default plugins.

    Returns
    -------
    dict
        The job at its end, as the API shows it.

    Raises
    ------
    CommandFailed
        When the job fails.
    """
    job_id = client.start_job(study, request or {})
    bars = {stage.name: progress.add_task(stage.title, total=1.0) for stage in PIPELINE}
    job: dict[str, Any] = {}
    for job in client.follow(job_id):
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
