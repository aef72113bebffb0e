"""The DICOM listener as a pynetdicom server: negotiation, allow-list, limits, and the handlers of C-ECHO and C-STORE."""

from __future__ import annotations

import logging
import ssl
from collections.abc import Callable
from typing import Any, cast

import structlog
from pydicom.dataset import Dataset
from pynetdicom import AE, _config, dimse_messages, evt
from pynetdicom.sop_class import Verification  # type: ignore[attr-defined]
from pynetdicom.transport import ThreadedAssociationServer
from sqlalchemy.exc import SQLAlchemyError

from fluoromap_service.api.http.file_pool import Task, run_in_pool
from fluoromap_service.dicom import DicomCode, dicom_problem
from fluoromap_service.dicom.indexed_header import read_run
from fluoromap_service.dicom.pixel_layout import DECODABLE
from fluoromap_service.dicom.reading import CAPTURES, PROJECTIONS
from fluoromap_service.dicom.store_statuses import StoreStatus, status_of
from fluoromap_service.listener.allow_list import AllowList
from fluoromap_service.listener.arriving import ArrivingFile
from fluoromap_service.listener.tls import ServerContext
from fluoromap_service.problem import Problem
from fluoromap_service.settings import settings
from fluoromap_service.store.audit import Act
from fluoromap_service.store.engine import writing
from fluoromap_service.study.arrivals import add_arrival

STORAGE_CLASSES = tuple(sorted(PROJECTIONS)) + tuple(sorted(CAPTURES))
"""SOP classes that the listener stores."""
TRANSFER_SYNTAXES = tuple(sorted(DECODABLE))
"""Transfer syntaxes that the listener accepts for storage."""
PDU_BYTES = 128 * 1024
"""Largest PDU that the listener announces (PS3.8 annex D.1)."""
LONGEST_PDU_BYTES = 1 << 20
"""A longer PDU ends the association, so that its length cannot fill the memory."""
IDLE_SECONDS = 60.0
"""Silence after which an association is ended."""
NEGOTIATION_SECONDS = 20.0
"""Time for the negotiation of an association."""

_REJECTED_PERMANENT, _BY_USER, _CALLING_TITLE = 0x01, 0x01, 0x03  # PS3.8 section 9.3.4

log = structlog.get_logger(__name__)


def start(
    host: str, port: int, title: str, allow: AllowList, tls: ServerContext | None = None
) -> ThreadedAssociationServer:
    """Start the listener in threads of its own and return it.

    Its ``ae.shutdown()`` ends it and its associations. With ``tls`` it speaks TLS only.

    Raises
    ------
    OSError
        When the listener cannot listen on the address.
    """
    # Objects go to disk while they arrive, into files of the store.
    _config.STORE_RECV_CHUNKED_DATASET = True
    setattr(dimse_messages, "NamedTemporaryFile", ArrivingFile)  # noqa: B010
    # pynetdicom's own lines may quote headers; this module logs what happens.
    _config.LOG_HANDLER_LEVEL = "none"
    logging.getLogger("pynetdicom").setLevel(logging.CRITICAL)
    entity = AE(ae_title=title)
    entity.maximum_pdu_size = PDU_BYTES
    entity.maximum_associations = settings().dicom_associations
    entity.require_called_aet = True
    entity.acse_timeout = NEGOTIATION_SECONDS
    entity.network_timeout = entity.dimse_timeout = IDLE_SECONDS
    entity.add_supported_context(Verification)
    for storage_class in STORAGE_CLASSES:
        entity.add_supported_context(storage_class, list(TRANSFER_SYNTAXES))
    handlers: list[tuple[evt.EventType, Callable[..., Any]]] = [
        (evt.EVT_CONN_OPEN, _prepare_connection),
        (evt.EVT_REQUESTED, lambda event: _check_sender(event, allow)),
        (evt.EVT_C_STORE, _store),
        (evt.EVT_CONN_CLOSE, _discard_unfinished),
    ]
    server = entity.start_server((host, port), block=False, ssl_context=tls, evt_handlers=cast(Any, handlers))
    assert server is not None
    return server


def _prepare_connection(event: evt.Event) -> None:
    """Prepare a new connection.

    Do its TLS handshake, and limit its silence and the length of its PDUs.
    """
    association = cast(Any, event.assoc)
    connection, stream = association.dul.socket, association.dul.socket.socket
    if isinstance(stream, ssl.SSLSocket):
        stream.settimeout(NEGOTIATION_SECONDS)
        try:
            stream.do_handshake()
        except OSError as error:
            log.warning(
                "tls_handshake_failed", address=association.requestor.address_info.address, error=type(error).__name__
            )
            connection.close()
            return
    # A sender that falls silent in the middle of a PDU would hold its association for ever.
    stream.settimeout(IDLE_SECONDS)

    def receive(count: int) -> bytearray:
        if count > LONGEST_PDU_BYTES:
            raise OSError("the PDU is longer than the listener accepts")
        content = bytearray(count)
        with memoryview(content) as view:
            arrived = 0
            while arrived < count:
                more = stream.recv_into(view[arrived:])
                if not more:
                    return bytearray(view[:arrived])
                arrived += more
        return content

    connection.recv = receive


def _check_sender(event: evt.Event, allow: AllowList) -> None:
    association = event.assoc
    title = _text(cast(Any, association.requestor.primitive).calling_ae_title)
    address = cast(Any, association.requestor.address_info).address
    if allow.allows(title, address):
        _take_senders_order(association)
        return
    log.warning("association_rejected", calling_aet=title, address=address)
    association.acse.send_reject(_REJECTED_PERMANENT, _BY_USER, _CALLING_TITLE)
    association.kill()


def _take_senders_order(association: Any) -> None:
    """Reduce each proposed context to its first transfer syntax that is accepted.

    A sender names the syntax first in which it has the object, so that it need not decompress. pynetdicom would take the first
    syntax of the listener's own list (PS3.8 section 9.3.2.2: the acceptor chooses).
    """
    accepted = {context.abstract_syntax: context.transfer_syntax for context in association.acceptor.supported_contexts}
    for proposed in association.requestor.primitive.presentation_context_definition_list:
        known = accepted.get(proposed.abstract_syntax, ())
        first = next((syntax for syntax in proposed.transfer_syntax if syntax in known), None)
        if first is not None:
            proposed.transfer_syntax = [first]


def _text(title: str | bytes | None) -> str:
    return (title.decode("ascii", "replace") if isinstance(title, bytes) else title or "").strip()


def _discard_unfinished(event: evt.Event) -> None:
    """Remove the file of an object whose connection ended before its last byte."""
    file = getattr(event.assoc.dimse.message, "_data_set_file", None)
    if file is not None:
        file.close()


def _store(event: evt.Event) -> Dataset:
    title = _text(cast(Any, event.assoc.requestor.primitive).calling_ae_title)
    status, code = _outcome(cast(Any, event.request), title)
    if status != StoreStatus.SUCCESS:
        log.warning("object_refused", calling_aet=title, status=f"{status:04X}", code=code)
    answer = Dataset()
    answer.Status = int(status)
    if code is not None:
        answer.ErrorComment = code
    return answer


def _outcome(request: Any, title: str) -> tuple[StoreStatus, str | None]:
    file: ArrivingFile = request._dataset_file
    try:
        study, new = _keep(request, file, title)
    except Problem as problem:
        return status_of(problem), problem.code
    except OSError:
        return StoreStatus.OUT_OF_RESOURCES, "no_space"
    except SQLAlchemyError as error:
        log.error("database_away", error=type(error).__name__)
        return StoreStatus.OUT_OF_RESOURCES, "unavailable"
    except Exception as error:
        log.error("storing_failed", error=type(error).__name__)
        return StoreStatus.PROCESSING_FAILURE, "internal"
    log.info("object_stored", calling_aet=title, study=study, new=new)
    return StoreStatus.SUCCESS, None


def _keep(request: Any, file: ArrivingFile, title: str) -> tuple[str, bool]:
    if file.too_large:
        raise Problem(413, "too_large", "The object is larger than the service accepts; send a shorter run.")
    if file.disk_full:
        raise OSError("no space")
    file.finish()
    # A hostile file can crash a decoder, so another process reads it.
    run = run_in_pool(Task.READ_FILE, read_run, file.path)
    facts = run.facts
    if (facts.sop_class_uid, facts.sop_instance_uid) != (request.AffectedSOPClassUID, request.AffectedSOPInstanceUID):
        raise dicom_problem(
            DicomCode.NOT_XA, "The UIDs of the data set differ from those of the C-STORE command; send it again."
        )
    with writing() as session:
        return add_arrival(session, file.path, run, file.sha256, Act(f"DICOM {title}", "C-STORE"))
