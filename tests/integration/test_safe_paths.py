"""Code in the folder where a user types ``fluoromap``: no process of the program may run it.

The folder holds a trap for every module that the program could import: a file that leaves a mark when Python runs it.
"""

from __future__ import annotations

import importlib.metadata
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from processes import client_of, environment_of, process, wait_until_ready

from fluoromap_service.cli.submission import find_files
from fluoromap_service.cli.supervisor import free_port, program

pytestmark = pytest.mark.timeout(600)

TRAP = """
with open({marks!r}, "a") as marks:
    marks.write(__name__ + "\\n")
raise RuntimeError("a module of the current folder was imported: " + __name__)
"""
SETTINGS = {
    ".env": "FLUOROMAP_DATABASE_URL=sqlite:////nonexistent/trap.sqlite\nFLUOROMAP_PORT=1\nPYTHONPATH=.\n",
    "alembic.ini": "[alembic]\nscript_location = .\nprepend_sys_path = .\nsqlalchemy.url = sqlite:////nonexistent/trap.sqlite\n",
    "fluoromap.toml": "this is no configuration",
    "study.toml": "this is no study",
    "pyproject.toml": "[tool.fluoromap]\nport = 1\n",
    "pyvenv.cfg": "home = /nonexistent\n",
    "logging.ini": "this is no configuration",
}
"""Files by which other programs take settings from the current folder."""
OPTIONAL = ("dl", "DLFCN", "celeryconfig", "sitecustomize", "usercustomize", "env", "fluoromap_plugins")
"""Modules that a library imports only where it finds them."""


@pytest.fixture
def folder(tmp_path: Path) -> Iterator[Path]:
    """Yield a folder of traps; none of them may have run at the end."""
    folder, marks = tmp_path / "downloads", tmp_path / "marks"
    folder.mkdir()
    names = {*sys.stdlib_module_names, *importlib.metadata.packages_distributions(), *OPTIONAL}
    for name in names:
        (folder / f"{name}.py").write_text(TRAP.format(marks=str(marks)))
    for name, content in SETTINGS.items():
        (folder / name).write_text(content)
    yield folder
    assert not marks.exists(), sorted(set(marks.read_text().split()))


def _call(folder: Path, environment: dict[str, str], *arguments: str) -> str:
    answer = subprocess.run(
        [program(), *arguments], cwd=folder, env=environment, stdin=subprocess.DEVNULL, capture_output=True, text=True
    )
    assert answer.returncode == 0, answer.stderr
    return answer.stdout


def _without_safe_path(data_dir: Path, **settings: str) -> dict[str, str]:
    """Return the environment of a user who never set the safe path."""
    environment = environment_of(data_dir, **settings)
    environment.pop("PYTHONSAFEPATH", None)
    return environment


def test_service_runs_nothing_of_the_folder(
    folder: Path, tmp_path: Path, simulated_study: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """API, worker, DICOM listener, sender and the processes that each of them starts, through an upload and a job."""
    configuration = tmp_path / "targets.toml"
    configuration.write_text('[targets.archive]\nkind = "dicomweb"\nurl = "http://127.0.0.1:9/studies"\n')
    environment = _without_safe_path(
        tmp_path / "data",
        FLUOROMAP_CONFIG=str(configuration),
        FLUOROMAP_DICOM_ALLOW="XA_ROOM_1",
        FLUOROMAP_DICOM_PORT=str(free_port()),
    )
    port = free_port()
    monkeypatch.chdir(folder)
    with process("up", "--port", str(port), environment=environment):
        url = f"http://127.0.0.1:{port}"
        wait_until_ready(url, tmp_path / "data")
        inputs = find_files(simulated_study)
        assert inputs.activation_times is not None
        with client_of(environment, port) as client:
            study = client.make_study("traps")
            assert not any(client.upload(study, path).objections for path in inputs.runs[:4])
            client.put_activation_times(study, inputs.activation_times)
            job = list(client.follow(client.start_job(study, {"pipeline": {"segmenter": {"name": "catheter-chain"}}})))
            assert job[-1]["state"] == "succeeded"


def test_commands_run_nothing_of_the_folder(folder: Path, tmp_path: Path) -> None:
    environment = _without_safe_path(tmp_path / "data")
    _call(folder, environment, "db", "upgrade")
    _call(folder, environment, "plugins")
    _call(folder, environment, "token", "create", "--name", "first", "--scope", "write")
    _call(folder, environment, "check")
    _call(folder, environment, "audit", "verify")
    _call(folder, environment, "backup", str(tmp_path / "backup.tar"))
    _call(folder, environment, "simulate", str(tmp_path / "study"), "--sites", "2", "--frames", "8")
    assert "2 of 2 sites" in _call(folder, environment, "run", str(tmp_path / "study"), "--dry-run")


def test_empty_folders_with_the_names_of_modules_do_no_harm(
    folder: Path, tmp_path: Path, simulated_study: Path
) -> None:
    """Python imports an empty folder as a package without members."""
    for trap in folder.glob("*.py"):
        trap.unlink()
        trap.with_suffix("").mkdir()
    answer = _call(folder, _without_safe_path(tmp_path / "data"), "run", str(simulated_study), "--dry-run")
    assert "5 of 5 sites" in answer


def test_an_empty_entry_of_pythonpath_is_not_passed_on(folder: Path, tmp_path: Path) -> None:
    """``PYTHONPATH=$PYTHONPATH:/some/folder`` has an empty entry where the variable was not set; it means the current folder.

    Python itself reads it before the program begins. The processes that the program starts do not.
    """
    for trap in folder.glob("*.py"):
        if trap.stem not in {"numpy", "scipy", "pydicom", "gdcm", "celery", "sqlalchemy"}:
            trap.unlink()
    environment = _without_safe_path(tmp_path / "data") | {"PYTHONPATH": f":{tmp_path}"}
    _call(folder, environment, "simulate", str(tmp_path / "study"), "--sites", "2", "--frames", "8")
    assert "2 of 2 sites" in _call(folder, environment, "run", str(tmp_path / "study"), "--dry-run")


def test_compiling_helper_runs_nothing_of_the_folder(folder: Path, tmp_path: Path) -> None:
    """A program that uses the science alone also starts the process that helps to compile kernels."""
    script = "from fluoromap.segmenter import kernels; raise SystemExit(kernels._start_helper().wait())"
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONSAFEPATH"}
    environment["NUMBA_CACHE_DIR"] = str(tmp_path)
    subprocess.run([sys.executable, "-P", "-c", script], cwd=folder, env=environment, check=False, capture_output=True)
