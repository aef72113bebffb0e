"""Time of a page of DICOMweb search, and of an upload, in a large archive beside a small one.

``python benchmarks/dicomweb.py`` fills an archive with the index rows of 100 000 simulated runs and one with those of 1 000, in a
fresh database each: SQLite, or with ``--database URL`` an empty PostgreSQL for the large one. It starts the API and prints for each
search the median of five requests, the slowest of eight at once, and the ratio to the small archive; then the time of an upload.
No pixels are stored for the simulated runs, so nothing but searches works on them.
"""

from __future__ import annotations

import argparse
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import httpx
import msgspec
import numpy as np

from fluoromap.geometry import Gantry
from fluoromap_service.cli.supervisor import free_port, program
from fluoromap_service.dicom import deterministic_uid, write_cine
from fluoromap_service.dicom.indexed_header import read_run

RUNS_OF_A_STUDY = 8
BATCH = 2000
SMALL = 1000
REQUESTS, AT_ONCE = 5, 8
LONGEST_START_SECONDS = 120.0
SEARCHES = {
    "studies": "studies",
    "studies, page 20": "studies?offset=1900",
    "studies, last page": "studies?offset={last_study}",
    "studies of a patient": "studies?PatientID=P00000123",
    "studies by name": "studies?PatientName=NAME00012*",
    "studies by a part of a name": "studies?PatientName=*GIVEN7",
    "studies without a hit": "studies?PatientName=*nobody*",
    "studies of a week": "studies?StudyDate=20240101-20240107",
    "studies by modality": "studies?ModalitiesInStudy=XA&limit=25&includefield=StudyDescription",
    "studies, all attributes": "studies?includefield=all",
    "series of a modality": "series?Modality=XA&limit=100",
    "instances": "instances",
    "instances by class, last page": "instances?SOPClassUID=1.2.840.10008.5.1.4.1.1.12.1&offset={last_run}",
    "instances, 500": "instances?limit=500",
    "instances of a maker, last page": "instances?Manufacturer=fluoromap&offset={last_run}",
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=100_000, help="Runs of the large archive.")
    parser.add_argument(
        "--database", default="", help="URL of an empty PostgreSQL for the large archive; SQLite without."
    )
    options = parser.parse_args()
    figures: dict[int, dict[str, tuple[float, float]]] = {}
    with tempfile.TemporaryDirectory() as name:
        for runs in (SMALL, options.runs):
            folder = Path(name) / str(runs)
            folder.mkdir()
            database = options.database if runs == options.runs else ""
            environment = os.environ | {"FLUOROMAP_DATA_DIR": str(folder), "FLUOROMAP_DATABASE_URL": database}
            start = time.perf_counter()
            subprocess.run([sys.executable, __file__, "--fill", str(runs)], env=environment, check=True)
            print(f"{runs} runs filled in {time.perf_counter() - start:.0f} s", flush=True)
            with started_api(environment) as address:
                figures[runs] = measure(address, runs, folder)
    large, small = figures[options.runs], figures[SMALL]
    print(f"{'':32} {'median':>8} {'8 at once':>10} {'ratio to ' + str(SMALL):>14}")
    for search, (median, slowest) in large.items():
        print(f"{search:32} {median:6.3f} s {slowest:8.3f} s {median / small[search][0]:14.1f}")


def fill(runs: int) -> None:
    """Store the index rows of simulated runs, as the service stores those of an upload."""
    from fluoromap_service.store import schema
    from fluoromap_service.store.engine import writing
    from fluoromap_service.store.models import DicomObject, DicomValue, File, Instance

    schema.upgrade()
    with tempfile.TemporaryDirectory() as name:
        path = Path(name) / "run.dcm"
        path.write_bytes(make_run(Path(name), 0))
        template = read_run(path)
    changing = ("00080018", "0020000D", "0020000E", "00100020", "00080020", "00100010")
    elements: dict[str, Any] = msgspec.json.decode(template.header.json)
    elements |= {tag: {"vr": elements[tag]["vr"], "Value": [f"<{tag}>"]} for tag in changing}
    header = msgspec.json.encode(elements).decode()
    same = [each for each in template.header.values if each.path not in changing]
    facts = template.facts.to_json()
    with writing() as session:
        session.add(File(sha256="0" * 64))
    for first in range(0, runs, BATCH):
        objects, values, instances = [], [], []
        for number in range(first, min(first + BATCH, runs)):
            study, object_id = number // RUNS_OF_A_STUDY, number + 1
            day = f"{datetime(2015, 1, 1, tzinfo=UTC) + timedelta(days=study % 3650):%Y%m%d}"
            uid, study_uid, series_uid = (
                f"1.2.826.0.{place}.{at}" for place, at in ((1, number), (2, study), (3, number))
            )
            name = f"NAME{study // 2:07}^GIVEN{study % 900}"
            own = dict(zip(changing, (uid, study_uid, series_uid, f"P{study // 2:08}", day, name), strict=True))
            shown = header
            for tag, text in own.items():
                shown = shown.replace(f'"<{tag}>"', f'{{"Alphabetic":"{text}"}}' if tag == "00100010" else f'"{text}"')
            instances.append(
                {
                    "sop_instance_uid": uid, "sha256": "0" * 64, "study_instance_uid": study_uid,
                    "series_instance_uid": series_uid, "facts": facts, "is_indexed": True,
                }
            )  # fmt: skip
            objects.append(
                {
                    "id": object_id, "uid": uid, "study_uid": study_uid, "series_uid": series_uid, "run": uid,
                    "modality": "XA", "sop_class_uid": template.facts.sop_class_uid, "header": shown,
                    "is_whole": True, "unreadable": 0,
                }
            )  # fmt: skip
            values += [
                {"object_id": object_id, "path": each.path, "item": each.item, "first": each.first, "last": each.last}
                for each in same
            ]
            values += [
                {"object_id": object_id, "path": tag, "item": 0, "first": text.casefold() if tag == "00100010" else text,
                 "last": text if tag == "00080020" else None}
                for tag, text in own.items()
            ]  # fmt: skip
        with writing() as session:
            for model, rows in ((Instance, instances), (DicomObject, objects), (DicomValue, values)):
                session.connection().execute(model.__table__.insert(), rows)  # type: ignore[attr-defined]
    with writing() as session:
        if session.get_bind().dialect.name == "postgresql":
            from sqlalchemy import text

            # The rows came with ids; an upload goes on after them.
            session.execute(text("SELECT setval('dicom_object_id_seq', (SELECT max(id) FROM dicom_object))"))


def make_run(folder: Path, number: int) -> bytes:
    """Return a small run as a DICOM file."""
    pixels = np.random.default_rng(number).integers(0, 4096, (4, 256, 256)).astype(np.uint16)
    path = folder / f"{number}.dcm"
    write_cine(
        path,
        iter(pixels),
        frame_count=4,
        gantry=Gantry(30.0, 0.0, 1000.0, 750.0, (0.3, 0.3), 256, 256),
        frame_time_ms=66.7,
        acquired=datetime(2026, 3, 1, tzinfo=UTC) + timedelta(seconds=20 * number),
        study_instance_uid=deterministic_uid("benchmark", "study"),
        series_number=number,
        sop_instance_uid=deterministic_uid("benchmark", "run", str(number)),
    )
    return path.read_bytes()


@contextmanager
def started_api(environment: dict[str, str]) -> Iterator[str]:
    """Start the API and yield its address."""
    port = free_port()
    process = subprocess.Popen(
        [program(), "api", "--port", str(port)], env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    address = f"http://127.0.0.1:{port}"
    try:
        end = time.monotonic() + LONGEST_START_SECONDS
        while True:
            try:
                httpx.get(f"{address}/v1/health").raise_for_status()
                break
            except httpx.HTTPError:
                if time.monotonic() > end or process.poll() is not None:
                    sys.exit("dicomweb: the API did not start")
                time.sleep(0.2)
        yield address
    finally:
        process.terminate()
        process.wait()


def measure(address: str, runs: int, folder: Path) -> dict[str, tuple[float, float]]:
    """Return the times of each search, in seconds.

    They are the median of some requests and the slowest of eight at once.
    """
    last_run = max(runs - 100, 0)
    last_study = max(runs // RUNS_OF_A_STUDY - 100, 0)
    figures = {}
    with httpx.Client(base_url=address, timeout=300.0) as client, ThreadPoolExecutor(AT_ONCE) as threads:

        def ask(path: str) -> float:
            start = time.perf_counter()
            answer = client.get(f"/dicom-web/{path}")
            seconds = time.perf_counter() - start
            if answer.status_code not in (200, 204):
                sys.exit(f"dicomweb: {path}: {answer.status_code} {answer.text}")
            return seconds

        for name, search in SEARCHES.items():
            path = search.format(last_run=last_run, last_study=last_study)
            ask(path)
            median = statistics.median(ask(path) for _ in range(REQUESTS))
            figures[name] = median, max(threads.map(ask, [path] * AT_ONCE))
        figures["upload of a run"] = upload(client, folder)
    return figures


def upload(client: httpx.Client, folder: Path) -> tuple[float, float]:
    """Return the median and the longest time of an upload, in seconds."""
    study = client.post("/v1/studies", json={"label": "benchmark"}).raise_for_status().headers["location"]
    times = []
    for number in range(REQUESTS + 2):
        content = make_run(folder, number)
        start = time.perf_counter()
        client.post(f"{study}/instances", files={"file": ("run.dcm", content, "application/dicom")}).raise_for_status()
        times.append(time.perf_counter() - start)
    # The first upload imports and compiles.
    return statistics.median(times[1:]), max(times[1:])


if __name__ == "__main__":
    if sys.argv[1:2] == ["--fill"]:
        fill(int(sys.argv[2]))
    else:
        main()
