"""The table of commands, what the program imports before a command is called, and the sentences of failures."""

from __future__ import annotations

import errno
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from pydantic import ValidationError

from fluoromap.contracts import Refusal
from fluoromap.reasons import Reason
from fluoromap_service import cli
from fluoromap_service.cli import app, environment
from fluoromap_service.cli.failures import CommandFailed, sentence_of
from fluoromap_service.problem import Problem
from fluoromap_service.settings import Settings, settings
from fluoromap_service.store.disk import NoSpace


@pytest.mark.parametrize("name", app.COMMANDS)
def test_every_command_has_its_module_and_the_help_of_the_table(name: str) -> None:
    assert cli.__file__ is not None
    assert (Path(cli.__file__).parent / "commands" / f"{name.replace('-', '_')}.py").exists()
    assert app.load(name).help.splitlines()[0] == app.COMMANDS[name]


def _loaded_by(module: str) -> set[str]:
    """Return the packages that a new Python has loaded after importing one module."""
    program = f"import sys, {module}; print(*sys.modules)"
    return set(
        subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout.split()
    )


def test_the_program_starts_without_the_packages_that_load_slowly() -> None:
    """Thread limits would come too late for NumPy and numba; the others would delay every command."""
    assert _loaded_by("fluoromap_service.cli.app").isdisjoint({"numpy", "numba", "sqlalchemy", "fastapi", "celery"})


@pytest.mark.parametrize("command", ["api", "worker"])
def test_numba_is_imported_after_the_folder_of_its_kernels_is_set(command: str) -> None:
    assert "numba" not in _loaded_by(f"fluoromap_service.cli.commands.{command}")


@pytest.fixture
def own_environment(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Variables that a test may set freely: they are removed before it and restored after it."""
    names = ("FLUOROMAP_HOST", "FLUOROMAP_PORT", "FLUOROMAP_DATA_DIR", "NUMBA_CACHE_DIR", *environment.THREAD_LIMITS)
    for name in names:
        monkeypatch.setenv(name, "")
        monkeypatch.delenv(name)
    yield
    monkeypatch.undo()
    settings.cache_clear()


@pytest.mark.usefixtures("own_environment")
def test_options_reach_the_settings_and_the_kernels(tmp_path: Path) -> None:
    settings()
    environment.apply_options("127.0.0.2", 8100, tmp_path)
    environment.keep_compiled_kernels()
    assert (settings().host, settings().port, settings().data_dir) == ("127.0.0.2", 8100, tmp_path)
    assert os.environ["NUMBA_CACHE_DIR"] == str(tmp_path / "numba")


@pytest.mark.usefixtures("own_environment")
def test_thread_limits_of_the_user_stay(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "3")
    environment.limit_threads()
    assert [os.environ[name] for name in environment.THREAD_LIMITS] == ["3", "1", "1"]


def _wrong_setting() -> ValidationError:
    with pytest.raises(ValidationError) as caught:
        Settings(port=-1)
    return caught.value


@pytest.mark.parametrize(
    ("error", "sentence"),
    [
        (CommandFailed("Do this."), r"Do this\."),
        (Problem(409, "busy", "Wait."), r"Wait\."),
        (Problem(422, "wrong", "Correct it.", [("row 7", "no number")]), r"Correct it\. \(row 7: no number\)"),
        (OSError(errno.ENOENT, "No such file or directory", "a.csv"), r"a\.csv: No such file or directory\."),
        (OSError(errno.ENOSPC, "No space left on device"), r"The disk is full; .+"),
        (NoSpace(), r"The disk is full; .+"),
        (_wrong_setting(), r"A setting is wrong \(FLUOROMAP_PORT: .+\); correct .+"),
    ],
)
def test_a_failure_is_a_sentence(error: Exception, sentence: str) -> None:
    shown = sentence_of(error)
    assert shown is not None
    assert re.fullmatch(sentence, shown)


@pytest.mark.parametrize("bug", [KeyError("x"), OSError("x"), Refusal(Reason.NO_ELECTRODES)])
def test_a_bug_has_no_sentence(bug: Exception) -> None:
    assert sentence_of(bug) is None


def test_a_problem_ends_the_program_with_1(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    def fail() -> None:
        raise Problem(503, "away", "The service is away; start it.")

    monkeypatch.setattr(app, "program", fail)
    with pytest.raises(SystemExit) as end:
        app.main()
    assert end.value.code == 1
    assert capsys.readouterr().err == "fluoromap: The service is away; start it.\n"
