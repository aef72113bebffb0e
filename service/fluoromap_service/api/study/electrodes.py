"""The routes of the electrodes in one frame: detected by a job, or set by hand."""

from __future__ import annotations

from dataclasses import asdict
from typing import Annotated, Literal

from fastapi import Body, Response
from pydantic import BaseModel, ConfigDict, Field
from sqlalchemy.orm import Session

from fluoromap_service.api.http.paths import FrameNumber, InstanceUid, StudyId
from fluoromap_service.api.http.preconditions import IfMatch
from fluoromap_service.api.http.problems import responses
from fluoromap_service.api.http.routers import new_router
from fluoromap_service.api.http.security import Reader, Writer
from fluoromap_service.problem import Problem, not_found
from fluoromap_service.results.detections import detected_electrodes
from fluoromap_service.store.engine import reading, writing
from fluoromap_service.store.models import Correction, Study
from fluoromap_service.store.names import Name
from fluoromap_service.study import corrections, instances, studies
from fluoromap_service.study.catheters import catalogue_of
from fluoromap_service.study.instances import StudyRun
from fluoromap_service.study.snapshot import CorrectedElectrode

router = new_router("/v1/studies/{study_id}/instances/{uid}/frames/{n}/electrodes", tags=["electrodes"])


class ElectrodeIn(BaseModel):
    """An electrode set by hand."""

    model_config = ConfigDict(
        extra="forbid",
        json_schema_extra={"examples": [{"catheter": "mapping", "electrode": 1, "u_px": 251.5, "v_px": 233.0}]},
    )
    catheter: Name = Field(max_length=64)
    electrode: int = Field(ge=1, le=64, description="1 is the tip.")
    u_px: float = Field(allow_inf_nan=False, description="Column; 0 is the centre of the leftmost stored pixel.")
    v_px: float = Field(allow_inf_nan=False, description="Row; 0 is the centre of the topmost stored pixel.")
    sd_px: float = Field(1.0, gt=0, le=50, allow_inf_nan=False, description="Standard deviation of each coordinate.")
    source: Literal["manual", "automatic"] = Field(
        "manual",
        description="The service ignores it and stores 'manual', so a client can correct an answer of GET and put it.",
    )


class ElectrodeOut(BaseModel):
    """One electrode in one frame."""

    catheter: str | None = Field(description="Null where no catheter of the study fits.", examples=["mapping"])
    electrode: int = Field(examples=[1])
    u_px: float = Field(examples=[251.5])
    v_px: float = Field(examples=[233.0])
    sd_px: float = Field(examples=[0.6])
    source: Literal["manual", "automatic"]


@router.get("", responses=responses(401, 403, 404, 422))
def get_electrodes(
    study_id: StudyId, uid: InstanceUid, n: FrameNumber, response: Response, caller: Reader
) -> list[ElectrodeOut]:
    """Return the electrodes set by hand; without any, the electrodes that the newest job detected."""
    with reading() as session:
        _run_with_frame(session, study_id, uid, n)
        correction = corrections.newest(session, study_id, uid, n)
        return _answer(session, study_id, uid, n, correction, response)


@router.put("", responses=responses(400, 401, 403, 404, 412, 422))
def put_electrodes(
    study_id: StudyId,
    uid: InstanceUid,
    n: FrameNumber,
    body: Annotated[list[ElectrodeIn], Body(max_length=512)],
    response: Response,
    caller: Writer,
    condition: IfMatch,
) -> list[ElectrodeOut]:
    """Set this frame's electrodes by hand.

    The next job tracks the run again from this frame. With `If-Match` the electrodes are set only when nobody has set
    others since they were read.
    """
    with writing() as session:
        study = studies.lock(session, study_id)
        run = _run_with_frame(session, study_id, uid, n)
        condition.check(_etag(corrections.newest(session, study_id, uid, n)))
        _check(study, run, body)
        electrodes = tuple(CorrectedElectrode(**item.model_dump(exclude={"source"})) for item in body)
        correction = corrections.put(session, study_id, uid, n, electrodes, caller)
        return _answer(session, study_id, uid, n, correction, response)


@router.delete("", responses=responses(401, 403, 404, 412, 422))
def delete_electrodes(
    study_id: StudyId, uid: InstanceUid, n: FrameNumber, response: Response, caller: Writer, condition: IfMatch
) -> list[ElectrodeOut]:
    """Return this frame to automatic detection; the answer lists the last detected electrodes."""
    with writing() as session:
        studies.lock(session, study_id)
        _run_with_frame(session, study_id, uid, n)
        correction = corrections.newest(session, study_id, uid, n)
        condition.check(_etag(correction))
        if correction is not None and correction.electrodes is not None:
            correction = corrections.put(session, study_id, uid, n, None, caller)
        return _answer(session, study_id, uid, n, correction, response)


def _run_with_frame(session: Session, study_id: str, uid: str, n: int) -> StudyRun:
    run = instances.run_of(session, study_id, uid)
    if n > run.facts.frames:
        raise not_found("frame")
    return run


def _answer(
    session: Session, study_id: str, uid: str, n: int, correction: Correction | None, response: Response
) -> list[ElectrodeOut]:
    response.headers["ETag"] = _etag(correction)
    if correction is not None and correction.electrodes is not None:
        return [ElectrodeOut(**electrode, source="manual") for electrode in correction.electrodes]
    detected = detected_electrodes(session, study_id, uid, n - 1)
    return [ElectrodeOut(**asdict(electrode), source="automatic") for electrode in detected]


def _etag(correction: Correction | None) -> str:
    return f'"{correction.version if correction else 0}"'


def _check(study: Study, run: StudyRun, body: list[ElectrodeIn]) -> None:
    """Check that the electrodes belong to the study's catheters, lie in the image and differ."""
    catalogue = catalogue_of(study)
    errors: list[tuple[str, str]] = []
    electrodes: set[tuple[str, int]] = set()
    places: set[tuple[str, float, float]] = set()
    for index, item in enumerate(body):
        where = f"body.{index}"
        if item.catheter not in catalogue.names:
            errors.append((f"{where}.catheter", f"the study's catheters are {', '.join(catalogue.names)}"))
        elif item.electrode > catalogue[item.catheter].electrodes:
            count = catalogue[item.catheter].electrodes
            errors.append((f"{where}.electrode", f"this catheter has {count} electrodes"))
        if (item.catheter, item.electrode) in electrodes:
            errors.append((f"{where}.electrode", "this electrode is set twice"))
        elif (item.catheter, item.u_px, item.v_px) in places:
            errors.append((where, "another electrode of this catheter is set on the same pixel"))
        places.add((item.catheter, item.u_px, item.v_px))
        electrodes.add((item.catheter, item.electrode))
        for name, value, size in (("u_px", item.u_px, run.facts.columns), ("v_px", item.v_px, run.facts.rows)):
            if not -0.5 <= value <= size - 0.5:
                errors.append((f"{where}.{name}", f"lies outside the image of {size} pixels"))
    if errors:
        detail = "Some electrodes are impossible; see 'errors' for each of them."
        raise Problem(422, "invalid_electrodes", detail, errors)
