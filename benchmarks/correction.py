"""Waiting time after a correction by hand: ``python benchmarks/correction.py [corrections]``.

The benchmark runs the demonstration's study (8 sites, 2 views, 30 frames, simulated) through the real service once. Then, for
each correction at another site, it moves one electrode of one frame by 2 px, starts a new job and waits for its map. It
prints:

- the seconds of the first job up to its map,
- for each correction the seconds from the PUT of the electrode to the new map, and the stages that were computed again,
- the milliseconds from the request of each overlay of the last map, not drawn before, to its arrival.
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
from fluoromap_service.cli.commands.demo import SPEC
from fluoromap_service.cli.progress import progress_bars
from fluoromap_service.cli.submission import find_files, upload
from fluoromap_service.cli.supervisor import private_service
from fluoromap_service.dicom.simulation import simulate

PATIENCE_S = 600.0
POLL_SECONDS = 0.05


def main(corrections: int) -> None:
    with tempfile.TemporaryDirectory() as folder:
        simulate(Path(folder) / "study", SPEC)
        with private_service(Path(folder) / "service") as service, service.client() as http:
            with Client(service.url, service.token) as client, progress_bars(Console(stderr=True)) as progress:
                study = upload(client, find_files(Path(folder) / "study"), "correction", progress).study
            first_s, job = _until_map(http, study)
            print(f"first job, up to the map: {first_s:.2f} s ({len(job['stages'])} stages)")
            _wait_for_end(http, job["id"])
            sites = http.get(f"/v1/studies/{study}/sites").json()["items"]
            seconds = []
            for number in range(corrections):
                site = sites[number % len(sites)]
                path, electrodes = electrodes_to_put(http, study, site["view_a"], frame=1 + number)
                start = time.perf_counter()
                http.put(path, json=electrodes).raise_for_status()
                _, job = _until_map(http, study)
                seconds.append(time.perf_counter() - start)
                stages = Counter(
                    stage["name"] for stage in _wait_for_end(http, job["id"])["stages"] if not stage["reused"]
                )
                again = ", ".join(f"{count} {name}" for name, count in stages.items())
                print(f"correction at {site['site']}: {seconds[-1]:.2f} s to the new map; computed again: {again}")
            print(f"median {median(seconds):.2f} s, longest {max(seconds):.2f} s")
            overlays = http.get(f"/v1/jobs/{job['id']}/overlays").json()["overlays"]
            for scale in (1, 2):
                waits = [1000 * _seconds(http, f"{overlay['href']}?scale={scale}") for overlay in overlays]
                print(
                    f"{len(waits)} overlays at {scale} x the frame's size: median {median(waits):.0f} ms, "
                    f"longest {max(waits):.0f} ms"
                )


def electrodes_to_put(http: httpx.Client, study: str, uid: str, frame: int) -> tuple[str, list[dict[str, Any]]]:
    """Return the path of a frame's electrodes, and the mapping catheter's electrodes with the first displaced."""
    path = f"/v1/studies/{study}/instances/{uid}/frames/{frame}/electrodes"
    found = http.get(path).json()
    chosen = [entry for entry in found if entry["catheter"] == "mapping"] or found
    if not chosen:
        raise SystemExit(f"no electrode was found in frame {frame}; give a smaller number of corrections")
    electrodes = [{name: entry[name] for name in ("catheter", "electrode", "u_px", "v_px")} for entry in chosen]
    electrodes[0]["u_px"] += 2.0
    return path, electrodes


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


def _wait_for_end(http: httpx.Client, job: str) -> dict[str, Any]:
    while True:
        state: dict[str, Any] = http.get(f"/v1/jobs/{job}?wait=30").json()
        if state["state"] in ("succeeded", "failed", "cancelled"):
            return state


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 5)
