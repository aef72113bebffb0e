"""Memory and processor time of a running service's processes, read from the kernel (Linux)."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path

SAMPLE_SECONDS = 0.25
_TICKS = os.sysconf("SC_CLK_TCK")


@dataclass
class ProcessFigures:
    """Peak resident memory in MiB and processor seconds of each process below this one, dead ones included.

    Keys are process ids. ``part`` says of which part of the service a process is: "api" or "worker".
    """

    part: dict[int, str] = field(default_factory=dict)
    peak_mib: dict[int, float] = field(default_factory=dict)
    cpu_seconds: dict[int, float] = field(default_factory=dict)

    def sample(self) -> None:
        """Read the present state of all processes below this one."""
        for pid, part in _descendants():
            with suppress(OSError, StopIteration, ValueError):
                status = Path(f"/proc/{pid}/status").read_text().splitlines()
                peak_kib = next(int(line.split()[1]) for line in status if line.startswith("VmHWM"))
                times = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
                self.part[pid] = part
                self.peak_mib[pid] = peak_kib / 1024
                self.cpu_seconds[pid] = (int(times[11]) + int(times[12])) / _TICKS

    def largest_mib(self, part: str) -> float:
        """Return the peak memory of the largest process of a part."""
        return max((self.peak_mib[pid] for pid in self.part if self.part[pid] == part), default=0.0)

    def processor_seconds(self, part: str) -> float:
        """Return the processor seconds of all processes of a part."""
        return sum(self.cpu_seconds[pid] for pid in self.part if self.part[pid] == part)


@contextmanager
def process_figures() -> Iterator[ProcessFigures]:
    """Sample the processes below this one until the block ends."""
    figures, end = ProcessFigures(), threading.Event()

    def watch() -> None:
        while not end.wait(SAMPLE_SECONDS):
            figures.sample()

    watcher = threading.Thread(target=watch, daemon=True)
    watcher.start()
    try:
        yield figures
    finally:
        end.set()
        watcher.join()
        figures.sample()


def _descendants() -> Iterator[tuple[int, str]]:
    """Yield id and part of each process of the service below this one."""
    parents: dict[int, int] = {}
    for folder in Path("/proc").iterdir():
        if folder.name.isdigit():
            with suppress(OSError, IndexError, ValueError):
                parents[int(folder.name)] = int((folder / "stat").read_text().rsplit(")", 1)[1].split()[1])
    for pid in parents:
        line, part = pid, ""
        while line in parents and line != os.getpid():
            with suppress(OSError):
                arguments = Path(f"/proc/{line}/cmdline").read_bytes().split(b"\0")
                part = next((each for each in ("api", "worker") if each.encode() in arguments), part)
            line = parents[line]
        if line == os.getpid() and part:
            yield pid, part
