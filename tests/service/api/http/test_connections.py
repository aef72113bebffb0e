"""Connections of a real server: silent ones end, and an answer before the end of a body closes its connection."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import pytest
import uvicorn

from fluoromap_service.api.app import create_app
from fluoromap_service.api.http import connections
from fluoromap_service.api.http.connections import TimedConnection


@pytest.fixture
def address(data_dir: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[str, int]]:
    """The address of a real server whose deadline for a header is short."""
    monkeypatch.setattr(connections, "HEADER_SECONDS", 0.5)
    with _served(create_app()) as address:
        yield address


@contextmanager
def _served(application: Any) -> Iterator[tuple[str, int]]:
    config = uvicorn.Config(application, http=TimedConnection, log_config=None, lifespan="off")
    server = uvicorn.Server(config)
    listening = socket.create_server(("127.0.0.1", 0))
    thread = threading.Thread(target=server.run, kwargs={"sockets": [listening]}, daemon=True)
    thread.start()
    while not server.started:
        time.sleep(0.01)
    yield listening.getsockname()
    server.should_exit = True
    thread.join()


def _all(connection: socket.socket) -> bytes:
    """Return everything until the server closes the connection."""
    connection.settimeout(60)
    content = b""
    while part := connection.recv(65536):
        content += part
    return content


@pytest.mark.parametrize("begin", [b"", b"GET /v1/health HTTP/1.1\r\nHost: local"])
def test_a_connection_without_a_whole_header_is_closed(address: tuple[str, int], begin: bytes) -> None:
    with socket.create_connection(address) as connection:
        connection.sendall(begin)
        assert _all(connection) == b""


def test_a_whole_header_in_time_is_answered(address: tuple[str, int]) -> None:
    with socket.create_connection(address) as connection:
        connection.sendall(b"GET /v1/health HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n")
        assert _all(connection).startswith(b"HTTP/1.1 200")


def test_a_broken_header_gets_a_problem_document(address: tuple[str, int]) -> None:
    with socket.create_connection(address) as connection:
        connection.sendall(b"nonsense\r\n\r\n")
        answer = _all(connection)
    assert answer.startswith(b"HTTP/1.1 400")
    assert b"application/problem+json" in answer
    assert b"nosniff" in answer


def test_an_answer_before_the_end_of_the_body_arrives_and_closes(address: tuple[str, int]) -> None:
    length = 8 * 2**20
    head = f"POST /v1/none HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/dicom\r\nContent-Length: {length}\r\n\r\n"
    with socket.create_connection(address) as connection:
        connection.sendall(head.encode() + bytes(length))
        answer = _all(connection)
    assert answer.startswith(b"HTTP/1.1 404")
    assert b"connection: close" in answer.lower()
    assert answer.endswith(b"}")


LONG_BYTES = 64 * 2**20
"""More than the buffers of both ends hold."""


@contextmanager
def _long_answer() -> Iterator[tuple[tuple[str, int], threading.Event]]:
    """Run a server of one long answer, and say when the answer has ended."""
    ended = threading.Event()

    async def application(scope: Any, receive: Any, send: Any) -> None:
        await send({"type": "http.response.start", "status": 200, "headers": []})
        for _ in range(64):
            await send({"type": "http.response.body", "body": bytes(LONG_BYTES // 64), "more_body": True})
        await send({"type": "http.response.body", "body": b""})
        ended.set()

    with _served(application) as address:
        yield address, ended


def test_a_client_that_takes_nothing_is_disconnected(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(connections, "WRITE_SECONDS", 0.2)
    with _long_answer() as (address, ended), socket.create_connection(address) as connection:
        connection.sendall(b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n")
        assert ended.wait(60)
        length = 0
        with suppress(ConnectionResetError):
            while part := connection.recv(2**20):
                length += len(part)
        assert length < LONG_BYTES


def test_a_client_that_reads_gets_the_whole_answer() -> None:
    length = 0
    with _long_answer() as (address, _), socket.create_connection(address) as connection:
        connection.sendall(b"GET / HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n")
        while part := connection.recv(2**20):
            length += len(part)
    assert length > LONG_BYTES
