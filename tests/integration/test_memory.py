"""Memory of API and worker does not grow with the length of a cine."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import psutil
import pytest
from numpy.typing import NDArray
from processes import client_of, environment_of, process, wait_until_ready

from fluoromap.geometry import Gantry
from fluoromap_service.cli.submission import find_files
from fluoromap_service.cli.supervisor import free_port
from fluoromap_service.dicom import write_cine

LARGEST_DIFFERENCE_MIB = 64
PIXELS = 256
"""Rows and columns of a frame. 600 more such frames take 75 MiB, so a process that holds all of them exceeds the limit."""
SHORT = 120

pytestmark = pytest.mark.timeout(900)


def _noise(frames: int) -> Iterator[NDArray[np.uint16]]:
    pattern = np.random.default_rng(1).integers(800, 1200, (PIXELS + 64, PIXELS), dtype=np.uint16)
    for frame in range(frames):
        yield pattern[frame % 64 : frame % 64 + PIXELS]


def _study(folder: Path, frames: int) -> Path:
    """Write a site of two runs of noise, of which the second is short."""
    folder.mkdir()
    for number, (primary_deg, count) in enumerate(((90.0, frames), (0.0, SHORT))):
        write_cine(
            folder / f"{number}.dcm",
            _noise(count),
            frame_count=count,
            gantry=Gantry(primary_deg, 0.0, 1000.0, 500.0, (0.7, 0.7), PIXELS, PIXELS),
            frame_time_ms=1000 / 60,
            acquired=datetime(2026, 1, 5, 9, 0, tzinfo=UTC) + timedelta(minutes=number),
            study_instance_uid=f"2.25.{frames}",
            series_number=number,
            sop_instance_uid=f"2.25.{frames}{number}",
        )
    (folder / "activation_times.csv").write_text("site,lat_ms\nS01,12.5\n")
    return folder


def _peak_mib(pid: int) -> float:
    """Return the largest resident memory, so far, of any process of a tree."""
    root = psutil.Process(pid)
    peaks = []
    for member in (root, *root.children(recursive=True)):
        status = Path(f"/proc/{member.pid}/status").read_text()
        peaks.append(next(int(line.split()[1]) for line in status.splitlines() if line.startswith("VmHWM")) / 1024)
    return max(peaks)


def _peaks_of_a_job(tmp_path: Path, frames: int) -> tuple[float, float]:
    data_dir = tmp_path / f"data-{frames}"
    environment = environment_of(data_dir, FLUOROMAP_WORKERS="1")
    port = free_port()
    with ExitStack() as stack:
        api = stack.enter_context(process("up", "--port", str(port), environment=environment))
        url = f"http://127.0.0.1:{port}"
        wait_until_ready(url, data_dir)
        children = psutil.Process(api.pid).children()
        worker = next(child.pid for child in children if "fluoromap worker" in " ".join(child.cmdline()))
        server = next(child.pid for child in children if "fluoromap api" in " ".join(child.cmdline()))
        client = stack.enter_context(client_of(environment, port))
        study = client.make_study("memory")
        inputs = find_files(_study(tmp_path / f"study-{frames}", frames))
        assert not any(client.upload(study, path).objections for path in inputs.runs)
        assert inputs.activation_times is not None
        client.put_activation_times(study, inputs.activation_times)
        *_, ended = client.follow(client.start_job(study))
        assert ended["state"] == "succeeded"
        points = client.points(ended["id"])
        assert {point["grade"] for point in points} == {"rejected"}
        return _peak_mib(server), _peak_mib(worker)


def test_six_times_the_frames_take_no_more_memory(tmp_path: Path) -> None:
    short, long = _peaks_of_a_job(tmp_path, SHORT), _peaks_of_a_job(tmp_path, 720)
    differences = np.subtract(long, short)
    print(f"peak MiB of API, worker: {SHORT} frames {short}, 720 frames {long}")
    assert (differences <= LARGEST_DIFFERENCE_MIB).all(), (short, long)
