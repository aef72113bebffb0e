"""The command line: its answers and its exit codes."""

from __future__ import annotations

import socket
from pathlib import Path

import pytest
from program import Program, one_sentence

from fluoromap_service.jobs import living_workers
from fluoromap_service.store.engine import writing


def test_token_is_shown_once_and_never_listed(fluoromap: Program) -> None:
    made = fluoromap("token", "create", "--name", "viewer", "--scope", "read", "--scope", "write", "--expires", "90d")
    assert made.returncode == 0
    text = made.stdout.strip()
    assert len(text) > 32
    listed = fluoromap("token", "list").stdout
    assert "viewer" in listed
    assert text not in listed


def test_a_token_of_that_name_cannot_be_made_twice_and_can_be_revoked(fluoromap: Program) -> None:
    assert fluoromap("token", "create", "--name", "n", "--scope", "write").returncode == 0
    assert "'n'" in one_sentence(fluoromap("token", "create", "--name", "n", "--scope", "read"))
    assert fluoromap("token", "revoke", "n").returncode == 0
    assert "'other'" in one_sentence(fluoromap("token", "revoke", "other"))


def test_given_token_is_made_once_and_known_afterwards(fluoromap: Program, tmp_path: Path) -> None:
    secret = tmp_path / "secret"
    secret.write_text("k" * 40 + "\n")
    arguments = (
        "token",
        "create",
        "--name",
        "first",
        "--scope",
        "read",
        "--scope",
        "write",
        "--from-file",
        str(secret),
    )
    for _ in range(2):
        answer = fluoromap(*arguments)
        assert (answer.returncode, answer.stdout) == (0, "")
    secret.write_text("short")
    one_sentence(fluoromap(*arguments))
    assert "nowhere" in one_sentence(fluoromap(*arguments[:-1], "nowhere"))


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
def test_wrong_usage_ends_with_2(fluoromap: Program, arguments: tuple[str, ...]) -> None:
    assert fluoromap(*arguments).returncode == 2


def test_wrong_setting_isone_sentence(fluoromap: Program) -> None:
    assert "FLUOROMAP_PORT" in one_sentence(fluoromap("token", "list", FLUOROMAP_PORT="many"))


def test_unreachable_database_isone_sentence(fluoromap: Program) -> None:
    url = "postgresql+psycopg://nobody@127.0.0.1:1/none"
    assert "FLUOROMAP_DATABASE_URL" in one_sentence(fluoromap("db", "upgrade", FLUOROMAP_DATABASE_URL=url))


@pytest.mark.parametrize("command", ["up", "api"])
def test_no_service_for_others_without_a_token(fluoromap: Program, command: str) -> None:
    assert fluoromap("db", "upgrade").returncode == 0
    assert "token create" in one_sentence(fluoromap(command, "--host", "0.0.0.0", "--port", "0"))


def test_run_says_what_is_missing(fluoromap: Program, tmp_path: Path) -> None:
    assert "not a folder" in one_sentence(fluoromap("run", "nowhere"))
    (tmp_path / "empty").mkdir()
    assert "no DICOM" in one_sentence(fluoromap("run", "empty"))


def test_plugins_are_listed(fluoromap: Program) -> None:
    answer = fluoromap("plugins")
    assert answer.returncode == 0
    for name in ("four-step", "maximum-likelihood", "motion-prior", "convex-hull"):
        assert name in answer.stdout


@pytest.mark.parametrize("command", ["api", "worker"])
def test_no_service_without_tables(fluoromap: Program, command: str) -> None:
    assert "db upgrade" in one_sentence(fluoromap(command))


def test_worker_check_fails_without_a_sign_of_life(fluoromap: Program) -> None:
    assert fluoromap("db", "upgrade").returncode == 0
    assert "sign of life" in one_sentence(fluoromap("worker", "--check"))
    with writing() as session:
        living_workers.worker_seen(session, f"fluoromap@{socket.gethostname()}")
    assert fluoromap("worker", "--check").returncode == 0
