"""Runs: DICOM instances, stored once by SOP Instance UID, and each study's own facts about them."""

from __future__ import annotations

import functools
import json
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sqlalchemy import Row, Text, bindparam, cast, delete, select
from sqlalchemy.orm import Session

from fluoromap.geometry.gantry import UPRIGHT, ImageAxes
from fluoromap_service.dicom.facts import InstanceFacts
from fluoromap_service.dicom.indexed_header import ReadRun
from fluoromap_service.dicom.inflation import have_same_data_set
from fluoromap_service.dicom.orientation import image_axes_from_orientation
from fluoromap_service.problem import Problem, not_found
from fluoromap_service.store import files
from fluoromap_service.store.engine import empty_write_ahead_log, writing
from fluoromap_service.store.models import (
    ENDED_JOB,
    Correction,
    File,
    Instance,
    Job,
    Rendering,
    Site,
    Study,
    StudyInstance,
)
from fluoromap_service.study import dicom_index
from fluoromap_service.study.snapshot import GantrySnapshot

GANTRY_KEYWORDS = {
    "primary_deg": "PositionerPrimaryAngle",
    "secondary_deg": "PositionerSecondaryAngle",
    "source_detector_mm": "DistanceSourceToDetector",
    "source_isocentre_mm": "DistanceSourceToPatient",
    "pixel_spacing_mm": "ImagerPixelSpacing",
}
"""Gantry fields and their DICOM keywords."""


DISTANCES = ("source_detector_mm", "source_isocentre_mm")


def is_behind_detector(gantry: dict[str, Any]) -> bool:
    """Return whether gantry values put the isocentre on or behind the detector."""
    detector, isocentre = (gantry.get(field) for field in DISTANCES)
    return detector is not None and isocentre is not None and isocentre >= detector


@dataclass(frozen=True, eq=False)
class StudyRun:
    """One run of a study.

    Parameters
    ----------
    arrival : int
        Rises in the order in which the runs came into the study.
    file_name : str or None
        As uploaded; may name the patient: never in a log, path or error.
    site, site_by : str or None
        Site that an upload or a person gave, and "upload" or "explicit".
    own_gantry : dict
        Gantry values that the study sets for this run.
    sha256 : str
        Content address of the file.
    facts : InstanceFacts
        Facts of the file's header.
    defaults : dict
        Gantry values of the study for all runs.
    """

    arrival: int
    file_name: str | None
    site: str | None
    site_by: str | None
    own_gantry: dict[str, Any]
    sha256: str
    facts: InstanceFacts
    defaults: dict[str, Any]

    @property
    def uid(self) -> str:
        """The SOP Instance UID."""
        return self.facts.sop_instance_uid

    @property
    def gantry(self) -> dict[str, Any]:
        """Effective gantry values: the run's own, else the header's, else the study's; None where unknown.

        The study's distances do not count for a run whose isocentre they would put behind the detector.
        """
        values = self.gantry_with(self.defaults)
        if not is_behind_detector(values):
            return values
        return self.gantry_with({field: value for field, value in self.defaults.items() if field not in DISTANCES})

    def gantry_with(self, defaults: dict[str, Any]) -> dict[str, Any]:
        """Return the gantry values with these defaults for the values that the run lacks."""
        own, values = self.own_gantry, {}
        for field in GANTRY_KEYWORDS:
            value = own.get(field)
            if value is None:
                value = getattr(self.facts, field)
            values[field] = defaults.get(field) if value is None else value
        return values

    @property
    def missing(self) -> list[str]:
        """DICOM keywords of the gantry values that are unknown."""
        return [GANTRY_KEYWORDS[field] for field, value in self.gantry.items() if value is None]

    @property
    def geometry(self) -> GantrySnapshot | None:
        """The run's whole geometry; None while a value is missing."""
        values, facts = self.gantry, self.facts
        if None in values.values():
            return None
        axes = _image_axes(facts, values)
        return GantrySnapshot(**values, rows=facts.rows, columns=facts.columns, image_axes=axes)


def _image_axes(facts: InstanceFacts, values: dict[str, Any]) -> ImageAxes:
    angles_came_later = facts.primary_deg is None or facts.secondary_deg is None
    if not angles_came_later or facts.patient_orientation is None or facts.image_axes != UPRIGHT:
        return facts.image_axes
    axes = image_axes_from_orientation(facts.patient_orientation, values["primary_deg"], values["secondary_deg"])
    return axes or facts.image_axes


def runs_of(session: Session, study_id: str) -> list[StudyRun]:
    """Return all runs of a study in the order of arrival."""
    return [_run(row) for row in session.execute(_RUNS, {"study_id": study_id})]


def run_of(session: Session, study_id: str, uid: str) -> StudyRun:
    """Return one run of a study.

    Raises
    ------
    Problem
        404 when the study has no such run.
    """
    row = session.execute(_ONE_RUN, {"study_id": study_id, "uid": uid}).first()
    if row is None:
        raise not_found("instance in this study")
    return _run(row)


def link_of(session: Session, study_id: str, uid: str) -> StudyInstance:
    """Return the row of a study's reference to a run, for a change.

    Raises
    ------
    Problem
        404 when the study has no such run.
    """
    link = session.scalar(_LINK, {"study_id": study_id, "uid": uid})
    if link is None:
        raise not_found("instance in this study")
    return link


# Built once, and columns instead of whole rows: each request on a study reads its runs.
_RUNS = (
    select(
        StudyInstance.id,
        StudyInstance.file_name,
        StudyInstance.site,
        StudyInstance.site_by,
        StudyInstance.gantry,
        Instance.sha256,
        cast(Instance.facts, Text),
        Study.gantry,
    )
    .join(Instance, Instance.sop_instance_uid == StudyInstance.sop_instance_uid)
    .join(Study, Study.id == StudyInstance.study_id)
    .where(StudyInstance.study_id == bindparam("study_id"))
    .order_by(StudyInstance.id)
)
_ONE_RUN = _RUNS.where(StudyInstance.sop_instance_uid == bindparam("uid"))
_LINK = select(StudyInstance).where(
    StudyInstance.study_id == bindparam("study_id"), StudyInstance.sop_instance_uid == bindparam("uid")
)
_STORED_HASH = select(Instance.sha256).where(Instance.sop_instance_uid == bindparam("uid"))


def _run(row: Row[int, str | None, str | None, str | None, dict[str, Any], str, str, dict[str, Any]]) -> StudyRun:
    arrival, file_name, site, site_by, gantry, sha256, facts, defaults = row
    return StudyRun(arrival, file_name, site, site_by, gantry, sha256, _facts(facts), defaults)


@functools.lru_cache(maxsize=2048)
def _facts(text: str) -> InstanceFacts:
    """Return the facts of a run from their stored JSON.

    Every upload reads all runs of its study, so each text is decoded only once.
    """
    return InstanceFacts.from_json(json.loads(text))


def add(
    session: Session,
    study_id: str,
    path: Path,
    run: ReadRun,
    sha256: str,
    *,
    file_name: str | None,
    site: str | None,
) -> bool:
    """Store an incoming file and refer to it from the study.

    Return False when both exist already. The file is stored again in that case too, because the stored one may be damaged.
    A file with the stored data set and other file meta information counts as the stored file: each sender writes its own
    (PS3.10 section 7.1).

    Raises
    ------
    Problem
        409 when the store has another data set under the same SOP Instance UID.
    """
    facts = run.facts
    files.lock(session)
    known = session.scalar(_STORED_HASH, {"uid": facts.sop_instance_uid})
    copy = known is not None and known != sha256
    if known is not None and copy and not _has_stored_data_set(path, known):
        raise Problem(
            409,
            "sop_instance_uid_taken",
            "The store has another file with the same SOP Instance UID; the sender must make a new UID for a changed file.",
            [("SOPInstanceUID", "already stored with other content")],
        )
    if not copy:
        files.keep(session, path, sha256=sha256)
    if known is None:
        session.add(
            Instance(
                sop_instance_uid=facts.sop_instance_uid,
                sha256=sha256,
                study_instance_uid=facts.study_instance_uid,
                series_instance_uid=facts.series_instance_uid,
                facts=facts.to_json(),
            )
        )
        session.flush()
    if not copy:
        dicom_index.put_run(session, facts, run.header)
    link = session.scalar(_LINK, {"study_id": study_id, "uid": facts.sop_instance_uid})
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


def _has_stored_data_set(path: Path, known: str) -> bool:
    try:
        return have_same_data_set(path, files.checked_path(known))
    except files.BrokenFile:
        return False


def remove(session: Session, study_id: str, uid: str) -> list[str]:
    """Take a run out of a study.

    The instance is deleted when no other study refers to it.

    Returns
    -------
    list of str
        Hashes of files; give them to :func:`unlink_unreferenced` after the commit.

    Raises
    ------
    Problem
        404 when there is no such run, 409 while a job works on it.
    """
    link = link_of(session, study_id, uid)
    active = session.scalars(select(Job.snapshot).where(Job.study_id == study_id, Job.state.not_in(list(ENDED_JOB))))
    if any(uid in snapshot["runs"] for snapshot in active):
        raise Problem(409, "job_running", "A job is working on this run; cancel it or wait for its end.")
    session.delete(link)
    session.execute(delete(Correction).where(Correction.study_id == study_id, Correction.sop_instance_uid == uid))
    for site in session.scalars(select(Site).where(Site.study_id == study_id)):
        site.explicit_a = None if site.explicit_a == uid else site.explicit_a
        site.explicit_b = None if site.explicit_b == uid else site.explicit_b
        if uid in (site.ordered_a, site.ordered_b):
            site.ordered_a = site.ordered_b = None
    # Kept pictures show the run itself: delete them with it.
    ended = select(Job.id).where(Job.study_id == study_id)
    kept = list(session.scalars(select(Rendering.sha256).where(Rendering.job_id.in_(ended))))
    session.execute(delete(Rendering).where(Rendering.job_id.in_(ended)))
    dicom_index.forget_results(session, session.scalars(ended))
    session.flush()
    return forget_instances(session, [uid], also=kept)


def forget_instances(session: Session, uids: Iterable[str], also: Iterable[str] = ()) -> list[str]:
    """Delete the instances that no study refers to, and the rows of unused files.

    Parameters
    ----------
    session : Session
    uids : iterable of str
        SOP Instance UIDs of the instances; their files are candidates.
    also : iterable of str
        Hashes of further candidates.

    Returns
    -------
    list of str
        Hashes of files without a row; give them to :func:`unlink_unreferenced` after the commit.
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
    """Remove files without a row from the disk, unless the same content arrived again meanwhile."""
    for sha256 in hashes:
        with writing() as session:
            files.lock(session)
            if session.get(File, sha256) is None:
                files.path_of(sha256).unlink(missing_ok=True)
    empty_write_ahead_log()
