"""Event streams and waiting requests beside a list of studies: what they cost the other callers.

``python benchmarks/streams.py`` starts a private API (SQLite, no worker, so that the job waits) and measures the mean time of
``GET /v1/studies`` alone, beside 300 event streams, and beside 300 requests with ``?wait=20``. Meanwhile another process commits
a change of the job several times a second. The command prints the times and their ratios, and compares these with the limit.
"""

from __future__ import annotations

import argparse
import asyncio
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress

import httpx

LIMIT = 2.0
JOB, STUDY = "1" * 32, "0" * 32


def _fill() -> None:
    from fluoromap_service.store import schema
    from fluoromap_service.store.engine import writing
    from fluoromap_service.store.models import Job, StageRow, Study

    schema.upgrade()
    with writing() as session:
        session.add_all(
            Study(id=f"{number:032x}", label="streams", catheters=[], reference="reference", mapping="mapping")
            for number in range(200)
        )
        session.flush()
        session.add(Job(id=JOB, study_id=STUDY, state="queued", snapshot={"sites": [], "runs": {}}))
        session.flush()
        session.add(
            StageRow(
                job_id=JOB, name="segment", subject="1.2", plugin="p", plugin_version="1", depends_on=[], state="pending"
            )
        )  # fmt: skip


def _change(seconds: float) -> None:
    """Add an event of the job four times a second."""
    from fluoromap_service.store.engine import writing
    from fluoromap_service.store.models import Event

    end = time.monotonic() + seconds
    while time.monotonic() < end:
        with writing() as session:
            session.add(Event(job_id=JOB, kind="stage", data={"name": "segment", "state": "running"}))
        time.sleep(0.25)


@contextmanager
def _server() -> Iterator[str]:
    with socket.create_server(("127.0.0.1", 0)) as probe:
        port = probe.getsockname()[1]
    program = ["-c", "from fluoromap_service.cli.app import main; main()", "api", "--port", str(port)]
    url = f"http://127.0.0.1:{port}"
    server = subprocess.Popen([sys.executable, *program], stderr=subprocess.DEVNULL)
    try:
        while True:
            with suppress(httpx.HTTPError):
                httpx.get(f"{url}/v1/health")
                break
            time.sleep(0.1)
        yield url
    finally:
        server.send_signal(signal.SIGINT)
        server.wait()


async def _hold(url: str, path: str) -> None:
    """Ask again and again, and read everything that comes."""
    host, port = url.removeprefix("http://").split(":")
    while True:
        reader, writer = await asyncio.open_connection(host, int(port))
        try:
            writer.write(f"GET {path} HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n".encode())
            while await reader.read(65536):
                pass
        finally:
            writer.close()


async def _list_seconds(url: str, path: str | None, count: int, seconds: float) -> float:
    """Return the mean time of a list of studies beside ``count`` other requests."""
    others = [asyncio.create_task(_hold(url, path)) for _ in range(count)] if path else []
    async with httpx.AsyncClient(timeout=120) as client:
        (await client.get(f"{url}/v1/studies")).raise_for_status()
        # The connections open first.
        await asyncio.sleep(seconds / 2)
        times, end = [], time.monotonic() + seconds
        while time.monotonic() < end:
            start = time.perf_counter()
            (await client.get(f"{url}/v1/studies")).raise_for_status()
            times.append(time.perf_counter() - start)
            await asyncio.sleep(0.05)
    for other in others:
        other.cancel()
    await asyncio.gather(*others, return_exceptions=True)
    return sum(times) / len(times)


def main() -> int:
    """Measure and compare; return 1 when a ratio exceeds the limit."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=300, help="streams or waiting requests at once")
    parser.add_argument("--seconds", type=float, default=10.0, help="length of each measurement")
    parser.add_argument("--change", type=float, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.change:
        _change(options.change)
        return 0
    with tempfile.TemporaryDirectory() as folder:
        os.environ["FLUOROMAP_DATA_DIR"] = folder
        _fill()
        change = [sys.executable, __file__, "--change", str(6 * options.seconds)]
        with _server() as url, subprocess.Popen(change) as changing:
            paths = {"alone": None, "streams": f"/v1/jobs/{JOB}/events", "waiting": f"/v1/jobs/{JOB}?wait=20"}
            means = {
                name: asyncio.run(_list_seconds(url, path, options.count, options.seconds))
                for name, path in paths.items()
            }
            changing.terminate()
    for name, mean in means.items():
        print(f"list of studies, {name}: {1000 * mean:.1f} ms, ratio {mean / means['alone']:.2f}")
    return int(max(means.values()) > LIMIT * means["alone"])


if __name__ == "__main__":
    sys.exit(main())
