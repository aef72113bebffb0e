"""A study of clinical size on the real service: ``python benchmarks/clinical_study.py [sites] [frames] [options]``.

The benchmark simulates a study of 20 sites, 2 views, 120 frames at 30 a second, and keeps its files for the next run. It runs the
study through four things, one after the other:

1. the functions of the stages in this process, one after the other: the yardstick;
2. the service with one worker process: a whole job;
3. the service with a worker process for each processor: a whole job, then pictures, report, archive, tracks and frames of that
   job, then corrections;
4. the same service with a queue: several jobs of the study, and behind them a job of two of its sites.

It prints wall-clock seconds, and processor seconds where other programs use the machine too. ``--parts`` chooses some of the four.
Give other sizes to see how each figure grows: ``clinical_study.py 5``, ``clinical_study.py 80``.
"""

from __future__ import annotations

import os

# One thread for each process, as in a worker: threads of the matrix products would only wait for each other.
os.environ.update(OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1", NUMBA_NUM_THREADS="1")

import argparse
import json
import re
import sqlite3
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

import httpx
import numpy as np
from correction import electrodes_to_put
from process_figures import ProcessFigures, process_figures
from rich.console import Console

from fluoromap.catheters import DEFAULT_CATALOGUE
from fluoromap.contracts import MonoplaneView, Refusal, Run, Segmentation, Silent, View
from fluoromap.fuser.mapped_sites import mapped_sites
from fluoromap.geometry import camera_from_gantry
from fluoromap.matching import SiteRuns, match_study
from fluoromap.phantom import StudySpec, simulate_study
from fluoromap.registry import DEFAULTS, build_fuser, build_monoplane, build_segmenter, build_triangulator, plugin
from fluoromap_service.cli.progress import progress_bars
from fluoromap_service.cli.supervisor import private_service
from fluoromap_service.dicom import open_frames, read_instance
from fluoromap_service.dicom.simulation import simulate
from fluoromap_service.jobs.stage_results import MapResult, SiteTracks, ViewTrack
from fluoromap_service.store.codec import encode

PATIENCE_S = 3600.0
POLL_SECONDS = 0.02
CINE_FRAMES = 120
PARTS = ("pure", "one", "all", "turns")
VIEWS: tuple[View, View] = ("a", "b")


@dataclass(frozen=True, slots=True)
class JobTimes:
    """Seconds from the request that starts a job.

    segmented : to the end of the last ``segment``. map : to the map. end : to the end. stages : seconds of all stages of a kind,
    from claim to stored result. worker_cpu, api_cpu : processor seconds of both parts of the service during the job.
    """

    segmented: float
    map: float
    end: float
    stages: dict[str, float]
    worker_cpu: float
    api_cpu: float


def main() -> None:
    """Measure the parts that the arguments choose."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sites", type=int, nargs="?", default=20)
    parser.add_argument("frames", type=int, nargs="?", default=120)
    parser.add_argument("--rate", type=float, default=30.0, help="frames a second")
    parser.add_argument("--segmenter", default=DEFAULTS["segmenter"])
    parser.add_argument("--corrections", type=int, default=12)
    parser.add_argument("--queued", type=int, default=4, help="jobs of the study before the job of two sites")
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=PARTS)
    parser.add_argument("--folder", type=Path, help="folder that keeps the simulated study")
    given = parser.parse_args()
    spec = StudySpec(seed=2026, sites=given.sites, frames=given.frames, frame_rate_hz=given.rate)
    folder = simulated_files(spec, given.folder)
    print(f"{spec.sites} sites, 2 views, {spec.frames} frames at {spec.frame_rate_hz:g}/s; segmenter {given.segmenter}")
    pure = _pure(folder, spec, given.segmenter) if "pure" in given.parts else None
    one = _one_worker(folder, given.segmenter, pure) if "one" in given.parts else None
    if "all" in given.parts:
        _all_workers(folder, given.segmenter, given.corrections, one)
    if "turns" in given.parts:
        _turns(folder, given.segmenter, given.queued)


def simulated_files(spec: StudySpec, folder: Path | None = None) -> Path:
    """Return the folder with the files of the study.

    The study is simulated where the folder is not complete.
    """
    cache = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "fluoromap"
    folder = folder or cache / f"study-{spec.seed}-{spec.sites}x{spec.frames}-{spec.frame_rate_hz:g}"
    if not (folder / "truth.json").exists():
        with progress_bars(Console(stderr=True)) as progress:
            bar = progress.add_task("simulate", total=2 * spec.sites)
            simulate(folder, spec, on_run=lambda: progress.advance(bar))
    return folder


# --- the yardstick: the functions of the stages in this process ------------------------------------------------------------


@contextmanager
def _counted(name: str, seconds: dict[str, float]) -> Iterator[None]:
    start = time.process_time()
    yield
    seconds[name] = seconds.get(name, 0.0) + time.process_time() - start


def _pure(folder: Path, spec: StudySpec, segmenter: str) -> dict[str, float]:
    """Return the processor seconds of each stage of the study."""
    for kind, name in {**DEFAULTS, "segmenter": segmenter}.items():
        stage = plugin(kind, name).stage
        getattr(stage, "warm_up", lambda: None)()
    study, seconds, megabytes = simulate_study(spec), dict[str, float](), dict[str, float]()

    def store(name: str, result: Any) -> None:
        megabytes[name] = megabytes.get(name, 0.0) + len(encode(result)) / 1e6

    runs = []
    for site in study.sites:
        cameras = [camera_from_gantry(run.gantry) for run in site.runs]
        found: list[Segmentation] = []
        for run, camera in zip(site.runs, cameras, strict=True):
            path = folder / "dicom" / f"{site.name}-{run.view}.dcm"
            facts = read_instance(path)
            with _counted("segment", seconds):
                shown = Run(
                    open_frames(path, facts), np.array(facts.frame_times_ms), camera.px_per_mm, facts.pixels,
                    facts.r_wave_frames,
                )  # fmt: skip
                found.append(build_segmenter(segmenter, {}).segment(shown, DEFAULT_CATALOGUE, {}, Silent()))
            store("segment", found[-1])
        runs.append(SiteRuns(site.name, cameras[0], cameras[1], found[0], found[1]))
    with _counted("match", seconds):
        matching = match_study(runs, DEFAULT_CATALOGUE, Silent())
    store("match", matching)
    with _counted("triangulate", seconds):
        triangulator = build_triangulator(DEFAULTS["triangulator"], {})
        located = triangulator.triangulate(matching.sites, DEFAULT_CATALOGUE, Silent())
    store("triangulate", located)
    with _counted("fuse", seconds):
        times = {site.name: (site.lat_ms, 2.0) for site in study.sites}
        fuser = build_fuser(DEFAULTS["fuser"], {})
        chamber = fuser.fuse(mapped_sites(located, DEFAULT_CATALOGUE, times), Silent())
    store("fuse", MapResult(chamber, None, "", None))
    named = {site.site: site for site in matching.sites}
    solver = build_monoplane(DEFAULTS["monoplane"], {})
    for at_site in located.sites:
        matched, tracks = named[at_site.site], []
        others = () if at_site.cycle else tuple(each.cycle for each in located.sites if each.cycle)
        with _counted("monoplane", seconds):
            for view in VIEWS:
                shown_view = MonoplaneView(
                    site=matched.site, view=view, camera=at_site.camera(view), catalogue=DEFAULT_CATALOGUE,
                    frame_times_ms=getattr(matched.runs, f"frame_times_{view}_ms"),
                    observations=getattr(matched.runs, f"track_{view}"),
                    a_priori=at_site.a_priori_points, a_priori_frame=at_site.diastolic_frame(view),
                    cycle=at_site.cycle, others=others,
                )  # fmt: skip
                try:
                    tracks.append(ViewTrack(view, solver.track(shown_view, Silent()), None, ""))
                except Refusal as refusal:
                    tracks.append(ViewTrack(view, None, refusal.reason, str(refusal)))
        store("monoplane", SiteTracks(at_site.site, tuple(tracks)))
    print("stages in one process, processor seconds (MB of the stored results):")
    for name, used in seconds.items():
        print(f"  {name:<12}{used:8.2f} s{megabytes[name]:8.2f} MB")
    print(f"  {'all':<12}{sum(seconds.values()):8.2f} s{sum(megabytes.values()):8.2f} MB")
    return seconds


# --- the service -----------------------------------------------------------------------------------------------------------


@contextmanager
def _service(workers: int | None) -> Iterator[tuple[httpx.Client, ProcessFigures, Path]]:
    """Run a service; give its client, the figures of its processes and its folder."""
    with (
        tempfile.TemporaryDirectory() as name,
        process_figures() as figures,
        private_service(Path(name) / "service", workers=workers) as service,
        service.client() as http,
    ):
        yield http, figures, Path(name) / "service"
        figures.sample()


def _one_worker(folder: Path, segmenter: str, pure: dict[str, float] | None) -> JobTimes:
    with _service(1) as (http, figures, _):
        study, _ = upload_study(http, folder)
        _, times = _job(http, figures, study, segmenter)
    _show_job("one worker process", times)
    if pure is not None:
        total = sum(pure.values())
        print(
            f"  overhead of the service over the stages alone: {100 * (times.end / total - 1):.0f} % of the wall clock, "
            f"{100 * (times.worker_cpu / total - 1):.0f} % of the worker's processor time"
        )
    return times


def _all_workers(folder: Path, segmenter: str, corrections: int, one: JobTimes | None) -> None:
    processors = len(os.sched_getaffinity(0))
    with _service(None) as (http, figures, data):
        study, uploads = upload_study(http, folder)
        print(
            f"upload: {sum(uploads):.2f} s; first {uploads[0]:.3f} s, median of the last ten {median(uploads[-10:]):.3f} s"
        )
        job, times = _job(http, figures, study, segmenter)
        _show_job(f"{processors} worker processes", times)
        megabytes = _stored_megabytes(data, job)
        of_stages = ", ".join(f"{name} {size:.2f}" for name, size in megabytes.items())
        print(f"stored results with partial results: {sum(megabytes.values()):.2f} MB ({of_stages})")
        if one is not None:
            print(f"  segmenting {one.segmented / times.segmented:.2f} times as fast as with one worker process")
        _results(http, job)
        _frames(http, study)
        _corrections(http, study, job, segmenter, corrections)
        print(
            f"peak memory of the largest process: worker {figures.largest_mib('worker'):.0f} MiB, "
            f"API {figures.largest_mib('api'):.0f} MiB"
        )


def _stored_megabytes(data: Path, job: str) -> dict[str, float]:
    """Return the size of the stored results of each stage of a job."""
    megabytes: dict[str, float] = {}
    with closing(sqlite3.connect(f"file:{data / 'fluoromap.sqlite'}?mode=ro", uri=True)) as database:
        rows = database.execute(
            "SELECT DISTINCT name, result FROM stage WHERE job_id = ? AND result IS NOT NULL", (job,)
        )
        for name, sha256 in rows:
            size = (data / "files" / sha256[:2] / sha256).stat().st_size
            megabytes[name] = megabytes.get(name, 0.0) + size / 1e6
    return megabytes


def _turns(folder: Path, segmenter: str, queued: int) -> None:
    """Measure a job of two sites alone, and behind jobs of the whole study."""
    with _service(None) as (http, _, _):
        large, _ = upload_study(http, folder)
        small, _ = upload_study(http, folder, sites=2)

        def submit(study: str, number: int) -> str:
            """Start a job that reuses no result of another number, because its catheters differ."""
            catheters = http.get(f"/v1/studies/{study}").json()["catheters"]
            named = [
                {name: each[name] for name in ("name", "electrodes", "spacing_mm", "tip_mm", "ring_mm")}
                for each in catheters
            ]
            named[0]["tip_mm"] += 0.001 * number
            http.patch(f"/v1/studies/{study}", json={"catheters": named}).raise_for_status()
            return start_job(http, study, segmenter)

        start = time.perf_counter()
        _stage_ends(http, submit(small, 0), start)
        alone = time.perf_counter() - start
        start = time.perf_counter()
        before = [submit(large, number) for number in range(1, queued + 1)]
        behind = time.perf_counter()
        _stage_ends(http, submit(small, queued + 1), behind)
        waited = time.perf_counter() - behind
        for job in before:
            _stage_ends(http, job, start)
        print(
            f"a job of two sites: alone {alone:.1f} s, behind {queued} jobs of the study {waited:.1f} s; these ended after "
            f"{time.perf_counter() - start:.1f} s"
        )


def _show_job(title: str, times: JobTimes) -> None:
    print(
        f"job with {title}: segmented {times.segmented:.2f} s, map {times.map:.2f} s, end {times.end:.2f} s; processor "
        f"seconds: worker {times.worker_cpu:.2f}, API {times.api_cpu:.2f}"
    )
    print(
        "  stages, from claim to stored result: " + ", ".join(f"{name} {s:.2f} s" for name, s in times.stages.items())
    )


def upload_study(http: httpx.Client, folder: Path, sites: int | None = None) -> tuple[str, list[float]]:
    """Return the study and the seconds of each upload; ``sites`` takes only the first ones."""
    study: str = http.post("/v1/studies", json={"label": "clinical study"}).raise_for_status().json()["id"]
    seconds = []
    runs = None if sites is None else 2 * sites
    for path in sorted((folder / "dicom").glob("*.dcm"))[:runs]:
        with path.open("rb") as stream:
            part = {"file": (path.name, stream, "application/dicom")}
            seconds.append(_seconds(http, "POST", f"/v1/studies/{study}/instances", files=part))
    lines = (folder / "activation_times.csv").read_bytes().splitlines(keepends=True)
    table = b"".join(lines if sites is None else lines[: 1 + sites])
    http.put(
        f"/v1/studies/{study}/activation-times", content=table, headers={"Content-Type": "text/csv"}
    ).raise_for_status()
    return study, seconds


def _job(http: httpx.Client, figures: ProcessFigures, study: str, segmenter: str) -> tuple[str, JobTimes]:
    """Run a job; return its id and its times."""
    figures.sample()
    worker, api = figures.processor_seconds("worker"), figures.processor_seconds("api")
    start = time.perf_counter()
    job = start_job(http, study, segmenter)
    ended = _stage_ends(http, job, start)
    end_s = time.perf_counter() - start
    figures.sample()
    return job, JobTimes(
        segmented=ended["segment"],
        map=ended["fuse"],
        end=end_s,
        stages=_stage_seconds(http),
        worker_cpu=figures.processor_seconds("worker") - worker,
        api_cpu=figures.processor_seconds("api") - api,
    )


def start_job(http: httpx.Client, study: str, segmenter: str) -> str:
    body = {"pipeline": {"segmenter": {"name": segmenter}}}
    job: str = http.post(f"/v1/studies/{study}/jobs", json=body).raise_for_status().json()["id"]
    return job


def _stage_ends(http: httpx.Client, job: str, start: float) -> dict[str, float]:
    """Return when the last stage of each kind ended.

    The times are seconds from ``start``.
    """
    ends: dict[str, float] = {}
    with http.stream("GET", f"/v1/jobs/{job}/events", timeout=PATIENCE_S) as events:
        for line in events.iter_lines():
            if line.startswith("data:"):
                event = json.loads(line.removeprefix("data:"))
                if "name" in event and event["state"] == "done":
                    ends[event["name"]] = time.perf_counter() - start
                elif event["state"] in ("failed", "cancelled"):
                    raise SystemExit(f"the job failed: {event}")
    return ends


def _stage_seconds(http: httpx.Client) -> dict[str, float]:
    """Return the seconds of all stages of each kind.

    They count from the claim to the stored result.
    """
    found = re.findall(r'^fluoromap_stage_seconds_sum{stage="(\w+)"} (\S+)$', http.get("/metrics").text, re.MULTILINE)
    return {name: float(seconds) for name, seconds in found}


# --- pictures, report, archive, tracks, frames -------------------------------------------------------------------------------


def _results(http: httpx.Client, job: str) -> None:
    overlays = [entry["href"] for entry in http.get(f"/v1/jobs/{job}/overlays").raise_for_status().json()["overlays"]]
    for scale in (1, 2):
        waits = [1000 * _seconds(http, "GET", f"{href}?scale={scale}") for href in overlays]
        again = [1000 * _seconds(http, "GET", f"{href}?scale={scale}") for href in overlays]
        print(
            f"{len(waits)} overlays at {scale} x: first {waits[0]:.0f} ms, then median {median(waits[1:]):.0f} ms, longest "
            f"{max(waits[1:]):.0f} ms; again median {median(again):.0f} ms"
        )
    for name in ("report.html", "archive.zip"):
        for turn in ("first time", "again"):
            first, whole, size = _streamed(http, f"/v1/jobs/{job}/{name}")
            print(f"{name}, {turn}: first byte {first:.3f} s, whole {whole:.3f} s, {size / 1e6:.1f} MB")
    for name in ("tracks", "tracks.csv", "map", "points"):
        print(f"{name}: {_seconds(http, 'GET', f'/v1/jobs/{job}/{name}'):.3f} s")


def _frames(http: httpx.Client, study: str) -> None:
    uid, frames = _first_run(http, study)
    path = f"/v1/studies/{study}/instances/{uid}/frames"
    wanted = range(1, min(frames, CINE_FRAMES) + 1)
    start = time.perf_counter()
    for number in wanted:
        _seconds(http, "GET", f"{path}/{number}.png")
    seconds = time.perf_counter() - start
    print(f"frames as PNG, one after the other: {len(wanted) / seconds:.0f} a second")
    start, sent = time.perf_counter(), 0
    while sent < len(wanted):
        content = http.get(f"{path}?first={sent + 1}&count={len(wanted) - sent}").raise_for_status().content
        sent += len(content) // (512 * 512)
    print(f"frames in batches: {len(wanted) / (time.perf_counter() - start):.0f} a second")


def _first_run(http: httpx.Client, study: str) -> tuple[str, int]:
    run = http.get(f"/v1/studies/{study}/instances?limit=1").json()["items"][0]
    return run["sop_instance_uid"], run["frames"]


# --- corrections -------------------------------------------------------------------------------------------------------------


def _corrections(http: httpx.Client, study: str, job: str, segmenter: str, count: int) -> None:
    """Correct an electrode at one site after another.

    First in any frame, then in the frame that the map uses.
    """
    sites = [site for site in http.get(f"/v1/studies/{study}/sites?limit=500").json()["items"] if site["site"]]
    used = {
        point["site"]: point["views"]["a"]["frame"]
        for point in http.get(f"/v1/jobs/{job}/points").raise_for_status().json()["points"]
        if point["grade"] != "rejected"
    }
    anywhere = [(sites[number % len(sites)], 1 + number) for number in range(count)]
    located = [(site, used[site["site"]]) for site in sites if site["site"] in used]
    at_diastole = [located[number % len(located)] for number in range(count)]
    for title, corrected in (("in any frame", anywhere), ("in the frame that the map uses", at_diastole)):
        _print_corrections(http, study, segmenter, title, corrected)


def _print_corrections(
    http: httpx.Client, study: str, segmenter: str, title: str, corrected: list[tuple[dict[str, Any], int]]
) -> None:
    seconds, computed = [], Counter[str]()
    for site, frame in corrected:
        path, electrodes = electrodes_to_put(http, study, site["view_a"], frame)
        start = time.perf_counter()
        http.put(path, json=electrodes).raise_for_status()
        job = start_job(http, study, segmenter)
        while http.get(f"/v1/jobs/{job}/map").status_code != 200:
            if time.perf_counter() - start > PATIENCE_S:
                raise SystemExit("no map after the correction")
            time.sleep(POLL_SECONDS)
        seconds.append(time.perf_counter() - start)
        while (state := http.get(f"/v1/jobs/{job}?wait=30").json())["state"] != "succeeded":
            if state["state"] in ("failed", "cancelled"):
                raise SystemExit(f"the job failed: {state['error']}")
        computed.update(stage["name"] for stage in state["stages"] if not stage["reused"])
    if seconds:
        p50, p95 = np.percentile(seconds, (50, 95))
        again = ", ".join(f"{number / len(seconds):.1f} {name}" for name, number in computed.items())
        print(
            f"{len(seconds)} corrections {title} -> map: p50 {p50:.2f} s, p95 {p95:.2f} s; computed again for each: {again}"
        )


def _seconds(http: httpx.Client, method: str, path: str, **more: Any) -> float:
    start = time.perf_counter()
    http.request(method, path, **more).raise_for_status()
    return time.perf_counter() - start


def _streamed(http: httpx.Client, path: str) -> tuple[float, float, int]:
    """Return the seconds to the first byte and to the last, and the bytes."""
    start, first, size = time.perf_counter(), 0.0, 0
    with http.stream("GET", path) as answer:
        answer.raise_for_status()
        for chunk in answer.iter_raw():
            first = first or time.perf_counter() - start
            size += len(chunk)
    return first, time.perf_counter() - start, size


if __name__ == "__main__":
    main()
