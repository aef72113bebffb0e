"""``deploy/release.py``: the same bytes from the same commit, and statements that name what they describe.

The locks: no build fetches a package without a hash.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import shutil
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path
from typing import Any

import pytest
from packaging.requirements import Requirement

TOP = Path(__file__).parent.parent
IDENTITY = {
    f"GIT_{who}_{what}": value
    for who in ("AUTHOR", "COMMITTER")
    for what, value in (("NAME", "tests"), ("EMAIL", "tests@example.org"), ("DATE", "2026-03-01T12:00:00Z"))
}


def _git(folder: Path, *arguments: str) -> str:
    command = ["git", "-C", str(folder), "-c", "commit.gpgsign=false", *arguments]
    answer = subprocess.run(command, check=True, env=os.environ | IDENTITY, capture_output=True, text=True)
    return answer.stdout.strip()


@pytest.fixture(scope="module")
def repository(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A repository with one commit: the files of this folder as they are now."""
    folder = tmp_path_factory.mktemp("release") / "repository"
    listed = _git(TOP, "ls-files", "--cached", "--others", "--exclude-standard").splitlines()
    for name in listed:
        if not name.startswith(("tests/", "docs/", "benchmarks/")) and (TOP / name).is_file():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(TOP / name, folder / name)
    _git(folder, "init", "--quiet")
    _git(folder, "add", "--all")
    _git(folder, "commit", "--quiet", "--message", "All files.")
    return folder


def _release(repository: Path, *arguments: object, **environment: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, repository / "deploy" / "release.py", *arguments]
    return subprocess.run(command, env=os.environ | environment, capture_output=True, text=True)


@pytest.fixture(scope="module")
def released(repository: Path) -> Path:
    """The folder of a release, signed by ``key`` beside it where the machine can sign."""
    key, out = repository.parent / "key", repository.parent / "released"
    sign: list[object] = []
    if shutil.which("ssh-keygen") is not None:
        subprocess.run(["ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-f", key], check=True)
        sign = ["--sign", key]
    answer = _release(repository, "--out", out, *sign, TZ="UTC", LC_ALL="C")
    assert answer.returncode == 0, answer.stderr
    return out


def test_two_builds_have_the_same_bytes(repository: Path, released: Path, tmp_path: Path) -> None:
    """Folder, time zone and umask differ, as on the machines of two people."""
    copy, again = tmp_path / "elsewhere" / "clone", tmp_path / "again"
    _git(tmp_path, "clone", "--quiet", str(repository), str(copy))
    umask = os.umask(0o077)
    try:
        answer = _release(copy, "--out", again, TZ="Asia/Tokyo", PYTHONHASHSEED="7")
    finally:
        os.umask(umask)
    assert answer.returncode == 0, answer.stderr
    names = {path.name for path in again.iterdir()}
    assert names == {path.name for path in released.iterdir() if path.suffix != ".sig"}
    assert len(names) == 3
    for name in names:
        assert (released / name).read_bytes() == (again / name).read_bytes(), name


def test_provenance_names_wheel_commit_and_locks(repository: Path, released: Path) -> None:
    statement: dict[str, Any] = json.loads((released / "provenance.json").read_text())
    subjects = {each["name"]: each["digest"]["sha256"] for each in statement["subject"]}
    (wheel,) = released.glob("*.whl")
    assert set(subjects) == {wheel.name, "fluoromap.cdx.json"}
    for name, digest in subjects.items():
        assert hashlib.sha256((released / name).read_bytes()).hexdigest() == digest
    dependencies = statement["predicate"]["buildDefinition"]["resolvedDependencies"]
    digests = {each["name"]: each["digest"] for each in dependencies}
    assert digests["source"] == {"gitCommit": _git(repository, "rev-parse", "HEAD")}
    for lock in ("requirements.lock", "requirements-build.lock"):
        assert digests[lock] == {"sha256": hashlib.sha256((TOP / lock).read_bytes()).hexdigest()}
    assert statement["_type"] == "https://in-toto.io/Statement/v1"
    assert statement["predicateType"] == "https://slsa.dev/provenance/v1"
    names = zipfile.ZipFile(wheel).namelist()
    assert "fluoromap_service/cli/app.py" in names
    assert not [name for name in names if name.startswith(("tests", "benchmarks", "deploy"))]


def test_list_of_components_is_the_lock(released: Path) -> None:
    listed = json.loads((released / "fluoromap.cdx.json").read_text())
    assert (listed["bomFormat"], listed["specVersion"]) == ("CycloneDX", "1.6")
    locked = set(
        re.findall(r"^([a-z0-9._-]+)(?:\[[^]]+])?==([^\s;]+)", (TOP / "requirements.lock").read_text(), re.MULTILINE)
    )
    assert {(each["name"], each["version"]) for each in listed["components"]} == locked
    for each in listed["components"]:
        hashes = [value for link in each["externalReferences"] for value in link.get("hashes", [])]
        assert hashes, each["name"]
        assert each["purl"].startswith(f"pkg:pypi/{each['name']}@{each['version']}")


@pytest.mark.skipif(shutil.which("ssh-keygen") is None, reason="ssh-keygen is not installed; it signs")
def test_signature_holds_and_a_changed_statement_does_not(released: Path, tmp_path: Path) -> None:
    signers = tmp_path / "signers"
    signers.write_text(f"maintainer {(released.parent / 'key.pub').read_text()}")
    command = ["ssh-keygen", "-Y", "verify", "-f", signers, "-I", "maintainer", "-n", "fluoromap",
               "-s", released / "provenance.json.sig"]  # fmt: skip
    content = (released / "provenance.json").read_bytes()
    assert subprocess.run(command, input=content, capture_output=True).returncode == 0
    assert subprocess.run(command, input=content.replace(b"sha256", b"sha512"), capture_output=True).returncode != 0


def test_files_that_are_not_committed_are_refused(repository: Path, tmp_path: Path) -> None:
    clone = tmp_path / "clone"
    _git(tmp_path, "clone", "--quiet", str(repository), str(clone))
    with (clone / "service" / "fluoromap_service" / "settings.py").open("a") as file:
        file.write("\n# changed\n")
    answer = _release(clone, "--out", tmp_path / "out")
    assert answer.returncode == 1
    assert "not committed" in answer.stderr
    assert not list((tmp_path / "out").glob("*"))


def _locked(name: str) -> dict[str, str]:
    content = (TOP / name).read_text()
    return dict(re.findall(r"^([a-z0-9._-]+)(?:\[[^]]+])?==([^\s;\\]+)", content, re.MULTILINE))


def test_the_build_backend_is_locked_with_hashes() -> None:
    project = tomllib.loads((TOP / "pyproject.toml").read_text())
    locked = _locked("requirements-build.lock")
    for wanted in map(Requirement, [*project["build-system"]["requires"], *project["dependency-groups"]["build"]]):
        assert wanted.specifier.contains(locked[wanted.name])
    lock = (TOP / "requirements-build.lock").read_text()
    assert lock.count("==") == len(re.findall(r"==\S+(?: ; .+)? \\\n    --hash=sha256:", lock))


def test_the_locks_agree() -> None:
    """One environment holds the packages of all three."""
    test = _locked("requirements-test.lock")
    for name in ("requirements.lock", "requirements-build.lock"):
        assert {each: version for each, version in _locked(name).items() if test.get(each, version) != version} == {}


@pytest.mark.parametrize("file", ["Dockerfile", "run"])
def test_nothing_is_installed_without_hashes(file: str) -> None:
    text = (TOP / file).read_text().replace("\\\n", " ")
    commands = [command for line in text.splitlines() for command in re.split(r"&&", line) if "pip install" in command]
    commands = [command for command in commands if not command.lstrip().startswith("#")]
    assert len(commands) >= 3
    for command in commands:
        from_lock = "--require-hashes -r" in command
        # The project itself: built without a network, or by a backend that is installed already.
        own = "--no-deps" in command and ("--no-build-isolation" in command or ".whl" in command)
        assert from_lock != own, command


def test_continuous_integration_pins_its_tools() -> None:
    for line in (TOP / ".ci" / "run").read_text().splitlines():
        for package in re.findall(r"pip install (?:--\S+ )*([^-\s]\S*)", line):
            assert "==" in package, line
