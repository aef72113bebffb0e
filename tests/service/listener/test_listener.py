"""The DICOM listener against a real peer: what it stores, what it refuses with which status, and what it leaves behind."""

from __future__ import annotations

import io
import socket
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, suppress
from pathlib import Path
from typing import Any, cast

import pydicom
import pytest
from fastapi.testclient import TestClient
from pydicom.dataset import Dataset
from pydicom.uid import (
    JPEG2000,
    MPEG2MPML,
    CTImageStorage,
    DeflatedExplicitVRLittleEndian,
    EnhancedXAImageStorage,
    ExplicitVRLittleEndian,
    ImplicitVRLittleEndian,
    JPEGBaseline8Bit,
    JPEGLosslessSV1,
    RLELossless,
    XRayAngiographicImageStorage,
    XRayRadiofluoroscopicImageStorage,
)
from pynetdicom import AE, evt
from pynetdicom.association import Association
from pynetdicom.dimse_messages import C_STORE_RQ
from pynetdicom.dimse_primitives import C_STORE
from pynetdicom.dsutils import encode
from pynetdicom.transport import ThreadedAssociationServer
from small_runs import STUDY_UID, edited, run_uid, small_run
from sqlalchemy import func, select

from fluoromap_service.dicom.store_statuses import StoreStatus
from fluoromap_service.listener import server
from fluoromap_service.listener.allow_list import AllowList
from fluoromap_service.settings import settings
from fluoromap_service.store import audit, files
from fluoromap_service.store.engine import reading
from fluoromap_service.store.models import File, Instance, Study, StudyInstance

OTHER_STUDY = "1.2.826.0.1.3680043.8.498.77"


Open = Callable[..., AbstractContextManager[Association]]


def dataset(content: bytes) -> Dataset:
    return pydicom.dcmread(io.BytesIO(content))


def count(table: Any) -> int:
    with reading() as session:
        return session.scalar(select(func.count()).select_from(table)) or 0


def files_on_disk() -> list[Path]:
    return [path for path in settings().files_dir.rglob("*") if path.is_file()]


def assert_nothing_stored() -> None:
    assert (count(Instance), count(File), count(StudyInstance)) == (0, 0, 0)
    assert files_on_disk() == []


def test_echo(open_association: Open) -> None:
    with open_association() as association:
        assert association.send_c_echo().Status == 0x0000


def test_runs_of_a_dicom_study_join_one_mapping_study(open_association: Open, tmp_path: Path) -> None:
    with open_association() as association:
        for number, angle in ((1, 0.0), (2, 90.0)):
            assert association.send_c_store(dataset(small_run(tmp_path, number, angle))).Status == 0x0000
        other = edited(small_run(tmp_path, 3, 0.0), StudyInstanceUID=OTHER_STUDY)
        assert association.send_c_store(dataset(other)).Status == 0x0000
    with reading() as session:
        links = session.execute(
            select(Study.study_instance_uid, StudyInstance.sop_instance_uid)
            .join(StudyInstance)
            .order_by(StudyInstance.id)
        ).all()
        acts = [(entry.who, entry.what, entry.study) for entry in audit.entries(session)]
        study = session.scalars(select(Study.id).where(Study.study_instance_uid == STUDY_UID)).one()
    assert [tuple(link) for link in links] == [
        (STUDY_UID, run_uid(1)), (STUDY_UID, run_uid(2)), (OTHER_STUDY, run_uid(3)),
    ]  # fmt: skip
    assert acts[0] == ("DICOM XA_ROOM_1", "C-STORE", study)


def test_stored_data_set_is_the_one_that_was_sent(open_association: Open, tmp_path: Path) -> None:
    sent = dataset(small_run(tmp_path, 1, 0.0))
    with open_association() as association:
        assert association.send_c_store(sent).Status == 0x0000
    with reading() as session:
        sha256 = session.scalars(select(Instance.sha256)).one()
    stored = pydicom.dcmread(io.BytesIO(files.read(sha256)))
    assert stored == sent
    assert stored.file_meta.TransferSyntaxUID == sent.file_meta.TransferSyntaxUID


def test_upload_over_http_and_c_store_of_one_run_are_one(
    open_association: Open, service: TestClient, study_path: str, tmp_path: Path
) -> None:
    content = small_run(tmp_path, 1, 0.0)
    answer = service.post(f"{study_path}/instances", content=content, headers={"content-type": "application/dicom"})
    assert answer.status_code == 201
    with open_association() as association:
        assert association.send_c_store(dataset(content)).Status == 0x0000
    assert (count(Instance), count(File), count(Study), count(StudyInstance)) == (1, 1, 2, 2)


def test_same_run_again_is_success_and_stored_once(open_association: Open, tmp_path: Path) -> None:
    run = dataset(small_run(tmp_path, 1, 0.0))
    with open_association() as association:
        assert [association.send_c_store(run).Status for _ in range(2)] == [0x0000, 0x0000]
    assert (count(Instance), count(StudyInstance), len(files_on_disk())) == (1, 1, 1)


def test_other_pixels_under_a_known_uid_are_refused(open_association: Open, tmp_path: Path) -> None:
    run = dataset(small_run(tmp_path, 1, 0.0))
    with open_association() as association:
        assert association.send_c_store(run).Status == 0x0000
        kept = files_on_disk()
        run.PixelData = bytes(len(run.PixelData))
        answer = association.send_c_store(run)
        assert answer.Status == StoreStatus.OTHER_CONTENT
        assert answer.ErrorComment == "sop_instance_uid_taken"
        assert association.send_c_echo().Status == 0x0000
    assert files_on_disk() == kept


@pytest.mark.parametrize(
    ("calling", "called", "diagnostic"),
    [("STRANGER", "FLUOROMAP", 0x03), ("XA_ROOM_1", "OTHER", 0x07)],
    ids=["calling", "called"],
)
def test_wrong_titles_are_rejected(open_association: Open, calling: str, called: str, diagnostic: int) -> None:
    with open_association(calling=calling, called=called) as association:
        assert association.is_rejected
        answer = association.acceptor.primitive
        assert (answer.result, answer.result_source, answer.diagnostic) == (0x01, 0x01, diagnostic)


def test_title_from_another_address_is_rejected(data_dir: Path) -> None:
    listener = server.start("127.0.0.1", 0, "FLUOROMAP", AllowList.from_text("XA_ROOM_1@192.0.2.7"))
    try:
        entity = AE(ae_title="XA_ROOM_1")
        entity.add_requested_context(XRayAngiographicImageStorage)
        association = entity.associate("127.0.0.1", listener.server_address[1], ae_title="FLUOROMAP")
        assert association.is_rejected
    finally:
        listener.ae.shutdown()


def test_negotiation_accepts_what_the_service_reads_and_nothing_else(open_association: Open) -> None:
    contexts = [
        (str(XRayAngiographicImageStorage), str(ExplicitVRLittleEndian)),
        (str(EnhancedXAImageStorage), str(ImplicitVRLittleEndian)),
        (str(XRayRadiofluoroscopicImageStorage), str(DeflatedExplicitVRLittleEndian)),
        (str(XRayAngiographicImageStorage), str(MPEG2MPML)),
        (str(CTImageStorage), str(ExplicitVRLittleEndian)),
    ]
    with open_association(*contexts) as association:
        accepted = {(cx.abstract_syntax, cx.transfer_syntax[0]) for cx in association.accepted_contexts}
        refused = {(cx.abstract_syntax, cx.result) for cx in association.rejected_contexts}
    assert set(contexts[:3]) < accepted
    # PS3.8 table 9-18: 3 abstract syntax, 4 transfer syntaxes not supported.
    assert refused == {(str(CTImageStorage), 3), (str(XRayAngiographicImageStorage), 4)}


@pytest.mark.parametrize("order", [1, -1])
def test_the_first_syntax_of_the_sender_is_taken(open_association: Open, order: int) -> None:
    """For each context by itself, also where several have one class."""
    xa = str(XRayAngiographicImageStorage)
    proposed = [
        [JPEGLosslessSV1, ImplicitVRLittleEndian], [ExplicitVRLittleEndian, ImplicitVRLittleEndian],
        [MPEG2MPML, JPEG2000, ExplicitVRLittleEndian], [ExplicitVRLittleEndian, JPEG2000, MPEG2MPML],
        [RLELossless, JPEGBaseline8Bit, DeflatedExplicitVRLittleEndian],
    ]  # fmt: skip
    lists = [[str(syntax) for syntax in syntaxes][::order] for syntaxes in proposed]
    contexts = [(xa, syntaxes) for syntaxes in lists]
    with open_association(*contexts) as association:
        taken = [cx.transfer_syntax[0] for cx in association.accepted_contexts if cx.abstract_syntax == xa]
        assert association.send_c_echo().Status == 0x0000
    assert taken == [next(syntax for syntax in syntaxes if syntax != MPEG2MPML) for syntaxes in lists]


def test_a_context_without_a_known_syntax_is_refused_beside_others(open_association: Open) -> None:
    xa = str(XRayAngiographicImageStorage)
    with open_association((xa, [str(MPEG2MPML)]), (xa, [str(JPEG2000)])) as association:
        assert [cx.result for cx in association.rejected_contexts] == [4]
        assert JPEG2000 in [cx.transfer_syntax[0] for cx in association.accepted_contexts]


@pytest.mark.parametrize(
    ("changes", "status", "comment"),
    [
        ({"SOPInstanceUID": "1.2.3"}, StoreStatus.NOT_OF_THIS_CLASS, "not_xa"),
        ({"Rows": None}, StoreStatus.CANNOT_UNDERSTAND, "malformed"),
        ({"NumberOfFrames": 9}, StoreStatus.CANNOT_UNDERSTAND, "pixel_data_mismatch"),
        ({"PixelData": None}, StoreStatus.CANNOT_UNDERSTAND, "no_pixel_data"),
    ],
    ids=["other UID", "no rows", "frames", "no pixels"],
)
def test_unusable_data_sets_have_defined_statuses(
    open_association: Open, tmp_path: Path, changes: dict[str, Any], status: int, comment: str
) -> None:
    content = small_run(tmp_path, 1, 0.0)
    request = _request(dataset(edited(content, **changes)), run_uid(1))
    with open_association() as association:
        # As send_c_store does: the reactor would take the answer.
        association._reactor_checkpoint.clear()
        _send(association, request)
        _, answer = association.dimse.get_msg(block=True)
        association._reactor_checkpoint.set()
        assert (answer.Status, answer.ErrorComment) == (status, comment)
        assert association.send_c_echo().Status == 0x0000
    assert_nothing_stored()


def test_object_larger_than_allowed_is_refused(
    open_association: Open, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("FLUOROMAP_MAX_UPLOAD_BYTES", "5000")
    settings.cache_clear()
    with open_association() as association:
        answer = association.send_c_store(dataset(small_run(tmp_path, 1, 0.0)))
        assert (answer.Status, answer.ErrorComment) == (StoreStatus.OUT_OF_RESOURCES, "too_large")
    assert_nothing_stored()


def test_full_disk_is_out_of_resources(open_association: Open, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fluoromap_service.store.disk.free_bytes", lambda: 0)
    monkeypatch.setattr("fluoromap_service.listener.arriving.BUFFER_BYTES", 1000)
    with open_association() as association:
        answer = association.send_c_store(dataset(small_run(tmp_path, 1, 0.0)))
        assert (answer.Status, answer.ErrorComment) == (StoreStatus.OUT_OF_RESOURCES, "no_space")
    assert_nothing_stored()


def test_aborted_transfer_leaves_nothing(
    open_association: Open, listener: ThreadedAssociationServer, tmp_path: Path
) -> None:
    closed = threading.Event()
    listener.bind(evt.EVT_CONN_CLOSE, lambda event: closed.set())
    started = threading.Event()
    listener.bind(evt.EVT_PDU_RECV, lambda event: started.set() if list(files_on_disk()) else None)
    request = _request(dataset(small_run(tmp_path, 1, 0.0)), run_uid(1))
    with open_association() as association:
        _send(association, request, fragments=4)
        assert started.wait(60)
        association.abort()
    assert closed.wait(60)
    assert_nothing_stored()
    with open_association() as association:
        assert association.send_c_store(dataset(small_run(tmp_path, 1, 0.0))).Status == 0x0000


def test_pdu_of_absurd_length_ends_its_association_only(
    open_association: Open, listener: ThreadedAssociationServer
) -> None:
    with socket.create_connection(("127.0.0.1", listener.server_address[1]), timeout=60) as connection:
        connection.sendall(b"\x01\x00\xff\xff\xff\xff" + bytes(100))
        with suppress(ConnectionResetError):
            assert connection.recv(100) == b""
    with open_association() as association:
        assert association.send_c_echo().Status == 0x0000


def test_sender_that_falls_silent_in_a_pdu_loses_its_association(
    data_dir: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(server, "IDLE_SECONDS", 0.5)
    listener = server.start("127.0.0.1", 0, "FLUOROMAP", AllowList.from_text("XA_ROOM_1"))
    closed = threading.Event()
    listener.bind(evt.EVT_CONN_CLOSE, lambda event: closed.set())
    entity = AE(ae_title="XA_ROOM_1")
    entity.add_requested_context(XRayAngiographicImageStorage, ExplicitVRLittleEndian)
    try:
        association = entity.associate("127.0.0.1", listener.server_address[1], ae_title="FLUOROMAP")
        assert association.is_established
        # A P-DATA PDU of 1000 bytes, of which 10 come (PS3.8 section 9.3.5).
        association.dul.socket.socket.sendall(b"\x04\x00\x00\x00\x03\xe8" + bytes(10))
        assert closed.wait(60)
    finally:
        listener.ae.shutdown()
    assert_nothing_stored()


def test_command_for_another_class_than_its_context_stores_nothing(open_association: Open, tmp_path: Path) -> None:
    request = _request(dataset(small_run(tmp_path, 1, 0.0)), run_uid(1))
    request.AffectedSOPClassUID = CTImageStorage
    with open_association() as association:
        association._reactor_checkpoint.clear()
        _send(association, request)
        _, answer = association.dimse.get_msg(block=True)
        association._reactor_checkpoint.set()
        assert answer.Status != 0x0000
        assert association.send_c_echo().Status == 0x0000
    assert_nothing_stored()


@pytest.mark.parametrize("kept_bytes", [200, 1500, -1000])
def test_truncated_data_set_is_refused_and_its_association_lives(
    open_association: Open, tmp_path: Path, kept_bytes: int
) -> None:
    run = dataset(small_run(tmp_path, 1, 0.0))
    request = _request(run, run_uid(1))
    whole = cast(io.BytesIO, request.DataSet).getvalue()
    request.DataSet = io.BytesIO(whole[:kept_bytes])
    with open_association() as association:
        association._reactor_checkpoint.clear()
        _send(association, request)
        _, answer = association.dimse.get_msg(block=True)
        association._reactor_checkpoint.set()
        assert answer.Status in (StoreStatus.CANNOT_UNDERSTAND, StoreStatus.NOT_OF_THIS_CLASS)
        assert_nothing_stored()
        assert association.send_c_store(run).Status == 0x0000


def test_many_associations_at_once_are_served_or_rejected(open_association: Open) -> None:
    together = threading.Barrier(200)

    def call(_: int) -> str:
        with open_association() as association:
            together.wait(60)
            return "served" if association.is_established else "rejected"

    with ThreadPoolExecutor(200) as threads:
        outcomes = list(threads.map(call, range(200)))
    # An association that is being rejected counts until its connection has ended, so that fewer may be served.
    assert 1 <= outcomes.count("served") <= settings().dicom_associations
    with open_association() as association:
        assert association.send_c_echo().Status == 0x0000


def _request(run: pydicom.Dataset, uid: str) -> C_STORE:
    """Return the command for a data set under a UID, also another one."""
    request = C_STORE()
    request.MessageID = 1
    request.AffectedSOPClassUID = str(XRayAngiographicImageStorage)
    request.AffectedSOPInstanceUID = uid
    request.Priority = 2
    encoded = encode(run, False, True)
    assert encoded is not None
    request.DataSet = io.BytesIO(encoded)
    return request


def _send(association: Any, request: C_STORE, fragments: int | None = None) -> None:
    """Send a C-STORE request in small fragments, or only the first of them."""
    (context,) = [cx for cx in association.accepted_contexts if cx.abstract_syntax == XRayAngiographicImageStorage]
    assert context.transfer_syntax[0] == ExplicitVRLittleEndian
    message = C_STORE_RQ()
    message.primitive_to_message(request)
    for number, fragment in enumerate(message.encode_msg(context.context_id, 2048)):
        if number == fragments:
            return
        association.dul.send_pdu(fragment)
