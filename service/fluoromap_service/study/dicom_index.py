"""The rows by which DICOMweb finds an object: its header, and the values that searches compare."""

from __future__ import annotations

from collections.abc import Iterable

from sqlalchemy import delete, update
from sqlalchemy.orm import Session

from fluoromap_service.dicom.facts import InstanceFacts
from fluoromap_service.dicom.indexed_header import IndexedHeader
from fluoromap_service.store.models import DicomObject, DicomValue, Instance

MODALITY, SOP_CLASS = "00080060", "00080016"
_INSERT_VALUES = DicomValue.__table__.insert()  # type: ignore[attr-defined]


def put_run(session: Session, facts: InstanceFacts, header: IndexedHeader) -> None:
    """Store the rows of a run in place of its old ones.

    The run's own row exists already.
    """
    session.execute(delete(DicomObject).where(DicomObject.run == facts.sop_instance_uid))
    row = DicomObject(
        uid=facts.sop_instance_uid,
        study_uid=facts.study_instance_uid,
        series_uid=facts.series_instance_uid,
        run=facts.sop_instance_uid,
    )
    _add(session, row, header)
    session.execute(update(Instance).where(Instance.sop_instance_uid == facts.sop_instance_uid).values(is_indexed=True))


def add_result(session: Session, job_id: str, name: str, header: IndexedHeader) -> None:
    """Store the rows of a DICOM object of a job."""
    uid, study_uid, series_uid = (header.first_value(tag) for tag in ("00080018", "0020000D", "0020000E"))
    _add(session, DicomObject(uid=uid, study_uid=study_uid, series_uid=series_uid, job_id=job_id, name=name), header)


def forget_results(session: Session, job_ids: Iterable[str]) -> None:
    """Delete the rows of the results of jobs.

    A search for their study makes them again.
    """
    session.execute(delete(DicomObject).where(DicomObject.job_id.in_(list(job_ids))))


def _add(session: Session, row: DicomObject, header: IndexedHeader) -> None:
    single = {value.path: value.first for value in reversed(header.values)}
    row.modality, row.sop_class_uid = single.get(MODALITY), single.get(SOP_CLASS)
    row.header, row.is_whole, row.unreadable = header.json, header.is_whole, header.unreadable
    session.add(row)
    session.flush()
    # The mapper takes longer for each row than the table's own statement, and a header has hundreds of values.
    values = [
        {"object_id": row.id, "path": value.path, "item": value.item, "first": value.first, "last": value.last}
        for value in header.values
    ]
    if values:
        session.connection().execute(_INSERT_VALUES, values)
