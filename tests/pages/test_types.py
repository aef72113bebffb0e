"""The types of the pages' modules, by TypeScript's compiler."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path


def test_modules_have_the_types_they_state(node_modules: Path, tmp_path: Path) -> None:
    options = {"paths": {"three": [str(node_modules / "@types" / "three")]}}
    config = {"extends": str(Path(__file__).parent / "tsconfig.json"), "compilerOptions": options}
    (tmp_path / "tsconfig.json").write_text(json.dumps(config))
    command = [node_modules / ".bin" / "tsc", "-p", tmp_path / "tsconfig.json"]
    answer = subprocess.run(command, capture_output=True, text=True)
    assert answer.returncode == 0, answer.stdout
