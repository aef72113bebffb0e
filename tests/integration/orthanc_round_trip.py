"""The round trip with Orthanc: runs go to it, from it to the listener, and the results come back to it. No person is involved.

Orthanc listens on all addresses, so this program must run in a network namespace of its own. Its arguments are the folder of a
simulated study and a folder for everything else. It prints what Orthanc holds in the end, as JSON, and the seconds from the first
C-STORE until the last result was back.
"""

from __future__ import annotations

import csv
import io
import json
import subprocess
import sys
import time
import zipfile
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, TypeVar

import httpx
import pydicom
from processes import environment_of, process, wait_until_ready
from pydicom.dataset import Dataset

from fluoromap_service.cli.own_token import read_token

PLUGIN = Path("/usr/share/orthanc/plugins/libOrthancDicomWeb.so")
ORTHANC, SERVICE = "http://127.0.0.1:8042", "http://127.0.0.1:8000"
PATIENCE_SECONDS = 600
CONFIGURATION = """
[rules.map]
sites = {sites}

[targets.pacs]
kind = "dicom"
host = "127.0.0.1"
port = 4242
aet = "ORTHANC"

[targets.archive]
kind = "dicomweb"
url = "http://127.0.0.1:8042/dicom-web"
job_ends = []
"""

Value = TypeVar("Value")


def main() -> None:
    study, folder = (Path(argument) for argument in sys.argv[1:])
    subprocess.run(["ip", "link", "set", "lo", "up"], check=True)
    runs = sorted((study / "dicom").glob("*.dcm"))
    with (study / "activation_times.csv").open() as stream:
        times = list(csv.DictReader(stream))
    with ExitStack() as stack:
        client = stack.enter_context(httpx.Client(timeout=120, trust_env=False))
        stack.enter_context(orthanc(folder / "orthanc"))
        stack.enter_context(service(folder, sites=len(times)))
        eventually(lambda: client.get(f"{ORTHANC}/system").status_code == 200)
        wait_until_ready(SERVICE, folder / "data")
        client.headers["Authorization"] = f"Bearer {read_token(folder / 'data')}"
        start = time.monotonic()
        subprocess.run(["storescu", "-aec", "ORTHANC", "127.0.0.1", "4242", *map(str, runs)], check=True)
        (known,) = client.get(f"{ORTHANC}/studies").json()
        client.post(f"{ORTHANC}/modalities/fluoromap/store", json={"Resources": [known]}).raise_for_status()
        send_times(client, times, runs)
        job = eventually(lambda: ended_job(client))
        assert job["state"] == "succeeded", job
        delivery = eventually(lambda: delivered(client, f"{SERVICE}/v1/deliveries?job={job['id']}"))
        seconds = time.monotonic() - start
        again = client.post(f"{SERVICE}/v1/jobs/{job['id']}/deliveries", json={"target": "archive"})
        archived = eventually(lambda: delivered(client, f"{SERVICE}/v1/deliveries?job={job['id']}&target=archive"))
        assert again.status_code == 202
        check_pixels(client, runs, objects_of(client, job["id"]))
        classes = [instance["00080016"]["Value"][0] for instance in found(client, runs[0], {})]
        with_job = {"job": job["id"], "attempts": [delivery["attempts"], archived["attempts"]]}
        print(json.dumps(with_job | {"classes": classes, "seconds": round(seconds, 1)}))


@contextmanager
def orthanc(folder: Path) -> Iterator[None]:
    folder.mkdir()
    configuration = {
        "StorageDirectory": str(folder), "IndexDirectory": str(folder), "HttpPort": 8042, "DicomPort": 4242,
        "DicomAet": "ORTHANC", "DicomCheckCalledAet": True, "RemoteAccessAllowed": False, "AuthenticationEnabled": False,
        "DicomAlwaysAllowStore": True, "DicomAlwaysAllowFind": True, "Plugins": [str(PLUGIN)],
        "DicomModalities": {"fluoromap": ["FLUOROMAP", "127.0.0.1", 11112]},
    }  # fmt: skip
    file = folder / "orthanc.json"
    file.write_text(json.dumps(configuration))
    with (folder / "orthanc.log").open("wb") as log:
        running = subprocess.Popen(["Orthanc", str(file)], stdout=log, stderr=log)
    try:
        yield
    finally:
        running.terminate()
        running.wait(60)


@contextmanager
def service(folder: Path, *, sites: int) -> Iterator[None]:
    configuration = folder / "fluoromap.toml"
    configuration.write_text(CONFIGURATION.format(sites=sites))
    environment = environment_of(
        folder / "data", FLUOROMAP_CONFIG=str(configuration), FLUOROMAP_DICOM_ALLOW="ORTHANC@127.0.0.1",
        FLUOROMAP_LEASE_SECONDS="60",
    )  # fmt: skip
    with process("up", environment=environment):
        yield


def send_times(client: httpx.Client, times: list[dict[str, str]], runs: list[Path]) -> None:
    """Send the table as the recording system does.

    It knows the runs by their series numbers.
    """
    numbers = {path.name: pydicom.dcmread(path, stop_before_pixels=True).SeriesNumber for path in runs}
    (study,) = client.get(f"{SERVICE}/v1/studies").json()["items"]
    rows = [f"{row['site']},{row['lat_ms']},{numbers[row['view_a']]},{numbers[row['view_b']]}" for row in times]
    answer = client.put(
        f"{SERVICE}/v1/studies/{study['id']}/activation-times",
        content="\n".join(["site,lat_ms,view_a,view_b", *rows]),
        headers={"Content-Type": "text/csv"},
    )
    assert answer.json() == {"sites": len(times), "unmatched": []}, answer.text


def ended_job(client: httpx.Client) -> dict[str, Any] | None:
    jobs: list[dict[str, Any]] = client.get(f"{SERVICE}/v1/jobs").json()["items"]
    return jobs[0] if jobs and jobs[0]["finished"] else None


def delivered(client: httpx.Client, url: str) -> dict[str, Any] | None:
    deliveries: list[dict[str, Any]] = client.get(url).json()["items"]
    return deliveries[0] if deliveries and deliveries[0]["state"] == "delivered" else None


def objects_of(client: httpx.Client, job: str) -> dict[str, Dataset]:
    """Return the result objects of a job by their SOP Instance UID."""
    with zipfile.ZipFile(io.BytesIO(client.get(f"{SERVICE}/v1/jobs/{job}/dicom").content)) as archive:
        read = [pydicom.dcmread(io.BytesIO(archive.read(name))) for name in archive.namelist()]
    return {item.SOPInstanceUID: item for item in read}


def check_pixels(client: httpx.Client, runs: list[Path], objects: dict[str, Dataset]) -> None:
    """Check that Orthanc finds every object by QIDO-RS, as it was sent."""
    sent = [pydicom.dcmread(path) for path in runs] + list(objects.values())
    for item in sent:
        (match,) = found(client, runs[0], {"SOPInstanceUID": item.SOPInstanceUID})
        assert match["00080018"]["Value"] == [item.SOPInstanceUID]
        (held,) = client.post(f"{ORTHANC}/tools/lookup", content=item.SOPInstanceUID).json()
        stored = pydicom.dcmread(io.BytesIO(client.get(f"{ORTHANC}/instances/{held['ID']}/file").content))
        assert stored.get("PixelData") == item.get("PixelData")
        assert stored.get("EncapsulatedDocument") == item.get("EncapsulatedDocument")
        assert stored.get("ContentSequence") == item.get("ContentSequence")


def found(client: httpx.Client, run: Path, query: dict[str, str]) -> list[dict[str, Any]]:
    """Return what QIDO-RS of Orthanc finds in the study of a run."""
    study = pydicom.dcmread(run, stop_before_pixels=True).StudyInstanceUID
    answer = client.get(
        f"{ORTHANC}/dicom-web/studies/{study}/instances", params=query, headers={"Accept": "application/dicom+json"}
    )
    instances: list[dict[str, Any]] = answer.json()
    return instances


def eventually(ask: Callable[[], Value]) -> Value:
    """Ask until the answer is true."""
    end = time.monotonic() + PATIENCE_SECONDS
    while time.monotonic() < end:
        try:
            answer = ask()
        except httpx.TransportError:
            answer = None  # type: ignore[assignment]
        if answer:
            return answer
        time.sleep(0.2)
    raise TimeoutError("the round trip did not come to its end; read the logs in its folder")


if __name__ == "__main__":
    main()
