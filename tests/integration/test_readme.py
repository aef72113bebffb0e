"""The curl lines of the README, run as they are: with the token that the service made, and with another one."""

from __future__ import annotations

import json
import re
import subprocess
import zipfile
from pathlib import Path

import pytest
from processes import embedded, environment_of, wait_until_ready

from fluoromap_service.cli.supervisor import free_port, program

pytestmark = pytest.mark.timeout(600)

README = Path(__file__).parents[2] / "README.md"
STARTS = {
    "points.csv": b"site,catheter,",
    "chamber.ply": b"ply",
    "overlay.png": b"\x89PNG",
    "report.html": b"<!doctype html>",
    "results.zip": b"PK",
}


def test_curl_lines_work_with_the_token_of_the_folder_and_with_another(simulated_study: Path, tmp_path: Path) -> None:
    block = re.search(r"^```bash\n(HOST=.*?)^```", README.read_text(), re.M | re.S)
    assert block is not None
    lines = block[1]
    assert (lines.count("ask "), lines.count("curl")) == (11, 1)
    (tmp_path / "home").mkdir()
    data_dir = tmp_path / "home" / ".fluoromap"
    environment = environment_of(data_dir)
    port = free_port()
    with embedded(environment, port):
        wait_until_ready(f"http://127.0.0.1:{port}", data_dir)
        _run(lines, port, tmp_path / "own", simulated_study, {"HOME": str(tmp_path / "home")})
        make = [program(), "token", "create", "--name", "readme", "--scope", "read", "--scope", "write"]
        token = subprocess.run(make, env=environment, check=True, capture_output=True, text=True).stdout
        _run(lines, port, tmp_path / "other", simulated_study, {"TOKEN": token.split()[-1]})


def _run(lines: str, port: int, folder: Path, study: Path, more: dict[str, str]) -> None:
    folder.mkdir()
    (folder / "study").symlink_to(study)
    script = "set -eu\n" + lines.replace("127.0.0.1:8000", f"127.0.0.1:{port}")
    environment = {"PATH": "/usr/local/bin:/usr/bin:/bin", **more}
    done = subprocess.run(["bash", "-c", script], cwd=folder, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert re.match(r"(20[01] ){10}", done.stdout)
    ends = [json.loads(line) for line in re.findall(r"^event: job\ndata: (.*)$", done.stdout, re.M)]
    assert ends[-1]["state"] == "succeeded"
    assert {name: (folder / name).read_bytes()[: len(start)].lower() for name, start in STARTS.items()} == {
        name: start.lower() for name, start in STARTS.items()
    }
    assert zipfile.ZipFile(folder / "results.zip").testzip() is None
