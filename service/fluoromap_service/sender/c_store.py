"""A DICOM node as the peer of a delivery: C-STORE, and C-FIND for an object that may have arrived already."""

from __future__ import annotations

import io
import ssl
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import pydicom
from pydicom.dataset import Dataset
from pydicom.uid import ExplicitVRLittleEndian, ImplicitVRLittleEndian
from pynetdicom import AE
from pynetdicom.association import Association
from pynetdicom.sop_class import StudyRootQueryRetrieveInformationModelFind  # type: ignore[attr-defined]

from fluoromap_service.api.results.result_objects import OutgoingObject
from fluoromap_service.deliveries.targets import CStoreTarget
from fluoromap_service.sender.peers import NotDelivered, Peer, answer_too_long, answer_too_slow
from fluoromap_service.settings import settings

CONNECT_SECONDS = 10.0
MOST_MATCHES = 16
"""Most answers to a question for one object. A target that gives more does not end its answer."""
_STORED = frozenset({0x0000, 0x0107, 0x0116, 0xB000, 0xB006, 0xB007, 0x0111})
"""Success, the warnings of PS3.4 table B.2-1, and "duplicate SOP instance" of PS3.7 annex C."""
_PENDING = frozenset({0xFF00, 0xFF01})


@contextmanager
def associated(target: CStoreTarget, objects: Sequence[OutgoingObject]) -> Iterator[Peer]:
    """Open an association with a target for its objects.

    Raises
    ------
    NotDelivered
        When there is no association, or one that accepts not all classes of the objects.
    """
    entity = AE(ae_title=target.calling_aet or settings().dicom_aet)
    entity.connection_timeout = CONNECT_SECONDS
    entity.acse_timeout = entity.dimse_timeout = entity.network_timeout = target.timeout_seconds
    for sop_class in dict.fromkeys(item.sop_class_uid for item in objects):
        # A context for each syntax: the target cannot choose Implicit VR where it could take Explicit VR.
        for syntax in (ExplicitVRLittleEndian, ImplicitVRLittleEndian):
            entity.add_requested_context(sop_class, syntax)
    entity.add_requested_context(StudyRootQueryRetrieveInformationModelFind)
    association = entity.associate(target.host, target.port, ae_title=target.aet, tls_args=_tls(target))
    try:
        _check(association, objects)
        yield _Node(association, target.timeout_seconds)
    finally:
        if association.is_established:
            association.release()


def _tls(target: CStoreTarget) -> tuple[ssl.SSLContext, str] | None:
    if not target.tls:
        return None
    try:
        context = ssl.create_default_context(cafile=target.ca_file)
        if target.certificate_file is not None:
            context.load_cert_chain(target.certificate_file, target.key_file)
    except OSError as error:
        raise NotDelivered(
            "configuration", "The sender cannot read the certificates of this target; correct the configuration file."
        ) from error
    return context, target.host


def _check(association: Association, objects: Sequence[OutgoingObject]) -> None:
    if association.is_rejected:
        answer: Any = association.acceptor.primitive
        raise NotDelivered(
            "association_rejected",
            f"The target rejected the association (result {answer.result}, source {answer.result_source}, diagnostic "
            f"{answer.diagnostic}); compare both AE titles with its configuration.",
        )
    if not association.is_established:
        raise NotDelivered(
            "unreachable", "The target does not answer as a DICOM node; check its address, its port and TLS."
        )
    accepted = {str(context.abstract_syntax) for context in association.accepted_contexts}
    refused = sorted({item.sop_class_uid for item in objects} - accepted)
    if refused:
        raise NotDelivered(
            "class_not_accepted",
            f"The target does not accept the SOP classes {', '.join(refused)}; allow them in its configuration.",
        )


class _Node:
    """An established association with a target."""

    def __init__(self, association: Association, answer_seconds: float) -> None:
        self._association, self._answer_seconds = association, answer_seconds

    def has(self, item: OutgoingObject) -> bool | None:
        model = StudyRootQueryRetrieveInformationModelFind
        if model not in {context.abstract_syntax for context in self._association.accepted_contexts}:
            return None
        query = Dataset()
        query.QueryRetrieveLevel = "IMAGE"
        query.StudyInstanceUID = item.study_instance_uid
        query.SeriesInstanceUID = item.series_instance_uid
        query.SOPInstanceUID = item.sop_instance_uid
        matches, answers, status = 0, 0, None
        # The timeouts of pynetdicom are for each message of an answer.
        end = time.monotonic() + self._answer_seconds
        try:
            for answer, match in self._association.send_c_find(query, model):
                status = answer.get("Status")
                matches += status in _PENDING and match is not None
                answers += 1
                if answers > MOST_MATCHES or time.monotonic() > end:
                    self._association.abort()
                    raise answer_too_long() if answers > MOST_MATCHES else answer_too_slow()
        except RuntimeError as error:
            raise _ended() from error
        # Without an end of the answers nobody knows whether it has the object.
        return bool(matches) if status == 0x0000 else None

    def store(self, item: OutgoingObject) -> None:
        try:
            answer = self._association.send_c_store(pydicom.dcmread(io.BytesIO(item.content)))
        except (RuntimeError, ValueError) as error:
            raise _ended() from error
        status = answer.get("Status")
        if status is None:
            raise _ended()
        if status not in _STORED:
            raise NotDelivered(
                "object_refused",
                f"The target answered {item.name} with the C-STORE status {status:04X}; look into the target's log.",
            )


def _ended() -> NotDelivered:
    return NotDelivered("connection_lost", "The association ended before the target answered; look at the target.")
