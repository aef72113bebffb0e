"""Wrong tokens are counted and limited for all replicas; valid tokens go on."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from fastapi import FastAPI
from fastapi.testclient import TestClient
from sqlalchemy import func, select, update

from fluoromap_service import auth
from fluoromap_service.api.app import create_app
from fluoromap_service.auth.failures import MOST_FAILURES, network_of
from fluoromap_service.settings import settings
from fluoromap_service.store import schema
from fluoromap_service.store.engine import engine, reading, writing
from fluoromap_service.store.models import SignInFailure
from fluoromap_service.study.upkeep import clean_up

PROXY = "192.0.2.1"


@pytest.fixture(params=["sqlite", "postgresql"])
def database(request: pytest.FixtureRequest, data_dir: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """An empty database of each kind."""
    if request.param == "postgresql":
        monkeypatch.setenv("FLUOROMAP_DATABASE_URL", request.getfixturevalue("postgres_url"))
        settings.cache_clear()
        schema.upgrade()
    yield
    engine().dispose()


def _client(address: str = "192.0.2.7") -> TestClient:
    return TestClient(create_app(), base_url="http://127.0.0.1", client=(address, 50_000))


def _status(service: TestClient, token: str, **headers: str) -> int:
    headers = {name.replace("_", "-"): value for name, value in headers.items()}
    return service.get("/v1/studies", headers={"Authorization": f"Bearer {token}", **headers}).status_code


def _stored() -> int:
    with reading() as session:
        return session.scalar(select(func.count()).select_from(SignInFailure)) or 0


@pytest.mark.usefixtures("database")
def test_wrong_tokens_are_limited_and_valid_ones_never() -> None:
    service, replica = _client(), _client()
    used, fresh = auth.create_token("used", ["write"]), auth.create_token("fresh", ["read"])
    assert _status(service, used) == 200
    statuses = [_status([service, replica][n % 2], f"wrong{n}") for n in range(MOST_FAILURES + 2)]
    assert statuses == [401] * MOST_FAILURES + [429] * 2
    answer = replica.get("/v1/studies", headers={"Authorization": "Bearer wrong"})
    assert answer.json()["code"] == "too_many_failures"
    assert 1 <= int(answer.headers["retry-after"]) <= 60
    for each in (service, replica):
        assert [_status(each, used), _status(each, fresh)] == [200, 200]
        assert each.post("/session", headers={"Authorization": f"Bearer {fresh}"}).status_code == 204
    assert _status(_client("192.0.2.8"), "wrong") == 401
    auth.revoke_token("used")
    assert _status(service, used) == 429
    app = service.app
    assert isinstance(app, FastAPI)
    assert app.state.sign_ins.failures == MOST_FAILURES // 2 + 2
    # A flood is not stored.
    assert _stored() == MOST_FAILURES + 1


@pytest.mark.usefixtures("database")
def test_failures_count_for_a_minute_and_leave_the_table() -> None:
    service = _client()
    auth.create_token("used", ["write"])
    for n in range(MOST_FAILURES):
        assert _status(service, f"wrong{n}") == 401
    clean_up()
    assert (_stored(), _status(service, "wrong")) == (MOST_FAILURES, 429)
    for moment in (SignInFailure.at - 61.0, SignInFailure.at + 3600.0):
        # Afterwards the clock goes on, or is set back.
        with writing() as session:
            session.execute(update(SignInFailure).values(at=moment))
        assert _status(service, "wrong") == 401
    clean_up()
    assert _stored() == 1


def test_a_header_of_the_client_itself_does_not_escape_the_limit(data_dir: Path) -> None:
    service = _client()
    auth.create_token("used", ["write"])
    statuses = [_status(service, "wrong", x_forwarded_for=f"203.0.113.{n}") for n in range(MOST_FAILURES + 1)]
    assert statuses[-2:] == [401, 429]


@pytest.mark.parametrize("proxies", [PROXY, "198.51.100.9 192.0.2.0/28"])
def test_behind_a_trusted_proxy_each_client_counts_by_itself(
    data_dir: Path, monkeypatch: pytest.MonkeyPatch, proxies: str
) -> None:
    monkeypatch.setenv("FLUOROMAP_TRUSTED_PROXIES", proxies)
    settings.cache_clear()
    service = _client(PROXY)
    auth.create_token("used", ["write"])
    # The proxy appends the address that it sees; the client wrote the others.
    statuses = [
        _status(service, "wrong", x_forwarded_for=f"203.0.113.{n}, 192.0.2.77") for n in range(MOST_FAILURES + 1)
    ]
    assert statuses[-2:] == [401, 429]
    assert _status(service, "wrong", x_forwarded_for="192.0.2.77, 192.0.2.78") == 401


def test_a_trusted_proxy_gives_the_scheme(data_dir: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    token = auth.create_token("used", ["write"])
    links = []
    for proxies in ("", PROXY):
        monkeypatch.setenv("FLUOROMAP_TRUSTED_PROXIES", proxies)
        settings.cache_clear()
        service = _client(PROXY)
        headers = {"Authorization": f"Bearer {token}", "X-Forwarded-Proto": "https"}
        for label in ("a", "b"):
            service.post("/v1/studies", json={"label": label}, headers=headers).raise_for_status()
        links.append(service.get("/v1/studies?limit=1", headers=headers).headers["link"])
    assert [link.partition(":")[0] for link in links] == ["<http", "<https"]


def test_an_untrusted_proxy_is_named_once_in_the_log(data_dir: Path, capfd: pytest.CaptureFixture[str]) -> None:
    service = _client(PROXY)
    token = auth.create_token("used", ["write"])
    for _ in range(3):
        assert _status(service, token, x_forwarded_for="203.0.113.9") == 200
    printed = "".join(capfd.readouterr())
    assert printed.count("proxy_not_trusted") == 1
    assert "FLUOROMAP_TRUSTED_PROXIES" in printed


@pytest.mark.parametrize(
    ("address", "network"),
    [
        ("192.0.2.7", "192.0.2.7"),
        ("::ffff:192.0.2.7", "192.0.2.7"),
        ("2001:db8::1", "2001:db8::/64"),
        ("2001:db8::ffff:1", "2001:db8::/64"),
        ("", "unknown"),
        ("x" * 5000, "unknown"),
    ],
)
def test_source_of_a_failure(address: str, network: str) -> None:
    assert network_of(address) == network
