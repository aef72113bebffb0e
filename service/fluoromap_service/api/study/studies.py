"""Mapping studies: one rhythm of one patient."""

from __future__ import annotations

from typing import Annotated, Self

from fastapi import APIRouter, Path, Response
from fastapi.responses import JSONResponse
from pydantic import BaseModel, ConfigDict, Field, JsonValue, StringConstraints, model_validator
from sqlalchemy.orm import Session

from fluoromap.catheters import CATHETER_TYPES, DEFAULT_CATALOGUE, Catheter, catheter_type
from fluoromap_service.api.http.idempotency import OnceJson
from fluoromap_service.api.http.paging import Page, Pages
from fluoromap_service.api.http.problems import responses
from fluoromap_service.api.http.security import Reader, Writer
from fluoromap_service.api.http.timestamps import rfc3339
from fluoromap_service.problem import Problem
from fluoromap_service.store.engine import reading, writing
from fluoromap_service.store.models import Study
from fluoromap_service.study import corrections, studies
from fluoromap_service.study.instances import unlink_unreferenced

router = APIRouter(prefix="/v1/studies", tags=["studies"])

StudyId = Annotated[str, Path(description="The study's id.")]
Line = Annotated[str, StringConstraints(pattern=r"^[^\x00-\x1f\x7f]*[^\x00-\x20\x7f][^\x00-\x1f\x7f]*$")]
"""Text of one line that is not blank."""
Millimetres = Annotated[float, Field(gt=0, le=100, allow_inf_nan=False)]

_CATHETERS: list[JsonValue] = [
    {"name": "reference", "electrodes": 4, "spacing_mm": [3.5, 6.0, 3.0], "tip_mm": 2.0, "ring_mm": 1.0},
    {"name": "mapping", "electrodes": 4, "edge_spacing_mm": [2.0, 5.0, 2.0], "tip_mm": 4.0, "ring_mm": 1.3},
    {"name": "coronary sinus", "type": "decapolar-2-5-2"},
]


class CatheterIn(BaseModel):
    """A catheter by the name of its type, or as its maker describes it; electrode 1 is the tip."""

    model_config = ConfigDict(extra="forbid", json_schema_extra={"examples": _CATHETERS})
    name: Line = Field(min_length=1, max_length=64)
    type: str | None = Field(
        None, max_length=64, description=f"Instead of all lengths, one of: {', '.join(CATHETER_TYPES)}."
    )
    electrodes: int | None = Field(None, ge=2, le=64)
    spacing_mm: list[Millimetres] | None = Field(
        None, description="From electrode centre to electrode centre along the shaft, from the tip on."
    )
    edge_spacing_mm: list[Millimetres] | None = Field(
        None, description="From electrode edge to electrode edge, as labels (2-5-2) give it; instead of spacing_mm."
    )
    tip_mm: Millimetres | None = Field(None, description="Length of the tip electrode.")
    ring_mm: Millimetres | None = Field(None, description="Length of each ring along the shaft.")

    @model_validator(mode="after")
    def _one_description(self) -> Self:
        self.catheter()
        return self

    def catheter(self) -> Catheter:
        """Return the catheter; a ValueError says what is missing."""
        lengths = self.electrodes, self.tip_mm, self.ring_mm
        if self.type is not None:
            if any(value is not None for value in (*lengths, self.spacing_mm, self.edge_spacing_mm)):
                raise ValueError("give either type or electrodes and lengths")
            return catheter_type(self.type, self.name)
        if self.electrodes is None or self.tip_mm is None or self.ring_mm is None:
            raise ValueError("give a type, or electrodes, tip_mm, ring_mm and a spacing")
        if (self.spacing_mm is None) == (self.edge_spacing_mm is None):
            raise ValueError("give either spacing_mm or edge_spacing_mm")
        if self.edge_spacing_mm is not None:
            return Catheter.from_edge_spacing(
                self.name, self.electrodes, tuple(self.edge_spacing_mm), self.tip_mm, self.ring_mm
            )
        return Catheter(self.name, self.electrodes, tuple(self.spacing_mm or ()), self.tip_mm, self.ring_mm)


class StudyIn(BaseModel):
    """A new study."""

    model_config = ConfigDict(
        extra="forbid",
        json_schema_extra={"examples": [{"label": "Dog 3, sinus rhythm", "chamber": "right ventricle"}]},
    )
    label: Line = Field(min_length=1, max_length=200, description="Your own name for it; no patient name.")
    chamber: Line | None = Field(None, max_length=100)
    catheters: list[CatheterIn] | None = Field(
        None, max_length=32, description="Default: reference, pacing and mapping, 4 electrodes each."
    )
    reference: Line | None = Field(
        None, max_length=64, description="The catheter that coordinates are counted from; by default the one named so."
    )
    notes: str | None = Field(None, max_length=10_000)


class StudyPatch(BaseModel):
    """What to change; members left out stay."""

    model_config = ConfigDict(extra="forbid", json_schema_extra={"examples": [{"notes": "pacing from the apex"}]})
    label: Line | None = Field(None, min_length=1, max_length=200)
    chamber: Line | None = Field(None, max_length=100)
    catheters: list[CatheterIn] | None = Field(None, max_length=32)
    reference: Line | None = Field(None, max_length=64)
    notes: str | None = Field(None, max_length=10_000)


class CatheterOut(BaseModel):
    name: str
    electrodes: int
    spacing_mm: list[float]
    tip_mm: float
    ring_mm: float


class StudyOut(BaseModel):
    """A mapping study."""

    id: str = Field(examples=["5d0c2f6e0c7b4b0f9a4de4d0c3a1b2f4"])
    label: str = Field(examples=["Dog 3, sinus rhythm"])
    chamber: str | None = Field(examples=["right ventricle"])
    catheters: list[CatheterOut]
    reference: str = Field(examples=["reference"])
    mapping: str = Field(description="The catheter whose tip maps.", examples=["mapping"])
    notes: str | None = Field(examples=[None])
    created: str = Field(examples=["2026-03-01T09:30:00.000Z"])
    updated: str = Field(examples=["2026-03-01T09:30:00.000Z"])


def _shape(study: Study) -> StudyOut:
    return StudyOut(
        id=study.id,
        label=study.label,
        chamber=study.chamber,
        catheters=[CatheterOut(**row) for row in study.catheters],
        reference=study.reference,
        mapping=study.mapping,
        notes=study.notes,
        created=rfc3339(study.created),
        updated=rfc3339(study.updated),
    )


@router.post("", status_code=201, response_model=StudyOut, responses=responses(400, 401, 403, 422))
def create_study(body: StudyIn, once: OnceJson, caller: Writer) -> Response:
    """Make a mapping study."""

    def act(session: Session) -> Response:
        given = tuple(item.catheter() for item in body.catheters or ()) or DEFAULT_CATALOGUE.catheters
        catalogue = studies.catalogue_with_roles(given, body.reference)
        study = studies.create(session, body.label, chamber=body.chamber, notes=body.notes, catalogue=catalogue)
        return JSONResponse(_shape(study).model_dump(), 201, {"Location": f"/v1/studies/{study.id}"})

    return once.answer(act)


@router.get("", responses=responses(400, 401, 403, 422))
def list_studies(paging: Pages, caller: Reader) -> Page[StudyOut]:
    """Studies, newest first."""
    after = paging.key(float, str)
    with reading() as session:
        found = studies.newest_first(session, paging.limit + 1, None if after is None else (after[0], after[1]))
        return paging.page(found, _shape, lambda study: (study.created, study.id))


@router.get("/{study_id}", responses=responses(401, 403, 404))
def get_study(study_id: StudyId, caller: Reader) -> StudyOut:
    """One study."""
    with reading() as session:
        return _shape(studies.get(session, study_id))


@router.patch("/{study_id}", responses=responses(400, 401, 403, 404, 409, 422))
def change_study(study_id: StudyId, body: StudyPatch, caller: Writer) -> StudyOut:
    """Change a study; jobs that run keep what they began with."""
    changes = body.model_dump(exclude_unset=True)
    with writing() as session:
        study = studies.lock(session, study_id)
        if "label" in changes and body.label is None:
            raise Problem(422, "invalid", "A study needs a label.", [("label", "must not be null")])
        for name in ("label", "chamber", "notes"):
            if name in changes:
                setattr(study, name, changes[name])
        if "catheters" in changes or "reference" in changes:
            _change_catheters(session, study, body)
        session.flush()
        session.refresh(study)
        return _shape(study)


def _change_catheters(session: Session, study: Study, body: StudyPatch) -> None:
    if "catheters" in body.model_fields_set:
        given = tuple(item.catheter() for item in body.catheters or ()) or DEFAULT_CATALOGUE.catheters
    else:
        given = studies.catalogue_of(study).catheters
    keeps_reference = "reference" not in body.model_fields_set and study.reference in {item.name for item in given}
    catalogue = studies.catalogue_with_roles(given, study.reference if keeps_reference else body.reference)
    electrodes = {(item.name, number) for item in given for number in range(1, item.electrodes + 1)}
    for frames in corrections.of_study(session, study.id).values():
        if any(
            (correction.catheter, correction.electrode) not in electrodes
            for placed in frames.values()
            for correction in placed
        ):
            raise Problem(
                409,
                "electrodes_marked",
                "Electrodes marked by hand belong to a catheter that would go; delete them first.",
            )
    study.catheters = studies.catheter_rows(catalogue)
    study.reference, study.mapping = catalogue.reference, catalogue.mapping


@router.delete("/{study_id}", status_code=204, response_class=Response, responses=responses(401, 403, 404, 409))
def delete_study(study_id: StudyId, caller: Writer) -> None:
    """Delete a study with its jobs, and the files nothing else refers to; 409 while a job runs."""
    with writing() as session:
        gone = studies.remove(session, study_id)
    unlink_unreferenced(gone)
