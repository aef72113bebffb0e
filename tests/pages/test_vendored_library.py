"""The vendored library is the released one, file by file."""

from __future__ import annotations

import hashlib
import re

from fluoromap_service.api.service.pages import ASSETS


def test_files_have_the_hashes_of_the_notice() -> None:
    folder = ASSETS / "three"
    stated = {
        name: sha256 for sha256, name in re.findall(r"^([0-9a-f]{64})  (\S+)", (folder / "README").read_text(), re.M)
    }
    assert set(stated) == {each.name for each in folder.iterdir()} - {"README", "three.module.min.d.ts"}
    for name, sha256 in stated.items():
        assert hashlib.sha256((folder / name).read_bytes()).hexdigest() == sha256, name
