"""The program ``fluoromap``, called in this process."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from program import Answer, Program

from fluoromap_service.cli import app
from fluoromap_service.settings import settings


@pytest.fixture
def fluoromap(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Iterator[Program]:
    """Yield a function that calls the program's entry point on an empty data folder."""
    for name in [name for name in os.environ if name.startswith("FLUOROMAP_") and "BROKER" not in name]:
        monkeypatch.delenv(name)
    monkeypatch.setenv("FLUOROMAP_DATA_DIR", str(tmp_path / "data"))
    monkeypatch.setenv("COLUMNS", "200")
    monkeypatch.chdir(tmp_path)

    def run(*arguments: str, **more: str) -> Answer:
        code: object = 0
        with monkeypatch.context() as patched:
            patched.setattr(sys, "argv", ["fluoromap", *arguments])
            for name, value in more.items():
                patched.setenv(name, value)
            settings.cache_clear()
            try:
                app.main()
            except SystemExit as end:
                code = end.code or 0
        written = capsys.readouterr()
        assert isinstance(code, int)
        return Answer(code, written.out, written.err)

    before = dict(os.environ)
    yield run
    # Commands store their options in the environment.
    os.environ.clear()
    os.environ.update(before)
    settings.cache_clear()
