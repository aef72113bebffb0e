"""The connection to a target that speaks HTTP, and the sentences for its failures."""

from __future__ import annotations

import asyncio
import ssl
from collections.abc import AsyncIterator, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx

from fluoromap_service.deliveries.targets import StowTarget, WebhookTarget
from fluoromap_service.sender.peers import NotDelivered, answer_too_long, answer_too_slow

CONNECT_SECONDS = 10.0

MOST_ANSWER_BYTES = 2**20
"""Longest answer that the sender reads. An answer about one object has some kilobytes."""

_CHUNK_BYTES = 64 * 1024
"""Part of a request that a target must take within its timeout."""


@dataclass(frozen=True, slots=True)
class Answer:
    """The whole answer of a target."""

    status: int
    content: bytes

    @property
    def is_success(self) -> bool:
        """Whether the status is one of 200 to 299."""
        return 200 <= self.status <= 299


class Connection:
    """An HTTP connection to a target, whose answers are limited in length and in total time.

    The limits of httpx are for each part of an answer. A target that sends one byte now and then passes them. Only the end of a
    task on an event loop limits the whole.

    Parameters
    ----------
    runner : Runner
        The event loop of the client.
    client : AsyncClient
    answer_seconds : float
        Longest time from the end of a request to the end of its answer.
    """

    def __init__(self, runner: asyncio.Runner, client: httpx.AsyncClient, answer_seconds: float) -> None:
        self._runner, self._client, self._answer_seconds = runner, client, answer_seconds

    def get(self, url: str, params: Mapping[str, str]) -> Answer:
        """Send a question and return the answer.

        Raises
        ------
        NotDelivered
            When the answer is too long or comes too slowly.
        HTTPError
            When the connection fails.
        """
        return self._runner.run(self._ask("GET", url, params=dict(params)))

    def post(self, url: str, parts: Sequence[bytes], headers: Mapping[str, str] | None = None) -> Answer:
        """Send a body, given in parts, and return the answer. Raises as :meth:`get`."""
        length = {"Content-Length": str(sum(len(part) for part in parts))}
        return self._runner.run(self._ask("POST", url, content=_chunks(parts), headers=length | dict(headers or {})))

    async def _ask(self, method: str, url: str, **request: Any) -> Answer:
        try:
            async with asyncio.timeout(None) as limit:

                async def trace(event: str, info: object) -> None:
                    # A long request may take its time; the clock runs from its end on.
                    if event.endswith("receive_response_headers.started"):
                        limit.reschedule(asyncio.get_running_loop().time() + self._answer_seconds)

                extensions = {"trace": trace}
                async with self._client.stream(method, url, extensions=extensions, **request) as answer:
                    content = bytearray()
                    # Raw: a short compressed answer can be very long.
                    async for chunk in answer.aiter_raw():
                        content += chunk
                        if len(content) > MOST_ANSWER_BYTES:
                            raise answer_too_long()
                    return Answer(answer.status_code, bytes(content))
        except TimeoutError as error:
            raise answer_too_slow() from error


async def _chunks(parts: Sequence[bytes]) -> AsyncIterator[bytes]:
    for part in parts:
        for start in range(0, len(part), _CHUNK_BYTES):
            yield part[start : start + _CHUNK_BYTES]


@contextmanager
def connected(target: StowTarget | WebhookTarget, headers: dict[str, str]) -> Iterator[Connection]:
    """Open an HTTP connection to a target. It follows no redirect.

    Raises
    ------
    NotDelivered
        When the target does not answer, within the block too.
    """
    try:
        verify: ssl.SSLContext | bool = True
        if target.ca_file is not None:
            verify = ssl.create_default_context(cafile=target.ca_file)
    except OSError as error:
        raise unreadable_secret() from error
    timeout = httpx.Timeout(target.timeout_seconds, connect=CONNECT_SECONDS)
    headers = {"Accept-Encoding": "identity", **headers}
    with asyncio.Runner() as runner:
        client = httpx.AsyncClient(verify=verify, headers=headers, timeout=timeout, trust_env=False)
        try:
            yield Connection(runner, client, target.timeout_seconds)
        except httpx.ConnectError as error:
            raise NotDelivered(
                "unreachable", "The target does not answer; check its URL, its certificate and the network."
            ) from error
        except httpx.HTTPError as error:
            raise NotDelivered(
                "connection_lost", "The connection ended before the target answered; look at the target."
            ) from error
        finally:
            runner.run(client.aclose())


def secret_of(path: Path) -> str:
    """Return the text of a file with a secret.

    Raises
    ------
    NotDelivered
        When the file cannot be read or is empty.
    """
    try:
        text = path.read_text().strip()
    except (OSError, UnicodeDecodeError) as error:
        raise unreadable_secret() from error
    if not text:
        raise unreadable_secret()
    return text


def unreadable_secret() -> NotDelivered:
    """Return the failure of a target whose secret or certificate cannot be read."""
    return NotDelivered(
        "configuration",
        "The sender cannot read a secret or certificate of this target; correct the configuration file.",
    )


def refused(status: int, what: str) -> NotDelivered:
    """Return the failure of a request that the target answered with an error."""
    return NotDelivered(
        "object_refused", f"The target answered {what} with the HTTP status {status}; look into the target's log."
    )
