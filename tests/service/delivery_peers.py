"""Targets of deliveries in this process: a DICOM node, a DICOMweb server and a webhook receiver, which count what arrives."""

from __future__ import annotations

import io
import json
import socketserver
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from email.message import Message
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pydicom
from pydicom.dataset import Dataset
from pynetdicom import AE, AllStoragePresentationContexts, _config, evt
from pynetdicom.sop_class import StudyRootQueryRetrieveInformationModelFind
from python_multipart import MultipartParser

from fluoromap_service.deliveries.targets import CStoreTarget, StowTarget, WebhookTarget

QUICK = {"first_wait_seconds": 1e-3, "longest_wait_seconds": 1e-3, "timeout_seconds": 60.0}
"""Waits of a target in tests."""

TARGETS = (
    CStoreTarget(name="pacs", kind="dicom", host="192.0.2.8", port=104, aet="PACS"),
    StowTarget(name="archive", kind="dicomweb", url="https://archive.example/dicom-web"),
    WebhookTarget(name="hook", kind="webhook", url="https://registry.example", secret_file=Path("/nonexistent")),
)
"""A target of each kind that does not exist."""

Arrival = Callable[[Dataset], int | None]
"""Called with an object before it counts as stored. A status refuses the object."""


@dataclass
class Archive:
    """The objects of a target in the order of arrival; a repeated object is in the list twice."""

    stored: list[Dataset] = field(default_factory=list)
    arrival: Arrival = lambda item: None
    on_stored: Callable[[Dataset], None] = lambda item: None
    questions: int = 0
    authorizations: list[str | None] = field(default_factory=list)

    @property
    def uids(self) -> list[str]:
        return [str(item.SOPInstanceUID) for item in self.stored]

    def take(self, item: Dataset) -> int | None:
        """Store an object; return the status that refuses it."""
        status = self.arrival(item)
        if status is None:
            self.stored.append(item)
            self.on_stored(item)
        return status


@contextmanager
def dicom_node(
    archive: Archive, *, answers_questions: bool = True, port: int = 0, handlers: Any = (), classes: int | None = None
) -> Iterator[CStoreTarget]:
    """Run a DICOM node with the AE title PACS and yield it as a target.

    It accepts the first ``classes`` SOP classes only.
    """

    def store(event: evt.Event) -> int:
        item = event.dataset
        item.file_meta = event.file_meta
        return archive.take(item) or 0x0000

    def find(event: evt.Event) -> Iterator[tuple[int, Dataset | None]]:
        archive.questions += 1
        if event.identifier.SOPInstanceUID in archive.uids:
            yield 0xFF00, event.identifier

    entity = AE(ae_title="PACS")
    entity.supported_contexts = AllStoragePresentationContexts[:classes]
    if answers_questions:
        entity.add_supported_context(StudyRootQueryRetrieveInformationModelFind)
    entity.require_called_aet = True
    # The listener of an earlier test lets pynetdicom write objects to files, for the whole process.
    chunked, _config.STORE_RECV_CHUNKED_DATASET = _config.STORE_RECV_CHUNKED_DATASET, False
    server = entity.start_server(
        ("127.0.0.1", port), block=False, evt_handlers=[(evt.EVT_C_STORE, store), (evt.EVT_C_FIND, find), *handlers]
    )
    try:
        yield CStoreTarget(
            name="pacs", kind="dicom", host="127.0.0.1", port=server.server_address[1], aet="PACS", **QUICK
        )
    finally:
        server.shutdown()
        _config.STORE_RECV_CHUNKED_DATASET = chunked


@contextmanager
def dicomweb_server(archive: Archive) -> Iterator[StowTarget]:
    """Run a DICOMweb server for STOW-RS and QIDO-RS, and yield it as a target."""

    class Handler(_Handler):
        def do_POST(self) -> None:
            assert self.path == "/dicom-web/studies"
            archive.authorizations.append(self.headers["Authorization"])
            (content,) = _parts(self.headers["Content-Type"], self.body())
            item = pydicom.dcmread(io.BytesIO(content))
            status = archive.take(item)
            reference = {"00081155": {"vr": "UI", "Value": [item.SOPInstanceUID]}}
            if status is None:
                self.answer(200, {"00081199": {"vr": "SQ", "Value": [reference]}})
            else:
                failed = reference | {"00081197": {"vr": "US", "Value": [status]}}
                self.answer(409, {"00081198": {"vr": "SQ", "Value": [failed]}})

        def do_GET(self) -> None:
            archive.questions += 1
            uid = self.path.rpartition("=")[2]
            self.answer(200, [{"00080018": {"vr": "UI", "Value": [uid]}}]) if uid in archive.uids else self.answer(204)

    with _serving(Handler) as url:
        yield StowTarget(name="archive", kind="dicomweb", url=f"{url}/dicom-web", **QUICK)


@contextmanager
def endless_server(head: bytes, part: bytes, pause_seconds: float) -> Iterator[tuple[str, list[int]]]:
    """Run a server whose answers never end.

    Yield its URL and the lengths of the answers that clients took until they hung up.
    """
    taken: list[int] = []

    class Handler(socketserver.StreamRequestHandler):
        def handle(self) -> None:
            length = next(
                int(line.split(b":")[1])
                for line in iter(self.rfile.readline, b"")
                if line.lower().startswith(b"content-length")
            )
            while self.rfile.readline().strip():
                pass
            self.rfile.read(length)
            sent = 0
            try:
                self.wfile.write(head)
                while not stop.wait(pause_seconds):
                    self.wfile.write(part)
                    sent += len(part)
            except OSError:
                taken.append(sent)

    stop = threading.Event()
    with socketserver.ThreadingTCPServer(("127.0.0.1", 0), Handler) as server:
        server.daemon_threads = True
        threading.Thread(target=server.serve_forever, daemon=True).start()
        try:
            yield f"http://127.0.0.1:{server.server_address[1]}", taken
        finally:
            stop.set()
            server.shutdown()


@dataclass
class Inbox:
    """The messages of a webhook receiver, and the statuses that it still answers before 204."""

    messages: list[tuple[Message, bytes]] = field(default_factory=list)
    statuses: list[int] = field(default_factory=list)


@contextmanager
def webhook_receiver(inbox: Inbox) -> Iterator[str]:
    """Run a receiver of messages and yield its URL."""

    class Handler(_Handler):
        def do_POST(self) -> None:
            inbox.messages.append((self.headers, self.body()))
            self.answer(inbox.statuses.pop(0) if inbox.statuses else 204)

    with _serving(Handler) as url:
        yield f"{url}/hook"


class _Handler(BaseHTTPRequestHandler):
    def log_message(self, *_: Any) -> None:
        """Write nothing."""

    def body(self) -> bytes:
        return self.rfile.read(int(self.headers["Content-Length"]))

    def answer(self, status: int, document: Any = None) -> None:
        content = b"" if document is None else json.dumps(document).encode()
        self.send_response(status)
        self.send_header("Content-Type", "application/dicom+json")
        if status != 204:
            self.send_header("Content-Length", str(len(content)))
        self.end_headers()
        self.wfile.write(content)


@contextmanager
def _serving(handler: type[BaseHTTPRequestHandler]) -> Iterator[str]:
    server = ThreadingHTTPServer(("127.0.0.1", 0), handler)
    server.daemon_threads = True
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_address[1]}"
    finally:
        server.shutdown()
        server.server_close()


def _parts(content_type: str, body: bytes) -> list[bytes]:
    message = Message()
    message["content-type"] = content_type
    assert (message.get_content_type(), message.get_param("type")) == ("multipart/related", "application/dicom")
    parts: list[bytearray] = []
    parser = MultipartParser(
        str(message.get_param("boundary")).encode(),
        {"on_part_begin": lambda: parts.append(bytearray()), "on_part_data": lambda d, s, e: parts[-1].extend(d[s:e])},
    )
    parser.write(body)
    parser.finalize()
    return [bytes(part) for part in parts]
