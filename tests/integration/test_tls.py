"""TLS to PostgreSQL and Redis: real servers with the options of ``deploy/tls/``, and the service that connects to them.

The service refuses a server with the certificate of another authority or for another name. The servers refuse connections without
TLS.
"""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import servers
import sqlalchemy
import yaml
from processes import environment_of, process, wait_until_ready
from redis import Redis
from redis.exceptions import ConnectionError as NoConnection

from fluoromap_service.cli.client import Client
from fluoromap_service.cli.supervisor import free_port, program

TOP = Path(__file__).parent.parent.parent
TLS = TOP / "deploy" / "tls"
OVERLAY: dict[str, Any] = yaml.safe_load((TLS / "docker-compose.yml").read_text())
NAME = "localhost"

pytestmark = [
    pytest.mark.timeout(300),
    pytest.mark.skipif(shutil.which("openssl") is None, reason="openssl is not installed; it makes the certificates"),
]


@dataclass(frozen=True)
class Servers:
    """Ports of PostgreSQL and Redis with TLS; the file of their authority; the file of an authority that they do not know."""

    postgres: int
    redis: int
    authority: Path
    stranger: Path

    def settings(self, authority: Path, name: str = NAME) -> dict[str, str]:
        """Return the addresses of the example, with the places of this test."""
        environment = OVERLAY["services"]["api"]["environment"]
        password = "${POSTGRES_PASSWORD:?see the top of docker-compose.yml}"
        database = environment["FLUOROMAP_DATABASE_URL"].replace(password, "secret")
        database = database.replace("postgres:5432", f"{name}:{self.postgres}")
        broker = environment["FLUOROMAP_BROKER_URL"].replace("redis:6379", f"{name}:{self.redis}")
        return {
            "FLUOROMAP_DATABASE_URL": database.replace("/run/secrets/authority", str(authority)),
            "FLUOROMAP_BROKER_URL": broker.replace("/run/secrets/authority", str(authority)),
        }


@pytest.fixture(scope="module")
def tls_servers() -> Iterator[Servers]:
    folder = servers.session_folder()
    try:
        for name in ("certificates", "strangers"):
            subprocess.run([TLS / "make-certificates.sh", folder / name, NAME], check=True, capture_output=True)
        places = {
            "postgres-certificate": "localhost.pem", "redis-certificate": "localhost.pem", "authority": "authority.pem",
        }  # fmt: skip
        with _server(folder, "postgres", places) as postgres, _server(folder, "redis", places) as redis:
            _make_database(folder / "postgres", postgres)
            yield Servers(
                postgres, redis, folder / "certificates" / "authority.pem", folder / "strangers" / "authority.pem"
            )
    finally:
        shutil.rmtree(folder, ignore_errors=True)


@contextmanager
def _server(folder: Path, kind: str, places: dict[str, str]) -> Iterator[int]:
    """Run a server with the command of the example and yield its port."""
    home = folder / kind
    shutil.copytree(folder / "certificates", home / "tls")
    command = [str(each) for each in OVERLAY["services"][kind]["command"]]
    command = [each.replace("/run/tls/server.key", str(home / "tls" / "localhost.key")) for each in command]
    for secret, name in places.items():
        command = [each.replace(f"/run/secrets/{secret}", str(home / "tls" / name)) for each in command]
    shutil.copy(TLS / "pg_hba.conf", home / "pg_hba.conf")
    command = [each.replace("/etc/postgresql/pg_hba.conf", str(home / "pg_hba.conf")) for each in command]
    # The program comes first, and the port of Redis last.
    options, port_option = command[1:], "-p"
    if kind == "redis":
        port_option = "--tls-port"
        place = options.index(port_option)
        del options[place : place + 2]
    with servers.tls_server("postgresql" if kind == "postgres" else kind, home, options, port_option) as port:
        yield port


def _make_database(socket_folder: Path, port: int) -> None:
    url = sqlalchemy.URL.create(
        "postgresql+psycopg", "postgres", host=str(socket_folder), port=port, database="postgres"
    )
    engine = sqlalchemy.create_engine(url, isolation_level="AUTOCOMMIT", poolclass=sqlalchemy.NullPool)
    servers.wait_until_accepted(engine)
    with engine.connect() as connection:
        connection.execute(sqlalchemy.text("CREATE ROLE fluoromap LOGIN PASSWORD 'secret'"))
        connection.execute(sqlalchemy.text("CREATE DATABASE fluoromap OWNER fluoromap"))


def test_the_service_works_over_tls(tls_servers: Servers, tmp_path: Path) -> None:
    environment = environment_of(tmp_path / "data", **tls_servers.settings(tls_servers.authority))
    subprocess.run([program(), "db", "upgrade"], env=environment, check=True)
    port = free_port()
    with process("api", "--port", str(port), environment=environment), process("worker", environment=environment):
        url = f"http://127.0.0.1:{port}"
        wait_until_ready(url, tmp_path / "data")
        with Client(url) as client:
            client.make_study("over TLS")
    engine = sqlalchemy.create_engine(environment["FLUOROMAP_DATABASE_URL"], poolclass=sqlalchemy.NullPool)
    with engine.connect() as connection:
        encrypted = connection.execute(
            sqlalchemy.text("SELECT version FROM pg_stat_ssl WHERE pid = pg_backend_pid() AND ssl")
        ).scalar()
        assert encrypted == "TLSv1.3"


@pytest.mark.parametrize("flaw", ["authority", "name"])
def test_the_service_refuses_another_server(tls_servers: Servers, tmp_path: Path, flaw: str) -> None:
    """Somebody between service and server has a certificate of another authority, or one for another name."""
    authority = tls_servers.stranger if flaw == "authority" else tls_servers.authority
    settings = tls_servers.settings(authority, NAME if flaw == "authority" else "127.0.0.1")
    answer = subprocess.run(
        [program(), "db", "upgrade"], env=environment_of(tmp_path / "data", **settings), capture_output=True, text=True
    )
    assert answer.returncode == 1
    assert "secret" not in answer.stderr
    assert _broker_state(settings["FLUOROMAP_BROKER_URL"]) != "connected"


def test_the_broker_of_the_example_is_reached(tls_servers: Servers) -> None:
    """Else the refusals above would show nothing."""
    assert _broker_state(tls_servers.settings(tls_servers.authority)["FLUOROMAP_BROKER_URL"]) == "connected"


def _broker_state(url: str) -> str:
    from celery import Celery

    with Celery("test", broker=url).connection_for_write() as connection:
        try:
            connection.ensure_connection(max_retries=1, interval_start=0, timeout=10)
        except Exception as error:
            return type(error).__name__
        return "connected"


def test_the_servers_refuse_connections_without_tls(tls_servers: Servers) -> None:
    url = f"postgresql+psycopg://fluoromap:secret@{NAME}:{tls_servers.postgres}/fluoromap?sslmode=disable"
    engine = sqlalchemy.create_engine(url, poolclass=sqlalchemy.NullPool)
    with pytest.raises(sqlalchemy.exc.OperationalError, match=r"pg_hba|no encryption"):
        engine.connect()
    with pytest.raises(NoConnection), Redis.from_url(f"redis://{NAME}:{tls_servers.redis}/0") as plain:
        plain.ping()


def test_every_part_of_the_example_uses_tls() -> None:
    services = yaml.safe_load((TOP / "docker-compose.yml").read_text())["services"]
    parts = {name for name, each in services.items() if str(each.get("image", "")).startswith("fluoromap:")}
    for name in parts:
        environment = OVERLAY["services"][name]["environment"]
        assert "sslmode=verify-full" in environment["FLUOROMAP_DATABASE_URL"]
        assert environment["FLUOROMAP_BROKER_URL"].startswith("rediss://")
        assert "authority" in OVERLAY["services"][name]["secrets"]
    assert OVERLAY["services"]["backup"]["environment"]["PGSSLMODE"] == "verify-full"
    assert set(OVERLAY["services"]) == set(services)
