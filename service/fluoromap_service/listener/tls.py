"""TLS of the DICOM listener (PS3.15 annex B): its own certificate, and the check of the senders' certificates."""

from __future__ import annotations

import socket
import ssl
from typing import Any

from fluoromap_service.problem import Problem


class ServerContext(ssl.SSLContext):
    """A TLS context whose handshakes happen in the thread of each association.

    pynetdicom would do them in the thread that accepts all connections: a silent client would hold all others up.
    """

    def wrap_socket(self, sock: socket.socket, *arguments: Any, **options: Any) -> ssl.SSLSocket:
        """Return the TLS socket of a connection, before its handshake."""
        return super().wrap_socket(sock, *arguments, **options | {"do_handshake_on_connect": False})


def server_context(certificate: str, key: str, authorities: str) -> ServerContext | None:
    """Return the TLS context of the listener.

    Parameters
    ----------
    certificate, key : str
        PEM files; without a certificate there is no TLS.
    authorities : str
        PEM file. A sender needs a certificate of one of these authorities. Empty: senders need none.

    Raises
    ------
    Problem
        422 ``invalid_configuration`` when a file cannot be used.
    """
    if not certificate:
        if key or authorities:
            raise _unusable("there is a key or an authority and no certificate")
        return None
    context = ServerContext(ssl.PROTOCOL_TLS_SERVER)
    context.minimum_version = ssl.TLSVersion.TLSv1_2
    try:
        context.load_cert_chain(certificate, key or None)
        if authorities:
            context.load_verify_locations(authorities)
            context.verify_mode = ssl.CERT_REQUIRED
    except OSError as error:
        raise _unusable(error.strerror or type(error).__name__) from error
    return context


def _unusable(reason: str) -> Problem:
    return Problem(
        422,
        "invalid_configuration",
        f"The DICOM listener cannot use its TLS files ({reason}); correct FLUOROMAP_DICOM_TLS_CERTIFICATE, "
        "FLUOROMAP_DICOM_TLS_KEY and FLUOROMAP_DICOM_TLS_CA.",
    )
