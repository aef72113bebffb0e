"""The service of one user: ``up`` makes its token and its link, and keeps other users of the machine out."""

from __future__ import annotations

import re
import stat
import subprocess
from pathlib import Path

import httpx
import pytest
from processes import client_of, embedded, environment_of, process, until_printed, wait_until_ready

from fluoromap_service.cli.supervisor import free_port, private_service, program

LINK = re.compile(r"(http://127\.0\.0\.1:\d+)/sign-in#([\w-]{43})")


def test_up_lets_in_its_user_only(tmp_path: Path) -> None:
    environment = environment_of(tmp_path / "data")
    port, file = free_port(), tmp_path / "data" / "access-token"
    texts, log = set(), tmp_path / "data" / "up.log"
    for _ in range(2):
        log.unlink(missing_ok=True)
        with embedded(environment, port):
            ((url, link),) = LINK.findall(until_printed(log, "another link"))
            assert url == f"http://127.0.0.1:{port}"
            wait_until_ready(url, tmp_path / "data")
            assert stat.S_IMODE(file.stat().st_mode) == 0o600
            assert stat.S_IMODE(file.parent.stat().st_mode) == 0o700
            texts.add(file.read_text())
            for path in ("/v1/studies", "/metrics", "/docs"):
                assert httpx.get(url + path).status_code == 401
            with httpx.Client(base_url=url) as browser:
                assert [browser.post("/sign-in", json={"link": link}).status_code for _ in range(2)] == [204, 401]
                assert browser.get("/session").json() == {"name": "local"}
                assert browser.post("/v1/studies", json={"label": "x"}, headers={"Origin": url}).status_code == 201
            # The loopback address is no trusted proxy.
            wrong = [_wrong_token(url, f"203.0.113.{n}") for n in range(21)]
            assert wrong[-1] == 429
            with client_of(environment, port) as client:
                client.make_study("y")
            assert file.read_text().strip() not in log.read_text()
    assert len(texts) == 1, "another start takes the same token"


def _wrong_token(url: str, forwarded_for: str) -> int:
    headers = {"Authorization": "Bearer wrong", "X-Forwarded-For": forwarded_for}
    return httpx.get(f"{url}/v1/studies", headers=headers).status_code


def test_a_folder_with_tokens_gets_no_other_unless_its_user_asks(tmp_path: Path) -> None:
    environment = environment_of(tmp_path / "data")
    create = [program(), "token", "create", "--name", "local", "--scope", "read", "--scope", "write"]
    subprocess.run(create, env=environment, check=True, capture_output=True)
    port, file = free_port(), tmp_path / "data" / "access-token"
    with process("up", "--port", str(port), environment=environment):
        assert "sign-in' prints a link" in until_printed(tmp_path / "data" / "up.log", "sign-in")
        assert not file.exists()
        command = [program(), "sign-in", "--port", str(port)]
        made = subprocess.run(command, env=environment, check=True, capture_output=True, text=True).stdout
        match = LINK.fullmatch(made.strip())
        assert match is not None
        with httpx.Client(base_url=f"http://127.0.0.1:{port}") as browser:
            assert browser.post("/sign-in", json={"link": match[2]}).status_code == 204
            assert browser.get("/session").json() == {"name": "local-2"}


@pytest.mark.parametrize("rounds", [2])
def test_a_private_service_lets_in_its_user_only(tmp_path: Path, rounds: int) -> None:
    for _ in range(rounds):
        with private_service(tmp_path / "data", computes=False) as service:
            assert httpx.get(f"{service.url}/v1/studies").status_code == 401
            with service.client() as client:
                assert client.get("/v1/studies").status_code == 200
            match = LINK.fullmatch(service.sign_in_link())
            assert match is not None
            assert match[1] == service.url
            assert httpx.post(f"{service.url}/sign-in", json={"link": match[2]}).status_code == 204
            assert service.token not in repr(service)
