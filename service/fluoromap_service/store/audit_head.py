"""The head of the audit trail goes out of the database, so that nobody can cut off the trail or write it anew unnoticed.

The head is the hash of the newest entry; it stands for all entries before it. A line with it goes to the log and, where
``FLUOROMAP_AUDIT_HEAD_FILE`` names one, to a file in another place. ``fluoromap audit verify --against`` compares such lines with
the trail.
"""

from __future__ import annotations

import json
import os
import re
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import structlog
from sqlalchemy import select
from sqlalchemy.orm import Session

from fluoromap_service.settings import settings
from fluoromap_service.store.audit import START
from fluoromap_service.store.engine import reading
from fluoromap_service.store.models import AuditEntry

EVENT = "audit_head"
"""Event of the lines with a head."""

log = structlog.get_logger(__name__)


@dataclass(frozen=True, slots=True)
class Head:
    """Id and hash of the newest entry; 0 and :data:`START` for an empty trail."""

    entry: int
    hash: str


def head_of(session: Session) -> Head:
    """Return the present head."""
    row = session.execute(select(AuditEntry.id, AuditEntry.hash).order_by(AuditEntry.id.desc()).limit(1)).first()
    return Head(0, START) if row is None else Head(row.id, row.hash)


class HeadWatch:
    """Publishes the head of the trail when it has changed, and notices when the one before is no longer in the trail."""

    def __init__(self) -> None:
        self.published: Head | None = None
        """The head that went out last."""
        self.breaks = 0
        """How often a published head was not in the trail any more."""

    def publish(self) -> None:
        """Let the present head out."""
        before = self.published
        with reading() as session:
            # The entry first: others may be appended between the two queries.
            kept = before is None or before.entry == 0 or _hash_of(session, before.entry) == before.hash
            head = head_of(session)
        if not kept and before is not None:
            self.breaks += 1
            log.error("audit_trail_rewritten", entry=before.entry, head=before.hash)
        if head != before:
            log.info(EVENT, entry=head.entry, head=head.hash)
            _append(head)
            self.published = head


def published_hashes(path: Path) -> list[str]:
    """Return the hashes of all heads in a file.

    It is the file of heads, or a log of the service.

    Raises
    ------
    OSError
        When the file cannot be read.
    """
    found = []
    for line in path.read_text(errors="replace").splitlines():
        try:
            record = json.loads(line)
        except ValueError:
            # A log can have lines of other programs.
            continue
        if isinstance(record, dict) and record.get("event") == EVENT and is_hash(str(record.get("head"))):
            found.append(str(record["head"]))
    return found


def is_hash(text: str) -> bool:
    """Return whether a text is the hash of an entry."""
    return re.fullmatch("[0-9a-f]{64}", text) is not None


def _hash_of(session: Session, entry: int) -> str | None:
    return session.scalar(select(AuditEntry.hash).where(AuditEntry.id == entry))


def _append(head: Head) -> None:
    if not settings().audit_head_file:
        return
    line = {"event": EVENT, "entry": head.entry, "head": head.hash, "timestamp": datetime.now(UTC).isoformat()}
    with Path(settings().audit_head_file).open("a") as file:
        file.write(json.dumps(line) + "\n")
        file.flush()
        os.fsync(file.fileno())
