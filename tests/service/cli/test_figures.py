"""The command ``fluoromap figures``: its files and exit codes; tests of the science cover the figures."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from fluoromap.contracts import Context, Refusal
from fluoromap.paper.figures import PaperFigures
from fluoromap.paper.figures.paper_figures import FigureNumbers
from fluoromap.reasons import Reason
from fluoromap_service.cli import app

FILES = {"figure3.png", "figure4.png", "figure5.png", "figures.json"}


def _made(seed: int, context: Context) -> PaperFigures:
    context.progress(1.0)
    numbers = FigureNumbers(True, seed, 20, 0.5, 4.0, "motion-prior", "smooth-surface", 0.3, 5.0, "S01", ())
    return PaperFigures({number: np.zeros((4, 4, 3), np.uint8) for number in (3, 4, 5)}, numbers)


@pytest.fixture
def call(monkeypatch: pytest.MonkeyPatch) -> Callable[..., int | str | None]:
    monkeypatch.setattr("fluoromap_service.cli.commands.figures.paper_figures", _made)

    def run(*arguments: str) -> int | str | None:
        monkeypatch.setattr(sys, "argv", ["fluoromap", "figures", *arguments])
        with pytest.raises(SystemExit) as end:
            app.main()
        return end.value.code

    return run


def test_files_are_written_replaced_and_named(
    call: Callable[..., int | str | None], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "new" / "figures"
    assert call(str(folder), "--seed", "3") in (None, 0)
    assert {path.name for path in folder.iterdir()} == FILES
    written = capsys.readouterr()
    assert {Path(line).name for line in written.out.splitlines()} == FILES
    assert "simulate, follow" in written.err
    (folder / "notes.txt").write_text("mine")
    before = (folder / "figures.json").read_bytes()
    assert call(str(folder), "--seed", "4") in (None, 0)
    assert (folder / "notes.txt").read_text() == "mine"
    assert (folder / "figures.json").read_bytes() != before


def test_a_folder_that_cannot_be_written_is_reported_in_one_sentence(
    call: Callable[..., int | str | None], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "file"
    file.write_text("")
    for folder in (file, file / "below"):
        assert call(str(folder)) == 1
        shown = capsys.readouterr().err
        assert shown.startswith("fluoromap: ")
        assert shown.count("\n") == 1
        assert str(file) in shown


def test_a_refusal_is_reported_in_a_sentence(
    call: Callable[..., int | str | None],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def refuse(seed: int, context: Context) -> PaperFigures:
        raise Refusal(Reason.TOO_FEW_SITES)

    monkeypatch.setattr("fluoromap_service.cli.commands.figures.paper_figures", refuse)
    assert call(str(tmp_path), "--seed", "8") == 1
    shown = capsys.readouterr().err.splitlines()[-1]
    assert shown.startswith("fluoromap: ")
    assert "8" in shown
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("arguments", [(), ("out", "--seed", "-1"), ("out", "more")])
def test_wrong_usage_ends_with_2(
    arguments: tuple[str, ...],
    call: Callable[..., int | str | None],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    assert call(*arguments) == 2
    assert not list(tmp_path.iterdir())
