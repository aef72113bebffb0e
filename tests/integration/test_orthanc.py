"""The round trip with a real PACS, where Orthanc and dcmtk are installed."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest
from orthanc_round_trip import PLUGIN
from pydicom.uid import (
    Comprehensive3DSRStorage,
    EncapsulatedSTLStorage,
    MultiFrameTrueColorSecondaryCaptureImageStorage,
    XRayAngiographicImageStorage,
)

HERE = Path(__file__).parent
# A namespace without other machines: root makes one at once, another user as root of a user namespace.
ALONE = ["unshare", "-n"] if os.geteuid() == 0 else ["unshare", "-rn"]

pytestmark = pytest.mark.timeout(900)


@pytest.fixture
def orthanc() -> None:
    """Skip where the round trip is impossible."""
    missing = [name for name in ("Orthanc", "storescu", "ip", "unshare") if shutil.which(name) is None]
    if missing or not PLUGIN.exists():
        pytest.skip(f"not installed: {' '.join(missing) or PLUGIN.name}; install orthanc, orthanc-dicomweb and dcmtk")
    if subprocess.run([*ALONE, "true"], capture_output=True).returncode != 0:
        pytest.skip("this user cannot make a network namespace, and Orthanc listens on all addresses")


@pytest.mark.usefixtures("orthanc")
def test_ten_runs_become_results_in_orthanc(simulated_study: Path, tmp_path: Path) -> None:
    paths = [HERE, *sys.path]
    answer = subprocess.run(
        [*ALONE, sys.executable, HERE / "orthanc_round_trip.py", simulated_study, tmp_path],
        env=os.environ | {"PYTHONPATH": os.pathsep.join(map(str, paths))}, capture_output=True, text=True,
    )  # fmt: skip
    assert answer.returncode == 0, answer.stderr
    held = json.loads(answer.stdout.splitlines()[-1])
    assert Counter(held["classes"]) == {
        XRayAngiographicImageStorage: 10,
        Comprehensive3DSRStorage: 1,
        MultiFrameTrueColorSecondaryCaptureImageStorage: 2,
        EncapsulatedSTLStorage: 1,
    }
    assert held["attempts"] == [1, 1]
