"""The deletion of a study, and its certificate: what went, by ids and hashes, without patient data."""

from __future__ import annotations

import hashlib
import json
from typing import Any

from sqlalchemy import func, select
from sqlalchemy.orm import Session

from fluoromap_service.problem import not_found
from fluoromap_service.store import audit, files, reidentification
from fluoromap_service.store.audit import Act
from fluoromap_service.store.models import AuditEntry, Correction, Deletion, File, Instance, Job, Site, StudyInstance
from fluoromap_service.study import studies
from fluoromap_service.study.instances import unlink_unreferenced


def delete(session: Session, study_id: str, who: str) -> list[str]:
    """Delete a study with its jobs, and record the certificate in the same transaction.

    Parameters
    ----------
    session : Session
    study_id : str
    who : str
        The caller, for the audit trail.

    Returns
    -------
    list of str
        Hashes of files; give them to :func:`remove_files` after the commit.

    Raises
    ------
    Problem
        As :func:`fluoromap_service.study.studies.remove`.
    """
    jobs = sorted(session.scalars(select(Job.id).where(Job.study_id == study_id)))
    uids = list(session.scalars(select(StudyInstance.sop_instance_uid).where(StudyInstance.study_id == study_id)))
    sites = session.scalar(select(func.count()).where(Site.study_id == study_id))
    corrections = session.scalar(select(func.count()).where(Correction.study_id == study_id))
    unreferenced = sorted(studies.remove(session, study_id))
    shared = session.scalar(select(func.count()).where(Instance.sop_instance_uid.in_(uids))) or 0
    certificate = {
        "study": study_id,
        "jobs": jobs,
        "files": unreferenced,
        "runs_deleted": len(uids) - shared,
        "runs_of_other_studies": shared,
        "sites": sites,
        "corrections": corrections,
        "reidentification_table": reidentification.table_of(study_id).exists(),
    }
    # The hash in the trail shows later that nobody has changed the certificate.
    (entry,) = audit.append(session, [Act(who, f"delete study; certificate {_hash(certificate)}", study_id)])
    session.add(Deletion(study=study_id, at=entry.at, certificate=certificate, audit_id=entry.id))
    return unreferenced


def remove_files(study_id: str, unreferenced: list[str]) -> None:
    """Remove the files of a deleted study from the disk.

    When the process ends before, :func:`fluoromap_service.study.orphans.remove_orphans` removes them later.
    """
    unlink_unreferenced(unreferenced)
    reidentification.remove_table(study_id)


def certificate_of(session: Session, study_id: str) -> dict[str, Any]:
    """Return the certificate of a deleted study, with its entry of the audit trail.

    ``files_left`` lists those of its files that are on the disk now although nothing refers to them; ``at`` is in seconds since
    1970 UTC.

    Raises
    ------
    Problem
        404 when no study of this id was deleted.
    """
    deletion = session.get(Deletion, study_id)
    if deletion is None:
        raise not_found("certificate of a deleted study")
    certificate, entry = deletion.certificate, session.get_one(AuditEntry, deletion.audit_id)
    gone = certificate["files"]
    stored_again = set(session.scalars(select(File.sha256).where(File.sha256.in_(gone))))
    left = [sha256 for sha256 in gone if sha256 not in stored_again and files.path_of(sha256).exists()]
    return {
        **certificate,
        "at": deletion.at,
        "by": entry.who,
        "files_left": left,
        "certificate_sha256": _hash(certificate),
        "audit": {"entry": entry.id, "what": entry.what, "hash": entry.hash},
    }


def _hash(certificate: dict[str, Any]) -> str:
    return hashlib.sha256(json.dumps(certificate, sort_keys=True, separators=(",", ":")).encode()).hexdigest()
