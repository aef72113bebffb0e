"""The access token in the data folder, and the first token of an installation."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from program import Program, one_sentence

from fluoromap_service import auth
from fluoromap_service.auth import sessions


def _link(fluoromap: Program, *options: str) -> str:
    answer = fluoromap("sign-in", *options)
    assert (answer.returncode, answer.stderr) == (0, "")
    return answer.stdout.strip()


def _names() -> list[str]:
    return [token.name for token in auth.list_tokens()]


def test_sign_in_makes_the_token_once_and_a_link_each_time(fluoromap: Program, tmp_path: Path) -> None:
    links = {_link(fluoromap, "--port", "8123") for _ in range(2)}
    assert len(links) == 2
    assert all(re.fullmatch(r"http://127\.0\.0\.1:8123/sign-in#[\w-]{43}", link) for link in links)
    assert re.match(r"http://\[::1\]:8000/", _link(fluoromap, "--host", "::1", "--port", "8000"))
    # A service that listens everywhere is reached from this machine on the loopback address.
    assert re.match(r"http://127\.0\.0\.1:8000/", _link(fluoromap, "--host", "0.0.0.0", "--port", "8000"))
    assert _names() == ["local"]
    caller = auth.verify((tmp_path / "data" / "access-token").read_text().strip())
    assert caller is not None
    assert caller.scopes == {"read", "write"}


def test_a_token_that_was_revoked_or_lost_is_replaced(fluoromap: Program, tmp_path: Path) -> None:
    file = tmp_path / "data" / "access-token"
    _link(fluoromap)
    first = file.read_text()
    assert fluoromap("token", "revoke", "local").returncode == 0
    _link(fluoromap)
    assert file.read_text() != first
    file.write_text("not a token\n")
    _link(fluoromap)
    file.unlink()
    _link(fluoromap)
    assert _names() == ["local", "local-2", "local-3", "local-4"]


@pytest.mark.parametrize("scopes", [["read"], ["metrics"], ["metrics", "read"]])
def test_the_first_token_must_write(fluoromap: Program, scopes: list[str]) -> None:
    options = [part for scope in scopes for part in ("--scope", scope)]
    sentence = one_sentence(fluoromap("token", "create", "--name", "monitor", *options))
    assert "token create --name NAME --scope read --scope write" in sentence
    assert _names() == []
    assert fluoromap("token", "create", "--name", "writer", "--scope", "write").returncode == 0
    assert fluoromap("token", "create", "--name", "monitor", *options).returncode == 0
    assert _names() == ["writer", "monitor"]


def test_sessions_are_listed(fluoromap: Program) -> None:
    _link(fluoromap)
    # A link that nobody has opened is no session.
    assert "local" not in fluoromap("token", "sessions").stdout
    token = auth.create_token("doctor", ["read"])
    sessions.begin(auth.token_hash(token))
    assert "doctor" in fluoromap("token", "sessions").stdout
