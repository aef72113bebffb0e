"""The command line: what it answers, and with which exit code."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

import pytest

from fluoromap.supervisor import program


@pytest.fixture
def fluoromap(tmp_path: Path):
    """Runs the installed program on an empty data folder."""
    kept = {key: value for key, value in os.environ.items() if not key.startswith("FLUOROMAP_")}
    environment = kept | {"FLUOROMAP_DATA_DIR": str(tmp_path / "data"), "COLUMNS": "200"}

    def run(*arguments: str, **more: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [program(), *arguments], env=environment | more, capture_output=True, text=True, cwd=tmp_path, timeout=120
        )

    return run


def _one_sentence(answer: subprocess.CompletedProcess[str], code: int = 1) -> str:
    assert answer.returncode == code, answer.stderr
    assert answer.stderr.startswith("fluoromap: ")
    assert answer.stderr.count("\n") == 1
    assert "Traceback" not in answer.stderr
    return answer.stderr


def test_token_is_shown_once_and_never_listed(fluoromap) -> None:
    made = fluoromap("token", "create", "--name", "viewer", "--scope", "read", "--scope", "write", "--expires", "90d")
    assert made.returncode == 0
    text = made.stdout.strip()
    assert len(text) > 32
    listed = fluoromap("token", "list").stdout
    assert "viewer" in listed
    assert text not in listed


def test_a_token_of_that_name_cannot_be_made_twice_and_can_be_revoked(fluoromap) -> None:
    assert fluoromap("token", "create", "--name", "n", "--scope", "read").returncode == 0
    assert "'n'" in _one_sentence(fluoromap("token", "create", "--name", "n", "--scope", "read"))
    assert fluoromap("token", "revoke", "n").returncode == 0
    assert "'other'" in _one_sentence(fluoromap("token", "revoke", "other"))


def test_given_token_is_made_once_and_known_afterwards(fluoromap, tmp_path: Path) -> None:
    secret = tmp_path / "secret"
    secret.write_text("k" * 40 + "\n")
    arguments = ("token", "create", "--name", "first", "--scope", "read", "--from-file", str(secret))
    for _ in range(2):
        answer = fluoromap(*arguments)
        assert (answer.returncode, answer.stdout) == (0, "")
    secret.write_text("short")
    _one_sentence(fluoromap(*arguments))
    assert "nowhere" in _one_sentence(fluoromap(*arguments[:-1], "nowhere"))


@pytest.mark.parametrize(
    "arguments",
    [
        ("nonsense",),
        ("token", "create", "--name", "n"),
        ("token", "create", "--name", "n", "--scope", "read", "--expires", "soon"),
        ("simulate", "x", "--contrast", "BRIGHT,LAT"),
        ("api", "--port", "65536"),
    ],
)
def test_wrong_usage_ends_with_2(fluoromap, arguments: tuple[str, ...]) -> None:
    answer = fluoromap(*arguments)
    assert answer.returncode == 2
    assert "Traceback" not in answer.stderr


def test_wrong_setting_is_one_sentence(fluoromap) -> None:
    assert "FLUOROMAP_PORT" in _one_sentence(fluoromap("token", "list", FLUOROMAP_PORT="many"))


def test_unreachable_database_is_one_sentence(fluoromap) -> None:
    url = "postgresql+psycopg://nobody@127.0.0.1:1/none"
    assert "FLUOROMAP_DATABASE_URL" in _one_sentence(fluoromap("db", "upgrade", FLUOROMAP_DATABASE_URL=url))


@pytest.mark.parametrize("command", ["up", "api"])
def test_no_service_for_others_without_a_token(fluoromap, command: str) -> None:
    assert fluoromap("db", "upgrade").returncode == 0
    assert "token create" in _one_sentence(fluoromap(command, "--host", "0.0.0.0", "--port", "0"))


def test_run_says_what_is_missing(fluoromap, tmp_path: Path) -> None:
    assert "not a folder" in _one_sentence(fluoromap("run", "nowhere"))
    (tmp_path / "empty").mkdir()
    assert "no DICOM" in _one_sentence(fluoromap("run", "empty"))


def test_plugins_are_listed(fluoromap) -> None:
    answer = fluoromap("plugins")
    assert answer.returncode == 0
    for name in ("four-step", "maximum-likelihood", "a-priori-lm", "convex-hull"):
        assert name in answer.stdout
