"""The routes of mapping studies: one study is one rhythm of one patient."""

from __future__ import annotations

from fastapi import Response
from fastapi.responses import JSONResponse
from pydantic import BaseModel, ConfigDict, Field
from sqlalchemy.orm import Session

from fluoromap.catheters import DEFAULT_CATALOGUE, Catalogue, Catheter
from fluoromap_service.api.http.idempotency import OnceJson
from fluoromap_service.api.http.paging import NewestFirst, Page, Pages
from fluoromap_service.api.http.paths import StudyId
from fluoromap_service.api.http.problems import responses
from fluoromap_service.api.http.routers import new_router
from fluoromap_service.api.http.security import Reader, Writer
from fluoromap_service.api.http.timestamps import rfc3339
from fluoromap_service.api.study.catheters import MOST_CATHETERS, CatheterIn, CatheterName, Line
from fluoromap_service.api.study.gantry import GantryOut, GantryPatch, changed_gantry, check_gantry
from fluoromap_service.problem import Problem
from fluoromap_service.store.engine import reading, writing
from fluoromap_service.store.models import Study
from fluoromap_service.study import corrections, deletion, studies
from fluoromap_service.study.catheters import (
    StudyCatheter,
    catalogue_of,
    catalogue_with_roles,
    catheters_of,
    set_catalogue,
)
from fluoromap_service.study.instances import runs_of

router = new_router("/v1/studies", tags=["studies"])


_STUDIES = NewestFirst(Study)


class StudyIn(BaseModel):
    """A new study."""

    model_config = ConfigDict(
        extra="forbid",
        json_schema_extra={"examples": [{"label": "Dog 3, sinus rhythm", "chamber": "right ventricle"}]},
    )
    label: Line = Field(min_length=1, max_length=200, description="Your own name for the study; no patient name.")
    chamber: Line | None = Field(None, max_length=100)
    catheters: list[CatheterIn] | None = Field(
        None, max_length=MOST_CATHETERS, description="Default: reference, pacing and mapping, 4 electrodes each."
    )
    reference: CatheterName | None = Field(
        None,
        max_length=64,
        description="The catheter from which coordinates count; by default the catheter named 'reference'. A study with one "
        "catheter has none, and its coordinates count from the isocentre.",
    )
    notes: str | None = Field(None, max_length=10_000)


class StudyPatch(BaseModel):
    """Changes of a study; a member that is left out stays as before."""

    model_config = ConfigDict(extra="forbid", json_schema_extra={"examples": [{"notes": "pacing from the apex"}]})
    label: Line | None = Field(None, min_length=1, max_length=200)
    chamber: Line | None = Field(None, max_length=100)
    catheters: list[CatheterIn] | None = Field(None, max_length=MOST_CATHETERS)
    reference: CatheterName | None = Field(None, max_length=64)
    notes: str | None = Field(None, max_length=10_000)
    gantry: GantryPatch | None = Field(
        None, description="Values for all runs whose headers lack them; null removes these values."
    )


class StudyOut(BaseModel):
    """A mapping study."""

    id: str = Field(examples=["5d0c2f6e0c7b4b0f9a4de4d0c3a1b2f4"])
    label: str = Field(examples=["Dog 3, sinus rhythm"])
    chamber: str | None = Field(examples=["right ventricle"])
    catheters: list[StudyCatheter]
    reference: str | None = Field(description="Null in a study with one catheter.", examples=["reference"])
    mapping: str = Field(description="The catheter whose tip maps.", examples=["mapping"])
    notes: str | None = Field(examples=[None])
    gantry: GantryOut = Field(description="Values for all runs whose headers lack them.")
    created: str = Field(examples=["2026-03-01T09:30:00.000Z"])
    updated: str = Field(examples=["2026-03-01T09:30:00.000Z"])


def _shape(study: Study) -> StudyOut:
    return StudyOut(
        id=study.id,
        label=study.label,
        chamber=study.chamber,
        catheters=list(catheters_of(study)),
        reference=study.reference,
        mapping=study.mapping,
        notes=study.notes,
        gantry=GantryOut(**{name: study.gantry.get(name) for name in GantryOut.model_fields}),
        created=rfc3339(study.created),
        updated=rfc3339(study.updated),
    )


@router.post("", status_code=201, response_model=StudyOut, responses=responses(400, 401, 403, 422))
def create_study(body: StudyIn, once: OnceJson, caller: Writer) -> Response:
    """Create a mapping study."""

    def act(session: Session) -> Response:
        catalogue = catalogue_with_roles(_catheters(body.catheters), body.reference)
        study = studies.create(session, body.label, chamber=body.chamber, notes=body.notes, catalogue=catalogue)
        return JSONResponse(_shape(study).model_dump(mode="json"), 201, {"Location": f"/v1/studies/{study.id}"})

    return once.answer(act)


@router.get("", responses=responses(400, 401, 403, 422))
def list_studies(pages: Pages, caller: Reader) -> Page[StudyOut]:
    """List the studies, the newest first."""
    with reading() as session:
        return pages.page_of_newest(pages.newest_first(session, _STUDIES), _shape)


@router.get("/{study_id}", responses=responses(401, 403, 404))
def get_study(study_id: StudyId, caller: Reader) -> StudyOut:
    """Return one study."""
    with reading() as session:
        return _shape(studies.get(session, study_id))


@router.patch("/{study_id}", responses=responses(400, 401, 403, 404, 409, 422))
def change_study(study_id: StudyId, body: StudyPatch, caller: Writer) -> StudyOut:
    """Change a study.

    Jobs that run keep the study of their start.
    """
    changes = body.model_dump(exclude_unset=True)
    with writing() as session:
        study = studies.lock(session, study_id)
        if "label" in changes and body.label is None:
            raise Problem(422, "invalid", "A study needs a label.", [("label", "must not be null")])
        for name in ("label", "chamber", "notes"):
            if name in changes:
                setattr(study, name, changes[name])
        if "catheters" in changes or "reference" in changes:
            catalogue = _changed_catalogue(study, body)
            _check_corrections(session, study, catalogue)
            set_catalogue(study, catalogue)
        if "gantry" in changes:
            study.gantry = changed_gantry(study.gantry, body.gantry)
            session.flush()
            check_gantry(study.gantry)
            for run in runs_of(session, study_id):
                check_gantry(run.gantry_with(study.gantry))
        session.flush()
        session.refresh(study)
        return _shape(study)


def _catheters(given: list[CatheterIn] | None) -> tuple[Catheter, ...]:
    return tuple(item.catheter() for item in given or ()) or DEFAULT_CATALOGUE.catheters


def _changed_catalogue(study: Study, body: StudyPatch) -> Catalogue:
    changed = "catheters" in body.model_fields_set
    catheters = _catheters(body.catheters) if changed else catalogue_of(study).catheters
    remains = len(catheters) > 1 and study.reference in {item.name for item in catheters}
    keeps_reference = "reference" not in body.model_fields_set and remains
    return catalogue_with_roles(catheters, study.reference if keeps_reference else body.reference)


def _check_corrections(session: Session, study: Study, catalogue: Catalogue) -> None:
    """Check that the catheters of all electrodes set by hand stay in the study."""
    electrodes = {(item.name, number) for item in catalogue.catheters for number in range(1, item.electrodes + 1)}
    for frames in corrections.of_study(session, study.id).values():
        corrected = {(electrode.catheter, electrode.electrode) for frame in frames.values() for electrode in frame}
        if not corrected <= electrodes:
            raise Problem(
                409,
                "electrodes_marked",
                "This change removes a catheter that has electrodes set by hand; delete those electrodes first.",
            )


@router.delete("/{study_id}", status_code=204, response_class=Response, responses=responses(401, 403, 404, 409))
def delete_study(study_id: StudyId, caller: Writer) -> None:
    """Delete a study with its jobs.

    The files that nothing else refers to are deleted too, and the table that leads back from de-identified exports. The
    answer is 409 while a job runs. `GET /v1/deletions/{study_id}` gives the certificate.
    """
    with writing() as session:
        unreferenced = deletion.delete(session, study_id, caller)
    deletion.remove_files(study_id, unreferenced)
