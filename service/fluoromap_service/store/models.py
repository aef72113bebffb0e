"""The tables. Times are seconds since 1970 UTC by the database's clock; frames in corrections count from 1."""

from __future__ import annotations

from enum import StrEnum
from typing import Any

from sqlalchemy import (
    DDL,
    JSON,
    BigInteger,
    Boolean,
    Float,
    ForeignKey,
    Index,
    Integer,
    MetaData,
    String,
    Text,
    UniqueConstraint,
    event,
    false,
)
from sqlalchemy.orm import DeclarativeBase, Mapped, mapped_column

from fluoromap_service.store.clock import db_now

Json = dict[str, Any]


CodePoints = Text().with_variant(Text(collation="C"), "postgresql")
"""Text in the order of code points, as SQLite orders it; the index then serves ranges and beginnings too."""


class Base(DeclarativeBase):
    """Base of all tables."""

    metadata = MetaData(
        naming_convention={
            "ix": "ix_%(column_0_label)s",
            "uq": "uq_%(table_name)s_%(column_0_name)s",
            "fk": "fk_%(table_name)s_%(column_0_name)s_%(referred_table_name)s",
            "pk": "pk_%(table_name)s",
        }
    )
    type_annotation_map = {dict[str, Any]: JSON, list[Any]: JSON, float: Float(53)}  # noqa: RUF012


class JobState(StrEnum):
    """The state of a job."""

    QUEUED = "queued"  # no stage has been claimed yet
    RUNNING = "running"
    SUCCEEDED = "succeeded"
    FAILED = "failed"
    CANCELLED = "cancelled"


class StageState(StrEnum):
    """The state of a stage."""

    PENDING = "pending"  # waits for other stages
    READY = "ready"  # may be claimed; a committed ready row is the outbox
    RUNNING = "running"  # claimed; alive while its lease is extended
    DONE = "done"
    FAILED = "failed"
    CANCELLED = "cancelled"


class DeliveryState(StrEnum):
    """The state of a delivery."""

    PENDING = "pending"  # may be claimed from its due time on; a committed pending row is the outbox
    SENDING = "sending"  # claimed; alive while its lease is extended
    DELIVERED = "delivered"
    FAILED = "failed"  # given up; somebody may ask for another try


class ObjectState(StrEnum):
    """The state of one object of a delivery."""

    PENDING = "pending"
    SENDING = "sending"  # after a crash nobody knows whether the target has it
    DELIVERED = "delivered"


ENDED_JOB = frozenset({JobState.SUCCEEDED, JobState.FAILED, JobState.CANCELLED})
ENDED_STAGE = frozenset({StageState.DONE, StageState.FAILED, StageState.CANCELLED})


class Token(Base):
    """An access token; the table has only the hash of its text."""

    __tablename__ = "token"
    id: Mapped[int] = mapped_column(primary_key=True)
    name: Mapped[str] = mapped_column(String(100), unique=True)
    sha256: Mapped[str] = mapped_column(String(64), unique=True)
    scopes: Mapped[list[Any]]
    created: Mapped[float] = mapped_column(default=db_now())
    expires: Mapped[float | None]
    revoked: Mapped[float | None]


class BrowserSession(Base):
    """A session of a browser, or a link that begins one; the table has only the hash of its secret."""

    __tablename__ = "browser_session"
    id: Mapped[int] = mapped_column(primary_key=True)
    sha256: Mapped[str] = mapped_column(String(64), unique=True)
    token_id: Mapped[int] = mapped_column(ForeignKey("token.id", ondelete="CASCADE"), index=True)
    opened: Mapped[float | None]  # None while it is a link that nobody has opened
    expires: Mapped[float]


class SignInFailure(Base):
    """A wrong token that somebody sent lately."""

    __tablename__ = "sign_in_failure"
    __table_args__ = (Index("ix_sign_in_failure_address_at", "address", "at"),)
    id: Mapped[int] = mapped_column(primary_key=True)
    address: Mapped[str] = mapped_column(String(64))
    at: Mapped[float] = mapped_column(default=db_now(), index=True)


class File(Base):
    """A file in the store, by the hash of its content."""

    __tablename__ = "file"
    sha256: Mapped[str] = mapped_column(String(64), primary_key=True)
    state: Mapped[list[Any] | None]  # inode, size and times of the file on disk when it was stored


class Study(Base):
    """A mapping study: one rhythm of one patient."""

    __tablename__ = "study"
    __table_args__ = (Index("ix_study_created_id", "created", "id"),)
    id: Mapped[str] = mapped_column(String(32), primary_key=True)
    label: Mapped[str] = mapped_column(String(200))
    chamber: Mapped[str | None] = mapped_column(String(100))
    notes: Mapped[str | None] = mapped_column(Text)
    catheters: Mapped[list[Any]]
    reference: Mapped[str | None] = mapped_column(String(64))
    mapping: Mapped[str] = mapped_column(String(64))
    gantry: Mapped[Json] = mapped_column(default=dict)  # completes the headers of all runs
    # The DICOM study whose runs join this study; only for a study that a DICOM door made.
    study_instance_uid: Mapped[str | None] = mapped_column(String(64), index=True)
    created: Mapped[float] = mapped_column(default=db_now())
    updated: Mapped[float] = mapped_column(default=db_now(), onupdate=db_now())


class Instance(Base):
    """A stored DICOM instance: one run, stored once for all studies that refer to it."""

    __tablename__ = "instance"
    sop_instance_uid: Mapped[str] = mapped_column(String(64), primary_key=True)
    sha256: Mapped[str] = mapped_column(ForeignKey("file.sha256"), index=True)
    study_instance_uid: Mapped[str] = mapped_column(String(64), index=True)
    series_instance_uid: Mapped[str] = mapped_column(String(64))
    facts: Mapped[Json]  # InstanceFacts.to_json()
    # False until the run has its row of DicomObject: runs that an earlier version stored are searched after it.
    is_indexed: Mapped[bool] = mapped_column(Boolean, default=False, server_default=false(), index=True)


class DicomObject(Base):
    """An object that DICOMweb shows: a stored run, or a result of a job. Searches read this table and DicomValue alone."""

    __tablename__ = "dicom_object"
    __table_args__ = (Index("ix_dicom_object_place", "study_uid", "series_uid", "uid", "modality", "sop_class_uid"),)
    id: Mapped[int] = mapped_column(primary_key=True)
    uid: Mapped[str] = mapped_column(CodePoints, unique=True)  # SOP Instance UID
    study_uid: Mapped[str] = mapped_column(CodePoints)
    series_uid: Mapped[str] = mapped_column(CodePoints)
    # Beside their rows of DicomValue: most objects have the same ones, so that an index of values helps little.
    modality: Mapped[str | None] = mapped_column(CodePoints)
    sop_class_uid: Mapped[str | None] = mapped_column(CodePoints)
    run: Mapped[str | None] = mapped_column(
        ForeignKey("instance.sop_instance_uid", ondelete="CASCADE"), unique=True
    )  # null for a result
    job_id: Mapped[str | None] = mapped_column(ForeignKey("job.id", ondelete="CASCADE"), index=True)  # null for a run
    name: Mapped[str | None] = mapped_column(String(64))  # of a result: report.dcm
    header: Mapped[str] = mapped_column(Text)  # IndexedHeader.json
    is_whole: Mapped[bool] = mapped_column(Boolean)  # the header has all that the metadata show
    unreadable: Mapped[int]  # attributes that could not be read


class DicomValue(Base):
    """A value of an object's header, in the form in which searches compare it."""

    __tablename__ = "dicom_value"
    __table_args__ = (Index("ix_dicom_value_path_first", "path", "first", "last", "object_id", "item"),)
    id: Mapped[int] = mapped_column(primary_key=True)
    object_id: Mapped[int] = mapped_column(ForeignKey("dicom_object.id", ondelete="CASCADE"), index=True)
    path: Mapped[str] = mapped_column(CodePoints)  # tags, with dots between
    item: Mapped[int]  # number of the item of a sequence; 0 outside sequences
    first: Mapped[str | None] = mapped_column(CodePoints)  # null: exists and cannot be compared
    last: Mapped[str | None] = mapped_column(CodePoints)  # of a date or time: the last moment that it may mean


class StudyInstance(Base):
    """A study's reference to an instance, with the study's own facts about it."""

    __tablename__ = "study_instance"
    __table_args__ = (UniqueConstraint("study_id", "sop_instance_uid", name="uq_study_instance"),)
    id: Mapped[int] = mapped_column(primary_key=True)  # rises in the order of arrival
    study_id: Mapped[str] = mapped_column(ForeignKey("study.id", ondelete="CASCADE"), index=True)
    sop_instance_uid: Mapped[str] = mapped_column(ForeignKey("instance.sop_instance_uid"), index=True)
    file_name: Mapped[str | None] = mapped_column(
        Text
    )  # as uploaded; may name the patient: never in a log, path or error
    site: Mapped[str | None] = mapped_column(String(64))  # given by upload or PATCH
    site_by: Mapped[str | None] = mapped_column(String(10))  # "upload" or "explicit"
    gantry: Mapped[Json] = mapped_column(default=dict)  # completes and overrides the header


class Site(Base):
    """A mapping site: its activation time, and the runs that PUT, the table or acquisition time gave it."""

    __tablename__ = "site"
    __table_args__ = (UniqueConstraint("study_id", "name", name="uq_site_name"),)
    id: Mapped[int] = mapped_column(primary_key=True)  # rises in the order of first mention: the table's row order
    study_id: Mapped[str] = mapped_column(ForeignKey("study.id", ondelete="CASCADE"), index=True)
    name: Mapped[str] = mapped_column(String(64))
    lat_ms: Mapped[float | None]
    lat_sd_ms: Mapped[float | None]
    lat_by: Mapped[str | None] = mapped_column(String(12))  # "csv", "explicit" or "electrogram"
    csv_row: Mapped[int | None]  # row of the last activation-time table that names it
    explicit_a: Mapped[str | None] = mapped_column(String(64))  # SOP instance UIDs set by PUT
    explicit_b: Mapped[str | None] = mapped_column(String(64))
    csv_a: Mapped[str | None] = mapped_column(Text)  # UID, series number or file name in the table
    csv_b: Mapped[str | None] = mapped_column(Text)
    ordered_a: Mapped[str | None] = mapped_column(String(64))  # SOP instance UIDs that acquisition time joined
    ordered_b: Mapped[str | None] = mapped_column(String(64))


class Correction(Base):
    """The electrodes of one frame set by hand; the newest version counts.

    ``electrodes`` null returns the frame to automatic detection.
    """

    __tablename__ = "correction"
    __table_args__ = (
        UniqueConstraint("study_id", "sop_instance_uid", "frame", "version", name="uq_correction_version"),
    )
    id: Mapped[int] = mapped_column(primary_key=True)
    study_id: Mapped[str] = mapped_column(ForeignKey("study.id", ondelete="CASCADE"), index=True)
    sop_instance_uid: Mapped[str] = mapped_column(String(64))
    frame: Mapped[int]
    version: Mapped[int]
    electrodes: Mapped[list[Any] | None]
    author: Mapped[str] = mapped_column(String(100))
    created: Mapped[float] = mapped_column(default=db_now())


class Job(Base):
    """One run of the pipeline over a study, on a frozen snapshot."""

    __tablename__ = "job"
    __table_args__ = (
        Index("ix_job_created_id", "created", "id"),
        Index("ix_job_study_created_id", "study_id", "created", "id"),
        Index("ix_job_finished", "finished"),
    )
    id: Mapped[str] = mapped_column(String(32), primary_key=True)
    study_id: Mapped[str] = mapped_column(ForeignKey("study.id", ondelete="CASCADE"))
    state: Mapped[str] = mapped_column(String(10), index=True)
    version: Mapped[int] = mapped_column(default=0)  # every change raises it: ETag, and row lock at the end of a stage
    snapshot: Mapped[Json]
    cancel_requested: Mapped[bool] = mapped_column(Boolean, default=False)
    error: Mapped[Json | None]
    created: Mapped[float] = mapped_column(default=db_now())
    started: Mapped[float | None]
    finished: Mapped[float | None]


class StageRow(Base):
    """One stage of a job for one subject."""

    __tablename__ = "stage"
    __table_args__ = (
        UniqueConstraint("job_id", "name", "subject", name="uq_stage"),
        Index("ix_stage_state_published", "state", "published"),
    )
    id: Mapped[int] = mapped_column(primary_key=True)
    job_id: Mapped[str] = mapped_column(ForeignKey("job.id", ondelete="CASCADE"), index=True)
    name: Mapped[str] = mapped_column(String(12))  # segment, match, triangulate, monoplane, fuse
    subject: Mapped[str] = mapped_column(String(64))  # SOP instance UID, site or study id
    plugin: Mapped[str] = mapped_column(String(100))
    plugin_version: Mapped[str] = mapped_column(String(50))
    depends_on: Mapped[list[Any]]  # ids of stages that must have ended first
    state: Mapped[str] = mapped_column(String(10))
    attempt: Mapped[int] = mapped_column(default=0)
    ready_since: Mapped[float | None]
    started: Mapped[float | None]  # of the last attempt
    lease_until: Mapped[float | None]
    worker: Mapped[str | None] = mapped_column(String(100))
    published: Mapped[float | None]
    publications: Mapped[int] = mapped_column(default=0)
    progress: Mapped[float] = mapped_column(default=0.0)
    reused: Mapped[bool] = mapped_column(Boolean, default=False)
    result: Mapped[str | None] = mapped_column(ForeignKey("file.sha256"), index=True)
    error: Mapped[Json | None]


class StageResult(Base):
    """A stored result, under the hash of plugin, version, parameters and all inputs of the stage."""

    __tablename__ = "stage_result"
    key: Mapped[str] = mapped_column(String(64), primary_key=True)
    sha256: Mapped[str] = mapped_column(ForeignKey("file.sha256"), index=True)


class Point(Base):
    """One electrode of one site of one job, located or rejected. Coordinates from the isocentre and from the reference."""

    __tablename__ = "point"
    __table_args__ = (UniqueConstraint("job_id", "site", "catheter", "electrode", name="uq_point"),)
    id: Mapped[int] = mapped_column(primary_key=True)
    job_id: Mapped[str] = mapped_column(ForeignKey("job.id", ondelete="CASCADE"), index=True)
    site: Mapped[str] = mapped_column(String(64))
    catheter: Mapped[str] = mapped_column(String(64))
    electrode: Mapped[int]
    position_mm: Mapped[list[Any] | None]  # [x, y, z]
    covariance_mm2: Mapped[list[Any] | None]  # [xx, xy, xz, yy, yz, zz]
    relative_mm: Mapped[list[Any] | None]
    relative_covariance_mm2: Mapped[list[Any] | None]
    view_a: Mapped[str | None] = mapped_column(String(64))
    view_b: Mapped[str | None] = mapped_column(String(64))
    frame_a: Mapped[int | None]  # counted from 1
    frame_b: Mapped[int | None]
    residual_a_px: Mapped[float | None]
    residual_b_px: Mapped[float | None]
    ray_angle_deg: Mapped[float | None]
    lat_ms: Mapped[float | None]
    grade: Mapped[str] = mapped_column(String(10))
    relative_grade: Mapped[str] = mapped_column(String(10))
    reasons: Mapped[list[Any]]


class Event(Base):
    """An event of a job; the event stream sends them in the order of their ids."""

    __tablename__ = "event"
    id: Mapped[int] = mapped_column(primary_key=True)
    job_id: Mapped[str] = mapped_column(ForeignKey("job.id", ondelete="CASCADE"), index=True)
    kind: Mapped[str] = mapped_column(String(10))  # "job" or "stage"
    data: Mapped[Json]


class Rendering(Base):
    """A picture, mesh, table or page of a job's results, made on request and kept; deleted with the job it was made for."""

    __tablename__ = "rendering"
    id: Mapped[int] = mapped_column(primary_key=True)
    job_id: Mapped[str] = mapped_column(ForeignKey("job.id", ondelete="CASCADE"), index=True)
    key: Mapped[str] = mapped_column(String(64), unique=True)  # hash of the study and of all dependencies
    sha256: Mapped[str] = mapped_column(ForeignKey("file.sha256"), index=True)
    bytes: Mapped[int | None] = mapped_column(BigInteger)  # None until the next clean-up in rows of earlier versions
    used: Mapped[float | None] = mapped_column(default=db_now())  # to within an hour


class DeliveryTarget(Base):
    """A target of deliveries, by its name in the file of targets. The file has its address and secrets."""

    __tablename__ = "delivery_target"
    name: Mapped[str] = mapped_column(String(64), primary_key=True)
    kind: Mapped[str] = mapped_column(String(10))  # dicom, dicomweb or webhook
    since: Mapped[float]  # jobs that ended later are delivered by themselves


class Delivery(Base):
    """The delivery of a job's results to one target."""

    __tablename__ = "delivery"
    __table_args__ = (
        UniqueConstraint("target", "job_id", name="uq_delivery"),
        Index("ix_delivery_state_target", "state", "target"),
        Index("ix_delivery_created_id", "created", "id"),
    )
    id: Mapped[str] = mapped_column(String(32), primary_key=True)
    target: Mapped[str] = mapped_column(ForeignKey("delivery_target.name"))
    job_id: Mapped[str] = mapped_column(ForeignKey("job.id", ondelete="CASCADE"), index=True)
    state: Mapped[str] = mapped_column(String(10))
    attempt: Mapped[int] = mapped_column(default=0)
    failures: Mapped[int] = mapped_column(default=0)  # since the first try, or since somebody asked for another one
    since: Mapped[float] = mapped_column(default=db_now())  # the time for giving up counts from here
    due: Mapped[float] = mapped_column(default=db_now())
    lease_until: Mapped[float | None]
    sender: Mapped[str | None] = mapped_column(String(100))
    error: Mapped[Json | None]
    created: Mapped[float] = mapped_column(default=db_now())
    finished: Mapped[float | None]


class DeliveryObject(Base):
    """A DICOM object of a delivery."""

    __tablename__ = "delivery_object"
    __table_args__ = (UniqueConstraint("delivery_id", "sop_instance_uid", name="uq_delivery_object"),)
    id: Mapped[int] = mapped_column(primary_key=True)
    delivery_id: Mapped[str] = mapped_column(ForeignKey("delivery.id", ondelete="CASCADE"))
    sop_instance_uid: Mapped[str] = mapped_column(String(64))
    name: Mapped[str] = mapped_column(String(64))  # file name in the results: report.dcm
    attempts: Mapped[int] = mapped_column(default=0)  # attempts of the delivery that had to send it
    state: Mapped[str] = mapped_column(String(10))
    delivered: Mapped[float | None]


class DeliveryAttempt(Base):
    """An attempt of a delivery that has ended; ``code`` null: all objects arrived."""

    __tablename__ = "delivery_attempt"
    id: Mapped[int] = mapped_column(primary_key=True)
    delivery_id: Mapped[str] = mapped_column(ForeignKey("delivery.id", ondelete="CASCADE"), index=True)
    number: Mapped[int]
    ended: Mapped[float] = mapped_column(default=db_now())
    code: Mapped[str | None] = mapped_column(String(40))
    detail: Mapped[str | None] = mapped_column(Text)


class Idempotency(Base):
    """The answer to a request with an Idempotency-Key, stored for 24 hours."""

    __tablename__ = "idempotency"
    id: Mapped[int] = mapped_column(primary_key=True)
    key: Mapped[str] = mapped_column(String(64), unique=True)  # hash of token, method, path and the client's key
    request_sha256: Mapped[str] = mapped_column(String(64))
    status: Mapped[int | None] = mapped_column(Integer)  # None until the first request has its answer
    headers: Mapped[Json | None]
    body: Mapped[str | None] = mapped_column(Text)
    study_id: Mapped[str | None] = mapped_column(ForeignKey("study.id", ondelete="CASCADE"), index=True)
    created: Mapped[float] = mapped_column(default=db_now(), index=True)


class Deletion(Base):
    """The certificate of a deleted study: what went, by ids and hashes. It holds no patient data and stays."""

    __tablename__ = "deletion"
    study: Mapped[str] = mapped_column(String(32), primary_key=True)
    at: Mapped[float]
    certificate: Mapped[Json]
    audit_id: Mapped[int]  # the entry of the audit trail that holds the certificate's hash


class Tally(Base):
    """A sum over the life of the installation, for the metrics."""

    __tablename__ = "tally"
    name: Mapped[str] = mapped_column(String(100), primary_key=True)
    value: Mapped[float]


class AuditEntry(Base):
    """An entry of the audit trail. It outlives the study that it names, so nothing refers to other tables."""

    __tablename__ = "audit"
    id: Mapped[int] = mapped_column(primary_key=True)
    at: Mapped[float]
    who: Mapped[str] = mapped_column(String(100))
    what: Mapped[str] = mapped_column(String(200))
    study: Mapped[str | None] = mapped_column(String(32), index=True)
    job: Mapped[str | None] = mapped_column(String(32))
    status: Mapped[int | None]
    hash: Mapped[str] = mapped_column(String(64))
    times: Mapped[int | None]  # None: once


APPEND_ONLY = {
    "sqlite": [
        f"CREATE TRIGGER audit_no_{verb} BEFORE {verb} ON audit BEGIN SELECT RAISE(ABORT, 'the audit trail is append-only'); END"
        for verb in ("UPDATE", "DELETE")
    ],
    "postgresql": [
        "CREATE FUNCTION audit_append_only() RETURNS trigger LANGUAGE plpgsql AS "
        "$$ BEGIN RAISE EXCEPTION 'the audit trail is append-only'; END $$",
        "CREATE TRIGGER audit_append_only BEFORE UPDATE OR DELETE OR TRUNCATE ON audit "
        "FOR EACH STATEMENT EXECUTE FUNCTION audit_append_only()",
    ],
}
"""The statements that make a database refuse to change the audit trail."""

_ddl: Any = DDL  # SQLAlchemy gives it no types
for _dialect, _statements in APPEND_ONLY.items():
    for _statement in _statements:
        event.listen(AuditEntry.__table__, "after_create", _ddl(_statement).execute_if(dialect=_dialect))


class WorkerSeen(Base):
    """A worker's last sign of life, for readiness."""

    __tablename__ = "worker_seen"
    name: Mapped[str] = mapped_column(String(100), primary_key=True)
    seen: Mapped[float]
