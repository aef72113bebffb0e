"""The listener with TLS: its certificate, the senders' certificates, and clients that never finish a handshake."""

from __future__ import annotations

import shutil
import socket
import ssl
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pydicom
import pytest
from pynetdicom import AE
from pynetdicom.association import Association
from pynetdicom.sop_class import Verification, XRayAngiographicImageStorage
from small_runs import small_run

from fluoromap_service.listener import server
from fluoromap_service.listener.allow_list import AllowList
from fluoromap_service.listener.tls import server_context
from fluoromap_service.problem import Problem

pytestmark = pytest.mark.skipif(
    shutil.which("openssl") is None, reason="openssl is not installed; it makes the certificates"
)


def make_certificate(folder: Path, name: str) -> tuple[str, str]:
    """Return the files of a new self-signed certificate and of its key.

    The certificate is for this machine.
    """
    certificate, key = folder / f"{name}.pem", folder / f"{name}.key"
    subprocess.run(
        ["openssl", "req", "-x509", "-newkey", "rsa:2048", "-nodes", "-days", "1", "-subj", f"/CN={name}", "-addext",
         "subjectAltName=IP:127.0.0.1", "-out", certificate, "-keyout", key],
        check=True, capture_output=True,
    )  # fmt: skip
    return str(certificate), str(key)


@contextmanager
def listening(certificate: str, key: str, authorities: str) -> Iterator[int]:
    tls = server_context(certificate, key, authorities)
    running = server.start("127.0.0.1", 0, "FLUOROMAP", AllowList.from_text("XA_ROOM_1"), tls)
    try:
        yield running.server_address[1]
    finally:
        running.ae.shutdown()


def associate(port: int, tls: ssl.SSLContext | None) -> Association:
    entity = AE(ae_title="XA_ROOM_1")
    entity.acse_timeout = entity.dimse_timeout = 60
    entity.add_requested_context(Verification)
    entity.add_requested_context(XRayAngiographicImageStorage)
    entity.add_requested_context(XRayAngiographicImageStorage, pydicom.uid.ExplicitVRLittleEndian)
    return entity.associate("127.0.0.1", port, ae_title="FLUOROMAP", tls_args=tls and (tls, "127.0.0.1"))


def client_context(authority: str, own: tuple[str, str] | None = None) -> ssl.SSLContext:
    context = ssl.create_default_context(cafile=authority)
    if own is not None:
        context.load_cert_chain(*own)
    return context


@pytest.mark.usefixtures("data_dir", "file_processes")
def test_store_over_tls(tmp_path: Path) -> None:
    certificate, key = make_certificate(tmp_path, "listener")
    run = tmp_path / "run.dcm"
    run.write_bytes(small_run(tmp_path, 1, 0.0))
    with listening(certificate, key, "") as port:
        association = associate(port, client_context(certificate))
        assert association.is_established
        assert association.send_c_store(pydicom.dcmread(run)).Status == 0x0000
        association.release()
        assert not associate(port, None).is_established


@pytest.mark.usefixtures("data_dir")
def test_senders_need_a_certificate_of_the_authority(tmp_path: Path) -> None:
    certificate, key = make_certificate(tmp_path, "listener")
    known, stranger = make_certificate(tmp_path, "known"), make_certificate(tmp_path, "stranger")
    with listening(certificate, key, known[0]) as port:
        association = associate(port, client_context(certificate, known))
        assert association.send_c_echo().Status == 0x0000
        association.release()
        assert not associate(port, client_context(certificate, stranger)).is_established
        assert not associate(port, client_context(certificate)).is_established


@pytest.mark.usefixtures("data_dir")
def test_silent_clients_hold_nobody_up(tmp_path: Path) -> None:
    certificate, key = make_certificate(tmp_path, "listener")
    with listening(certificate, key, "") as port:
        silent = [socket.create_connection(("127.0.0.1", port)) for _ in range(5)]
        association = associate(port, client_context(certificate))
        assert association.send_c_echo().Status == 0x0000
        association.release()
        for connection in silent:
            connection.close()


def test_old_protocols_are_refused(tmp_path: Path) -> None:
    context = server_context(*make_certificate(tmp_path, "listener"), "")
    assert context is not None
    assert context.minimum_version >= ssl.TLSVersion.TLSv1_2


def test_unusable_files_have_a_sentence(tmp_path: Path) -> None:
    certificate, key = make_certificate(tmp_path, "listener")
    assert server_context("", "", "") is None
    for files in (
        ("", key, ""),
        (str(tmp_path / "none.pem"), key, ""),
        (certificate, certificate, ""),
        (certificate, key, key),
    ):
        with pytest.raises(Problem, match="FLUOROMAP_DICOM_TLS_CERTIFICATE"):
            server_context(*files)
