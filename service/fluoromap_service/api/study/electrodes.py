"""The electrodes of one frame: found automatically, or set by hand."""

from __future__ import annotations

import math
from typing import Annotated, Literal

from fastapi import APIRouter, Body, Response
from pydantic import BaseModel, ConfigDict, Field
from sqlalchemy import select
from sqlalchemy.orm import Session

from fluoromap.contracts import Chain, Matching, NamedChain, Segmentation
from fluoromap_service.api.http.problems import responses
from fluoromap_service.api.http.security import Reader, Writer
from fluoromap_service.api.study.frames import FrameNumber
from fluoromap_service.api.study.instances import InstanceUid
from fluoromap_service.api.study.studies import StudyId
from fluoromap_service.jobs.stage_results import load, stage_of
from fluoromap_service.problem import Problem, not_found
from fluoromap_service.store.engine import reading, writing
from fluoromap_service.store.models import Correction, Job, StageRow, StageState, Study
from fluoromap_service.study import corrections, instances, studies
from fluoromap_service.study.instances import StudyRun
from fluoromap_service.study.snapshot import CorrectedElectrode, Snapshot

router = APIRouter(prefix="/v1/studies/{study_id}/instances/{uid}/frames/{n}/electrodes", tags=["electrodes"])


class ElectrodeIn(BaseModel):
    """An electrode set by hand."""

    model_config = ConfigDict(
        extra="forbid",
        json_schema_extra={"examples": [{"catheter": "mapping", "electrode": 1, "u_px": 251.5, "v_px": 233.0}]},
    )
    catheter: str = Field(max_length=64)
    electrode: int = Field(ge=1, le=64, description="1 is the tip.")
    u_px: float = Field(allow_inf_nan=False, description="Column; 0 is the centre of the leftmost stored pixel.")
    v_px: float = Field(allow_inf_nan=False, description="Row; 0 is the centre of the topmost stored pixel.")
    sd_px: float = Field(1.0, gt=0, le=50, allow_inf_nan=False, description="Standard deviation of each coordinate.")
    source: Literal["manual", "automatic"] = Field(
        "manual", description="Whatever stands here, what is put is manual: an answer of GET can be corrected and put."
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
    """Electrodes set by hand where there are any, else those the newest job found."""
    with reading() as session:
        _run_with_frame(session, study_id, uid, n)
        correction = corrections.newest(session, study_id, uid, n)
        return _answer(session, study_id, uid, n, correction, response)


@router.put("", responses=responses(400, 401, 403, 404, 422))
def put_electrodes(
    study_id: StudyId,
    uid: InstanceUid,
    n: FrameNumber,
    body: Annotated[list[ElectrodeIn], Body(max_length=512)],
    response: Response,
    caller: Writer,
) -> list[ElectrodeOut]:
    """Set this frame's electrodes by hand; the next job tracks the run anew from here."""
    with writing() as session:
        study = studies.lock(session, study_id)
        run = _run_with_frame(session, study_id, uid, n)
        _check(study, run, body)
        correction = corrections.put(
            session,
            study_id,
            uid,
            n,
            tuple(CorrectedElectrode(**item.model_dump(exclude={"source"})) for item in body),
            caller,
        )
        return _answer(session, study_id, uid, n, correction, response)


@router.delete("", responses=responses(401, 403, 404, 422))
def delete_electrodes(
    study_id: StudyId, uid: InstanceUid, n: FrameNumber, response: Response, caller: Writer
) -> list[ElectrodeOut]:
    """Return this frame to automatic detection; answers what that found last."""
    with writing() as session:
        studies.lock(session, study_id)
        _run_with_frame(session, study_id, uid, n)
        correction = corrections.newest(session, study_id, uid, n)
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
    response.headers["ETag"] = f'"{correction.version if correction else 0}"'
    if correction is not None and correction.electrodes is not None:
        return [ElectrodeOut(**electrode, source="manual") for electrode in correction.electrodes]
    return _detected(session, study_id, uid, n - 1)


def _detected(session: Session, study_id: str, uid: str, frame: int) -> list[ElectrodeOut]:
    """What the newest job that segmented this run found in ``frame`` (from 0)."""
    stage = session.scalar(
        select(StageRow)
        .join(Job, Job.id == StageRow.job_id)
        .where(
            Job.study_id == study_id,
            StageRow.name == "segment",
            StageRow.subject == uid,
            StageRow.state == StageState.DONE,
        )
        .order_by(Job.created.desc(), Job.id)
        .limit(1)
    )
    if stage is None:
        return []
    # A chain set by hand was deleted since; what would be found instead, the next job will tell.
    chains = tuple(chain for chain in load(Segmentation, stage).frames[frame].chains if not chain.manual)
    found: list[ElectrodeOut] = []
    for chain, name in zip(chains, _names(session, stage.job_id, uid, frame, chains), strict=True):
        for electrode, (u, v), covariance in zip(chain.electrodes, chain.pixels_uv, chain.covariance_px2, strict=True):
            sd = math.sqrt(max(float(covariance.trace()) / 2, 0.0))
            found.append(
                ElectrodeOut(
                    catheter=name, electrode=electrode, u_px=float(u), v_px=float(v), sd_px=sd, source="automatic"
                )
            )
    return found


def _names(session: Session, job_id: str, uid: str, frame: int, chains: tuple[Chain, ...]) -> list[str | None]:
    """A catheter for each chain, none twice: as the job's matching named it, else its most probable kind."""
    of_track = {chain.track: chain.catheter for chain in _named_chains(session, job_id, uid, frame)}
    names = [of_track.get(chain.track) if chain.track >= 0 else None for chain in chains]
    likely = sorted(
        ((probability, index, name) for index, chain in enumerate(chains) for name, probability in chain.kinds),
        key=lambda item: (-item[0], item[1]),
    )
    for _, index, name in likely:
        if names[index] is None and name not in names:
            names[index] = name
    return names


def _named_chains(session: Session, job_id: str, uid: str, frame: int) -> tuple[NamedChain, ...]:
    stage = stage_of(session, job_id, "match")
    if stage is None or stage.state != StageState.DONE:
        return ()
    snapshot = Snapshot.model_validate(session.get_one(Job, job_id).snapshot)
    views = {
        site.site: "a" if site.view_a == uid else "b" for site in snapshot.sites if uid in (site.view_a, site.view_b)
    }
    for site in load(Matching, stage).sites:
        if site.site in views:
            return (site.track_a if views[site.site] == "a" else site.track_b)[frame].chains
    return ()


def _check(study: Study, run: StudyRun, body: list[ElectrodeIn]) -> None:
    catalogue = studies.catalogue_of(study)
    errors: list[tuple[str, str]] = []
    seen: set[tuple[str, int]] = set()
    places: set[tuple[str, float, float]] = set()
    for index, item in enumerate(body):
        where = f"body.{index}"
        if item.catheter not in catalogue.names:
            errors.append((f"{where}.catheter", f"the study's catheters are {', '.join(catalogue.names)}"))
        elif item.electrode > catalogue[item.catheter].electrodes:
            count = catalogue[item.catheter].electrodes
            errors.append((f"{where}.electrode", f"this catheter has {count} electrodes"))
        if (item.catheter, item.electrode) in seen:
            errors.append((f"{where}.electrode", "this electrode is set twice"))
        elif (item.catheter, item.u_px, item.v_px) in places:
            errors.append((where, "another electrode of this catheter is set on the same pixel"))
        places.add((item.catheter, item.u_px, item.v_px))
        seen.add((item.catheter, item.electrode))
        for name, value, size in (("u_px", item.u_px, run.facts.columns), ("v_px", item.v_px, run.facts.rows)):
            if not -0.5 <= value <= size - 0.5:
                errors.append((f"{where}.{name}", f"lies outside the image of {size} pixels"))
    if errors:
        raise Problem(422, "invalid_electrodes", "Some electrodes cannot be where they were set.", errors)
