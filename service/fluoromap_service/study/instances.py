"""Runs: DICOM instances, kept once by SOP Instance UID, and what each study says of them."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sqlalchemy import delete, select
from sqlalchemy.orm import Session

from fluoromap.geometry.gantry import UPRIGHT, ImageAxes, view_axes
from fluoromap_service.dicom.facts import InstanceFacts
from fluoromap_service.dicom.orientation import image_axes_from_orientation
from fluoromap_service.problem import Problem
from fluoromap_service.store import files
from fluoromap_service.store.engine import writing
from fluoromap_service.store.models import ENDED_JOB, Correction, File, Instance, Job, Rendering, Site, StudyInstance
from fluoromap_service.study.snapshot import GantrySnapshot

GANTRY_KEYWORDS = {
    "primary_deg": "PositionerPrimaryAngle",
    "secondary_deg": "PositionerSecondaryAngle",
    "source_detector_mm": "DistanceSourceToDetector",
    "source_isocentre_mm": "DistanceSourceToPatient",
    "pixel_spacing_mm": "ImagerPixelSpacing",
}
"""Gantry fields and the DICOM keywords that tell them."""


@dataclass(frozen=True, eq=False)
class StudyRun:
    """One run as a study sees it."""

    link: StudyInstance
    instance: Instance
    facts: InstanceFacts

    @property
    def uid(self) -> str:
        return self.facts.sop_instance_uid

    @property
    def gantry(self) -> dict[str, Any]:
        return gantry_values(self.facts, self.link.gantry)[0]

    @property
    def missing(self) -> list[str]:
        return gantry_values(self.facts, self.link.gantry)[1]


def gantry_values(facts: InstanceFacts, override: dict[str, Any]) -> tuple[dict[str, Any], list[str]]:
    """The header's gantry values, completed and overridden by the study's, and the DICOM keywords still missing."""
    values = {
        field: override[field] if override.get(field) is not None else getattr(facts, field)
        for field in GANTRY_KEYWORDS
    }
    return values, [keyword for field, keyword in GANTRY_KEYWORDS.items() if values[field] is None]


def effective_gantry(facts: InstanceFacts, override: dict[str, Any]) -> GantrySnapshot | None:
    """The run's whole geometry, or None while something is missing."""
    values, missing = gantry_values(facts, override)
    if missing:
        return None
    return GantrySnapshot(**values, rows=facts.rows, columns=facts.columns, image_axes=_image_axes(facts, values))


def _image_axes(facts: InstanceFacts, values: dict[str, Any]) -> ImageAxes:
    angles_came_later = facts.primary_deg is None or facts.secondary_deg is None
    if not angles_came_later or facts.patient_orientation is None or facts.image_axes != UPRIGHT:
        return facts.image_axes
    told = image_axes_from_orientation(facts.patient_orientation, values["primary_deg"], values["secondary_deg"])
    return told or facts.image_axes


def ray_angle_deg(first: StudyRun, second: StudyRun) -> float | None:
    """Angle between two runs' central rays, folded to 0..90 degrees; None while gantry angles are missing."""
    axes = [central_ray(run) for run in (first, second)]
    if axes[0] is None or axes[1] is None:
        return None
    cosine = abs(sum(a * b for a, b in zip(axes[0], axes[1], strict=True)))
    return math.degrees(math.acos(min(cosine, 1.0)))


def central_ray(run: StudyRun) -> tuple[float, float, float] | None:
    """Unit vector from the isocentre to the detector in patient axes (LPS); None while gantry angles are missing."""
    primary, secondary = run.gantry["primary_deg"], run.gantry["secondary_deg"]
    if primary is None or secondary is None:
        return None
    x, y, z = view_axes(primary, secondary)[2].tolist()
    return x, y, z


def runs_of(session: Session, study_id: str) -> list[StudyRun]:
    """All runs of a study in the order of arrival."""
    query = (
        select(StudyInstance, Instance)
        .join(Instance, Instance.sop_instance_uid == StudyInstance.sop_instance_uid)
        .where(StudyInstance.study_id == study_id)
        .order_by(StudyInstance.id)
    )
    return [
        StudyRun(link, instance, InstanceFacts.from_json(instance.facts)) for link, instance in session.execute(query)
    ]


def run_of(session: Session, study_id: str, uid: str) -> StudyRun:
    """One run of a study.

    Raises
    ------
    Problem
        404 when the study has no such run.
    """
    row = session.execute(
        select(StudyInstance, Instance)
        .join(Instance, Instance.sop_instance_uid == StudyInstance.sop_instance_uid)
        .where(StudyInstance.study_id == study_id, StudyInstance.sop_instance_uid == uid)
    ).first()
    if row is None:
        raise Problem(404, "not_found", "There is no such instance in this study.")
    return StudyRun(row[0], row[1], InstanceFacts.from_json(row[1].facts))


def add(
    session: Session,
    study_id: str,
    path: Path,
    facts: InstanceFacts,
    sha256: str,
    *,
    file_name: str | None,
    site: str | None,
) -> bool:
    """Store an incoming file and refer to it from the study. False when both were there already.

    Raises
    ------
    Problem
        409 when other bytes are stored under the same SOP Instance UID.
    """
    files.lock(session)
    known = session.get(Instance, facts.sop_instance_uid)
    if known is not None and known.sha256 != sha256:
        raise Problem(
            409,
            "sop_instance_uid_taken",
            "Another file with the same SOP Instance UID is stored already; the sender must mint a new UID for changed files.",
            [("SOPInstanceUID", "already stored with other content")],
        )
    if known is None:
        files.keep(session, path, "application/dicom", sha256=sha256)
        session.add(
            Instance(
                sop_instance_uid=facts.sop_instance_uid,
                sha256=sha256,
                study_instance_uid=facts.study_instance_uid,
                series_instance_uid=facts.series_instance_uid,
                series_number=facts.series_number,
                acquired=facts.acquired.isoformat() if facts.acquired else None,
                facts=facts.to_json(),
            )
        )
        session.flush()
    link = session.scalar(
        select(StudyInstance).where(
            StudyInstance.study_id == study_id, StudyInstance.sop_instance_uid == facts.sop_instance_uid
        )
    )
    if link is not None:
        if site is not None and link.site_by != "explicit":
            link.site, link.site_by = site, "upload"
        return False
    session.add(
        StudyInstance(
            study_id=study_id,
            sop_instance_uid=facts.sop_instance_uid,
            file_name=file_name,
            site=site,
            site_by="upload" if site is not None else None,
            gantry={},
        )
    )
    session.flush()
    return True


def remove(session: Session, study_id: str, uid: str) -> list[str]:
    """Take a run out of a study; the instance goes too when no other study refers to it.

    Returns
    -------
    list of str
        Hashes of files to hand to :func:`unlink_unreferenced` after the commit.

    Raises
    ------
    Problem
        404 when there is no such run, 409 while a job works on it.
    """
    run = run_of(session, study_id, uid)
    active = session.scalars(select(Job.snapshot).where(Job.study_id == study_id, Job.state.not_in(list(ENDED_JOB))))
    if any(uid in snapshot["runs"] for snapshot in active):
        raise Problem(409, "job_running", "A job is working on this run; cancel it or wait for its end.")
    session.delete(run.link)
    session.execute(delete(Correction).where(Correction.study_id == study_id, Correction.sop_instance_uid == uid))
    for site in session.scalars(select(Site).where(Site.study_id == study_id)):
        site.explicit_a = None if site.explicit_a == uid else site.explicit_a
        site.explicit_b = None if site.explicit_b == uid else site.explicit_b
        if uid in (site.paired_a, site.paired_b):
            site.paired_a = site.paired_b = None
    # Pictures show the run itself: those that were kept go with it.
    ended = select(Job.id).where(Job.study_id == study_id)
    kept = list(session.scalars(select(Rendering.sha256).where(Rendering.job_id.in_(ended))))
    session.execute(delete(Rendering).where(Rendering.job_id.in_(ended)))
    session.flush()
    return forget_instances(session, [uid], also=kept)


def forget_instances(session: Session, uids: Iterable[str], also: Iterable[str] = ()) -> list[str]:
    """Delete those instances no study refers to, and the rows of their files and of the files ``also``, where unused.

    Returns the hashes of the files whose rows went, for :func:`unlink_unreferenced` after the commit.
    """
    files.lock(session)
    candidates = list(also)
    for uid in uids:
        if session.scalar(select(StudyInstance.id).where(StudyInstance.sop_instance_uid == uid).limit(1)) is None:
            instance = session.get(Instance, uid)
            if instance is not None:
                candidates.append(instance.sha256)
                session.delete(instance)
    session.flush()
    return [path.name for path in files.remove_unreferenced(session, candidates)]


def unlink_unreferenced(hashes: Iterable[str]) -> None:
    """Remove files from the disk whose rows are gone, unless the same content has arrived again since."""
    for sha256 in hashes:
        with writing() as session:
            files.lock(session)
            if session.get(File, sha256) is None:
                files.path_of(sha256).unlink(missing_ok=True)
