"""A client that a generator makes of the OpenAPI document computes a study, from the upload to the results."""

from __future__ import annotations

import csv
import importlib
import io
import os
import re
import shutil
import subprocess
import sys
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pydicom
import pytest
from fastapi.testclient import TestClient
from PIL import Image

TOP = Path(__file__).parents[2]
PROGRAM = "openapi-python-client"
PACKAGE = "fluoromap_client"


@pytest.fixture
def generator() -> str:
    """Return the path of the generator, which has an environment of its own; skip without it."""
    found = shutil.which(PROGRAM, path=os.pathsep.join([str(TOP / ".client-generator" / "bin"), os.environ["PATH"]]))
    if found is None:
        pytest.skip(f"no client is generated: {PROGRAM} is not installed; .ci/run installs it")
    return found


@pytest.fixture
def call(generator: str, service: TestClient, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """Generate the client as docs/api.md says; return a function that calls one of its operations."""
    (configuration,) = re.findall(r"^```yaml\n(package_name.*?)```", (TOP / "docs" / "api.md").read_text(), re.S | re.M)
    (tmp_path / "client.yaml").write_text(configuration)
    (tmp_path / "openapi.json").write_bytes(service.get("/v1/openapi.json").content)
    command = [generator, "generate", "--path", "openapi.json", "--config", "client.yaml", "--output-path", "out"]
    answer = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert answer.returncode == 0, answer.stdout + answer.stderr
    # The generator knows no tables as bodies; it sends them as application/octet-stream.
    left_out = re.findall(r"Unsupported content.type ([a-z]+/[a-z0-9.+-]+)", answer.stdout + answer.stderr)
    assert set(left_out) <= {"text/csv"}, answer.stdout
    monkeypatch.syspath_prepend(tmp_path / "out")
    client = importlib.import_module(PACKAGE).Client(base_url="http://127.0.0.1").set_httpx_client(service)

    def call_operation(tag: str, name: str, *arguments: Any, **keywords: Any) -> Any:
        operation = importlib.import_module(f"{PACKAGE}.api.{tag}.{name}")
        answer = operation.sync_detailed(*arguments, client=client, **keywords)
        assert answer.status_code < 300, answer.content
        return answer.parsed

    yield call_operation
    for name in [name for name in sys.modules if name.partition(".")[0] == PACKAGE]:
        del sys.modules[name]


def test_a_generated_client_computes_a_study(call: Any, simulated_study: Path) -> None:
    models, types = (importlib.import_module(f"{PACKAGE}.{name}") for name in ("models", "types"))
    study = call("studies", "create_study", body=models.StudyIn(label="generated client"))
    runs = sorted((simulated_study / "dicom").glob("*.dcm"))
    body = models.UploadInstancesFilesBody(
        file=[types.File(io.BytesIO(run.read_bytes()), run.name, "application/dicom") for run in runs]
    )
    uploaded = call("instances", "upload_instances", study.id, body=body)
    assert (len(uploaded.instances), uploaded.rejected) == (len(runs), [])
    with (simulated_study / "activation_times.csv").open("rb") as table:
        times = call("sites", "put_activation_times", study.id, body=types.File(payload=table))
    assert (times.sites, times.unmatched) == (len(runs) // 2, [])
    job = call("jobs", "create_job", study.id)
    assert call("jobs", "get_job", job.id, wait=1.0).state == "succeeded"

    points = call("results", "get_points", job.id).points
    table = list(csv.DictReader(io.StringIO(call("results", "get_points_csv", job.id))))
    assert [point.site for point in points] == [row["site"] for row in table]
    found = call("results", "get_map", job.id)
    assert np.asarray(found.vertices_mm).shape[1] == 3
    with zipfile.ZipFile(call("results", "get_archive", job.id).payload) as archive:
        assert "report.html" in archive.namelist()
    with zipfile.ZipFile(call("results", "get_dicom", job.id).payload) as archive:
        report = pydicom.dcmread(io.BytesIO(archive.read("report.dcm")))
    assert report.Modality == "SR"
    mesh = call("results", "get_mesh", job.id, models.MeshFormat.STL).payload.read()
    assert len(mesh) == 84 + 50 * int.from_bytes(mesh[80:84], "little")
    (first, *_) = call("results", "list_overlays", job.id).overlays
    picture = Image.open(call("results", "get_overlay", job.id, first.sop_instance_uid).payload)
    assert picture.format == "PNG"
