"""Build a release: wheel, list of components, provenance and signature.

Run ``python deploy/release.py`` in an environment made from ``requirements-test.lock`` and ``requirements-build.lock``. It builds
from the last commit, never from files that are not committed, and writes into ``dist/``:

- the wheel: every build of one commit has the same bytes;
- ``fluoromap.cdx.json``: the packages of ``requirements.lock`` with their hashes, in the form CycloneDX 1.6;
- ``provenance.json``: hashes of wheel and list, of the commit and of the locks, as an in-toto statement v1 with the predicate
  SLSA provenance v1;
- ``provenance.json.sig`` with ``--sign KEY``: a signature by that SSH key.
"""

from __future__ import annotations

import argparse
import hashlib
import importlib.metadata
import json
import os
import platform
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

TOP = Path(__file__).resolve().parent.parent
LOCKS = ("requirements.lock", "requirements-build.lock")
COMPONENTS = "fluoromap.cdx.json"
PROVENANCE = "provenance.json"
STATEMENT_TYPE = "https://in-toto.io/Statement/v1"
PREDICATE_TYPE = "https://slsa.dev/provenance/v1"
BUILD_TYPE = "https://packaging.python.org/en/latest/specifications/binary-distribution-format/"


def main() -> int:
    """Build the release and print its files with their hashes."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("dist"), help="Folder of the release.")
    parser.add_argument("--sign", type=Path, metavar="KEY", help="Private SSH key that signs the provenance.")
    options = parser.parse_args()
    if _git("status", "--porcelain", "--untracked-files=no"):
        print("release: there are changes that are not committed; commit or undo them first.", file=sys.stderr)
        return 1
    out: Path = options.out.resolve()
    out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        source = Path(folder) / "fluoromap"
        _check_out(source)
        wheel = _build(source, out)
        _list_components(source, out / COMPONENTS)
        statement = _provenance(source, [wheel, out / COMPONENTS])
    (out / PROVENANCE).write_text(json.dumps(statement, indent=2, sort_keys=True) + "\n")
    if options.sign is not None:
        (out / f"{PROVENANCE}.sig").unlink(missing_ok=True)
        command = ["ssh-keygen", "-q", "-Y", "sign", "-f", options.sign, "-n", "fluoromap", out / PROVENANCE]
        subprocess.run(command, check=True, capture_output=True)
    for path in (wheel, out / COMPONENTS, out / PROVENANCE):
        print(f"{_sha256(path)}  {path}")
    return 0


def _git(*arguments: str) -> str:
    answer = subprocess.run(["git", "-C", TOP, *arguments], check=True, capture_output=True, text=True)
    return answer.stdout.strip()


def _check_out(source: Path) -> None:
    """Copy the files of the last commit into a new folder."""
    archive = source.with_suffix(".tar")
    _git("archive", "--format=tar", f"--output={archive}", "HEAD")
    source.mkdir()
    subprocess.run(["tar", "--extract", f"--file={archive}", f"--directory={source}"], check=True)


def _build(source: Path, out: Path) -> Path:
    # The archive of a wheel holds times; this variable gives all files that of the commit.
    environment = os.environ | {"SOURCE_DATE_EPOCH": _git("show", "--no-patch", "--format=%ct", "HEAD")}
    command = [sys.executable, "-P", "-m", "hatchling", "build", "--target", "wheel", "--directory", source / "dist"]
    subprocess.run(command, cwd=source, env=environment, check=True, capture_output=True)
    (built,) = (source / "dist").iterdir()
    return Path(shutil.copyfile(built, out / built.name))


def _list_components(source: Path, file: Path) -> None:
    command = [
        sys.executable, "-P", "-m", "cyclonedx_py", "requirements", "--pyproject", source / "pyproject.toml",
        "--output-reproducible", "--spec-version", "1.6", "--output-format", "JSON", "--output-file", file,
        source / "requirements.lock",
    ]  # fmt: skip
    subprocess.run(command, check=True, capture_output=True)


def _provenance(source: Path, products: list[Path]) -> dict[str, Any]:
    """Return the statement about the origin of the products.

    References
    ----------
    in-toto Attestation Framework, Statement v1; SLSA, Provenance v1.
    """
    commit = _git("rev-parse", "HEAD")
    locks = [{"name": name, "digest": {"sha256": _sha256(source / name)}} for name in LOCKS]
    tools = {name: importlib.metadata.version(name) for name in ("hatchling", "cyclonedx-bom")}
    return {
        "_type": STATEMENT_TYPE,
        "subject": [{"name": path.name, "digest": {"sha256": _sha256(path)}} for path in products],
        "predicateType": PREDICATE_TYPE,
        "predicate": {
            "buildDefinition": {
                "buildType": BUILD_TYPE,
                "externalParameters": {"command": ["python", "deploy/release.py"], "commit": commit},
                "resolvedDependencies": [{"name": "source", "digest": {"gitCommit": commit}}, *locks],
            },
            "runDetails": {
                "builder": {
                    "id": "deploy/release.py",
                    "version": {"python": platform.python_version(), "system": platform.system(), **tools},
                }
            },
        },
    }


def _sha256(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


if __name__ == "__main__":
    sys.exit(main())
