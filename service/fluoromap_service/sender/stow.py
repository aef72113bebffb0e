"""A DICOMweb server as the peer of a delivery: STOW-RS, and QIDO-RS for an object that may have arrived already."""

from __future__ import annotations

import json
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from fluoromap_service.api.results.result_objects import OutgoingObject
from fluoromap_service.auth import is_loopback
from fluoromap_service.deliveries.targets import StowTarget
from fluoromap_service.sender.http_targets import Answer, Connection, connected, refused, secret_of
from fluoromap_service.sender.peers import NotDelivered, Peer

_FAILED, _REASON = "00081198", "00081197"  # FailedSOPSequence, FailureReason: PS3.18 annex I.2.2
_DUPLICATE = 0x0111
_JSON = "application/dicom+json"


def shows_secret(target: StowTarget) -> bool:
    """Return whether the network between would see the header Authorization of a target."""
    plain = target.url.scheme == "http" and not is_loopback(target.url.host or "")
    return plain and target.authorization_file is not None


@contextmanager
def open_server(target: StowTarget) -> Iterator[Peer]:
    """Open a connection to a DICOMweb server.

    Raises
    ------
    NotDelivered
        When it does not answer, within the block too.
    """
    headers = {"Accept": _JSON}
    if shows_secret(target) and not target.allow_insecure:
        raise NotDelivered(
            "insecure_target",
            "The header Authorization of this target would cross the network without TLS. Give the target an https URL, or set "
            "allow_insecure = true in the configuration file.",
        )
    if target.authorization_file is not None:
        headers["Authorization"] = secret_of(target.authorization_file)
    with connected(target, headers) as connection:
        yield _Server(connection, str(target.url).rstrip("/"))


class _Server:
    """A DICOMweb server with its base address."""

    def __init__(self, connection: Connection, base: str) -> None:
        self._connection, self._base = connection, base

    def has(self, item: OutgoingObject) -> bool | None:
        answer = self._connection.get(
            f"{self._base}/studies/{item.study_instance_uid}/series/{item.series_instance_uid}/instances",
            {"SOPInstanceUID": item.sop_instance_uid},
        )
        if answer.status in (204, 404):
            return False
        found = _json(answer) if answer.status == 200 else None
        return bool(found) if isinstance(found, list) else None

    def store(self, item: OutgoingObject) -> None:
        boundary = secrets.token_hex(16)
        head = f"--{boundary}\r\nContent-Type: application/dicom\r\n\r\n".encode()
        tail = f"\r\n--{boundary}--\r\n".encode()
        answer = self._connection.post(
            f"{self._base}/studies",
            [head, item.content, tail],
            {"Content-Type": f'multipart/related; type="application/dicom"; boundary={boundary}'},
        )
        failed = _failures(_json(answer))
        if failed and all(reason == _DUPLICATE for reason in failed):
            return
        if failed or not answer.is_success:
            raise refused(answer.status, item.name)


def _json(answer: Answer) -> Any:
    try:
        return json.loads(answer.content)
    except (ValueError, RecursionError):
        return None


def _failures(document: Any) -> list[Any]:
    """Return the failure reasons of an answer to STOW-RS."""
    try:
        return [item[_REASON]["Value"][0] for item in document[_FAILED]["Value"]]
    except (KeyError, IndexError, TypeError):
        return []
