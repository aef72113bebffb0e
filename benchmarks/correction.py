"""How long one waits after a correction by hand: ``python benchmarks/correction.py [corrections]``.

Runs the demonstration's study (8 sites, 2 views, 30 frames, simulated) through the real service once, then moves one electrode
of one frame by 2 px, asks for a new job and waits for its map; again and again at another site. Prints the seconds from the
PUT of the electrode to the map in hand, beside the seconds of the first job up to its map, and what was computed again. Last
the milliseconds from asking for each overlay of the last map, not drawn before, to having it.
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from statistics import median
from typing import Any

import httpx
from rich.console import Console

from fluoromap_service.cli.client import Client
from fluoromap_service.cli.demo import SPEC
from fluoromap_service.cli.progress import progress_bars
from fluoromap_service.cli.submission import find_files, upload
from fluoromap_service.cli.supervisor import private_service
from fluoromap_service.dicom.simulation import simulate

PATIENCE_S = 600.0
POLL_SECONDS = 0.05


def main(corrections: int) -> None:
    with tempfile.TemporaryDirectory() as folder:
        simulate(Path(folder) / "study", SPEC)
        with private_service(Path(folder) / "service") as url, httpx.Client(base_url=url, timeout=120) as http:
            with Client(url) as client, progress_bars(Console(stderr=True)) as progress:
                study, _ = upload(client, find_files(Path(folder) / "study"), "correction", progress)
            first_s, job = _until_map(http, study)
            print(f"first job, up to the map: {first_s:.2f} s ({len(job['stages'])} stages)")
            _ended(http, job["id"])
            sites = http.get(f"/v1/studies/{study}/sites").json()["items"]
            taken = []
            for number in range(corrections):
                site = sites[number % len(sites)]
                path, marks = _moved_tip(http, study, site["view_a"], frame=1 + number)
                start = time.perf_counter()
                http.put(path, json=marks).raise_for_status()
                _, job = _until_map(http, study)
                taken.append(time.perf_counter() - start)
                stages = Counter(stage["name"] for stage in _ended(http, job["id"])["stages"] if not stage["reused"])
                again = ", ".join(f"{count} {name}" for name, count in stages.items())
                print(f"correction at {site['site']}: {taken[-1]:.2f} s to the new map; computed again: {again}")
            print(f"median {median(taken):.2f} s, longest {max(taken):.2f} s")
            overlays = http.get(f"/v1/jobs/{job['id']}/overlays").json()["overlays"]
            for scale in (1, 2):
                waits = [1000 * _seconds(http, f"{overlay['href']}?scale={scale}") for overlay in overlays]
                print(
                    f"{len(waits)} overlays at {scale} x the frame's size: median {median(waits):.0f} ms, "
                    f"longest {max(waits):.0f} ms"
                )


def _moved_tip(http: httpx.Client, study: str, uid: str, frame: int) -> tuple[str, list[dict[str, Any]]]:
    """Where the electrodes of a frame are put, and the mapping catheter's with the first of them moved."""
    path = f"/v1/studies/{study}/instances/{uid}/frames/{frame}/electrodes"
    found = http.get(path).json()
    chosen = [entry for entry in found if entry["catheter"] == "mapping"] or found
    if not chosen:
        raise SystemExit(f"no electrode was found in frame {frame}; ask for fewer corrections")
    marks = [{name: entry[name] for name in ("catheter", "electrode", "u_px", "v_px")} for entry in chosen]
    marks[0]["u_px"] += 2.0
    return path, marks


def _until_map(http: httpx.Client, study: str) -> tuple[float, dict[str, Any]]:
    start = time.perf_counter()
    job: dict[str, Any] = http.post(f"/v1/studies/{study}/jobs", json={}).raise_for_status().json()
    while time.perf_counter() - start < PATIENCE_S:
        if http.get(f"/v1/jobs/{job['id']}/map").status_code == 200:
            return time.perf_counter() - start, job
        time.sleep(POLL_SECONDS)
    raise SystemExit(f"no map after {PATIENCE_S:.0f} s")


def _seconds(http: httpx.Client, href: str) -> float:
    start = time.perf_counter()
    http.get(href).raise_for_status()
    return time.perf_counter() - start


def _ended(http: httpx.Client, job: str) -> dict[str, Any]:
    while True:
        state: dict[str, Any] = http.get(f"/v1/jobs/{job}?wait=30").json()
        if state["state"] in ("succeeded", "failed", "cancelled"):
            return state


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 5)
