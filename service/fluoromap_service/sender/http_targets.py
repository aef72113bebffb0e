"""The connection to a target that speaks HTTP, and the sentences for its failures."""

from __future__ import annotations

import ssl
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import httpx

from fluoromap_service.deliveries.targets import StowTarget, WebhookTarget
from fluoromap_service.sender.peers import NotDelivered

CONNECT_SECONDS = 10.0


@contextmanager
def connected(target: StowTarget | WebhookTarget, headers: dict[str, str]) -> Iterator[httpx.Client]:
    """Open an HTTP client for a target. It follows no redirect.

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
    with httpx.Client(verify=verify, headers=headers, timeout=timeout, trust_env=False) as client:
        try:
            yield client
        except httpx.ConnectError as error:
            raise NotDelivered(
                "unreachable", "The target does not answer; check its URL, its certificate and the network."
            ) from error
        except httpx.HTTPError as error:
            raise NotDelivered(
                "connection_lost", "The connection ended before the target answered; look at the target."
            ) from error


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
