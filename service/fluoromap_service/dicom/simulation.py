"""A simulated study as files: DICOM runs and activation times as a user sends them, and the truth."""

from __future__ import annotations

import csv
import dataclasses
import json
import multiprocessing
import os
from collections.abc import Callable, Mapping
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fluoromap.phantom import SimulatedRun, SimulatedSite, SimulatedStudy, StudySpec, simulate_study
from fluoromap_service.dicom import deterministic_uid, write_cine

STARTED = datetime(2026, 1, 5, 9, 0, tzinfo=UTC)
"""The start of every simulated study."""


@dataclass(frozen=True, slots=True)
class SimulatedFiles:
    """The files of a simulated study; never upload ``truth``."""

    runs: tuple[Path, ...]
    activation_times: Path
    truth: Path


def simulate(
    folder: Path, spec: StudySpec, *, processes: int | None = None, on_run: Callable[[], None] = lambda: None
) -> SimulatedFiles:
    """Write a study's runs (``dicom/S01-a.dcm`` ...), ``activation_times.csv`` and ``truth.json`` into a folder.

    Parameters
    ----------
    folder : Path
        The function makes the folder and replaces the files of an earlier simulation.
    spec : StudySpec
        The same spec gives the same files.
    processes : int, optional
        Number of processes that render; by default one a processor.
    on_run : callable
        Called after each written run.

    Raises
    ------
    ValueError
        When the heart does not fit into the field of the views.
    """
    study = simulate_study(spec)
    (folder / "dicom").mkdir(parents=True, exist_ok=True)
    jobs = [(number, view) for number in range(spec.sites) for view in (0, 1)]
    paths = [_run_path(folder, study.sites[number], study.sites[number].runs[view]) for number, view in jobs]
    workers = min(processes or os.cpu_count() or 1, len(jobs))
    if workers == 1:
        for (number, view), path in zip(jobs, paths, strict=True):
            _write_run(study, number, view, path)
            on_run()
    else:
        # Spawned, not forked: the caller may have threads.
        context = multiprocessing.get_context("spawn")
        with ProcessPoolExecutor(workers, context, initializer=_hold, initargs=(spec,)) as pool:
            written = [pool.submit(_write_held, *job, path) for job, path in zip(jobs, paths, strict=True)]
            for future in as_completed(written):
                future.result()
                on_run()
    table = folder / "activation_times.csv"
    _write_activation_times(table, study, folder)
    truth = folder / "truth.json"
    truth.write_text(json.dumps(truth_of(study), indent=1))
    return SimulatedFiles(tuple(paths), table, truth)


def truth_of(study: SimulatedStudy) -> dict[str, Any]:
    """Return the answers of a perfect pipeline, as JSON types.

    Millimetres along LPS axes. ``relative_mm`` counts from the reference catheter's mean, everything else from the isocentre.
    """
    chamber = study.chamber
    return {
        "spec": dataclasses.asdict(study.spec),
        "heart_rate_hz": study.heart_rate_hz,
        "reference_mm": _numbers(study.reference_mm),
        "chamber": {
            "centre_mm": _numbers(chamber.centre_mm),
            "axes": _numbers(chamber.axes),
            "semi_axes_mm": _numbers(chamber.semi_axes_mm),
            "focus_mm": _numbers(chamber.focus_mm),
            "conduction_mm_per_ms": chamber.conduction_mm_per_ms,
            "reference_ms": chamber.reference_ms,
            "volume_ml": chamber.volume_ml,
        },
        "sites": [
            {
                "site": site.name,
                "lat_ms": site.truth.lat_ms,
                "contact_mm": _numbers(site.truth.contact_mm),
                "diastole_mm": _by_catheter(site.truth.diastole_mm),
                "relative_mm": _by_catheter(site.truth.relative_mm),
                "runs": {
                    run.view: {"phases": _numbers(run.truth.phases), "points_mm": _by_catheter(run.truth.points_mm)}
                    for run in site.runs
                },
            }
            for site in study.sites
        ],
    }


def _run_path(folder: Path, site: SimulatedSite, run: SimulatedRun) -> Path:
    return folder / "dicom" / f"{site.name}-{run.view}.dcm"


def _write_run(study: SimulatedStudy, number: int, view: int, path: Path) -> None:
    run = study.sites[number].runs[view]
    # Another version of the renderer makes other pixels, and other pixels need another UID.
    names = ("simulated-study", version("fluoromap"), repr(study.spec))
    series_number = 2 * number + view + 1
    write_cine(
        path,
        run.frames,
        frame_count=len(run.frames),
        gantry=run.gantry,
        frame_time_ms=1000 / study.spec.frame_rate_hz,
        acquired=STARTED + timedelta(seconds=run.start_seconds),
        study_instance_uid=deterministic_uid(*names),
        series_number=series_number,
        sop_instance_uid=deterministic_uid(*names, str(series_number)),
        r_wave_frames=run.r_wave_frames,
    )


_held: SimulatedStudy | None = None


def _hold(spec: StudySpec) -> None:
    global _held
    _held = simulate_study(spec)


def _write_held(number: int, view: int, path: Path) -> None:
    assert _held is not None
    _write_run(_held, number, view, path)


def _write_activation_times(path: Path, study: SimulatedStudy, folder: Path) -> None:
    with path.open("w", newline="") as stream:
        table = csv.writer(stream)
        table.writerow(("site", "lat_ms", "view_a", "view_b"))
        for site in study.sites:
            names = (_run_path(folder, site, run).name for run in site.runs)
            table.writerow((site.name, f"{site.lat_ms:.1f}", *names))


def _by_catheter(arrays: Mapping[str, NDArray[np.float64]]) -> dict[str, Any]:
    return {catheter: _numbers(array) for catheter, array in arrays.items()}


def _numbers(array: NDArray[np.float64]) -> Any:
    return np.round(array, 4).tolist()
