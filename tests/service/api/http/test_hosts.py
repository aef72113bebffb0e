"""The header Host: answers repeat it in addresses, so it must be one that the installation allows."""

from __future__ import annotations

import pytest
from fastapi.testclient import TestClient
from pydantic import ValidationError

from fluoromap_service import auth
from fluoromap_service.api.app import create_app
from fluoromap_service.settings import Settings, settings


@pytest.fixture
def bearer(data_dir: object) -> dict[str, str]:
    """Return the header with a valid token."""
    return {"Authorization": f"Bearer {auth.create_token('writer', ['write'])}"}


def _allow(monkeypatch: pytest.MonkeyPatch, names: str) -> None:
    monkeypatch.setenv("FLUOROMAP_ALLOWED_HOSTS", names)
    settings.cache_clear()


@pytest.mark.parametrize(
    ("host", "status"),
    [
        ("fluoromap.example", 200),
        ("FLUOROMAP.example:8443", 200),
        ("[2001:db8::7]:8443", 200),
        ("localhost:8000", 200),
        ("127.0.0.1", 200),
        ("[::1]:8000", 200),
        ("evil.example", 421),
        ("fluoromap.example.evil.example", 421),
        ("192.0.2.7", 421),
        ("", 400),
    ],
)
def test_configured_names_and_loopback_are_allowed(
    bearer: dict[str, str], monkeypatch: pytest.MonkeyPatch, host: str, status: int
) -> None:
    _allow(monkeypatch, "fluoromap.example [2001:DB8::7]")
    service = TestClient(create_app(), base_url="http://127.0.0.1")
    for path in ("/v1/studies", "/dicom-web/studies", "/"):
        answer = service.get(path, headers={"Host": host, **bearer})
        assert (answer.status_code in (200, 204)) is (status == 200), path
        if status != 200:
            code = "unknown_host" if status == 421 else "malformed"
            assert (answer.status_code, answer.json()["code"]) == (status, code), path
    # A probe calls a replica by its address.
    assert service.get("/v1/health", headers={"Host": "192.0.2.7:8000"}).status_code == 200


@pytest.mark.parametrize("host", ["evil.example/x?", "a b", "a@b", "evil.example#", "[broken", "x" * 300, "a:b", '"><'])
def test_without_names_a_host_must_be_one(bearer: dict[str, str], host: str) -> None:
    service = TestClient(create_app(), base_url="http://127.0.0.1")
    assert service.get("/v1/studies", headers={"Host": "any.name:80", **bearer}).status_code == 200
    answer = service.get("/v1/studies", headers={"Host": host, **bearer})
    assert (answer.status_code, answer.json()["code"]) == (400, "malformed")
    assert host not in answer.text


def test_a_link_does_not_sign_in_under_another_name(bearer: dict[str, str], monkeypatch: pytest.MonkeyPatch) -> None:
    _allow(monkeypatch, "fluoromap.example")
    service = TestClient(create_app(), base_url="http://127.0.0.1")
    answer = service.post("/sign-in", json={"link": "x"}, headers={"Host": "evil.example"})
    assert (answer.status_code, answer.json()["code"]) == (421, "unknown_host")


@pytest.mark.parametrize(
    ("setting", "value"),
    [
        ("allowed_hosts", "https://fluoromap.example"),
        ("allowed_hosts", "fluoromap.example:443"),
        ("allowed_hosts", "*"),
        ("trusted_proxies", "*"),
        ("trusted_proxies", "192.0.2.7/8"),
        ("trusted_proxies", "proxy.example"),
    ],
)
def test_settings_that_are_no_names_or_networks(setting: str, value: str) -> None:
    with pytest.raises(ValidationError, match="write"):
        Settings(**{setting: value})
