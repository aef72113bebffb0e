"""A listener in this process, and a sender."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path

import pytest
from pydicom.uid import ExplicitVRLittleEndian, XRayAngiographicImageStorage
from pynetdicom import AE
from pynetdicom.association import Association
from pynetdicom.sop_class import Verification
from pynetdicom.transport import ThreadedAssociationServer

from fluoromap_service.api.http import file_pool
from fluoromap_service.listener import server
from fluoromap_service.listener.allow_list import AllowList

Open = Callable[..., AbstractContextManager[Association]]


@pytest.fixture(scope="session")
def file_processes() -> Iterator[None]:
    """End the processes of the file pool with the session."""
    yield
    file_pool.close()


@pytest.fixture
def listener(data_dir: Path, file_processes: None) -> Iterator[ThreadedAssociationServer]:
    """A listener on a free port that allows the sender XA_ROOM_1 from this machine."""
    running = server.start("127.0.0.1", 0, "FLUOROMAP", AllowList.from_text("XA_ROOM_1@127.0.0.0/8"))
    yield running
    running.ae.shutdown()


@pytest.fixture
def open_association(listener: ThreadedAssociationServer) -> Open:
    """Open an association with the listener for a block, by default as a sender of XA runs."""

    @contextmanager
    def open_one(
        *contexts: tuple[str, str | list[str]], calling: str = "XA_ROOM_1", called: str = "FLUOROMAP"
    ) -> Iterator[Association]:
        entity = AE(ae_title=calling)
        entity.acse_timeout = entity.dimse_timeout = 60
        entity.add_requested_context(Verification)
        for sop_class, syntaxes in contexts or ((XRayAngiographicImageStorage, ExplicitVRLittleEndian),):
            entity.add_requested_context(sop_class, syntaxes)
        association = entity.associate("127.0.0.1", listener.server_address[1], ae_title=called)
        try:
            yield association
        finally:
            if association.is_established:
                association.release()

    return open_one
