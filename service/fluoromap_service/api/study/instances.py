"""The routes of a study's runs: DICOM in, facts out."""

from __future__ import annotations

from contextlib import ExitStack
from typing import Annotated, Any, Literal

from fastapi import Query, Request, Response
from fastapi.responses import JSONResponse
from pydantic import BaseModel, ConfigDict, Field
from sqlalchemy.orm import Session

from fluoromap_service.api.http.file_pool import Task, run_in_pool
from fluoromap_service.api.http.idempotency import Once, OnceUpload
from fluoromap_service.api.http.paging import Page, Pages
from fluoromap_service.api.http.paths import InstanceUid, StudyId
from fluoromap_service.api.http.problems import ProblemDocument, document, responses
from fluoromap_service.api.http.routers import new_router
from fluoromap_service.api.http.security import Reader, Writer
from fluoromap_service.api.http.timestamps import rfc3339_or_none
from fluoromap_service.api.study.gantry import GantryPatch, RunGantryOut, changed_gantry, check_gantry
from fluoromap_service.api.study.uploads import Part, in_upload_thread, receive
from fluoromap_service.dicom.indexed_header import ReadRun, read_run
from fluoromap_service.problem import Problem, not_found
from fluoromap_service.store.engine import reading, writing
from fluoromap_service.store.models import Study
from fluoromap_service.store.names import Name
from fluoromap_service.study import instances, sites, studies
from fluoromap_service.study.binding import BoundSite, binding_of, views_of
from fluoromap_service.study.instances import StudyRun

router = new_router("/v1/studies/{study_id}/instances", tags=["instances"])

SITE = "Mapping site of all runs of the request."


class InstanceOut(BaseModel):
    """One run."""

    sop_instance_uid: str = Field(examples=["1.2.826.0.1.3680043.8.498.1"])
    site: str | None = Field(description="Mapping site of the run.", examples=["S03"])
    view: Literal["a", "b"] | None = Field(examples=["a"])
    frames: int = Field(examples=[120])
    rows: int = Field(examples=[512])
    columns: int = Field(examples=[512])
    frame_time_ms: float | None = Field(description="Null for a single frame.", examples=[16.7])
    acquired: str | None = Field(examples=["2026-03-01T09:30:00.000Z"])
    plane: Literal["single", "A", "B"]
    gantry: RunGantryOut = Field(
        description="The values in use: the run's own, else the header's, else the study's; and the header's table."
    )
    missing: list[str] = Field(
        description="DICOM keywords to complete by PATCH.", examples=[["DistanceSourceToDetector"]]
    )
    simulated: bool = Field(description="True for a run that `fluoromap simulate` wrote.")
    warnings: list[str] = Field(
        description="Codes of oddities; 'unbound': no site has this run.", examples=[["table_moved"]]
    )


class UploadOut(BaseModel):
    """The result of an upload: stored runs, and a problem for each other file."""

    instances: list[InstanceOut]
    rejected: list[ProblemDocument] = Field(
        description="`part` is the number of the file in the request, counted from 1."
    )


class InstancePatch(BaseModel):
    """Changes of a run; a member that is left out stays."""

    model_config = ConfigDict(
        extra="forbid",
        json_schema_extra={"examples": [{"site": "S03", "gantry": {"source_detector_mm": 1000.0}}]},
    )
    site: Name | None = Field(
        None, description="Moves the run to this site; null takes the run out of every site.", max_length=64
    )
    gantry: GantryPatch | None = Field(None, description="Overrides the header; null returns to the header's values.")


def instance_shape(run: StudyRun, views: dict[str, tuple[BoundSite, str]]) -> InstanceOut:
    """Return a run in the shape of the answer."""
    bound = views.get(run.uid)
    warnings = [str(warning) for warning in run.facts.warnings]
    warnings += bound[0].warnings if bound else ["unbound"]
    return InstanceOut.model_validate(
        {
            "sop_instance_uid": run.uid,
            "site": bound[0].site if bound else None,
            "view": bound[1] if bound else None,
            "frames": run.facts.frames,
            "rows": run.facts.rows,
            "columns": run.facts.columns,
            "frame_time_ms": run.facts.frame_time_ms if run.facts.frames > 1 else None,
            "acquired": rfc3339_or_none(run.facts.acquired),
            "plane": run.facts.plane,
            "gantry": run.gantry | {"table_mm": run.facts.table_mm, "table_origin": run.facts.table_origin},
            "missing": run.missing,
            "simulated": run.facts.simulated,
            "warnings": list(dict.fromkeys(warnings)),
        }
    )


@router.post(
    "",
    status_code=201,
    response_model=UploadOut,
    responses={
        200: {"model": UploadOut, "description": "Nothing new."},
        **responses(400, 401, 403, 404, 409, 413, 415, 422),
    },
    openapi_extra={
        "requestBody": {
            "required": True,
            "content": {
                "multipart/form-data": {
                    "schema": {
                        "type": "object",
                        "required": ["file"],
                        "properties": {
                            "file": {"type": "array", "items": {"type": "string", "format": "binary"}},
                            "site": {"type": "string", "description": SITE},
                        },
                    }
                },
                "application/dicom": {"schema": {"type": "string", "format": "binary"}},
            },
        }
    },
)
async def upload_instances(
    study_id: StudyId,
    request: Request,
    once: OnceUpload,
    caller: Writer,
    site: Annotated[Name | None, Query(description=SITE, examples=["S03"])] = None,
) -> Response:
    """Send X-ray runs, one or many.

    A problem of one file does not affect the others.
    """
    await in_upload_thread(_check_study, study_id)
    with ExitStack() as stack:
        parts, site_field = await receive(request, stack)
        site = site if site_field is None else site_field
        if site is not None and not sites.is_site_name(site):
            detail = "This text cannot name a site; use 1 to 64 characters without slashes."
            raise Problem(422, "invalid_site", detail, [("site", "not usable as a name")])
        if not parts:
            raise Problem(
                422,
                "no_file",
                "The request has no part named 'file'; send each run as such a part.",
                [("file", "missing")],
            )
        return await in_upload_thread(_store, study_id, parts, site, once)


def _check_study(study_id: str) -> None:
    with reading() as session:
        studies.get(session, study_id)


def _store(study_id: str, parts: list[Part], site: str | None, once: Once) -> Response:
    once.content = "\n".join([site or "", *(part.sha256 for part in parts)])
    checked = [_read(part) for part in parts]

    def act(session: Session) -> Response:
        study = studies.lock(session, study_id)
        stored: list[str] = []
        rejected: list[Problem] = []
        new = False
        for number, (part, run) in enumerate(zip(parts, checked, strict=True), start=1):
            try:
                if isinstance(run, Problem):
                    raise run
                new |= instances.add(
                    session, study_id, part.path, run, part.sha256, file_name=part.file_name, site=site
                )
                stored.append(run.facts.sop_instance_uid)
            except Problem as problem:
                rejected.append(_of_part(problem, number))
        documents = [document(problem) for problem in rejected]
        if not stored:
            first = rejected[0]
            extra = {"rejected": documents}
            raise Problem(first.status, first.code, first.detail, first.errors, headers=first.headers, extra=extra)
        if site is not None:
            sites.mention(session, study_id, site)
        body = {"instances": _shapes(session, study, stored), "rejected": documents}
        return JSONResponse(body, 201 if new else 200)

    return once.answer(act)


def _read(part: Part) -> ReadRun | Problem:
    # A hostile file can crash a decoder, so another process reads it.
    try:
        return run_in_pool(Task.READ_FILE, read_run, part.path)
    except Problem as problem:
        if problem.status == 429:
            raise
        return problem


def _of_part(problem: Problem, number: int) -> Problem:
    problem.extra["part"] = number
    return problem


def _shapes(session: Session, study: Study, uids: list[str]) -> list[dict[str, Any]]:
    runs = instances.runs_of(session, study.id)
    views = views_of(binding_of(session, study.id, runs=runs))
    by_uid = {run.uid: run for run in runs}
    return [instance_shape(by_uid[uid], views).model_dump() for uid in dict.fromkeys(uids)]


@router.get("", responses=responses(400, 401, 403, 404, 422))
def list_instances(study_id: StudyId, pages: Pages, caller: Reader) -> Page[InstanceOut]:
    """List the study's runs in the order of arrival."""
    with reading() as session:
        runs = studies.runs_of(session, study_id)
        views = views_of(binding_of(session, study_id, runs=runs))
        return pages.page_of_all(runs, lambda run: instance_shape(run, views), lambda run: run.uid)


def _one(session: Session, study_id: str, uid: str) -> InstanceOut:
    runs = studies.runs_of(session, study_id)
    run = next((run for run in runs if run.uid == uid), None)
    if run is None:
        raise not_found("instance in this study")
    return instance_shape(run, views_of(binding_of(session, study_id, runs=runs)))


@router.get("/{uid}", responses=responses(401, 403, 404, 422))
def get_instance(study_id: StudyId, uid: InstanceUid, caller: Reader) -> InstanceOut:
    """Return one run."""
    with reading() as session:
        return _one(session, study_id, uid)


@router.patch("/{uid}", responses=responses(400, 401, 403, 404, 422))
def change_instance(study_id: StudyId, uid: InstanceUid, body: InstancePatch, caller: Writer) -> InstanceOut:
    """Complete or override the gantry of the header, or move the run to another site."""
    with writing() as session:
        study = studies.lock(session, study_id)
        link = instances.link_of(session, study_id, uid)
        if "site" in body.model_fields_set:
            sites.move_run(session, study, uid, body.site)
        if "gantry" in body.model_fields_set:
            link.gantry = changed_gantry(link.gantry, body.gantry)
            session.flush()
            check_gantry(instances.run_of(session, study_id, uid).gantry_with({}))
        session.flush()
        return _one(session, study_id, uid)


@router.delete("/{uid}", status_code=204, response_class=Response, responses=responses(401, 403, 404, 409, 422))
def delete_instance(study_id: StudyId, uid: InstanceUid, caller: Writer) -> None:
    """Take a run out of the study; 409 while a job works on it.

    The service deletes the file when no other study refers to it.
    """
    with writing() as session:
        studies.lock(session, study_id)
        unreferenced = instances.remove(session, study_id, uid)
    instances.unlink_unreferenced(unreferenced)
