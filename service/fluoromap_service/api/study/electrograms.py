"""The route of electrograms, which give activation times."""

from __future__ import annotations

from fastapi import Request
from pydantic import BaseModel, Field
from starlette.concurrency import run_in_threadpool

from fluoromap.electrogram import UnusableElectrogram, activation_time
from fluoromap_service.api.http.paths import SiteName, StudyId
from fluoromap_service.api.http.problems import responses
from fluoromap_service.api.http.routers import new_router
from fluoromap_service.api.http.security import Writer
from fluoromap_service.api.study.csv_input import csv_body, csv_text, electrogram
from fluoromap_service.problem import Problem
from fluoromap_service.store.engine import reading, writing
from fluoromap_service.study import sites, studies

router = new_router("/v1/studies/{study_id}", tags=["sites"])


class ElectrogramOut(BaseModel):
    """The activation time of a site by its electrograms."""

    lat_ms: float = Field(
        description="Mapping minus reference in the same beat, the mean of the beats.", examples=[41.0]
    )
    sd_ms: float = Field(description="Its standard deviation.", examples=[1.2])
    reference_ms: float = Field(
        description="Steepest negative deflection of the reference in a typical beat.", examples=[112.0]
    )
    mapping_ms: float = Field(
        description="Steepest negative deflection of the mapping catheter in that beat.", examples=[153.0]
    )
    beats: int = Field(description="Number of beats that count.", examples=[3])
    warnings: list[str]


@router.put(
    "/electrograms/{site}",
    responses=responses(400, 401, 403, 404, 413, 415, 422),
    openapi_extra=csv_body("time_ms,reference,mapping\n0,0.01,0.02\n1,0.01,0.02\n"),
)
async def put_electrogram(
    study_id: StudyId,
    site: SiteName,
    request: Request,
    caller: Writer,
) -> ElectrogramOut:
    """Compute a site's activation time from its electrograms: `time_ms,reference,mapping`."""
    text = await csv_text(request)

    def act() -> ElectrogramOut:
        with reading() as session:
            studies.get(session, study_id)
        time_ms, reference, mapping = electrogram(text)
        try:
            result = activation_time(time_ms, reference, mapping)
        except UnusableElectrogram as error:
            raise Problem(422, "unusable_electrogram", str(error)) from None
        answer = ElectrogramOut(
            lat_ms=result.lat_ms,
            sd_ms=result.sd_ms,
            reference_ms=result.reference_ms,
            mapping_ms=result.mapping_ms,
            beats=result.beats,
            warnings=[str(warning) for warning in result.warnings],
        )
        with writing() as session:
            row = sites.mention(session, studies.lock(session, study_id).id, site)
            row.lat_ms, row.lat_sd_ms, row.lat_by = answer.lat_ms, answer.sd_ms, "electrogram"
        return answer

    return await run_in_threadpool(act)
