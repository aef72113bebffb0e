"""Sign in with a token, in a browser."""

from __future__ import annotations

import os
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest
import servers
from processes import PATIENCE_SECONDS, environment_of, process

from fluoromap_service.cli.supervisor import program


@pytest.fixture
def closed_service(tmp_path: Path) -> Iterator[tuple[str, str]]:
    """Yield the address and the token of a service that asks for one."""
    environment = environment_of(tmp_path / "data")
    subprocess.run([program(), "db", "upgrade"], env=environment, check=True, capture_output=True)
    command = [program(), "token", "create", "--name", "doctor", "--scope", "read", "--scope", "write"]
    made = subprocess.run(command, env=environment, check=True, capture_output=True, text=True)
    port = servers.free_port()
    with process("api", "--port", str(port), environment=environment):
        url = f"http://127.0.0.1:{port}"
        # Without a worker the service is alive but never ready.
        end = time.monotonic() + PATIENCE_SECONDS
        while True:
            try:
                httpx.get(f"{url}/v1/health", timeout=10)
                break
            except httpx.TransportError:
                assert time.monotonic() < end, "the service did not answer in time"
                time.sleep(0.1)
        yield url, made.stdout.split()[-1]


def test_a_link_signs_in_once(browser: Any, closed_service: tuple[str, str], tmp_path: Path) -> None:
    url, _ = closed_service
    command = [program(), "sign-in", "--port", url.rpartition(":")[2]]
    environment = os.environ | {"FLUOROMAP_DATA_DIR": str(tmp_path / "data")}
    link = subprocess.run(command, env=environment, check=True, capture_output=True, text=True).stdout.strip()
    assert link.startswith(f"{url}/sign-in#")
    with browser.new_context(base_url=url) as context:
        page = context.new_page()
        asked: list[str] = []
        page.on("request", lambda request: asked.append(request.url))
        page.goto(link)
        page.get_by_text("Signed in as local").wait_for()
        assert page.url == f"{url}/"
        page.go_back()
        assert link.rpartition("#")[2] not in page.evaluate("location.href")
        assert not [each for each in asked if link.rpartition("#")[2] in each]
    with browser.new_context(base_url=url) as context:
        page = context.new_page()
        page.goto(link)
        page.get_by_role("alert").get_by_text("was used or is too old").wait_for()
        assert context.cookies() == []
    assert link.rpartition("#")[2] not in (tmp_path / "data" / "api.log").read_text()


def test_a_browser_signs_in_and_out(browser: Any, closed_service: tuple[str, str]) -> None:
    url, token = closed_service
    with browser.new_context(base_url=url) as context:
        page = context.new_page()
        page.goto("/studies/any")
        page.wait_for_url("**/sign-in")
        page.get_by_label("Access token").fill("wrong")
        page.get_by_role("button", name="Sign in").click()
        page.get_by_role("alert").get_by_text("unknown, expired or revoked").wait_for()
        page.get_by_label("Access token").fill(token)
        page.get_by_role("button", name="Sign in").click()
        page.get_by_text("There is no study yet.").wait_for()
        (cookie,) = context.cookies()
        assert (cookie["httpOnly"], cookie["sameSite"]) == (True, "Strict")
        page.get_by_label("Name of the study").fill("Signed in")
        page.get_by_role("button", name="Create the study").click()
        page.wait_for_url("**/studies/*")
        page.get_by_text("Signed in as doctor").wait_for()
        page.get_by_role("button", name="Sign out").click()
        page.wait_for_url("**/sign-in")
        page.goto("/")
        page.wait_for_url("**/sign-in")
