"""The service under load: readers, uploads and queued jobs at once, beside a bare FastAPI route.

``python benchmarks/load.py`` starts a private API (SQLite, no worker, so that the queued jobs wait), fills its table of jobs and
measures, with clients in a process of their own:

1. readers against a bare FastAPI route that answers as many bytes as the service's routes do on average;
2. the same readers against the service, beside uploaders and queued jobs;
3. an upload of 5 MB beside them;
4. a page of ``GET /v1/jobs`` alone, with all jobs in the table.

It prints the figures and compares them with the limits. ``--seconds 300`` is the full run.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Awaitable, Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import httpx
import numpy as np

READ_RATIO = 5.0
UPLOAD_SECONDS = 3.0
PAGE_MS = 100.0
BARE = """
import sys
from fastapi import FastAPI, Response
import uvicorn

content = b"x" * int(sys.argv[2])
app = FastAPI()

@app.get("/")
def bare() -> Response:
    return Response(content, media_type="application/json")

uvicorn.run(app, port=int(sys.argv[1]), log_level="error")
"""


@dataclass
class Timings:
    """Durations of requests in seconds, and the number of failed ones."""

    seconds: list[float] = field(default_factory=list)
    errors: int = 0
    bytes: int = 0

    def percentile(self, share: float) -> float:
        """Return a percentile in seconds."""
        return float(np.percentile(self.seconds, share)) if self.seconds else float("nan")


async def _request(address: tuple[str, int], head: str, body: bytes = b"") -> tuple[int, bytes]:
    """Send one request on a new connection; return status and body."""
    reader, writer = await asyncio.open_connection(*address)
    try:
        writer.write(f"{head}\r\nHost: localhost\r\nConnection: close\r\nContent-Length: {len(body)}\r\n\r\n".encode())
        writer.write(body)
        await writer.drain()
        answer = await reader.read()
    finally:
        writer.close()
    header, _, content = answer.partition(b"\r\n\r\n")
    return int(header[9:12] or 0), content


async def _repeat(send: Callable[[], Awaitable[tuple[int, bytes]]], end: float, pause: float, into: Timings) -> None:
    while time.monotonic() < end:
        start = time.monotonic()
        try:
            status, content = await send()
        except OSError:
            status, content = 0, b""
        into.seconds.append(time.monotonic() - start)
        into.errors += not 200 <= status < 300
        into.bytes += len(content)
        await asyncio.sleep(pause)


def _reader(address: tuple[str, int], paths: Sequence[str], number: int) -> Callable[[], Awaitable[tuple[int, bytes]]]:
    turn = number

    async def send() -> tuple[int, bytes]:
        nonlocal turn
        turn += 1
        return await _request(address, f"GET {paths[turn % len(paths)]} HTTP/1.1")

    return send


def _uploader(
    address: tuple[str, int], path: str, files: Sequence[bytes]
) -> Callable[[], Awaitable[tuple[int, bytes]]]:
    turn = 0

    async def send() -> tuple[int, bytes]:
        nonlocal turn
        turn += 1
        head = f"POST {path} HTTP/1.1\r\nContent-Type: application/dicom"
        return await _request(address, head, files[turn % len(files)])

    return send


async def _read(address: tuple[str, int], paths: Sequence[str], readers: int, seconds: float, pause: float) -> Timings:
    timings, end = Timings(), time.monotonic() + seconds
    sends = (_reader(address, paths, number) for number in range(readers))
    await asyncio.gather(*(_repeat(send, end, pause, timings) for send in sends))
    return timings


async def _read_and_upload(
    address: tuple[str, int], plan: dict[str, Any], small: Sequence[bytes], large: bytes
) -> dict[str, Timings]:
    reads, uploads, single = Timings(), Timings(), Timings()
    end = time.monotonic() + plan["seconds"]
    tasks = [
        _repeat(_reader(address, plan["paths"], number), end, plan["pause"], reads) for number in range(plan["readers"])
    ]
    tasks += [
        _repeat(_uploader(address, plan["upload"], small), end, plan["pause"], uploads)
        for _ in range(plan["uploaders"])
    ]
    tasks.append(_repeat(_uploader(address, plan["upload"], [large]), end, 1.0, single))
    await asyncio.gather(*tasks)
    return {"reads": reads, "uploads": uploads, "single": single}


def _runs(folder: Path) -> tuple[list[bytes], bytes]:
    """Return small DICOM files, and one of about 5 MB."""
    from fluoromap.geometry import Gantry
    from fluoromap_service.dicom import deterministic_uid, write_cine

    def run(number: int, frames: int, size: int) -> bytes:
        path = folder / "run.dcm"
        pixels = np.random.default_rng(number).integers(0, 4096, (frames, size, size)).astype(np.uint16)
        write_cine(
            path, iter(pixels), frame_count=frames, gantry=Gantry(0.0, 0.0, 1000.0, 750.0, (0.3, 0.3), size, size),
            frame_time_ms=66.7, acquired=datetime(2026, 3, 1, tzinfo=UTC), study_instance_uid=deterministic_uid("load"),
            series_number=number, sop_instance_uid=deterministic_uid("load", str(number)),
        )  # fmt: skip
        return path.read_bytes()

    return [run(number, 3, 64) for number in range(1, 6)], run(100, 10, 512)


def _fill(queued: int, ended: int, sites: int) -> str:
    """Add a study with queued and ended jobs; return its id."""
    from sqlalchemy import insert

    from fluoromap_service.store import schema
    from fluoromap_service.store.engine import writing
    from fluoromap_service.store.models import Job, StageRow, Study

    schema.upgrade()
    now = time.time()
    snapshot = {"sites": [], "runs": {f"1.2.{n}": {"facts": {"text": "x" * 400}} for n in range(2 * sites)}}
    with writing() as session:
        session.add(Study(id="0" * 32, label="load", catheters=[], reference="reference", mapping="mapping"))
        session.flush()
        for first in range(0, ended, 5000):
            rows = [
                {
                    "id": f"{n:032x}", "study_id": "0" * 32, "state": "succeeded", "snapshot": {},
                    "created": now - 10 - n, "finished": now,
                }
                for n in range(first, min(first + 5000, ended))
            ]  # fmt: skip
            session.execute(insert(Job), rows)
        for number in range(queued):
            job = f"{10**9 + number:032x}"
            session.execute(
                insert(Job),
                [
                    {
                        "id": job,
                        "study_id": "0" * 32,
                        "state": "queued",
                        "snapshot": snapshot,
                        "created": now - number / 1000,
                    }
                ],
            )
            stages = [
                {"job_id": job, "name": "segment", "subject": f"1.2.{n}", "plugin": "p", "plugin_version": "1",
                 "depends_on": [], "state": "pending"}
                for n in range(2 * sites)
            ]  # fmt: skip
            session.execute(insert(StageRow), stages)
    return "0" * 32


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@contextmanager
def _server(arguments: list[str], port: int, path: str) -> Iterator[tuple[str, int]]:
    process = subprocess.Popen([sys.executable, *arguments], stderr=subprocess.DEVNULL)
    try:
        end = time.monotonic() + 120
        while time.monotonic() < end:
            try:
                if httpx.get(f"http://127.0.0.1:{port}{path}", trust_env=False).status_code < 500:
                    break
            except httpx.HTTPError:
                time.sleep(0.1)
        yield "127.0.0.1", port
    finally:
        process.send_signal(signal.SIGTERM)
        process.wait(30)


def main() -> int:
    """Run the benchmark and print its figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--readers", type=int, default=200)
    parser.add_argument("--uploaders", type=int, default=20)
    parser.add_argument("--queued", type=int, default=50)
    parser.add_argument("--jobs", type=int, default=100_000)
    parser.add_argument("--pause", type=float, default=1.0, help="seconds that a reader waits between two requests")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        os.environ |= {"FLUOROMAP_DATA_DIR": name, "FLUOROMAP_DATABASE_URL": "", "FLUOROMAP_BROKER_URL": ""}
        return _measure(options, Path(name))


def _measure(options: argparse.Namespace, folder: Path) -> int:
    study = _fill(options.queued, options.jobs, 200)
    small, large = _runs(folder)
    port, bare_port = _free_port(), _free_port()
    program = ["-c", "from fluoromap_service.cli.app import main; main()", "api", "--port", str(port)]
    with _server(program, port, "/v1/ready?") as address:
        upload = f"/v1/studies/{study}/instances"
        with httpx.Client(base_url=f"http://127.0.0.1:{port}", trust_env=False, timeout=120) as client:
            for content in (*small, large):
                answer = client.post(upload, content=content, headers={"Content-Type": "application/dicom"})
                assert answer.status_code == 201, answer.text
            uid = answer.json()["instances"][0]["sop_instance_uid"]
            paths = [f"/v1/studies/{study}", "/v1/jobs?limit=10", f"{upload}/{uid}", f"/v1/studies/{study}/sites"]
            sizes = [len(client.get(path).content) for path in paths]
            pages = []
            cursor = ""
            for _ in range(30):
                start = time.monotonic()
                page = client.get(f"/v1/jobs?limit=50{cursor}")
                pages.append(time.monotonic() - start)
                cursor = f"&cursor={page.json()['next']}"
            first_page_bytes = len(client.get("/v1/jobs?limit=50").content)
        plan = {
            "seconds": options.seconds, "readers": options.readers, "uploaders": options.uploaders, "paths": paths,
            "pause": options.pause, "upload": upload,
        }  # fmt: skip
        loaded = asyncio.run(_read_and_upload(address, plan, small, large))
    with _server(["-c", BARE, str(bare_port), str(sum(sizes) // len(sizes))], bare_port, "/") as address:
        bare = asyncio.run(_read(address, ["/"], options.readers, options.seconds / 2, options.pause))
    reads, uploads, single = loaded["reads"], loaded["uploads"], loaded["single"]
    errors = reads.errors + uploads.errors + single.errors + bare.errors
    ratio = reads.percentile(95) / bare.percentile(95)
    page_ms = 1000 * float(np.median(pages))
    report = {
        "errors": errors,
        "bare_p50_ms": 1000 * bare.percentile(50), "bare_p95_ms": 1000 * bare.percentile(95), "bare_reads": len(bare.seconds),
        "read_p50_ms": 1000 * reads.percentile(50), "read_p95_ms": 1000 * reads.percentile(95), "reads": len(reads.seconds),
        "read_p95_to_bare": ratio,
        "small_upload_p95_s": uploads.percentile(95), "uploads": len(uploads.seconds),
        "upload_5_mb_p50_s": single.percentile(50), "upload_5_mb_max_s": single.percentile(100), "upload_5_mb": len(single.seconds),
        "page_of_50_median_ms": page_ms, "page_of_50_max_ms": 1000 * max(pages), "page_of_50_bytes": first_page_bytes,
    }  # fmt: skip
    print(json.dumps({name: round(value, 2) for name, value in report.items()}, indent=1))
    failed = [
        name
        for name, good in {
            "errors": errors == 0,
            "reads": ratio <= READ_RATIO,
            "upload": single.percentile(95) <= UPLOAD_SECONDS,
            "page": page_ms <= PAGE_MS,
        }.items()
        if not good
    ]
    print("all limits are kept" if not failed else f"limits not kept: {', '.join(failed)}")
    return int(bool(failed))


if __name__ == "__main__":
    sys.exit(main())
