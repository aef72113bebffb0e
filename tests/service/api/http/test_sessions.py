"""Sessions of browsers: sign in with a token, and no request of another origin."""

from __future__ import annotations

import base64

import pytest
from fastapi.testclient import TestClient
from sql_statements import sql_statements
from sqlalchemy import select, update

from fluoromap_service import auth
from fluoromap_service.api.app import create_app
from fluoromap_service.api.http.session import COOKIE
from fluoromap_service.auth import sessions
from fluoromap_service.settings import settings
from fluoromap_service.store import audit, schema
from fluoromap_service.store.engine import reading, writing
from fluoromap_service.store.models import BrowserSession
from fluoromap_service.study.upkeep import clean_up

HOST = "http://127.0.0.1"


@pytest.fixture
def token(service: TestClient) -> str:
    """Return a token that may read and write."""
    return auth.create_token("doctor", ["read", "write"])


def _sign_in(service: TestClient, token: str) -> None:
    answer = service.post("/session", headers={"Authorization": f"Bearer {token}"})
    assert answer.status_code == 204
    cookie = answer.headers["set-cookie"].lower()
    assert "httponly" in cookie
    assert "samesite=strict" in cookie


def test_open_service_shows_its_pages(service: TestClient) -> None:
    for path in ("/", "/docs", "/sign-in", "/studies/any", "/assets/studies/page.js"):
        assert service.get(path).status_code == 200
    assert service.get("/assets/../report.html.j2").status_code == 404
    assert service.get("/assets/missing.js").status_code == 404
    for name in ("%00", "page.js%00", "a" * 5000 + ".js", "%2e%2e/report.html.j2", "shared/%00/api.js", "%ff.js"):
        assert service.get(f"/assets/{name}").status_code == 404, name[:20]


def test_pages_may_run_their_own_scripts_only(service: TestClient) -> None:
    policy = service.get("/").headers["content-security-policy"]
    assert "script-src 'self'" in policy
    assert "unsafe" not in policy
    # A browser that has the page takes over the headers of the answer "unchanged".
    again = service.get("/", headers={"If-None-Match": service.get("/").headers["etag"]})
    assert (again.status_code, again.headers["content-security-policy"]) == (304, policy)


def test_page_without_session_leads_to_sign_in(service: TestClient, token: str) -> None:
    answer = service.get("/", headers={"Accept": "text/html"}, follow_redirects=False)
    assert (answer.status_code, answer.headers["location"]) == (303, "/sign-in")
    assert service.get("/sign-in").status_code == 200
    assert service.get("/assets/sign-in.js").status_code == 200
    assert service.get("/assets/studies/page.js", headers={"Accept": "*/*"}).status_code == 401
    assert service.get("/v1/studies", headers={"Accept": "text/html"}).status_code == 401


def test_session_reads_and_writes(service: TestClient, token: str) -> None:
    _sign_in(service, token)
    assert service.get("/v1/studies").status_code == 200
    assert service.post("/v1/studies", json={"label": "x"}, headers={"Origin": HOST}).status_code == 201


@pytest.mark.parametrize("headers", [{"Origin": "http://127.0.0.1:9"}, {"Origin": "null"}, {}])
def test_session_writes_from_own_pages_only(service: TestClient, token: str, headers: dict[str, str]) -> None:
    _sign_in(service, token)
    answer = service.post("/v1/studies", json={"label": "x"}, headers=headers)
    assert (answer.status_code, answer.json()["code"]) == (403, "foreign_origin")


def test_wrong_token_begins_no_session(service: TestClient, token: str) -> None:
    answer = service.post("/session", headers={"Authorization": "Bearer wrong"})
    assert answer.status_code == 401
    assert COOKIE not in answer.cookies


def test_reading_token_begins_a_session_that_cannot_write(service: TestClient, token: str) -> None:
    _sign_in(service, auth.create_token("guest", ["read"]))
    assert service.get("/v1/studies").status_code == 200
    assert service.post("/v1/studies", json={"label": "x"}, headers={"Origin": HOST}).status_code == 403


def test_session_ends_with_sign_out_and_with_revocation(service: TestClient, token: str) -> None:
    _sign_in(service, token)
    auth.revoke_token("doctor")
    assert service.get("/v1/studies").status_code == 401
    again = auth.create_token("again", ["read"])
    _sign_in(service, again)
    stolen = service.cookies[COOKIE]
    assert service.get("/v1/studies").status_code == 200
    assert service.delete("/session", headers={"Origin": HOST}).status_code == 204
    service.cookies.clear()
    assert service.get("/v1/studies").status_code == 401
    # A copy of the cookie is worth nothing either; the token goes on.
    assert service.get("/v1/studies", headers={"Cookie": f"{COOKIE}={stolen}"}).status_code == 401
    assert service.get("/v1/studies", headers={"Authorization": f"Bearer {again}"}).status_code == 200


def test_the_cookie_is_no_token_and_the_token_no_cookie(service: TestClient, token: str) -> None:
    _sign_in(service, token)
    session = service.cookies.pop(COOKIE)
    assert token not in (session, base64.urlsafe_b64decode(session + "==").decode("latin-1"))
    with reading() as database:
        assert session not in database.scalars(select(BrowserSession.sha256)).all()
    assert service.get("/v1/studies", headers={"Authorization": f"Bearer {session}"}).status_code == 401
    for cookie in (token, base64.urlsafe_b64encode(token.encode()).decode()):
        assert service.get("/v1/studies", headers={"Cookie": f"{COOKIE}={cookie}"}).status_code == 401


def test_each_sign_in_is_a_session_of_its_own(service: TestClient, token: str) -> None:
    ids = set()
    for _ in range(2):
        _sign_in(service, token)
        ids.add(service.cookies.pop(COOKIE))
    assert len(ids) == 2
    assert [each.token for each in sessions.list_sessions()] == ["doctor", "doctor"]


def test_a_token_has_a_limited_number_of_sessions(
    service: TestClient, token: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sessions, "MOST_SESSIONS", 3)
    _sign_in(service, auth.create_token("other", ["read"]))
    other = service.cookies.pop(COOKIE)
    ids = [sessions.begin(auth.token_hash(token)) for _ in range(5)]
    statuses = [
        service.get("/v1/studies", headers={"Cookie": f"{COOKIE}={each}"}).status_code for each in [*ids, other]
    ]
    assert statuses == [401, 401, 200, 200, 200, 200]


def test_session_ends_by_itself_and_leaves_the_table(service: TestClient, token: str) -> None:
    _sign_in(service, token)
    (listed,) = sessions.list_sessions()
    assert listed.expires == pytest.approx(listed.opened + sessions.SESSION_SECONDS)
    clean_up()
    assert service.get("/v1/studies").status_code == 200
    with writing() as session:
        session.execute(update(BrowserSession).values(expires=1.0))
    answer = service.get("/v1/studies")
    assert (answer.status_code, answer.json()["code"]) == (401, "unauthorized")
    assert sessions.list_sessions() == []
    clean_up()
    with reading() as session:
        assert session.scalars(select(BrowserSession)).all() == []


def test_session_of_a_token_that_was_revoked_leaves_the_table(service: TestClient, token: str) -> None:
    _sign_in(service, token)
    auth.revoke_token("doctor")
    assert sessions.list_sessions() == []
    assert sessions.remove_ended() == 1


def test_a_session_costs_no_query_until_the_database_changes(service: TestClient, token: str) -> None:
    _sign_in(service, token)
    service.get("/v1/studies")
    with sql_statements() as statements:
        assert service.get("/v1/studies").status_code == 200
    assert not [each for each in statements if "FROM token" in each or "browser_session" in each]


@pytest.mark.parametrize(
    ("base", "headers", "secure"),
    [
        ("http://127.0.0.1", {}, False),
        ("http://localhost", {}, False),
        ("http://[::1]:8000", {}, False),
        ("https://127.0.0.1", {}, True),
        ("http://fluoromap.example", {}, True),
        ("http://192.0.2.7:8000", {}, True),
        # A proxy that speaks TLS to the browser and calls the service as localhost.
        ("http://127.0.0.1", {"X-Forwarded-For": "192.0.2.9"}, True),
        ("http://127.0.0.1", {"Via": "1.1 proxy"}, True),
    ],
)
def test_cookie_is_secure_unless_the_browser_is_on_this_machine(
    data_dir: object, base: str, headers: dict[str, str], secure: bool
) -> None:
    token = auth.create_token("doctor", ["read", "write"])
    service = TestClient(create_app(), base_url=base)
    for answer in (
        service.post("/session", headers={"Authorization": f"Bearer {token}", **headers}),
        service.post("/sign-in", json={"link": sessions.make_link(token)}, headers=headers),
    ):
        assert answer.status_code == 204
        assert ("; secure" in answer.headers["set-cookie"].lower()) is secure


def _open(service: TestClient, link: str | None) -> int:
    return service.post("/sign-in", json={"link": link}).status_code


def test_link_signs_in_once(service: TestClient, token: str) -> None:
    link = sessions.make_link(token)
    # The secret of a link is no session.
    assert service.get("/v1/studies", headers={"Cookie": f"{COOKIE}={link}"}).status_code == 401
    assert _open(service, link) == 204
    assert service.get("/session").json() == {"name": "doctor"}
    assert _open(service, link) == 401
    assert _open(service, service.cookies[COOKIE]) == 401
    with reading() as session:
        assert ("doctor", "sign in by link") in [(each.who, each.what) for each in audit.entries(session)]


def test_link_that_waits_too_long_or_whose_token_ended(service: TestClient, token: str) -> None:
    links = [sessions.make_link(token) for _ in range(2)]
    with writing() as session:
        first = session.scalars(select(BrowserSession).order_by(BrowserSession.id)).first()
        assert first is not None
        first.expires = 1.0
    assert _open(service, links[0]) == 401
    auth.revoke_token("doctor")
    assert [_open(service, link) for link in (links[1], "", "wrong")] == [401] * 3
    assert sessions.make_link(token) is None
    assert sessions.begin(auth.token_hash(token)) is None
    assert COOKIE not in service.cookies


def test_sessions_on_postgresql(postgres_url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FLUOROMAP_DATABASE_URL", postgres_url)
    settings.cache_clear()
    schema.upgrade()
    token = auth.create_token("doctor", ["read", "write"])
    replicas = [TestClient(create_app(), base_url=HOST) for _ in range(2)]
    assert _open(replicas[0], sessions.make_link(token)) == 204
    replicas[1].cookies = replicas[0].cookies
    assert replicas[1].get("/v1/studies").status_code == 200
    assert replicas[0].delete("/session", headers={"Origin": HOST}).status_code == 204
    assert replicas[1].get("/v1/studies").status_code == 401
    _sign_in(replicas[0], token)
    auth.revoke_token("doctor")
    assert replicas[0].get("/v1/studies").status_code == 401
    assert sessions.remove_ended() == 1
