"""C-STORE and STOW-RS into fluoromap, side by side with Orthanc: the same files, the same machine, the same run.

``python benchmarks/ingest.py`` makes runs of 16 MB, sends them with dcmtk's ``storescu`` and one HTTP client, in turn to both, and
prints for each door the throughput, the processor seconds of the receiver and the growth of its memory. ``--rounds 8`` sends
2 GiB through each door. It needs Orthanc with its DICOMweb plugin, and dcmtk. It runs in a network namespace of its own, because
Orthanc listens on all addresses.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from http.client import HTTPConnection
from pathlib import Path

import numpy as np
import psutil

from fluoromap.geometry import Gantry
from fluoromap_service.cli.supervisor import program
from fluoromap_service.dicom import deterministic_uid, write_cine

PLUGIN = "/usr/share/orthanc/plugins/libOrthancDicomWeb.so"
FILES, FRAMES, SIZE = 16, 32, 512
LONGEST_START_SECONDS = 120.0
MIB = 2**20


@dataclass
class Receiver:
    """A program that receives: the port of its door, and its processes."""

    name: str
    port: int
    process: psutil.Process
    sent_bytes: int = 0
    wall_seconds: float = 0.0
    cpu_seconds: float = 0.0
    first_bytes: int = 0
    largest_bytes: int = 0

    def processes(self) -> list[psutil.Process]:
        return [self.process, *self.process.children(recursive=True)]

    def cpu_now(self) -> float:
        return sum(sum(process.cpu_times()[:2]) for process in self.processes())

    @contextmanager
    def measured(self, size: int) -> Iterator[None]:
        """Add a block in which so many bytes arrive."""
        stop = threading.Event()
        self.first_bytes = self.first_bytes or self.process.memory_info().rss

        def watch() -> None:
            while not stop.wait(0.05):
                self.largest_bytes = max(self.largest_bytes, self.process.memory_info().rss)

        watcher = threading.Thread(target=watch)
        watcher.start()
        cpu, start = self.cpu_now(), time.perf_counter()
        try:
            yield
        finally:
            self.wall_seconds += time.perf_counter() - start
            self.cpu_seconds += self.cpu_now() - cpu
            self.sent_bytes += size
            stop.set()
            watcher.join()

    @property
    def mib_a_second(self) -> float:
        return self.sent_bytes / MIB / self.wall_seconds

    def line(self) -> str:
        growth = (self.largest_bytes - self.first_bytes) / MIB
        return (
            f"{self.name:22} {self.mib_a_second:8.1f} MiB/s   {1024 * MIB * self.cpu_seconds / self.sent_bytes:6.2f} "
            f"processor s/GiB   memory of the process +{max(growth, 0.0):.0f} MiB"
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=4, help="Rounds of 16 files through each door.")
    parser.add_argument("--alone", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if not options.alone:
        missing = [name for name in ("Orthanc", "storescu", "unshare", "ip") if shutil.which(name) is None]
        if missing:
            sys.exit(f"ingest: install {', '.join(missing)} first")
        namespace = ["unshare", "-n"] if os.geteuid() == 0 else ["unshare", "-rn"]
        os.execvp("unshare", [*namespace, sys.executable, *sys.argv, "--alone"])
    subprocess.run(["ip", "link", "set", "lo", "up"], check=True)
    with tempfile.TemporaryDirectory() as name, ExitStack() as stack:
        folder = Path(name)
        template = make_run(folder)
        doors = start_receivers(stack, folder)
        for number in range(-1, options.rounds):
            for door in ("C-STORE", "STOW-RS"):
                files = make_round(folder, template, f"{door}-{number}")
                for receiver in doors[door] if number % 2 else reversed(doors[door]):
                    # The first round compiles and imports; it does not count.
                    with receiver.measured(sum(file.stat().st_size for file in files)):
                        send_by_c_store(receiver.port, files) if door == "C-STORE" else send_by_stow(
                            receiver.port, files
                        )
                    if number < 0:
                        receiver.sent_bytes, receiver.wall_seconds, receiver.cpu_seconds = 0, 0.0, 0.0
                        receiver.first_bytes = receiver.largest_bytes = receiver.process.memory_info().rss
                for file in files:
                    file.unlink()
        for door, receivers in doors.items():
            print(f"{door}, {receivers[0].sent_bytes / MIB:.0f} MiB")
            for receiver in receivers:
                print(f"  {receiver.line()}")
            print(f"  fluoromap : Orthanc = {receivers[0].mib_a_second / receivers[1].mib_a_second:.2f}")


def make_run(folder: Path) -> bytes:
    """Return a run of 16 MB as a DICOM file."""
    pixels = np.random.default_rng(0).integers(0, 4096, (FRAMES, SIZE, SIZE)).astype(np.uint16)
    path = folder / "template.dcm"
    write_cine(
        path,
        iter(pixels),
        frame_count=FRAMES,
        gantry=Gantry(30.0, 0.0, 1000.0, 750.0, (0.3, 0.3), SIZE, SIZE),
        frame_time_ms=66.7,
        acquired=datetime(2026, 3, 1, tzinfo=UTC),
        study_instance_uid=uid("study"),
        series_number=1,
        sop_instance_uid=uid("template"),
    )
    content = path.read_bytes()
    path.unlink()
    return content


def uid(name: str) -> str:
    """Return a UID that has the same length for every name."""
    return deterministic_uid("ingest", name)[:36].ljust(36, "1")


def make_round(folder: Path, template: bytes, name: str) -> list[Path]:
    """Write the files of a round.

    They have the same pixels under new UIDs, in a study of their own.
    """
    files = []
    for number in range(FILES):
        content = template.replace(uid("template").encode(), uid(f"{name}-{number}").encode())
        files.append(folder / f"{name}-{number}.dcm")
        files[-1].write_bytes(content.replace(uid("study").encode(), uid(name).encode()))
    return files


def start_receivers(stack: ExitStack, folder: Path) -> dict[str, list[Receiver]]:
    environment = {key: value for key, value in os.environ.items() if not key.startswith("FLUOROMAP_")}
    environment |= {"FLUOROMAP_DATA_DIR": str(folder / "data")}
    subprocess.run([program(), "db", "upgrade"], env=environment, check=True)
    configuration = {
        "StorageDirectory": str(folder / "orthanc"), "IndexDirectory": str(folder / "orthanc"), "HttpPort": 8042, "DicomPort": 4242,
        "DicomAet": "FLUOROMAP", "DicomAlwaysAllowStore": True, "AuthenticationEnabled": False, "Plugins": [PLUGIN],
    }  # fmt: skip
    (folder / "orthanc.json").write_text(json.dumps(configuration))
    commands = {
        "api": [program(), "api"],
        "listener": [program(), "dicom-listener", "--allow", "STORESCU"],
        "orthanc": ["Orthanc", str(folder / "orthanc.json")],
    }
    running = {}
    for name, command in commands.items():
        with (folder / f"{name}.log").open("wb") as log:
            child = subprocess.Popen(command, env=environment, stdout=log, stderr=log)
        stack.callback(child.wait, 60)
        stack.callback(child.terminate)
        running[name] = psutil.Process(child.pid)
    for port in (8000, 11112, 4242, 8042):
        wait_for(port)
    return {
        "C-STORE": [Receiver("fluoromap", 11112, running["listener"]), Receiver("Orthanc", 4242, running["orthanc"])],
        "STOW-RS": [Receiver("fluoromap", 8000, running["api"]), Receiver("Orthanc", 8042, running["orthanc"])],
    }


def wait_for(port: int) -> None:
    end = time.monotonic() + LONGEST_START_SECONDS
    while not any(
        connection.status == "LISTEN" and connection.laddr.port == port for connection in psutil.net_connections("tcp")
    ):
        if time.monotonic() > end:
            sys.exit(f"ingest: nothing listens on port {port}")
        time.sleep(0.1)


def send_by_c_store(port: int, files: list[Path]) -> None:
    subprocess.run(["storescu", "-aec", "FLUOROMAP", "127.0.0.1", str(port), *map(str, files)], check=True)


def send_by_stow(port: int, files: list[Path]) -> None:
    connection = HTTPConnection("127.0.0.1", port, timeout=600)
    for file in files:
        head = b"--edge\r\nContent-Type: application/dicom\r\n\r\n"
        content = b"".join((head, file.read_bytes(), b"\r\n--edge--\r\n"))
        kind = 'multipart/related; type="application/dicom"; boundary=edge'
        headers = {"Content-Type": kind, "Accept": "application/dicom+json"}
        connection.request("POST", "/dicom-web/studies", content, headers)
        answer = connection.getresponse()
        text = answer.read()
        if answer.status != 200:
            sys.exit(f"ingest: port {port} answered {answer.status}: {text[:500]!r}")
    connection.close()


if __name__ == "__main__":
    main()
